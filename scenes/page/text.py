"""Text of the page, as HTML: scene, anatomy, result and its reliability."""

from collections.abc import Sequence
from html import escape

import numpy as np

from ar.overlay import hud
from ar.page.elements import OPEN_DETAILS
from sim.anatomy import name_region
from sim.bodies.lobes import describe_location
from sim.deformation import Deformation, Outcome
from sim.material import Material, Tissue

from ..play.deformers import GUARDED, PatientSetup
from ..play.observer import ELLIPSOID_COLOUR, TumourEstimate
from ..play.player import Frame, is_undeformed
from ..play.stage import TRUTH_COLOUR, TUMOUR_COLOUR, Stage
from ..script.scene import Scene
from ..script.tool_paths import Touch
from ..script.uncertainty import TumourError
from .comparison import ComparisonRow
from .cost_plot import format_cost_plot

ESTIMATE_EXPLANATION = (  # Explanation of the image where the motion is estimated from the cortex.
    "The tumour's position is estimated from the dots on the cortex alone: no force and no stiffness is known."
)
WARNING = 'class="warn"'  # Mark of a warning in HTML.
RESEARCH_ONLY = "Research only. Not a medical device."  # Restriction of use.
# Names of finite elements for users.
ELEMENTS = {"p1": "linear tetrahedra", "p2": "quadratic tetrahedra", "smoothed": "smoothed linear tetrahedra"}
EFFECTS = {
    "ToolForce": "push of the tool",
    "ToolContact": "contact of the tool",
    "Retraction": "the spatula",
    "Gravity": "gravity and fluid",
    "Resection": "the resection",
    "Pulsation": "heartbeat and breath",
    "SkullContact": "contact with the skull",
    "Inertia": "inertia",
    "Elasticity": "elastic tissue",
    "Held": "fixed base of the brain",
    "Bonded": "bond to the skull",
    "Slide": "sliding along the skull",
}
"""Names of a scene's effects for users."""


def describe_effect(name: str) -> str:
    """Return the name of an effect class for users."""
    return EFFECTS.get(name, name)


def format_caption(theatre: PatientSetup, scene: Scene, anatomy: str) -> str:
    """Describe the image: visible parts, meaning of the lines, and anatomy."""
    title = " ".join(scene.title.split())
    seen = "" if scene.observation_model is None else f" {ESTIMATE_EXPLANATION}"
    return (
        f'<p class="number">Simulation: {describe_location(theatre.anatomy)} tumour '
        f"<small>{RESEARCH_ONLY}</small></p><p>{escape(title)}{seen}</p>{format_page_legend(scene)}"
        f'<p class="dim">{escape(describe_scene(theatre, scene, anatomy))}</p>'
    )


def format_page_legend(scene: Scene) -> str:
    """Build the legend of the lines, each with a sample."""
    scan = ('stroke="#ddd" stroke-width="2" stroke-dasharray="1.5 3"', "tumour in the scan")
    now, true, ellipsoid = (to_stroke(colour) for colour in (TUMOUR_COLOUR, TRUTH_COLOUR, ELLIPSOID_COLOUR))
    under = (f'{now} stroke-width="3" stroke-dasharray="5 3"', "hidden by tool, drape or bone")
    keys = [
        (f'{now} stroke-width="3"', "predicted tumour"),
        under,
        (f'{now} stroke-width="1.5" stroke-dasharray="4 3"', "95 % error band"),
        scan,
        (f'{true} stroke-width="1.5"', "FEM reference (3-D view)"),
    ]
    if scene.observation_model is not None:
        keys = [
            (f'{now} stroke-width="3"', "estimated tumour"),
            under,
            (f'{true} stroke-width="2" stroke-dasharray="8 3"', "simulated tumour (FEM)"),
            (f'{ellipsoid} stroke-width="2" stroke-dasharray="5 3"', "95 % region of the tumour centre"),
            scan,
        ]
    if scene.tool is not None:
        keys.append(('stroke="#fff" stroke-width="1.5"', "tip to tumour, in mm"))
    return format_legend(keys)


def format_legend(keys: Sequence[tuple[str, str]]) -> str:
    """Return a legend: each line's attributes as SVG has them, and what it means."""
    lines = (
        f'<span><svg width="26" height="8"><line x1="1" y1="4" x2="25" y2="4" {line}/></svg>{text}</span>'
        for line, text in keys
    )
    return f'<div class="legend">{"".join(lines)}</div>'


def to_stroke(colour: Sequence[float]) -> str:
    """Return a colour, sRGB in [0, 1], as a line has it in HTML."""
    return 'stroke="#' + "".join(f"{round(255.0 * share):02x}" for share in colour) + '"'


def describe_scene(theatre: PatientSetup, scene: Scene, anatomy: str) -> str:
    """Describe the anatomy, the side, and the tissue of the FEM model."""
    mesh = theatre.anatomy.mesh
    return f"Brain: {anatomy}; {len(mesh.nodes)} mesh points. FEM: {describe_fem(theatre, scene)}."


def describe_fem(theatre: PatientSetup, scene: Scene) -> str:
    """Element and tissue that the theatre's finite elements have in a scene."""
    element, elasticity = theatre.choose_element(scene), scene.elasticity
    own = (f"; the {name_region(label)} of {describe_tissue(one)}" for label, one in elasticity.regions.items())
    return f"{ELEMENTS.get(element, element)}, {describe_tissue(elasticity.default)}{''.join(own)}"


def describe_tissue(tissue: Tissue | None) -> str:
    """Return a tissue's law and constants."""
    if tissue is None:
        return "a tissue for each region"
    fades = ", which relaxes under a held load" if tissue.prony else ""
    if not isinstance(tissue, Material):
        return f"{tissue.law} tissue{fades}"
    return (
        f"{tissue.law} tissue of Young's modulus {1e-3 * tissue.young:g} kPa and Poisson's ratio {tissue.poisson:g}"
        f"{fades}"
    )


def describe_deformer(name: str) -> str:
    """Describe a deformer."""
    if name == GUARDED:
        return "fast model with FEM check"
    return "FEM (reference)" if name == "fem" else f"fast model ({name})"


def describe_work(scene: Scene, name: str, number: int, touch: Touch | None) -> str:
    """Describe the running solve: a frame of the script, or the manual touch."""
    if touch is None:
        return f"solving frame {number} ({describe_deformer(name)})"
    how = f"{1e3 * touch.depth:.1f} mm deep" if scene.posed else f"{touch.force:.2f} N"
    return f"computing the deformation for the manual tool, {how} ({describe_deformer(name)})"


def format_pending(shown: int, asked: int, frames: int) -> str:
    """Describe an image that does not show the requested frame yet."""
    way = f" on the way to frame {asked}, this is frame {shown} of {frames - 1}" if shown != asked else ""
    return f'<p class="stale">Result pending:{way or " it is being computed"}.</p>'


def plan_words(lines: Sequence[str]) -> str:
    """List the solvers of FEM in HTML; empty without solvers."""
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>" if lines else ""


def format_trust(answer: Deformation, name: str) -> str:
    """Describe the source of a solution and its error; as a warning with the reason, if it is unreliable."""
    outcome = answer.outcome[0]
    who = f"<b>{escape(_describe_guarded(outcome) if name == GUARDED else describe_deformer(name))}</b>"
    if outcome is Outcome.EXTRAPOLATED:
        return (
            f'<p>{who}</p><p class="warn">Do not rely on this result: the load lies outside the range that the model '
            "was trained on, so its error is not bounded.</p>"
        )
    if not outcome.good:
        return f'<p>{who}</p><p class="warn">Do not rely on this result: {escape(outcome.value)}.</p>'
    how = "inside the range that it was trained on" if outcome is Outcome.PREDICTED else "converged"
    if is_undeformed(answer):
        return f"<p>{who}: {how}. Nothing moves the tumour.</p>"
    bound = float(answer.bound[0, 0])
    if not np.isfinite(bound):
        return f"<p>{who}: {how}.</p>"
    return (
        f"<p>{who}: {how}. Surrogate error (95 %): at most {hud.bound_words(bound, 2)} at any point of the tumour, "
        "relative to FEM.</p>"
    )


def _describe_guarded(outcome: Outcome) -> str:
    """Describe which of the two computed the solution of a guarded model."""
    by_model = outcome in (Outcome.PREDICTED, Outcome.EXTRAPOLATED)
    return "fast model" if by_model else "FEM, because the error bound of the fast model is too large"


def format_tumour_trust(error: TumourError) -> str:
    """Describe the error of the tumour position relative to the patient, which includes more than the model."""
    if error.bound is None:
        return (
            "<p>Tumour position error: not known. <code>sulcus uncertainty SCENE</code> estimates it for a scripted "
            "scene.</p>"
        )
    within = hud.bound_words(error.bound, 1)
    said = f"Tumour position error (95 %): at most {within} at any point of its surface"
    guess = ": rough estimate (few samples, load outside the tissue model, or by the size of the motion)"
    guess = guess if error.guess else ""
    if error.registration_words:
        said += f" ({error.registration_words})"
    if error.observed is None:
        return f"<p>{said}{guess or f'; the largest part is {escape(error.largest)}'}.</p>"
    without = "" if error.prior is None else f"; without cortex observation {hud.bound_words(error.prior, 1)}{guess}"
    return f"<p>{said}{without}.</p>"


def report(
    frame: Frame,
    stage: Stage,
    name: str,
    verdict: str,
    rows: Sequence[ComparisonRow],
    frames: int,
    without: Sequence[str] = (),
) -> str:
    """Build the report of a solution: distance, motion and warnings; reliability, loads and times on demand."""
    left = stage.select_stage(frame.loads).left
    facts = [f"frame {frame.number} of {frames - 1}", f"{frame.time:.2f} s", *([frame.acts] if frame.acts else [])]
    if frame.distance_error is not None and frame.distance_error < np.inf:
        facts += [f"error of the distance <= {hud.bound_words(frame.distance_error, 1)} (95 %, relative to FEM)"]
    off = None if frame.doubt else frame.tumour_error.bound
    parts = [] if frame.distance is None else [format_tip_distance(frame.distance, off, frame.inside)]
    number, *found = [""] if frame.estimate is None else describe_estimate(frame.estimate)
    parts.append(number)
    if frame.estimate is not None or not is_undeformed(frame.deformation):
        parts.append(f"<p>{format_motion(frame)}</p>")
    if without:
        parts.append(f"<p>Switched off: {escape(', '.join(without))}.</p>")
    details = [format_trust(frame.deformation, name), format_tumour_trust(frame.tumour_error), *found]
    details.append(f"<p>{escape('; '.join(facts))}</p>")
    if left is not None and len(left.loose):
        details.append(f"<p>{len(left.loose)} loose elements were removed with the resection.</p>")
    spent = {"deform": "deformation", "render": "rendering", "overlay": "overlay"}
    took = ", ".join(f"{spent.get(stage, stage)} {1e3 * seconds:.1f}" for stage, seconds in frame.seconds.items())
    details += [verdict, f'<p class="dim">time [ms]: {took}</p></div>']
    warnings = [part for part in details if WARNING in part]
    parts += [*warnings, format_cost_plot(rows)]
    return "".join([*parts, OPEN_DETAILS, *(part for part in details if WARNING not in part)])


def format_motion(frame: Frame) -> str:
    """Describe the tumour's displacement with its errors: of the model, and of the tumour in the patient."""
    said = f"tumour moved {1e3 * frame.moved:.2f} mm{'' if frame.estimate is None else ' (estimate)'}"
    if frame.moved_error is not None:
        off = f"tumour position error {hud.bound_words(frame.moved_error, 1)}"
    else:
        off = f"{'error' if frame.doubt else 'tumour position error'} not known"
    if frame.model_error is not None and frame.estimate is None:
        off = f"surrogate error {hud.bound_words(frame.model_error, 2)}, {off}"
    return f"{said} ({off})"


def describe_estimate(found: TumourEstimate) -> list[str]:
    """Describe an estimate, its error and its input; or the reason of its rejection."""
    truth = f"simulated (FEM): {format_unbroken(found.truly)}"
    if found.location is None:
        return [
            f'<p class="number">tumour position unknown ({truth})</p>',
            f'<p class="warn">Observation rejected: {escape(found.refusal)}</p>',
        ]
    moved = format_unbroken(found.moved, found.location.p95)
    held = "inside" if found.held else "outside"
    guess = f" {found.location.doubt}" if found.location.doubt else ""
    still = "" if found.noticed else " No significant motion detected."
    return [
        f'<p class="number">estimated tumour motion {moved} ({truth})</p>',
        f"<p><b>estimate</b> from {escape(found.source)}: error {1e3 * found.off:.1f} mm; the simulated centre is "
        f"{held} the 95 % region. Causes: {found.location.named_causes}.{still}{guess}</p>",
    ]


def format_tip_distance(distance: float, error: float | None, inside: bool) -> str:
    """Return the page's first line: from the tip to the tumour's surface, with its error [m], as HTML.

    None: not known.
    """
    said = format_unbroken(distance, error)
    what = f"tip inside the tumour, {said} below its surface" if inside else f"tip to tumour {said}"
    return f'<p class="number">{what}</p>'


def format_unbroken(length: float, error: float | None = None) -> str:
    """Return a length and its error [m] in millimetres, whose unit no new line parts from them."""
    said = hud.format_millimetres(length, error).replace("+-", "\N{PLUS-MINUS SIGN}")
    return said.replace(" ", "&nbsp;")
