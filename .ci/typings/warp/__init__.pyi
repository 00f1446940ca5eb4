# Kernel bodies are Warp's own language, which a Python type checker cannot read: to it, everything of Warp is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
