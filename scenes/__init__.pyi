"""What happens: scripted tools, the loop that plays them, and the command line."""

from .episodes.episode import collect
from .episodes.exports.card import write_card
from .episodes.reading.torch_dataset import EpisodeDataset
from .episodes.reading.windows import Episodes, read_episodes
from .play.deformers import PatientSetup, open_theatre
from .play.player import Frame, Player
from .script.camera_paths import Focus, HandHeld, Microscope, Orbit
from .script.craniotomy_frame import CraniotomyFrame, build_craniotomy_frame
from .script.debulking import Debulking
from .script.head_pose import HeadPose
from .script.observation_models import PointObservation, StereoObservation
from .script.scene import Bounds, Scene, find_scene
from .script.shipped_files import get_template_path
from .script.tool import Blade, Instrument, Probe
from .script.tool_paths import Touch, draw, keep_idle, lay, palpate, press, slide, stroke_cortex
from .script.viewpoint import Viewpoint
from .tracked.calibration_file import read_calibration, write_calibration

__all__ = [
    "Blade",
    "Bounds",
    "CraniotomyFrame",
    "Debulking",
    "EpisodeDataset",
    "Episodes",
    "Focus",
    "Frame",
    "HandHeld",
    "HeadPose",
    "Instrument",
    "Microscope",
    "Orbit",
    "PatientSetup",
    "Player",
    "PointObservation",
    "Probe",
    "Scene",
    "StereoObservation",
    "Touch",
    "Viewpoint",
    "build_craniotomy_frame",
    "collect",
    "draw",
    "find_scene",
    "get_template_path",
    "keep_idle",
    "lay",
    "open_theatre",
    "palpate",
    "press",
    "read_calibration",
    "read_episodes",
    "slide",
    "stroke_cortex",
    "write_calibration",
    "write_card",
]
