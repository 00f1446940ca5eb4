"""Controls of the page, labelled for users."""

from collections.abc import Callable

import numpy as np

from ar.overlay.hud import name_bearings
from ar.overlay.styles import STYLES, Style
from ar.page.elements import STYLE_KEY
from ar.page.parts import Dropdown, Fold, Note, Slider, Toggle
from sim.effects import Elasticity, Gravity, Inertia, Pulsation, Resection, remember

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
"""Label of a static camera."""
PLAN = "solver details (advanced)"
"""Label of the note on the solvers."""
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
    names: tuple[str, ...],
    wish: Requests,
    give: Callable[[str], None],
    take: Callable[..., None],
    effects: Fold,
    refine: Callable[[], None],
) -> list[Slider | Dropdown | Toggle | Fold | Note]:
    """Build all controls of a scene that these deformers support.

    `give` receives who gets the tool, `take` numbers of its touch, as `Requests.take_over` does; `effects` are the
    switches of the effects; `refine` starts the refinement of the error.
    """
    cameras = "scene default", STATIC_CAMERA, *PATHS

    def film(name: str) -> None:
        wish.set(path="" if name == cameras[0] else name)

    models = {describe_deformer(name): name for name in names}
    slices = build_slice_control(wish.through, lambda name: wish.set(through=name))
    hand = [] if scene.tool is None else [*build_tool_controls(scene, site, wish, give, take), slices]
    scenes = SCENES if scene.name in SCENES else (scene.name, *SCENES)
    return [
        Dropdown("scene", scenes, scene.name, lambda name: wish.set(scene=name), hint="what deforms the brain"),
        Dropdown(
            "deformer",
            tuple(models),
            describe_deformer(wish.deformer),
            lambda words: wish.set(deformer=models[words]),
            "model",
            "FEM solves every load; the fast models were trained on FEM",
        ),
        add_overlay_controls(wish.style, lambda style: wish.set(style=style)),
        Dropdown("camera", cameras, wish.path or cameras[0], film, hint="motion of the camera"),
        *hand[:1],
        effects,
        *hand[1:],
        build_registration_control(scene, wish),
        Toggle("refine the error", False, lambda on: refine() if on else None, hint=REFINE_HINT),
        Note(REFINED_ERROR),
        Fold("camera position", build_camera_sliders(scene, site, wish)),
        Note(PLAN),
        Note(OWN_FILM, OWN_VIDEO_NOTE),
    ]


def add_overlay_controls(now: Style, choose: Callable[[Style], None]) -> Dropdown:
    """Build the choice of overlay styles."""
    styles: dict[str, Style] = {words: style for style, words in STYLES.items()}
    return Dropdown(
        "overlay",
        tuple(styles),
        STYLES[now],
        lambda words: choose(styles[words]),
        hint="style of the overlay",
        key=STYLE_KEY,
    )


def build_registration_control(scene: Scene, wish: Requests) -> Dropdown:
    """Build the choice of the registration of the scan to the patient."""
    names: dict[str, Registration] = {describe_registration(size): name for name, size in REGISTRATIONS.items()}
    now = describe_registration(REGISTRATIONS[wish.registration or scene.registration])
    hint = "error of the scan's registration to the patient; it is part of the error of the tumour's position"
    return Dropdown("registration", tuple(names), now, lambda words: wish.set(registration=names[words]), hint=hint)


def build_slice_control(now: str, choose: Callable[[str], None]) -> Dropdown:
    """Build the choice of slice positions."""
    places = TUMOUR_MIDDLE, TIP
    hint = "position of the scan slices (tab slices)"
    return Dropdown("slices", places, now or places[0], choose, hint=hint)


def build_camera_sliders(scene: Scene, site: CraniotomyFrame, wish: Requests) -> tuple[Slider, Slider]:
    """Build the sliders of the camera's tilt and distance, at the scene's own."""
    camera = scene.viewpoint.build_camera(site)
    away = camera.centre - scene.viewpoint.find_target(site)
    length = float(np.linalg.norm(away))
    tilt = np.degrees(np.arccos(np.clip(-away @ site.axis / length, -1.0, 1.0)))
    return (
        Slider(
            "camera tilt [deg]", -60.0, 60.0, 1.0, round(float(tilt)), lambda value: wish.set(tilt=-np.radians(value)),
            words="tilt [deg]", hint="angle between the line of sight and the axis of the craniotomy",
        ),
        Slider(
            "camera distance [mm]", 150.0, 600.0, 10.0, round(1e3 * length, -1),
            lambda value: wish.set(distance=1e-3 * value), words="distance [mm]", hint="a smaller distance magnifies",
        ),
    )  # fmt: skip


def is_animated(scene: Scene, site: CraniotomyFrame) -> bool:
    """Return True if the scene evolves without tool input."""
    effects = scene.get_effects_on(site.anatomy)
    relaxing = remember(effect for effect in effects if isinstance(effect, Elasticity))
    return relaxing or any(isinstance(effect, Gravity | Inertia | Pulsation | Resection) for effect in effects)


def build_tool_controls(
    scene: Scene, site: CraniotomyFrame, wish: Requests, give: Callable[[str], None], take: Callable[..., None]
) -> list[Slider | Dropdown]:
    """Build the controls of the tool: who holds it, and its position within the opening, in patient directions."""
    assert scene.tool is not None
    room = max(0.5, np.floor(2e3 * (site.clearance - scene.tool.radius)) / 2.0)
    sides = name_bearings(scene.viewpoint.build_camera(site).T_camera_world[:3, :3])
    stops = "limited by the edge of the craniotomy"
    against = "direction of the push: tilt from the surface normal"
    ways = (("right", "x", sides["right"]), ("up", "y", sides["top"]))
    places = (
        Slider(
            f"place {way} [mm]", -room, room, 0.5, 0.0, lambda value, axis=axis: take(**{axis: 1e-3 * value}),
            f"{way}, to {side} [mm]", stops,
        )
        for way, axis, side in ways
    )  # fmt: skip
    tilts = (
        Slider(
            f"direction {way} [deg]", -MAX_TILT, MAX_TILT, 1.0, 0.0,
            lambda value, way=way: take(**{way: np.radians(value)}), f"tilt {way}, to {side} [deg]", against,
        )
        for way, _, side in ways
    )  # fmt: skip
    return [
        Dropdown("tool", (SCRIPT, HAND), SCRIPT, give, hint=MANUAL_HINT),
        build_strength_slider(scene, wish, take),
        *places,
        *tilts,
    ]


def to_slider_values(scene: Scene, touch: Touch) -> dict[str, float]:
    """Values of the tool's sliders at a touch, by their labels."""
    strong = {"depth [mm]": 1e3 * touch.depth} if scene.posed else {"force [N]": touch.force}
    places = {"place right [mm]": 1e3 * touch.x, "place up [mm]": 1e3 * touch.y}
    tilts = {f"direction {way} [deg]": np.degrees(tilt) for way, tilt in zip(("right", "up"), touch.tilt, strict=True)}
    return {label: round(float(value), 2) for label, value in (strong | places | tilts).items()}


def build_strength_slider(scene: Scene, wish: Requests, take: Callable[..., None]) -> Slider:
    """Build the slider of the force, or of the depth of a posed tool."""
    touch = wish.touch
    if scene.posed:
        low = -1e3 * IDLE_HEIGHT
        high = max(MAX_DEPTH, round(1e3 * scene.max_depth, 1))
        now = min(max(1e3 * touch.depth, low), high)
        hint = "how far the tool is beyond where it just touches; negative: in the air"
        return Slider("depth [mm]", low, high, 0.1, now, lambda value: take(depth=1e-3 * value), hint=hint)
    return Slider(
        "force [N]",
        0.0,
        MAX_FORCE,
        0.01,
        min(touch.force, MAX_FORCE),
        lambda value: take(force=value),
        hint="how hard it pushes",
    )
