"""Files that ship with the package."""

from importlib.resources import files
from pathlib import Path


def get_template_path() -> Path:
    """Return the path of the template anatomy, a .vtu; its scan and its models are next to it."""
    return Path(str(files("scenes"))) / "data" / "template.vtu"


def get_gym_model_path() -> Path:
    """Return the path of the model of the gym's blade poses on the template, for tissue without relaxation."""
    return get_template_path().with_suffix(".gym.npz")
