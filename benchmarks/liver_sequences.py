"""Estimates of forces and positions of a liver from point clouds of its surface, on a public data set.

The data are of gmestdagh/adjoint-elastic-registration (GPL-3; they stay outside this repository): five sequences of
fifty clouds of a linear liver, and five of a neo-Hookean one, with the true force and the true position of the mesh.
Mestdagh, Cotin 2022, "An optimal control problem for elastic registration and force estimation in augmented surgery",
MICCAI, report 6.5 to 9.4 % of the force on the linear sequences, and 0.8 to 1.2 s for an update.

    python benchmarks/liver_sequences.py PATH/TO/data/liver [--mesh remeshed|default] [--sequences linear/s1 ...]

The method is that of `surrogate.locating`: forces are a Gaussian process on the patch where they may act (the data name
its vertices), tissue is linear, and each cloud conditions them; closest points are recomputed. Sizes and lengths are
those of greatest evidence on the first cloud. Tissue is linear for neo-Hookean livers too; the table notes it.
"""

import argparse
import sys
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import meshio
import numpy as np
from scipy.linalg import cho_solve, cholesky
from scipy.sparse import load_npz
from scipy.sparse.linalg import splu

from sim.errors import InputError
from sim.geometry.closest_point import find_closest_points
from sim.geometry.locate import locate
from sim.geometry.surface import normalise_vectors
from sim.geometry.tetmesh import TetMesh
from sim.runtime.threads import limit_to_one_thread
from surrogate.array_functions import compute_squared_distances
from surrogate.locating.calibration import RADIUS_SQUARED
from surrogate.locating.evidence import compute_correlation

PUBLISHED = {"linear": "force 6.5 - 9.4 %, 0.8 - 1.2 s an update", "neohookean": "no figure that we know"}
# Candidate correlation lengths [m] of forces, sizes of one vertex's force [N], and errors of points [m].
LENGTHS, SIZES, ERRORS = (4e-3, 1e-2, 2.5e-2), (1e-4, 1e-3, 1e-2, 1e-1, 1.0), (1e-5, 5e-5, 2e-4, 6e-4)
ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Liver:
    """Mesh, and its motion by unit forces along each axis on each vertex of a patch.

    Parameters
    ----------
    mesh
        Vertices in metres.
    surface
        (S, 3) vertices of the triangles that the clouds sample.
    patch
        (f,) vertices on which forces may act.
    motion
        (V, 3, 3 f) [m/N].
    """

    mesh: TetMesh
    surface: np.ndarray
    patch: np.ndarray
    motion: np.ndarray


def read_liver(folder: Path, mesh: str, sequence: Path) -> Liver:
    """Read the mesh and the patch of a sequence; solve for the motion by the patch's forces.

    Raises
    ------
    InputError
        A folder without the files of the data.
    """
    base = folder / f"mesh-{mesh}"
    try:
        read = meshio.read(base / "liver.msh")
        held, surface = (np.load(base / f"{name}.npy") for name in ("dirichlet-vertices", "matching-triangles"))
        stiffness = load_npz(base / "stiffness_matrix.npz").tocsc()
        patch = np.load(sequence / f"forces-vertices-{mesh}.npy")
    except OSError as error:
        raise InputError(f"{folder}: {error}. Give the folder data/liver of the repository.") from error
    tets = np.concatenate([block.data for block in read.cells if block.type == "tetra"]).astype(int)
    body = TetMesh(read.points.astype(float), tets, np.ones(len(tets), int))
    free = np.setdiff1d(np.arange(stiffness.shape[0]), (3 * held[:, None] + np.arange(3)).ravel())
    factor = splu(stiffness[free][:, free].tocsc())
    force = np.zeros((stiffness.shape[0], 3 * len(patch)))
    force[(3 * patch[:, None] + np.arange(3)).ravel(), np.arange(3 * len(patch))] = 1.0
    motion = np.zeros_like(force)
    motion[free] = factor.solve(force[free])
    return Liver(body, surface, patch, motion.reshape(-1, 3, 3 * len(patch)))


@dataclass(frozen=True)
class Hyperparameters:
    """Hyperparameters of the prior of forces and of point errors, from `LENGTHS`, `SIZES` and `ERRORS`."""

    length: float
    size: float
    error: float

    def compute_covariance(self, liver: Liver) -> np.ndarray:
        """Compute the prior covariance of the patch's forces (3 f, 3 f) [N^2]."""
        at = liver.mesh.nodes[liver.patch]
        return np.kron(self.size**2 * compute_correlation(compute_squared_distances(at, at), self.length), np.eye(3))


def linearise_observation(liver: Liver, cloud: np.ndarray, force: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linearise the observation of forces by a cloud (n, 3) [m] about an estimate `force` (3 f,) [N].

    Return rows (n, 3 f) [m/N] that map forces to motions along the surface's normal, and the observed motions (n,) [m].
    """
    nodes = liver.mesh.nodes
    corners = (nodes + liver.motion @ force)[liver.surface]
    _, triangle, weights = find_closest_points(cloud, corners)
    a, b, c = np.moveaxis(corners[triangle], 1, 0)
    normal, vertices = normalise_vectors(np.cross(b - a, c - a)), liver.surface[triangle]
    rows = np.einsum("nc,ni,ncif->nf", weights, normal, liver.motion[vertices], optimize=True)
    at_rest = np.einsum("nc,nci->ni", weights, nodes[vertices])
    return rows, np.einsum("ni,ni->n", cloud - at_rest, normal)


def condition_prior(
    settings: Hyperparameters, prior: np.ndarray, rows: np.ndarray, observed: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return mean (3 f,) [N] and covariance of forces, and the log evidence (Rasmussen, Williams 2006, 2.30)."""
    gain = prior @ rows.T
    whole = rows @ gain
    whole[np.diag_indices(len(whole))] += settings.error**2
    factor = cholesky(whole, lower=True)
    weight = cho_solve((factor, True), observed)
    log = -0.5 * float(observed @ weight) - float(np.log(np.diag(factor)).sum())
    return gain @ weight, prior - gain @ cho_solve((factor, True), gain.T), log


def choose_hyperparameters(liver: Liver, cloud: np.ndarray) -> Hyperparameters:
    """Choose the hyperparameters of greatest evidence on a cloud."""
    rows, value = linearise_observation(liver, cloud, np.zeros(3 * len(liver.patch)))
    candidates = [Hyperparameters(*each) for each in product(LENGTHS, SIZES, ERRORS)]
    return max(
        candidates, key=lambda settings: condition_prior(settings, settings.compute_covariance(liver), rows, value)[2]
    )


def estimate_forces(liver: Liver, clouds: list[np.ndarray]) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Estimate forces (3 f,) [N], their covariance, and the computing time [s], cloud by cloud."""
    settings, force, found = choose_hyperparameters(liver, clouds[0]), np.zeros(3 * len(liver.patch)), []
    prior = settings.compute_covariance(liver)
    for cloud in clouds:
        begun = time.perf_counter()
        for _ in range(ROUNDS):
            force, covariance, _ = condition_prior(settings, prior, *linearise_observation(liver, cloud, force))
        found.append((force, covariance, time.perf_counter() - begun))
    return found


def measure_sequence(folder: Path, mesh: str, name: str) -> str:
    """Estimate one sequence; return its row of the table."""
    sequence = folder / "sequences" / name
    liver = read_liver(folder, mesh, sequence)
    true = np.load(sequence / "true-forces.npy")
    clouds = [np.loadtxt(path) for path in sorted((sequence / "pointclouds").glob("pc*.txt"))]
    if len(clouds) != len(true):
        raise InputError(f"{sequence}: {len(clouds)} clouds and {len(true)} true forces: the folder is not whole.")
    places = np.load(sequence / "positions-default.npy").reshape(len(true), -1, 3)
    rest = meshio.read(folder / "mesh-default" / "liver.msh").points
    at, off, position, held, seconds = locate(liver.mesh, rest), [], [], [], []
    with limit_to_one_thread():  # matrix products are small
        found = estimate_forces(liver, clouds)
    for (force, covariance, took), truth, place in zip(found, true, places, strict=True):
        miss = force.reshape(-1, 3).sum(axis=0) - truth
        spread = covariance.reshape(len(liver.patch), 3, len(liver.patch), 3).sum(axis=(0, 2))
        off.append(np.linalg.norm(miss) / np.linalg.norm(truth))
        held.append(miss @ np.linalg.solve(spread, miss) < RADIUS_SQUARED)
        position.append(np.linalg.norm(rest + at.interpolate((liver.motion @ force)[None])[0] - place, axis=1))
        seconds.append(took)
    mean, p95 = 1e3 * np.mean(position), 1e3 * np.percentile(position, 95.0)
    kind = "neohookean" if "neohookean" in name else "linear"
    return (
        f"| {name} | {100.0 * np.mean(off):.1f} % | {100.0 * np.mean(held):.0f} % | {mean:.2f}, {p95:.2f} mm "
        f"| {1e3 * np.median(seconds):.0f} ms | {PUBLISHED[kind]} |"
    )


def list_sequences(folder: Path) -> list[str]:
    """List the names of the sequences in a folder, in either layout of the data."""
    base = folder / "sequences"
    return sorted(path.parent.relative_to(base).as_posix() for path in base.rglob("true-forces.npy"))


def main(argv: list[str] | None = None) -> int:
    """Print a table; return 2 if the folder does not contain the data."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="data/liver of the repository")
    parser.add_argument("--mesh", choices=("remeshed", "default"), default="remeshed", help="mesh of the estimate")
    parser.add_argument("--sequences", nargs="+", help="names such as linear/s1 (default: all)")
    args = parser.parse_args(argv)
    try:
        names = args.sequences or list_sequences(args.folder)
        if not names:
            raise InputError(f"{args.folder}: holds no sequences. Give the folder data/liver of the repository.")
        print("| sequence | force is off by | in its 95 % ellipsoid | positions: mean, p95 | an update | published |")
        print("|---|---|---|---|---|---|")
        for name in names:
            print(measure_sequence(args.folder, args.mesh, name), flush=True)
    except InputError as error:
        print(f"liver_sequences: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
