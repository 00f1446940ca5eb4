"""Paths of the data files in the package."""

from importlib.resources import files
from pathlib import Path


def get_template_path() -> Path:
    """Return the path of the template anatomy (.vtu); its scan and its models are in the same folder."""
    return Path(str(files("scenes"))) / "data" / "template.vtu"


def get_gym_model_path() -> Path:
    """Return the path of the gym's trained model for blade poses on the template, for tissue without relaxation."""
    return get_template_path().with_suffix(".gym.npz")
