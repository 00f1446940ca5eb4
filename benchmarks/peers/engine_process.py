"""An engine in a process of its own: it reads a case, then solves the loads that it is asked for, one at a time.

Between the processes pass files and lines alone, so that an engine of another licence stays in its own.
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
"""Nodal forces (V, 3) [N] to displacements (V, 3) [m], from rest."""


@dataclass(frozen=True, eq=False)
class Case:
    """A body of linear tetrahedra of one log neo-Hookean tissue, and the loads on it.

    Parameters
    ----------
    nodes, tets
        (V, 3) [m] and (T, 4), positively oriented.
    held
        (V,) bool: nodes that do not move.
    young, poisson, mu, lam
        The tissue's constants [Pa], as engineers and as Lamé give them.
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
    """Leave a case where `serve` finds it."""
    np.savez(folder / "case.npz", **asdict(case))


def answer_path(folder: Path, number: int) -> Path:
    """Where an engine leaves its displacements (V, 3) [m] under a load."""
    return folder / f"answer{number}.npy"


def serve(set_up: Callable[[Case], Solve]) -> None:
    """Solve the loads whose numbers come in, a line each; the command line ends with the folder and how many threads.

    Says `READY` when everything is imported and read, then for each load a line of JSON: its seconds, and the reason if
    it failed. The seconds of the first include `set_up`. What an engine prints goes to standard error.
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
        answer_path(folder, number).unlink(missing_ok=True)
        begun, reason = time.perf_counter(), ""
        try:
            solve = solve or set_up(case)
            displacement = solve(case.force[number])
        except Exception as error:  # every engine has errors of its own, and the other loads are still to be tried
            displacement, reason = None, f"{type(error).__name__}: {error}"
        seconds = time.perf_counter() - begun
        if displacement is not None:
            np.save(answer_path(folder, number), displacement)
        print(json.dumps({"seconds": seconds, "reason": reason}), file=said)
