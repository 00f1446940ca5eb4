"""Measurement of what each effect of a scene costs, and of how much it moves the tumour."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape

from ..play.deformers import PatientSetup
from ..play.effect_ablation import ALL, AblationRow, measure_effects
from ..script.scene import Scene
from .text import describe_effect

SOLVED_FRAMES = 8  # Number of frames of the script that are solved with and without each effect.


def measure_costs(theatre: PatientSetup, scene: Scene) -> Iterator[str]:
    """Yield the table (HTML) of a scene's effects whenever a row is added.

    Raises
    ------
    InputError
        See `measure_effects`.
    """
    yield "<p>The scene is solved with and without each effect...</p>"
    rows: list[AblationRow] = []
    for row in measure_effects(theatre, scene, max(1, len(scene.times) // SOLVED_FRAMES)):
        rows.append(row)
        yield format_effect_table(rows, len(scene.get_effects_on(theatre.anatomy)))


def format_effect_table(rows: Sequence[AblationRow], count: int) -> str:
    """Build the table of `count` effects from the measured rows; the first row is that of the whole scene."""
    lines = []
    for row in rows:
        name = "all effects" if row.effect == ALL else describe_effect(row.effect)
        if row.milliseconds is None or row.tumour_mm is None:
            lines.append(f"<tr><td>{escape(name)}</td><td colspan=2>always on ({escape(row.refused)})</td></tr>")
        else:
            lines.append(
                f"<tr><td>{escape(name)}</td><td>{row.milliseconds:+.0f} ms</td><td>{row.tumour_mm:.2f} mm</td></tr>"
            )
    left = "" if len(rows) > count else f'<p class="stale">{count + 1 - len(rows)} more are being measured.</p>'
    return (
        "<p>FEM time per frame that each effect adds, and how far it moves the tumour (largest mean of the script):</p>"
        f"<table>{''.join(lines)}</table>{left}"
    )
