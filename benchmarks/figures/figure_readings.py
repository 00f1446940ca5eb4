"""Places of a figure's numbers in the JSON output of each measurement, and the better direction of each."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sim.arguments import MAX_MAGNITUDE

Place = tuple[str | int | Mapping[str, str | float], ...]
"""Path to a number in the JSON output of a measurement.

A text or a whole number is a key or an index. A mapping picks from a list the one item whose fields are these.
"""
Better = Literal["smaller", "larger", "same"]
"""Better direction of a number; "same": it should not change."""


@dataclass(frozen=True)
class Reading:
    """Number of a figure: its name, unit, better direction, and place in the JSON output."""

    name: str
    unit: str
    better: Better
    place: Place


def read_number(output: Any, place: Place) -> float | None:
    """Return the number >= 0 at a place in JSON output; None if there is none, or several."""
    try:
        for step in place:
            if isinstance(step, Mapping):
                (output,) = (item for item in output if all(_fits(item[key], wanted) for key, wanted in step.items()))
            else:
                output = output[step]
        number = math.nan if isinstance(output, bool) else float(output)
    except (LookupError, TypeError, ValueError, OverflowError):
        return None
    return number if 0.0 <= number <= MAX_MAGNITUDE else None


def _fits(value: object, wanted: str | float) -> bool:
    """Return True if a field has the wanted value; a name may be followed by a version."""
    return value == wanted or (isinstance(value, str) and value.startswith(f"{wanted} "))


def _smaller(name: str, unit: str, *place: str | int | Mapping[str, str | float]) -> Reading:
    return Reading(name, unit, "smaller", place)


def _larger(name: str, unit: str, *place: str | int | Mapping[str, str | float]) -> Reading:
    return Reading(name, unit, "larger", place)


def _same(name: str, unit: str, *place: str | int | Mapping[str, str | float]) -> Reading:
    return Reading(name, unit, "same", place)


def list_rates(*presets: str) -> tuple[Reading, ...]:
    """List loads per second of `benchmarks throughput`."""
    return tuple(_larger(name, "loads/s", "rows", {"preset": name}, "rate") for name in presets)


def list_steps(*presets: str) -> tuple[Reading, ...]:
    """List the solver's steps of `benchmarks throughput`."""
    return tuple(
        _smaller(f"{name}, {kind}", "steps", "rows", {"preset": name}, f"steps_{kind}")
        for name in presets
        for kind in ("median", "p99")
    )


TOGETHER = (_larger("the tools together", "loads/s", "tools", 0, "rate"), _smaller("set-up", "s", "tools", 0, "set_up"))
"""Numbers of all tools of `benchmarks throughput` on its first tissue."""

LIVE = tuple(
    _smaller(f"{ride}: {name}", unit, "rides", {"ride": ride}, field)
    for ride in ("palpation", "spatula")
    for name, unit, field in (("median", "ms", "median"), ("p99", "ms", "p99"), ("off", "mm", "error"))
)
"""Numbers of `benchmarks live`."""

STAGES = tuple(
    _smaller(f"{name}: {kind}", "ms", "rows", {"name": row}, kind)
    for name, row in (("a load from rest", "FEM, a single load"), ("a frame from the last", "FEM, live"))
    for kind in ("median", "p95")
)
"""Numbers of `benchmarks stages`."""

PICTURE = (
    *(
        _smaller(stage, "ms", "rows", {"stage": stage}, "median")
        for stage in ("load", "deform", "render", "composite", "encode", "send", "frame")
    ),
    _smaller("frame, p95", "ms", "rows", {"stage": "frame"}, "p95"),
    _larger("together", "pictures/s", "pictures_per_second"),
)
"""Numbers of `benchmarks frame`."""


def list_shortcut_medians(*pairs: tuple[str, str]) -> tuple[Reading, ...]:
    """List the medians of `benchmarks shortcuts` with and without each acceleration."""
    return tuple(
        _smaller(f"{shortcut}, {work}: {kind}", "ms", "rows", {"shortcut": shortcut, "work": work}, field)
        for shortcut, work in pairs
        for kind, field in (("with", "median"), ("without", "median_without"))
    )


def list_growth(*batches: str) -> tuple[Reading, ...]:
    """List one mesh size of `benchmarks growth`, with batches of these numbers of loads, 1 included."""
    return (
        _smaller("set-up", "s", "rows", {"asked": 1}, "set_up"),
        *(_smaller(f"a load of {count}", "s", "rows", {"asked": int(count)}, "load") for count in batches),
        _smaller("memory", "GiB", "rows", {"asked": 1}, "memory"),
    )


def list_peer_ratios(tolerances: Sequence[str], peers: Sequence[str]) -> tuple[Reading, ...]:
    """List the seconds of sulcus in `benchmarks solver`, and each peer's ratio to them."""
    loads = (("first load", "first", "first_ratio"), ("a further one", "further", "ratio"))
    found = []
    for tolerance in tolerances:
        mesh = ("meshes", {"tolerance": float(tolerance)}, "rows")
        for name, ours, ratio in loads:
            found.append(_smaller(f"to {tolerance}, {name}", "s", *mesh, {"engine": "sulcus"}, ours))
            found += [
                _larger(f"to {tolerance}, {name} by {peer}", "times as long", *mesh, {"engine": peer}, ratio)
                for peer in peers
            ]
    return tuple(found)


def list_robustness(*presets: str) -> tuple[Reading, ...]:
    """List numbers of `benchmarks robust`."""
    found = []
    for name in presets:
        found.append(_larger(f"{name}: converged", "loads", "sets", {"preset": name}, "converged"))
        found += [
            _smaller(f"{name}, {kind}", "steps", "sets", {"preset": name}, f"outer_{kind}")
            for kind in ("median", "p99")
        ]
    return tuple(found)


def list_skull_motions(*names: str) -> tuple[Reading, ...]:
    """List numbers of `benchmarks skull` with one mesh and one Poisson's ratio."""
    found = []
    for name in names:
        found.append(_same(f"{name}: tumour moves", "mm", "rows", {"skull": name}, "motion"))
        found.append(_smaller(f"{name}: a load", "s", "rows", {"skull": name}, "seconds"))
    return tuple(found)


def list_element_motions(names: Sequence[str], poissons: Sequence[float]) -> tuple[Reading, ...]:
    """List numbers of `benchmarks elements --coarse` with one mesh."""
    found = []
    for name in names:
        for nu in poissons:
            row = ("rows", {"element": name, "poisson": nu})
            found.append(_same(f"{name}, nu {nu:g}: tumour moves", "mm", *row, "motion"))
            found.append(_smaller(f"{name}, nu {nu:g}: a solve", "s", *row, "solve"))
    return tuple(found)


LIMIT = (_same("limit of fine meshes, nu 0.495", "mm", "limit_mm", "0.495"),)
"""Numbers of `benchmarks elements --poisson 0.495`."""
