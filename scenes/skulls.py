"""What the skull and the mesh decide: the tumour's motion, what passes the closed skull, what its bond bears."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sim.accuracy import TRAIN
from sim.anatomy import TUMOUR_LABEL, Anatomy
from sim.effects import pushed_effects
from sim.fem import Fem
from sim.loads import Loads
from sim.material import Material


@dataclass(frozen=True)
class Row:
    """One skull on one mesh at one Poisson's ratio.

    Parameters
    ----------
    motion
        Mean motion of the tumour by volume, its mean over the loads [mm].
    leaked, bond
        The largest over the loads, as in `Deformation`; None where nothing is bonded.
    seconds
        A load, set-up left out.
    failed
        Loads that did not converge; they are in no figure.
    """

    skull: str
    poisson: float
    vertices: int
    motion: float
    leaked: float
    bond: float | None
    seconds: float
    failed: int


def rows(
    anatomies: Sequence[Anatomy], skulls: Sequence[str], poissons: Sequence[float], loads: Loads, device: str
) -> Iterator[Row]:
    """The same loads on every mesh, Poisson's ratio and skull; E 3 kPa, neo-Hookean, the recommended element."""
    for poisson in poissons:
        for skull in skulls:
            for anatomy in anatomies:
                yield _measured(anatomy, skull, poisson, loads, device)


def _measured(anatomy: Anatomy, skull: str, poisson: float, loads: Loads, device: str) -> Row:
    mesh = anatomy.mesh
    fem = Fem(anatomy, pushed_effects(anatomy, Material("neo-hookean", 3000.0, poisson), skull), TRAIN, device)
    fem.deform(loads.rows(slice(0, 1)).scaled(1e-3))  # kernels are compiled or loaded at their first launch
    begun = clock.perf_counter()
    answer = fem.deform(loads)
    seconds = (clock.perf_counter() - begun) / len(loads)
    good = np.array([outcome.good for outcome in answer.outcome])
    inside = mesh.region == TUMOUR_LABEL
    moved = np.average(
        answer.displacement[good][:, mesh.tets[inside]].mean(axis=2), axis=1, weights=mesh.volumes[inside]
    )
    bond = float(answer.bond[good].max())
    return Row(
        skull, poisson, len(mesh.nodes), 1e3 * float(np.linalg.norm(moved, axis=1).mean()),
        float(answer.leaked[good].max()), bond if np.isfinite(bond) else None, seconds, int((~good).sum()),
    )  # fmt: skip
