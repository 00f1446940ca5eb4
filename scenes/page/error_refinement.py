"""Refinement of the error of the load that a page shows, by an ensemble of that load."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from html import escape

from ..analysis.uncertainty import Answer, estimate_uncertainty, solve_ensemble, solve_nominal
from ..play.deformers import PatientSetup
from ..script.priors import sample_priors
from ..script.scene import Scene
from ..script.tool_paths import Touch

DRAWS = 16  # Number of sampled patients: two for each number that is fitted to them.


def refine_error(theatre: PatientSetup, scene: Scene, touch: Touch, time: float, count: int = DRAWS) -> Iterator[str]:
    """Yield the progress (HTML) of an ensemble of a scene whose tool stays at a touch, and its error at a time [s].

    `count` is the number of sampled patients.

    Raises
    ------
    InputError
        See `solve_nominal` and `estimate_uncertainty`.
    """
    held, draws = replace(scene, path=lambda time: touch), sample_priors(count, 0)
    yield "<p>The load is solved for sampled patients...</p>"
    still, found = solve_nominal(theatre, held), list[Answer]()
    for result in solve_ensemble(theatre, held, draws):
        found.append(result)
        yield f"<p>{len(found)} of {count} sampled patients are solved.</p>"
    refined = estimate_uncertainty(theatre, held, still, draws, found)
    error = refined.evaluate(time, 0.0, scene.registration)
    moved, off = 1e3 * refined.read(refined.moved, time), 1e3 * (error.moved or 0.0)
    yield (
        f"<p>Refined for this load, from {count} sampled patients: the tumour moves {moved:.1f} \N{PLUS-MINUS SIGN} "
        f"{off:.1f} mm; position error <= {1e3 * (error.prior or 0.0):.1f} mm (95 %"
        f"{', rough estimate' if error.guess else ''}), {escape(error.registration_words)}. Largest contribution: "
        f"{escape(error.largest)}.</p>"
    )
