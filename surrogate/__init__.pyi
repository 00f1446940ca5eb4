"""What was learnt about tissue: data sets, regressors, and deformers made of them."""

from .data.dataset import Dataset, read_dataset
from .data.simulate import simulate
from .data.tool_loads import draw
from .data.tool_poses import draw_poses
from .evaluation.coverage import Coverage, compute_coverage
from .evaluation.score import Score, score
from .fitting.fit import fit_tissue
from .fitting.observed_frame import ObservedFrame, Tool, read_tools
from .fitting.tissue import FittedTissue, load_tissue, save_tissue
from .locating.locator import Location, Locator
from .locating.locator_store import load_locator, make_locator, save_locator
from .locating.observation import Observation
from .locating.observed_files import read_observation
from .model.guarded import Guarded
from .model.learned import Learned
from .model.own_learners import register_learner
from .model.store import load, save
from .onnx_export.export import build_onnx_model, write_onnx
from .regressors.protocol import Regressor
from .training.train import Trained, train

__all__ = [
    "Coverage",
    "Dataset",
    "FittedTissue",
    "Guarded",
    "Learned",
    "Location",
    "Locator",
    "Observation",
    "ObservedFrame",
    "Regressor",
    "Score",
    "Tool",
    "Trained",
    "build_onnx_model",
    "compute_coverage",
    "draw",
    "draw_poses",
    "fit_tissue",
    "load",
    "load_locator",
    "load_tissue",
    "make_locator",
    "read_dataset",
    "read_observation",
    "read_tools",
    "register_learner",
    "save",
    "save_locator",
    "save_tissue",
    "score",
    "simulate",
    "train",
    "write_onnx",
]
