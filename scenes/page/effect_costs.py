"""Background measurement of what each effect of a scene costs, and of how much it moves the tumour."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from html import escape

from sim.errors import InputError

from ..play.deformers import PatientSetup
from ..play.effect_ablation import ALL, AblationRow, measure_effects
from ..script.scene import Scene
from .text import describe_effect

SOLVED_FRAMES = 8  # Number of frames of the script that are solved with and without each effect.


class EffectCosts:
    """Measurement of a scene's effects, at most once; `show` receives the table (HTML) whenever a row is added."""

    def __init__(self, theatre: PatientSetup, scene: Scene, turn: threading.Lock, show: Callable[[str], None]) -> None:
        """Prepare the measurement; it holds the lock `turn`, so that no other solver is built meanwhile."""
        self.theatre, self.scene, self.turn, self.show = theatre, scene, turn, show
        self.closed, self.thread = threading.Event(), threading.Thread(target=self._measure, name="costs", daemon=True)

    def start(self) -> None:
        """Start the measurement, unless it was started before."""
        if self.thread.ident is None:
            self.show("<p>The scene is solved with and without each effect...</p>")
            self.thread.start()

    def close(self) -> None:
        """End the measurement after the effect in progress."""
        self.closed.set()

    def _measure(self) -> None:
        rows: list[AblationRow] = []
        try:
            with self.turn:
                for row in measure_effects(self.theatre, self.scene, max(1, len(self.scene.times) // SOLVED_FRAMES)):
                    if self.closed.is_set():
                        return
                    rows.append(row)
                    self.show(format_effect_table(rows, len(self.scene.get_effects_on(self.theatre.anatomy))))
        except InputError as error:
            self.show(f'<p class="warn">{escape(str(error))}</p>')


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
