"""What happens: scripted tools, the loop that plays them, and the command line."""

from .play.deformers import Theatre, open_theatre
from .play.episode import collect
from .play.player import Frame, Player
from .script.debulking import Debulking
from .script.head_posture import Lying
from .script.scene import Bounds, Scene, Viewpoint, find_scene
from .script.shipped_files import template_path
from .script.sight import Sight
from .script.site import Site, site_of
from .script.tool import Blade, Instrument, Probe
from .script.tool_paths import Touch, draw, idle, lay, palpate, press, slide, wander

__all__ = [
    "Blade",
    "Bounds",
    "Debulking",
    "Frame",
    "Instrument",
    "Lying",
    "Player",
    "Probe",
    "Scene",
    "Sight",
    "Site",
    "Theatre",
    "Touch",
    "Viewpoint",
    "collect",
    "draw",
    "find_scene",
    "idle",
    "lay",
    "open_theatre",
    "palpate",
    "press",
    "site_of",
    "slide",
    "template_path",
    "wander",
]
