"""Process of an engine: it reads a case, then solves the requested loads one at a time.

Processes exchange files and lines only, so that code under another licence is loaded in its own process alone.
"""

import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

READY = "ready"
Solve = Callable[[np.ndarray], np.ndarray]
"""Function from nodal forces (V, 3) [N] to displacements (V, 3) [m], from the undeformed state."""


@dataclass(frozen=True, eq=False)
class Case:
    """Body of linear tetrahedra of one log neo-Hookean tissue, and its loads.

    Parameters
    ----------
    nodes, tets
        (V, 3) [m] and (T, 4), positively oriented.
    held
        (V,) bool: nodes that do not move.
    young, poisson, mu, lam
        Constants of the tissue: Young's modulus [Pa], Poisson's ratio, and Lamé's parameters [Pa].
    force
        (L, V, 3) [N]: nodal forces of L loads.
    tolerance
        Free residual <= tolerance x the largest 2-norm among internal forces, load and reactions.
    """

    nodes: np.ndarray
    tets: np.ndarray
    held: np.ndarray
    young: float
    poisson: float
    mu: float
    lam: float
    force: np.ndarray
    tolerance: float


def write_case(folder: Path, case: Case) -> None:
    """Write a case to the folder from which `serve_loads` reads it."""
    np.savez(folder / "case.npz", **asdict(case))


def to_result_path(folder: Path, number: int) -> Path:
    """Return the path of an engine's displacements (V, 3) [m] under a load."""
    return folder / f"answer{number}.npy"


def serve_loads(set_up: Callable[[Case], Solve]) -> None:
    """Solve the loads whose numbers are read, one a line; the last arguments are the folder and the number of threads.

    Prints `READY` after imports and reading, then for each load a line of JSON: its seconds, and the reason if
    it failed. The seconds of the first include `set_up`. Other output of an engine is sent to standard error.
    """
    folder, threads = Path(sys.argv[-2]), int(sys.argv[-1])
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:threads])
    said = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    with np.load(folder / "case.npz") as stored:
        read: dict[str, Any] = {name: array if array.ndim else float(array) for name, array in stored.items()}
    case = Case(**read)
    print(READY, file=said)
    solve = None
    for line in sys.stdin:
        number = int(line)
        to_result_path(folder, number).unlink(missing_ok=True)
        begun, reason = time.perf_counter(), ""
        try:
            solve = solve or set_up(case)
            displacement = solve(case.force[number])
        except Exception as error:  # engines raise any exceptions, and the other loads are still to be solved
            displacement, reason = None, f"{type(error).__name__}: {error}"
        seconds = time.perf_counter() - begun
        if displacement is not None:
            np.save(to_result_path(folder, number), displacement)
        print(json.dumps({"seconds": seconds, "reason": reason}), file=said)
