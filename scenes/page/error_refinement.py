"""Refined error of the load that a page shows, from an ensemble of solutions of this load."""

from collections.abc import Iterator
from dataclasses import replace

from ..analysis.uncertainty import Answer, estimate_uncertainty, solve_ensemble, solve_nominal
from ..play.deformers import PatientSetup
from ..script.priors import sample_priors
from ..script.scene import Scene
from ..script.tool_paths import Touch
from .text import format_length, format_position_error

DRAWS = 18  # Number of sampled patients: two for each fitted parameter.


def refine_error(patient: PatientSetup, scene: Scene, touch: Touch, time: float, count: int = DRAWS) -> Iterator[str]:
    """Solve an ensemble of a scene whose tool stays at `touch`; yield the progress, then the error at a time [s].

    The yielded texts are HTML. `count` is the number of sampled patients (ensemble members).

    Raises
    ------
    InputError
        See `solve_nominal` and `estimate_uncertainty`.
    """
    static_scene = replace(scene, path=lambda time: touch)
    samples = sample_priors(count, 0, scene.elasticity.default)
    yield "<p>solving the load for sampled patients...</p>"
    nominal, solutions = solve_nominal(patient, static_scene), list[Answer]()
    for result in solve_ensemble(patient, static_scene, samples):
        solutions.append(result)
        yield f"<p>{len(solutions)} of {count} sampled patients are solved.</p>"
    refined = estimate_uncertainty(patient, static_scene, nominal, samples, solutions)
    error = refined.evaluate(time, 0.0, scene.registration)
    motion = format_length(refined.interpolate(refined.moved, time), error.moved)
    yield (
        f"<p>Refined for this load, from {count} sampled patients: the tumour moves {motion}.</p>"
        f"{format_position_error(error)}"
    )
