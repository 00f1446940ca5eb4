"""Switches of a scene's effects, labelled with the FEM time and the tumour motion that each effect adds."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from html import escape

from ar.page.parts import Folder, Note, Toggle

from ..play.deformers import PatientSetup
from ..play.effect_ablation import ALL, build_record, list_switchable_effects, measure_effects
from ..play.effect_record import EffectRecord, format_unphysical
from ..script.scene import Scene
from .requests import Requests
from .text import describe_effect

EFFECT_COSTS = "cost of the effects"
"""Label of the note on the effects' costs."""
EFFECT_FOLD = "physics effects: time per frame, tumour motion"  # Label of the folder of switches.
SOLVED_FRAMES = 8  # Number of frames of the script that are solved with and without each effect.
# Metrics of the figures on a switch.
METRICS = (
    "median FEM time per frame that it adds [ms], and maximum over the frames of the mean displacement of the tumour "
    "that it causes [mm]"
)
HINT = f"switch this effect on or off; {METRICS}"  # Hint of an effect's switch.
MEASURE_HINT = "solves the scene with and without each effect, in the background"  # Hint of the measuring switch.

Figures = Mapping[str, tuple[float | None, float | None]]
"""Time [ms] and motion [mm] of the effects by class name, as in `EffectRecord`."""


def build_effect_switches(
    patient: PatientSetup, scene: Scene, requests: Requests, measure: Callable[[], None]
) -> Folder:
    """Build a folder of effect switches with their recorded costs, and a switch that calls `measure`."""
    record = patient.find_effect_record(scene)
    figures: Figures = {} if record is None else record.effects
    switches = (
        Toggle(name, True, partial(requests.switch_effect, name), format_switch_label(name, figures), HINT)
        for name in list_switchable_effects(scene, patient.anatomy)
    )
    source = "" if record is None else f"Recorded on {record.day} with {record.machine}, {record.frames} frames"
    note = format_costs(patient, scene, record, source or "The costs are not measured for this scene and anatomy")
    measure_switch = Toggle(
        "measure costs", False, lambda on: measure() if on else None, "measure on this machine", MEASURE_HINT
    )
    return Folder(EFFECT_FOLD, (*switches, measure_switch, Note(EFFECT_COSTS, note, is_plain=True)), is_open=True)


def measure_costs(patient: PatientSetup, scene: Scene) -> Iterator[dict[str, str]]:
    """Measure the effects; after each effect, yield new texts of its switch and of the note (HTML), by label.

    Raises
    ------
    InputError
        See `measure_effects`.
    """
    names, every = list_switchable_effects(scene, patient.anatomy), max(1, len(scene.times) // SOLVED_FRAMES)
    rows = []
    yield {EFFECT_COSTS: "<p>The scene is solved with and without each effect...</p>"}
    for row in measure_effects(patient, scene, every, names):
        rows.append(row)
        record = build_record(patient, scene, rows, every, "this machine")
        remaining = len(names) + 1 - len(rows)
        source = f"Measured on {record.machine}, {record.frames} frames; effects left to measure: {remaining}"
        switch_text = {name: format_switch_label(name, record.effects) for name in names if name == row.effect}
        yield switch_text | {EFFECT_COSTS: format_costs(patient, scene, record, source)}


def format_switch_label(effect_name: str, figures: Figures) -> str:
    """Return the label of an effect's switch: name, added time per frame [ms], and added tumour motion [mm]."""
    milliseconds, motion = figures.get(effect_name, (None, None))
    if milliseconds is None or motion is None:
        return f"{describe_effect(effect_name)}: {'cannot be disabled' if effect_name in figures else 'not measured'}"
    return f"{describe_effect(effect_name)}: {milliseconds:+.0f} ms, {motion:.2f} mm"


def format_costs(patient: PatientSetup, scene: Scene, record: EffectRecord | None, source: str) -> str:
    """Describe (HTML) source and metrics of the figures, results of the full scene, and effects that are always on."""
    sentences = [source] if record is None else [source, f"Of each effect: {METRICS}", *_list_findings(record)]
    switchable = list_switchable_effects(scene, patient.anatomy)
    names = (type(effect).__name__ for effect in scene.get_effects_on(patient.anatomy))
    always_on = ", ".join(describe_effect(name) for name in names if name not in switchable)
    return f"<p>{escape('. '.join([*sentences, f'Always on: {always_on}']))}.</p>"


def _list_findings(record: EffectRecord) -> Iterator[str]:
    milliseconds, motion = record.effects.get(ALL, (None, None))
    if milliseconds is not None:
        yield f"All effects together: {milliseconds:.0f} ms, {motion:.2f} mm"
    if record.unphysical:
        yield format_unphysical(record.unphysical)
    for name, (cost, _) in record.effects.items():
        if cost is None:
            reason = record.refused.get(name, "").rstrip(".")
            yield f"Not solvable without {describe_effect(name)}" + (f": {reason}" if reason else "")
