"""What was learnt about tissue: data sets, regressors, and deformers made of them."""

from .data.dataset import Dataset, read_dataset
from .data.simulate import simulate
from .data.tool_loads import draw
from .data.tool_poses import draw_poses
from .evaluation.certificate import Certificate, certify
from .evaluation.coverage import Coverage, coverage
from .evaluation.score import Score, score
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
    "Regressor",
    "Score",
    "Trained",
    "certify",
    "coverage",
    "draw",
    "draw_poses",
    "learner",
    "load",
    "onnx_model",
    "read_dataset",
    "save",
    "score",
    "simulate",
    "train",
    "write_onnx",
]
