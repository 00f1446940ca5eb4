"""What the surgeon sees: triangles and cameras in, pixels out. Knows no brain."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
