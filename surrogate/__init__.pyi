"""What was learnt about tissue: data sets, regressors, and deformers made of them."""

from .data.dataset import Dataset, read_dataset
from .data.simulate import simulate
from .data.tool_loads import draw
from .data.tool_poses import draw_poses
from .evaluation.certificate import Certificate, certify
from .evaluation.coverage import Coverage, coverage
from .evaluation.score import Score, score
from .locating.locator import Location, Locator
from .locating.locator_files import load_locator, save_locator
from .locating.observation import Observation
from .locating.observed_files import read_observation
from .locating.setup import make_locator
from .model.learned import Learned
from .model.own_learners import learner
from .model.store import load, save
from .onnx_export.export import onnx_model, write_onnx
from .regressors.protocol import Regressor
from .training.train import Trained, train

__all__ = [
    "Certificate",
    "Coverage",
    "Dataset",
    "Learned",
    "Location",
    "Locator",
    "Observation",
    "Regressor",
    "Score",
    "Trained",
    "certify",
    "coverage",
    "draw",
    "draw_poses",
    "learner",
    "load",
    "load_locator",
    "make_locator",
    "onnx_model",
    "read_dataset",
    "read_observation",
    "save",
    "save_locator",
    "score",
    "simulate",
    "train",
    "write_onnx",
]
