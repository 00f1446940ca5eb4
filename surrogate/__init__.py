"""Trained models of tissue: data sets, regressors, and deformers built from them."""

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
FORMER = {
    "Frame": "ObservedFrame",
    "coverage": "compute_coverage",
    "learner": "register_learner",
    "onnx_model": "build_onnx_model",
}
"""Former names of public names, mapped to the current names; they work for one more release."""


def __getattr__(name):
    """Load a public name of this package by its current or its former name."""
    return _load(FORMER.get(name, name))
