"""What happens: scripted tools, the loop that plays them, and the command line."""

from .episodes.episode import collect
from .episodes.exports.card import write_card
from .episodes.reading.torch_dataset import EpisodeDataset
from .episodes.reading.windows import Episodes, read_episodes
from .play.deformers import Theatre, open_theatre
from .play.player import Frame, Player
from .script.camera_paths import Focus, HandHeld, Microscope, Orbit
from .script.debulking import Debulking
from .script.head_posture import Lying
from .script.scene import Bounds, Scene, find_scene
from .script.shipped_files import get_template_path
from .script.sight import Sight, StereoSight
from .script.site import Site, build_site
from .script.tool import Blade, Instrument, Probe
from .script.tool_paths import Touch, draw, keep_idle, lay, palpate, press, slide, stroke_cortex
from .script.viewpoint import Viewpoint
from .tracked.calibration_file import read_calibration, write_calibration

__all__ = [
    "Blade",
    "Bounds",
    "Debulking",
    "EpisodeDataset",
    "Episodes",
    "Focus",
    "Frame",
    "HandHeld",
    "Instrument",
    "Lying",
    "Microscope",
    "Orbit",
    "Player",
    "Probe",
    "Scene",
    "Sight",
    "Site",
    "StereoSight",
    "Theatre",
    "Touch",
    "Viewpoint",
    "build_site",
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
