"""Comparison of a page's deformers with FEM: error of the shown solution, and a table of times and errors."""

import time as clock
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from ar.overlay.hud import format_millimetres
from sim.deformation import Deformation
from sim.loads import Pushed
from surrogate.evaluation.choose import find_pareto_front

from ..play.frame_text import describe_outcome
from ..play.player import Frame, Player
from ..play.tip_reading import measure_tip_distance
from ..script.tool_paths import compute_tool_height
from .fem_worker import FemResult
from .requests import Display

# Texts: the displayed result is FEM's; FEM's result is the reference.
FEM_SHOWN, FEM_REFERENCE = "this is the result of the FEM solver", "the truth is the result of the FEM solver"


@dataclass(frozen=True)
class Comparison:
    """Comparison of a deformer with the FEM solution of frame `number`, over the tumour's nodes.

    `mean` and `largest` error [m] are None if FEM computed the shown solution. `motion` [m] is the mean displacement,
    `distance` [m] the distance from tip to tumour, both by FEM. `warning` is the reason if FEM is unreliable (or "").
    """

    number: int
    seconds: float
    warning: str
    motion: float
    mean: float | None
    largest: float | None
    distance: float | None = None


def compare_with_fem(fem: FemResult, player: Player, is_fem: bool, solution: Deformation | None = None) -> Comparison:
    """Compare the deformer of a player with an FEM solution of the same loads.

    `solution` is the deformer's solution of these loads, computed if None. If `is_fem`, the errors are None.
    """
    nodes = player.stage.select_stage(fem.loads).anatomy.tumour_nodes
    motion = float(np.linalg.norm(fem.deformation.restrict(nodes).displacement[0], axis=1).mean())
    distances = None
    if not is_fem:
        distances = compute_node_errors(fem, player, solution or player.deformer.deform(fem.loads, at=nodes))
    mean_and_max = (None, None) if distances is None else (float(distances.mean()), float(distances.max()))
    pushed = fem.loads.get_all(Pushed)
    lift = compute_tool_height(float(np.linalg.norm(pushed[0].force[0]))) if pushed else 0.0
    tip = measure_tip_distance(player.site.anatomy, fem.loads, fem.deformation, player.scene.tool, lift)
    distance = None if tip is None else tip.distance
    return Comparison(
        fem.number, fem.seconds, describe_outcome(fem.deformation.outcome[0]), motion, *mean_and_max, distance
    )


def compute_node_errors(fem: FemResult, player: Player, deformation: Deformation) -> np.ndarray:
    """Return the distance (n,) [m] of each tumour node between the solution `deformation` and the FEM solution."""
    nodes = player.stage.select_stage(fem.loads).anatomy.tumour_nodes
    displacements = (solution.restrict(nodes).displacement[0] for solution in (fem.deformation, deformation))
    return np.linalg.norm(np.subtract(*displacements), axis=1)


def format_comparison(comparison: Comparison | None, stale: bool, waiting_text: str, fem_text: str = FEM_SHOWN) -> str:
    """Format the comparison as HTML; if `stale`, it is grey, marked as of a previous load, and ends in `waiting_text`.

    `fem_text` is the text for a solution that FEM computed.
    """
    if comparison is None:
        return f'<p class="stale">{escape(waiting_text)}</p>'
    result = fem_text
    if comparison.mean is not None and comparison.largest is not None:
        result = f"difference from FEM: mean {1e3 * comparison.mean:.3f}, maximum {1e3 * comparison.largest:.3f} mm"
    distance = "" if comparison.distance is None else f"tip to tumour {format_millimetres(comparison.distance)}, "
    details = f"{distance}tumour moved {1e3 * comparison.motion:.2f} mm (FEM, without its position error"
    details += f"; frame {comparison.number}, FEM {1e3 * comparison.seconds:.0f} ms"
    details += f", {comparison.warning})" if comparison.warning else ")"
    if stale:
        return f'<p class="stale">previous load: {result}; {details}. {escape(waiting_text)}</p>'
    return f"<p>{result}; {details}</p>"


def describe_change(fem: FemResult, player: Player, solution: Deformation, disabled: Sequence[str]) -> str:
    """Describe the mean distance (HTML) of the tumour between a solution with `disabled` effects and one with all."""
    mean = 1e3 * float(compute_node_errors(fem, player, solution).mean())
    return f"<p>without {escape(', '.join(disabled))} the tumour position differs by {mean:.2f} mm</p>"


@dataclass
class PageState:
    """State of the page: last request, its solution, the rendered frame, and the comparison with FEM.

    `goal` is the user's request, `request` the request that the shown frame fulfils, and `look` its display settings.
    The page is still from the time `still_at` [s], after `still_time` [s] without change. Before, images are coarse if
    a sharp image needs a `render_time` above `max_render_time` [s].
    """

    goal: tuple | None = None
    request: tuple | None = None
    shown: FemResult | None = None
    shows_undeformed: bool = False
    look: Display | None = None
    load: str = ""
    frame: Frame | None = None
    still_at: float = 0.0
    render_time: float = 0.0
    coarse: bool = False
    image: np.ndarray | None = None
    reference: FemResult | None = None
    shown_fem: FemResult | None = None
    compared_deformer: tuple | None = None
    comparison: Comparison | None = None
    stale: bool | None = None
    plan: tuple[str, ...] | None = None
    still_time: float = 0.5
    max_render_time: float = 0.015

    def choose_resolution(self) -> bool:
        """Choose the resolution of the next image, and restart the waiting time; return True if the image is coarse."""
        time = clock.perf_counter()
        self.coarse = self.render_time > self.max_render_time and time < self.still_at
        self.still_at = time + self.still_time
        return self.coarse

    def record_rendering(self, seconds: float) -> None:
        """Record the rendering time of an image [s]; the time of a coarse image is scaled to that of a sharp image."""
        self.render_time = seconds * (COARSE_SAVING if self.coarse else 1.0)

    @property
    def is_still(self) -> bool:
        """True if nothing has changed for `still_time`."""
        return clock.perf_counter() >= self.still_at


COARSE_SAVING = 5.0  # Duration of rendering a sharp image relative to a coarse one, at most.
MIN_COMPARED_MOTION = 0.1e-3  # Smallest mean motion of the tumour of a load that is compared [m].
MAX_RECENT_LOADS = 120  # Number of last loads that are kept for each deformer.


@dataclass(frozen=True)
class ComparisonRow:
    """Median time and error of a deformer over `loads` loads; `is_optimal`: on the Pareto front (None: not ranked)."""

    name: str
    milliseconds: float
    millimetres: float
    loads: int
    is_optimal: bool | None


class AccuracyTimeTable:
    """Table of times [ms] and mean errors relative to FEM [mm], by deformer and load."""

    def __init__(self) -> None:
        self._times: dict[str, dict[str, float]] = {}
        self._errors: dict[str, dict[str, float]] = {}

    def record_time(self, deformer: str, load_id: str, seconds: float) -> None:
        """Record the time [s] of a deformer for the load `load_id`."""
        _store_recent(self._times.setdefault(deformer, {}), load_id, 1e3 * seconds)

    def record_error(self, deformer: str, load_id: str, error: float) -> None:
        """Record the mean error [m] of a deformer for the load `load_id`, relative to the FEM solution."""
        _store_recent(self._errors.setdefault(deformer, {}), load_id, 1e3 * error)

    @property
    def rows(self) -> list[ComparisonRow]:
        """Rows of the deformers that have a time and an error, the fastest deformer first.

        If all deformers share some loads, only these loads count, and the rows are ranked. Otherwise each row uses the
        deformer's own loads, and rows are not ranked, because medians over different loads are not comparable.
        """
        loads_of = {name: self._times.get(name, {}).keys() & missed.keys() for name, missed in self._errors.items()}
        loads_of = {name: loads for name, loads in loads_of.items() if loads}
        common_loads = set.intersection(*map(set, loads_of.values())) if len(loads_of) > 1 else set()
        medians = {name: self._compute_medians(name, common_loads or loads) for name, loads in loads_of.items()}
        best = find_pareto_front(medians) if common_loads else None
        return [
            ComparisonRow(name, *pair, len(common_loads or loads_of[name]), None if best is None else name in best)
            for name, pair in sorted(medians.items(), key=lambda item: item[1])
        ]

    def _compute_medians(self, name: str, loads: set[str]) -> tuple[float, float]:
        times, errors = self._times[name], self._errors[name]
        return float(np.median([times[load] for load in loads])), float(np.median([errors[load] for load in loads]))


def _store_recent(numbers: dict[str, float], load_id: str, value: float) -> None:
    """Store the newest value of a load; above `MAX_RECENT_LOADS` loads, drop the oldest load."""
    numbers.pop(load_id, None)
    numbers[load_id] = value
    if len(numbers) > MAX_RECENT_LOADS:
        del numbers[next(iter(numbers))]
