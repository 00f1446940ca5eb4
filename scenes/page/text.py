"""Text of the page (HTML): scene, anatomy, result and reliability of the result."""

from collections.abc import Sequence
from html import escape

import numpy as np

from ar.overlay import hud
from ar.page.elements import OPEN_DETAILS
from sim.anatomy import name_region
from sim.bodies.lobes import describe_location
from sim.deformation import Deformation, Outcome
from sim.material import IsotropicTissue, Tissue

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
    "The tumour's position is estimated from the dots on the cortex alone: force and stiffness are not used."
)
WARNING = 'class="warn"'  # Mark of a warning in HTML.
RESEARCH_ONLY = "Research only. Not a medical device."  # Restriction of use.
# Names of finite elements for users.
ELEMENTS = {"p1": "linear tetrahedra", "p2": "quadratic tetrahedra", "smoothed": "smoothed linear tetrahedra"}
EFFECTS = {
    "ToolForce": "push of the tool",
    "ToolContact": "contact of the tool",
    "Retraction": "the spatula",
    "Gravity": "gravity and CSF",
    "Resection": "the resection",
    "Pulsation": "heartbeat and breath",
    "SkullContact": "contact with the skull",
    "Inertia": "inertia",
    "Elasticity": "elastic tissue",
    "Held": "fixed base of the brain",
    "Bonded": "bond to the skull",
    "Slide": "sliding along the skull",
}
"""Names of effects for users, by class name."""


def describe_effect(effect_name: str) -> str:
    """Return the name for users of an effect, given by its class name."""
    return EFFECTS.get(effect_name, effect_name)


def format_caption(patient: PatientSetup, scene: Scene, anatomy: str) -> str:
    """Build the caption of the image (HTML): tumour location, scene title, legend of the lines, and anatomy."""
    title = " ".join(scene.title.split())
    estimate_note = "" if scene.observation_model is None else f" {ESTIMATE_EXPLANATION}"
    return (
        f'<p class="number">Simulation: {describe_location(patient.anatomy)} tumour '
        f"<small>{RESEARCH_ONLY}</small></p><p>{escape(title)}{estimate_note}</p>{format_page_legend(scene)}"
        f'<p class="dim">{escape(describe_scene(patient, scene, anatomy))}</p>'
    )


def format_page_legend(scene: Scene) -> str:
    """Build the legend (HTML) of the lines in a scene's images, with a sample of each line."""
    scan_key = ('stroke="#ddd" stroke-width="2" stroke-dasharray="1.5 3"', "tumour in the scan")
    predicted, fem, region = (to_svg_stroke(colour) for colour in (TUMOUR_COLOUR, TRUTH_COLOUR, ELLIPSOID_COLOUR))
    hidden_key = (f'{predicted} stroke-width="3" stroke-dasharray="5 3"', "hidden by tool, drape or bone")
    keys = [
        (f'{predicted} stroke-width="3"', "predicted tumour"),
        hidden_key,
        (f'{predicted} stroke-width="1.5" stroke-dasharray="4 3"', "95 % error band"),
        scan_key,
        (f'{fem} stroke-width="1.5"', "FEM reference (3-D view)"),
    ]
    if scene.observation_model is not None:
        keys = [
            (f'{predicted} stroke-width="3"', "estimated tumour"),
            hidden_key,
            (f'{fem} stroke-width="2" stroke-dasharray="8 3"', "simulated tumour (FEM)"),
            (f'{region} stroke-width="2" stroke-dasharray="5 3"', "95 % region of the tumour centre"),
            scan_key,
        ]
    if scene.tool is not None:
        keys.append(('stroke="#fff" stroke-width="1.5"', "tip to tumour, in mm"))
    return format_legend(keys)


def format_legend(entries: Sequence[tuple[str, str]]) -> str:
    """Build a legend (HTML) of lines from pairs of SVG line attributes and meaning."""
    samples = (
        f'<span><svg width="26" height="8"><line x1="1" y1="4" x2="25" y2="4" {attributes}/></svg>{text}</span>'
        for attributes, text in entries
    )
    return f'<div class="legend">{"".join(samples)}</div>'


def to_svg_stroke(colour: Sequence[float]) -> str:
    """Format a colour, sRGB in [0, 1], as the stroke attribute of an SVG line."""
    return 'stroke="#' + "".join(f"{round(255.0 * channel):02x}" for channel in colour) + '"'


def describe_scene(patient: PatientSetup, scene: Scene, anatomy: str) -> str:
    """Describe the anatomy, the size of its mesh, and the FEM model."""
    mesh = patient.anatomy.mesh
    return f"Brain: {anatomy}; {len(mesh.nodes)} mesh points. FEM: {describe_fem(patient, scene)}."


def describe_fem(patient: PatientSetup, scene: Scene) -> str:
    """Describe element type and tissue of the FEM model of a scene."""
    element, elasticity = patient.choose_element(scene), scene.elasticity
    regions = (f"; the {name_region(key)} of {describe_tissue(tissue)}" for key, tissue in elasticity.regions.items())
    return f"{ELEMENTS.get(element, element)}, {describe_tissue(elasticity.default)}{''.join(regions)}"


def describe_tissue(tissue: Tissue | None) -> str:
    """Describe a tissue's law and constants."""
    if tissue is None:
        return "a tissue for each region"
    relaxation = ", viscoelastic" if tissue.prony else ""
    if not isinstance(tissue, IsotropicTissue):
        return f"{tissue.law} tissue{relaxation}"
    return (
        f"{tissue.law} tissue of Young's modulus {1e-3 * tissue.young:g} kPa and Poisson's ratio {tissue.poisson:g}"
        f"{relaxation}"
    )


def describe_deformer(name: str) -> str:
    """Return the description of a deformer for users, given its name."""
    if name == GUARDED:
        return "fast model with FEM check"
    return "FEM (reference)" if name == "fem" else f"fast model ({name})"


def describe_solve(scene: Scene, name: str, number: int, touch: Touch | None) -> str:
    """Describe the running solve: a frame of the script, or the manual tool input."""
    if touch is None:
        return f"solving frame {number} ({describe_deformer(name)})"
    strength = f"depth {1e3 * touch.depth:.1f} mm" if scene.posed else f"{touch.force:.2f} N"
    return f"computing the deformation for the manual tool, {strength} ({describe_deformer(name)})"


def format_pending(shown_frame: int, requested_frame: int, frame_count: int) -> str:
    """Describe (HTML) that the requested frame is not shown yet, and which frame is shown."""
    way = f" frame {shown_frame} of {frame_count - 1} is shown, on the way to frame {requested_frame}"
    progress = way if shown_frame != requested_frame else ""
    return f'<p class="stale">Result pending:{progress or " it is being computed"}.</p>'


def format_solver_list(solvers: Sequence[str]) -> str:
    """Format sentences on the FEM solvers as an HTML list; empty without solvers."""
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in solvers)}</ul>" if solvers else ""


def describe_result(deformation: Deformation, deformer: str) -> str:
    """Describe (HTML) the source of a solution and its error; an unreliable solution gets a warning with the reason."""
    outcome = deformation.outcome[0]
    source = f"<b>{escape(_describe_guarded(outcome) if deformer == GUARDED else describe_deformer(deformer))}</b>"
    if outcome is Outcome.EXTRAPOLATED:
        return (
            f'<p>{source}</p><p class="warn">Do not rely on this result: the load lies outside the range that the '
            "model was trained on, so its error is not bounded.</p>"
        )
    if not outcome.good:
        return f'<p>{source}</p><p class="warn">Do not rely on this result: {escape(outcome.value)}.</p>'
    state = "inside the range that it was trained on" if outcome is Outcome.PREDICTED else "converged"
    if is_undeformed(deformation):
        return f"<p>{source}: {state}. Nothing moves the tumour.</p>"
    bound = float(deformation.bound[0, 0])
    if not np.isfinite(bound):
        return f"<p>{source}: {state}.</p>"
    return (
        f"<p>{source}: {state}. Surrogate error (95 %): at most {hud.format_bound(bound, 2)} at any point of the "
        "tumour, relative to FEM.</p>"
    )


def _describe_guarded(outcome: Outcome) -> str:
    """Describe the source of a guarded model's solution: the model, or FEM."""
    by_model = outcome in (Outcome.PREDICTED, Outcome.EXTRAPOLATED)
    return "fast model" if by_model else "FEM, because the error bound of the fast model is too large"


def format_position_error(error: TumourError) -> str:
    """Describe (HTML) the error of the tumour position relative to the patient, from all sources of error."""
    if error.bound is None:
        return (
            "<p>Tumour position error: not known. <code>sulcus uncertainty SCENE</code> estimates it for a scripted "
            "scene.</p>"
        )
    bound = hud.format_bound(error.bound, 1)
    text = f"Tumour position error (95 %): at most {bound} at any point of its surface"
    caveat = ": rough estimate (few samples, load outside the tissue model, or by the size of the motion)"
    caveat = caveat if error.is_rough else ""
    if error.registration_text:
        text += f" ({error.registration_text})"
    if error.observed is None:
        return f"<p>{text}{caveat or f'; the largest part is {escape(error.main_source)}'}.</p>"
    prior = "" if error.prior is None else f"; without cortex observation: {hud.format_bound(error.prior, 1)}{caveat}"
    return f"<p>{text}{prior}.</p>"


def format_report(
    frame: Frame,
    stage: Stage,
    deformer: str,
    comparison: str,
    rows: Sequence[ComparisonRow],
    frame_count: int,
    disabled_effects: Sequence[str] = (),
) -> str:
    """Build the report (HTML) of a frame: distance, motion, warnings and cost plot; further details are collapsed."""
    remaining = stage.select_stage(frame.loads).remaining_body
    facts = [f"frame {frame.number} of {frame_count - 1}", f"{frame.time:.2f} s", *([frame.acts] if frame.acts else [])]
    if frame.distance_error is not None and frame.distance_error < np.inf:
        bound = hud.format_bound(frame.distance_error, 1)
        facts += [f"error of the tip-to-tumour distance <= {bound} (95 %, relative to FEM)"]
    error = None if frame.doubt else frame.tumour_error.bound
    parts = [] if frame.distance is None else [format_tip_distance(frame.distance, error, frame.inside)]
    headline, *estimate_texts = [""] if frame.estimate is None else describe_estimate(frame.estimate)
    parts.append(headline)
    if frame.estimate is not None or not is_undeformed(frame.deformation):
        parts.append(f"<p>{format_motion(frame)}</p>")
    if disabled_effects:
        parts.append(f"<p>Switched off: {escape(', '.join(disabled_effects))}.</p>")
    details = [describe_result(frame.deformation, deformer), format_position_error(frame.tumour_error), *estimate_texts]
    details.append(f"<p>{escape('; '.join(facts))}</p>")
    if remaining is not None and len(remaining.loose_tetrahedra):
        details.append(f"<p>{len(remaining.loose_tetrahedra)} loose elements were removed with the resection.</p>")
    labels = {"deform": "deformation", "render": "rendering", "overlay": "overlay"}
    times = ", ".join(f"{labels.get(task, task)} {1e3 * seconds:.1f}" for task, seconds in frame.seconds.items())
    details += [comparison, f'<p class="dim">time [ms]: {times}</p></div>']
    warnings = [part for part in details if WARNING in part]
    parts += [*warnings, format_cost_plot(rows)]
    return "".join([*parts, OPEN_DETAILS, *(part for part in details if WARNING not in part)])


def format_motion(frame: Frame) -> str:
    """Describe the tumour's displacement, with the model's error and the error relative to the patient."""
    motion = f"tumour moved {1e3 * frame.moved:.2f} mm{'' if frame.estimate is None else ' (estimate)'}"
    if frame.moved_error is not None:
        error = f"motion error {hud.format_bound(frame.moved_error, 1)}"
    else:
        error = f"{'error' if frame.doubt else 'motion error'} not known"
    if frame.model_error is not None and frame.estimate is None:
        error = f"surrogate error {hud.format_bound(frame.model_error, 2)}, {error}"
    return f"{motion} ({error})"


def describe_estimate(estimate: TumourEstimate) -> list[str]:
    """Describe (HTML parts) an estimate with its error and input, or the reason why the observation was rejected."""
    reference = f"simulated (FEM): {format_length(estimate.true_distance)}"
    if estimate.location is None:
        return [
            f'<p class="number">tumour position unknown ({reference})</p>',
            f'<p class="warn">Observation rejected: {escape(estimate.rejection)}</p>',
        ]
    motion = format_length(estimate.motion_length, estimate.location.p95)
    side = "inside" if estimate.is_covered else "outside"
    doubt = f" {estimate.location.doubt}" if estimate.location.doubt else ""
    notice = "" if estimate.is_significant else " No significant motion detected."
    return [
        f'<p class="number">estimated tumour motion {motion} ({reference})</p>',
        f"<p><b>estimate</b> from {escape(estimate.source)}: error {1e3 * estimate.error:.1f} mm; the simulated centre "
        f"is {side} the 95 % region. Causes: {estimate.location.named_causes}.{notice}{doubt}</p>",
    ]


def format_tip_distance(distance: float, error: float | None, is_inside: bool) -> str:
    """Format the distance [m] from the tip to the tumour's surface as the page's first line (HTML).

    `error` is the error bound [m]; None: not known.
    """
    length = format_length(distance, error)
    text = f"tip inside the tumour, {length} below its surface" if is_inside else f"tip to tumour {length}"
    return f'<p class="number">{text}</p>'


def format_length(length: float, error: float | None = None) -> str:
    """Format a length and its error [m] in millimetres, as HTML without line breaks."""
    text = hud.format_millimetres(length, error).replace("+-", "\N{PLUS-MINUS SIGN}")
    return text.replace(" ", "&nbsp;")
