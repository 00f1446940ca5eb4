"""Controls of the page, such as menus, sliders and switches, with labels and hints for users."""

from collections.abc import Callable

import numpy as np

from ar.overlay.hud import name_edge_directions
from ar.overlay.styles import STYLES, Style
from ar.page.elements import STYLE_KEY
from ar.page.parts import Dropdown, Folder, Note, Slider, Toggle
from sim.effects import Elasticity, Gravity, Inertia, Pulsation, Resection, has_history

from ..script.camera_paths import PATHS
from ..script.craniotomy_frame import CraniotomyFrame
from ..script.registration import REGISTRATIONS, Registration, describe_registration
from ..script.scene import SCENES, Scene
from ..script.tool_paths import IDLE_HEIGHT, Touch
from .requests import HAND, SCRIPT, Requests
from .side_panels import TIP, TUMOUR_MIDDLE
from .text import describe_deformer

MAX_FORCE = 0.4  # End of the force slider [N].
MAX_DEPTH = 8.0  # End of the depth slider [mm], where the scene's script does not go deeper.
MAX_TILT = 40.0  # End of the direction sliders [deg].
STATIC_CAMERA = "stays"
"""Label of the menu entry for a static camera."""
PLAN = "solver details (advanced)"
"""Label of the note that lists the solvers."""
REFINED_ERROR = "refined error"
"""Label of the note on the refined error."""
REFINE_HINT = "solves this load for 16 sampled patients in the background, for minutes"  # Hint of the switch.
OWN_FILM = "your own video or camera"
"""Label of the note on own videos."""
# Text of the note on own videos.
OWN_VIDEO_NOTE = (  # Text of that note.
    "<p>The same page can show your own video, or a camera of this machine, with the tumour overlay:</p>"
    "<p><code>sulcus overlay VIDEO --page --camera K.yaml --registration R.json --tool T.json</code></p>"
    "<p>A camera's number instead of the video selects that camera. <code>sulcus film palpate --out film</code> makes "
    "a test video. <code>sulcus overlay --help</code> lists the command that makes each file.</p>"
)
MANUAL_HINT = "Moving a slider switches to manual control; automatic returns to the script."  # Hint on manual control.


def build_controls(
    scene: Scene,
    site: CraniotomyFrame,
    deformers: tuple[str, ...],
    requests: Requests,
    set_mode: Callable[[str], None],
    move: Callable[..., None],
    effect_switches: Folder,
    refine_error: Callable[[], None],
) -> list[Slider | Dropdown | Toggle | Folder | Note]:
    """Build all controls of a scene; `deformers` are the names of the available deformers.

    Callbacks: `set_mode` receives the control mode of the tool, `move` receives changed values of the tool input (see
    `Requests.set_manual_input`), and `refine_error` starts the refinement of the error.
    """
    cameras = "scene default", STATIC_CAMERA, *PATHS

    def select_path(name: str) -> None:
        requests.set(path="" if name == cameras[0] else name)

    models = {describe_deformer(name): name for name in deformers}
    tool_controls = [] if scene.tool is None else build_tool_controls(scene, site, requests, set_mode, move)
    scenes = SCENES if scene.name in SCENES else (scene.name, *SCENES)
    return [
        Dropdown("scene", scenes, scene.name, lambda name: requests.set(scene=name), hint="cause of the deformation"),
        Dropdown(
            "deformer",
            tuple(models),
            describe_deformer(requests.deformer),
            lambda label: requests.set(deformer=models[label]),
            "model",
            "FEM solves every load; the fast models were trained on FEM",
        ),
        build_style_controls(requests.style, lambda style: requests.set(style=style)),
        Dropdown("camera", cameras, requests.path or cameras[0], select_path, hint="motion of the camera"),
        *tool_controls[:1],
        effect_switches,
        *tool_controls[1:],
        build_registration_control(scene, requests),
        Toggle("refine the error", False, lambda on: refine_error() if on else None, hint=REFINE_HINT),
        Note(REFINED_ERROR),
        Folder("camera position", build_camera_sliders(scene, site, requests)),
        Note(PLAN),
        Note(OWN_FILM, OWN_VIDEO_NOTE),
    ]


def build_style_controls(current_style: Style, set_style: Callable[[Style], None]) -> Dropdown:
    """Build the menu of the overlay styles."""
    styles: dict[str, Style] = {label: style for style, label in STYLES.items()}
    return Dropdown(
        "overlay",
        tuple(styles),
        STYLES[current_style],
        lambda label: set_style(styles[label]),
        hint="style of the overlay",
        key=STYLE_KEY,
    )


def build_registration_control(scene: Scene, requests: Requests) -> Dropdown:
    """Build the menu of the registration error between scan and patient."""
    names: dict[str, Registration] = {describe_registration(size): name for name, size in REGISTRATIONS.items()}
    current = describe_registration(REGISTRATIONS[requests.registration or scene.registration])
    hint = "error of the scan's registration to the patient; it is part of the error of the tumour's position"
    return Dropdown("registration", tuple(names), current, lambda key: requests.set(registration=names[key]), hint=hint)


def build_slice_control(current_position: str, set_position: Callable[[str], None]) -> Dropdown:
    """Build the menu of the position of the scan slices."""
    places = TUMOUR_MIDDLE, TIP
    hint = "position of the scan slices (tab slices)"
    return Dropdown("slices", places, current_position or places[0], set_position, hint=hint)


def build_camera_sliders(scene: Scene, site: CraniotomyFrame, requests: Requests) -> tuple[Slider, Slider]:
    """Build the sliders of the camera's tilt and distance; they start at the scene's values."""
    camera = scene.viewpoint.build_camera(site)
    offset = camera.centre - scene.viewpoint.find_target(site)
    distance = float(np.linalg.norm(offset))
    tilt = np.degrees(np.arccos(np.clip(-offset @ site.axis / distance, -1.0, 1.0)))
    return (
        Slider(
            "camera tilt [deg]", -60.0, 60.0, 1.0, round(float(tilt)), lambda deg: requests.set(tilt=-np.radians(deg)),
            text="tilt [deg]", hint="angle between the line of sight and the axis of the craniotomy",
        ),
        Slider(
            "camera distance [mm]", 150.0, 600.0, 10.0, round(1e3 * distance, -1),
            lambda mm: requests.set(distance=1e-3 * mm), text="distance [mm]", hint="a smaller distance magnifies",
        ),
    )  # fmt: skip


def is_animated(scene: Scene, site: CraniotomyFrame) -> bool:
    """Return True if the scene evolves without tool input."""
    effects = scene.get_effects_on(site.anatomy)
    relaxing = has_history(effect for effect in effects if isinstance(effect, Elasticity))
    return relaxing or any(isinstance(effect, Gravity | Inertia | Pulsation | Resection) for effect in effects)


def build_tool_controls(
    scene: Scene, site: CraniotomyFrame, requests: Requests, set_mode: Callable[[str], None], move: Callable[..., None]
) -> list[Slider | Dropdown]:
    """Build controls of the tool (mode, strength, position, direction) and of the slices; labels name patient sides."""
    assert scene.tool is not None
    limit = max(0.5, np.floor(2e3 * (site.clearance - scene.tool.radius)) / 2.0)
    sides = name_edge_directions(scene.viewpoint.build_camera(site).T_camera_world[:3, :3])
    limit_hint = "limited by the edge of the craniotomy"
    tilt_hint = "direction of the push: tilt from the surface normal"
    directions = (("right", "x", sides["right"]), ("up", "y", sides["top"]))
    positions = (
        Slider(
            f"place {name} [mm]", -limit, limit, 0.5, 0.0, lambda value, axis=axis: move(**{axis: 1e-3 * value}),
            f"position {name} (to {side}) [mm]", limit_hint,
        )
        for name, axis, side in directions
    )  # fmt: skip
    tilts = (
        Slider(
            f"direction {name} [deg]", -MAX_TILT, MAX_TILT, 1.0, 0.0,
            lambda value, name=name: move(**{f"tilt_{name}": np.radians(value)}),
            f"tilt {name} (to {side}) [deg]", tilt_hint,
        )
        for name, _, side in directions
    )  # fmt: skip
    return [
        Dropdown("tool", (SCRIPT, HAND), SCRIPT, set_mode, hint=MANUAL_HINT),
        build_strength_slider(scene, requests, move),
        *positions,
        *tilts,
        build_slice_control(requests.through, lambda name: requests.set(through=name)),
    ]


def to_slider_values(scene: Scene, touch: Touch) -> dict[str, float]:
    """Convert a tool input to the values of the tool's sliders, by slider label."""
    strength = {"depth [mm]": 1e3 * touch.depth} if scene.posed else {"force [N]": touch.force}
    positions = {"place right [mm]": 1e3 * touch.x, "place up [mm]": 1e3 * touch.y}
    tilts = {f"direction {key} [deg]": np.degrees(tilt) for key, tilt in zip(("right", "up"), touch.tilt, strict=True)}
    return {label: round(float(value), 2) for label, value in (strength | positions | tilts).items()}


def build_strength_slider(scene: Scene, requests: Requests, move: Callable[..., None]) -> Slider:
    """Build the slider of the tool force, or of the depth if the scene moves the tool by its pose."""
    touch = requests.touch
    if scene.posed:
        low = -1e3 * IDLE_HEIGHT
        high = max(MAX_DEPTH, round(1e3 * scene.max_depth, 1))
        start = min(max(1e3 * touch.depth, low), high)
        hint = "depth of the tool beyond first contact; negative: no contact"
        return Slider("depth [mm]", low, high, 0.1, start, lambda value: move(depth=1e-3 * value), hint=hint)
    start = min(touch.force, MAX_FORCE)
    return Slider("force [N]", 0.0, MAX_FORCE, 0.01, start, lambda value: move(force=value), hint="force of the tool")
