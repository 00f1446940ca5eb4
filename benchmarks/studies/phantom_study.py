"""Motion of the lesion of a silicone brain phantom between fluid levels: measured by CT, and predicted by FEM.

The data set github.com/tanadul-s/brain-shift-prediction-v3 has a phantom ("cuboidbrain3") with a stiff lesion and CT
markers. The initial scan shows it upright on its fixture in air. Three others show it on its side: a in air, b and c in
water up to 0 and 75 mm. Coordinates are those of the deformed scans in the authors' script: z points upwards.

Measured from the public files alone: the centroid of the lesion's surface moves by 1.7 mm from a to b, by 3.0 mm from b
to c, and by 4.6 mm from a to c (its marker: 2.0, 2.5 and 4.4 mm). The reference markers are 5 to 15 mm apart and the
lesion is 70 mm away, so these motions are uncertain: translation alone gives 1.9, 3.1 and 4.8 mm.

The model neglects contact with the printed skull and the different density of the lesion, and applies the fluid level
to the undeformed phantom, whose markers sag by 5 to 12 mm. Like `Gravity`, it takes the initial scan for an equilibrium
under weight; the authors take it for unloaded.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.optimize import nnls
from trimesh import transform_points

from ar.tracking.registration import fit_rigid
from sim.anatomy import BRAIN_LABEL, TUMOUR_LABEL, Anatomy
from sim.bodies.markups import SIGNS
from sim.bodies.meshfile import read_mesh
from sim.effects import Elasticity, Gravity, Held
from sim.errors import InputError
from sim.fem import Fem
from sim.geometry.closest_point import find_closest_points
from sim.geometry.locate import locate
from sim.geometry.surface import is_enclosing
from sim.geometry.tetmesh import TetMesh
from sim.loads import build_posture
from sim.material import Material
from sim.runtime.outside_files import wrap_errors

SCANS = Path("data/phantom/cuboidbrain3/scanned")
MESHES = Path("data/phantom/cuboidbrain3/mesh/measured")
BODY = MESHES / "expt4_initial/segmented_initial_silicone.msh"
STATES = "abc"
REMEDY = "Give a checkout of github.com/tanadul-s/brain-shift-prediction-v3."

# Constants of the authors: src/config/constants.yaml, scripts/phantom_cuboidbrain3.py.
YOUNG, POISSON = 21717.95, 0.353034483  # silicone: Young's modulus [Pa], Poisson's ratio
DENSITIES = 1104.375, 997.0  # silicone, water [kg/m^3]
LEVELS = {"b": 0.0, "c": 0.075}  # fluid level [m]; a has no fluid
FIXTURE = -0.01  # nodes with x up to this value are fixed [m]
REFERENCE = {
    "initial": np.array([[0, 0, 140], [0, 0, 145], [0, -10, 140], [15, 0, 140]]) / 1e3,
    "deformed": np.array([[0, 0, 120], [5, 0, 120], [0, 10, 120], [0, 0, 135]]) / 1e3,
}
"""Design coordinates (4, 3) [m] of the reference markers o, x, y, z, which differ between the two holders."""
SCAN_GRAVITY, GRAVITY = (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)  # direction in the initial scan, and in the deformed ones

STIFFNESS_RATIO = 100.0  # Young's modulus of the lesion (printed PLA, 4 GPa), relative to silicone: nearly rigid
STEPS = 4  # simulated fluid levels between two states
MAX_VERTICES = 2000  # vertices of the lesion whose distance is measured
MAX_OFFSET = 0.01  # largest distance between the lesion's surface and its marker, both as centroids [m]


@dataclass(frozen=True, eq=False)
class PhantomScan:
    """Registered scan [m]: surface markers (4, 3), lesion surface (V, 3) and (S, 3), and the transform T (4, 4).

    `residual` is the RMS distance of the registered reference markers from their design [m].
    """

    floats: np.ndarray
    points: np.ndarray
    triangles: np.ndarray
    T: np.ndarray
    residual: float

    @property
    def centroid(self) -> np.ndarray:
        """Centroid (3,) [m] of the volume that the lesion's surface encloses."""
        corners = self.points[self.triangles] - self.points.mean(axis=0)
        volumes = np.einsum("si,si->s", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
        return self.points.mean(axis=0) + volumes @ corners.sum(axis=1) / (4.0 * volumes.sum())


@dataclass(frozen=True)
class PhantomRow:
    """Motion of the lesion between two states by one source, and its errors relative to the measured motion [mm].

    `shift`: displacement of the centroid. `centroid`: error of that vector. `surface`: mean distance of the moved
    lesion's vertices from the measured surface. `markers`: RMS error of the displacements of the surface markers.
    """

    motion: str
    source: str
    shift: float
    centroid: float | None = None
    surface: float | None = None
    markers: float | None = None


def list_files(name: str) -> tuple[Path, Path]:
    """Return the files of the scan `name` (initial, a, b or c) in the data set: markers, and lesion surface."""
    if name == "initial":
        return SCANS / "expt4_initial_scan_processing/markers_initial.mrk.json", BODY.with_stem(
            "segmented_initial_lesion"
        )
    markers = SCANS / f"expt4_deformed_scan_processing/markers_deformed_{name}.mrk.json"
    return markers, MESHES / f"expt4{name}/segmented_deformed_lesion.msh"


def read_scan(folder: Path, name: str) -> PhantomScan:
    """Read the markers and the lesion of a scan, and register both by the four reference markers.

    Raises
    ------
    InputError
        A file is damaged, a marker is missing, or the lesion is far from its marker.
    """
    import meshio

    markers, lesion = (folder / path for path in list_files(name))
    with wrap_errors(markers, "markers of the phantom", REMEDY):
        markup = json.loads(markers.read_text(encoding="utf-8"))["markups"][0]
        places = {each["label"].removeprefix("marker_"): each["position"] for each in markup["controlPoints"]}
        labels = [*(f"refframe_{axis}" for axis in "oxyz"), *(f"float_{k}" for k in range(1, 5)), "lesion_centroid"]
        if lacking := [label for label in labels if label not in places]:
            raise InputError(f"{markers}: has no marker {', '.join(lacking)}. {REMEDY}")
        marked = 1e-3 * np.array([places[label] for label in labels], float) * SIGNS[markup["coordinateSystem"]]
    with wrap_errors(lesion, "a surface of Gmsh", REMEDY):
        surface = meshio.read(lesion)
        used, triangles = np.unique(surface.cells_dict["triangle"], return_inverse=True)
        points, triangles = 1e-3 * np.asarray(surface.points[used], float), triangles.reshape(-1, 3)
    design = REFERENCE["initial" if name == "initial" else "deformed"]
    T, residuals = fit_rigid(marked[:4], design)
    marked, points = (transform_points(each, T) for each in (marked, points))
    scan = PhantomScan(marked[4:8], points, triangles, T, float(np.sqrt((residuals**2).sum(axis=1).mean())))
    offset = np.linalg.norm(scan.centroid - marked[8])
    if not offset <= MAX_OFFSET:
        raise InputError(f"{lesion}: its centroid is {1e3 * offset:.0f} mm from its marker: must be 10 mm or less.")
    return scan


def read_body(folder: Path, initial: PhantomScan) -> Anatomy:
    """Read the tetrahedra of the initial scan; those inside the lesion's surface have its label.

    Raises
    ------
    InputError
        The mesh is not readable, has no tetrahedron in the lesion, or does not reach the fixture.
    """
    mesh = read_mesh(folder / BODY, "mm").mesh
    nodes = transform_points(mesh.nodes, initial.T)
    centres, corners = nodes[mesh.tets].mean(axis=1), initial.points[initial.triangles]
    near = ((centres >= initial.points.min(axis=0)) & (centres <= initial.points.max(axis=0))).all(axis=1)
    region = np.full(len(mesh.tets), BRAIN_LABEL)
    region[[tet for tet in np.flatnonzero(near) if is_enclosing(corners, centres[tet])]] = TUMOUR_LABEL
    fixed = nodes[:, 0] <= FIXTURE
    for found, lacking in ((region == TUMOUR_LABEL, "tetrahedron in the lesion"), (fixed, "node in the fixture")):
        if not found.any():
            raise InputError(
                f"{folder / BODY}: has no {lacking}: its coordinates must be those of the initial scan [mm]."
            )
    anatomy = TetMesh(nodes, mesh.tets, region, mesh.middles)
    return Anatomy(anatomy, np.repeat(fixed[:, None], 3, axis=1), np.zeros_like(nodes), np.zeros(len(nodes), bool))


def solve_levels(body: Anatomy, levels: Sequence[float], device: str) -> np.ndarray:
    """Return the displacements (n, V, 3) [m] since the initial scan, lying on the side in fluid up to n levels [m].

    Raises
    ------
    InputError
        A level has no equilibrium.
    """
    silicone = Material("neo-hookean", YOUNG, POISSON)
    laws = Elasticity(silicone, {TUMOUR_LABEL: silicone.replace_constants(STIFFNESS_RATIO * YOUNG)})
    weight = Gravity(SCAN_GRAVITY, -np.inf, *DENSITIES)
    found = Fem(body, (laws, Held(), weight), device=device).deform(build_posture(np.array(GRAVITY), np.array(levels)))
    if bad := [f"{1e3 * level:.0f}" for level, one in zip(levels, found.outcome, strict=True) if not one.good]:
        raise InputError(f"no equilibrium of the phantom was found at fluid levels of {', '.join(bad)} mm.")
    return found.displacement


def compare_motions(scans: dict[str, PhantomScan], body: Anatomy | None, device: str) -> Iterator[PhantomRow]:
    """Compare measured motions of the lesion with two predictions, or with none if there is no `body`.

    "fluid level" is the simulated motion. "four markers" is the non-negative combination of motions at simulated fluid
    levels that fits the surface markers best, so stiffness and level need not be right.
    """
    fields = np.zeros((2 * STEPS + 1, 0, 3))
    if body is not None:
        levels = [float(body.mesh.nodes[:, 2].min()), *LEVELS.values()]
        between = [np.linspace(low, high, STEPS + 1) for low, high in pairwise(levels)]
        fields = solve_levels(body, [*between[0], *between[1][1:]], device)
    for first, last in ((0, 1), (1, 2), (0, 2)):
        start, end = scans[STATES[first]], scans[STATES[last]]
        name, still = f"{STATES[first]} to {STATES[last]}", np.eye(4)
        measured = end.floats - start.floats
        yield PhantomRow(name, "measured", 1e3 * float(np.linalg.norm(end.centroid - start.centroid)))
        yield _compare(name, "no motion", still, np.zeros_like(measured), start, end)
        if body is None:
            continue
        before, steps = fields[STEPS * first], fields[STEPS * first + 1 : STEPS * last + 1] - fields[STEPS * first]
        seen = locate(body.mesh, scans["initial"].floats).interpolate(steps)
        share, _ = nnls(seen.reshape(len(seen), -1).T, measured.ravel())
        lesion = np.unique(body.mesh.tets[body.mesh.region == TUMOUR_LABEL])
        placed = body.mesh.nodes[lesion] + before[lesion]
        for source, weights in (("fluid level", np.eye(len(steps))[-1]), ("four markers", share)):
            moved = placed + np.tensordot(weights, steps[:, lesion], 1)
            yield _compare(name, source, fit_rigid(placed, moved)[0], np.tensordot(weights, seen, 1), start, end)


def _compare(
    motion: str, source: str, T: np.ndarray, floats: np.ndarray, start: PhantomScan, end: PhantomScan
) -> PhantomRow:
    """Return the errors of a rigid motion T (4, 4) of the lesion, and of displacements (4, 3) of its markers."""
    centroid = transform_points(start.centroid[None], T)[0]
    some = transform_points(start.points[:: 1 + len(start.points) // MAX_VERTICES], T)
    apart = np.linalg.norm(find_closest_points(some, end.points[end.triangles]).point - some, axis=1).mean()
    markers = np.sqrt(((floats - (end.floats - start.floats)) ** 2).sum(axis=1).mean())
    values = np.linalg.norm(centroid - start.centroid), np.linalg.norm(centroid - end.centroid), apart, markers
    return PhantomRow(motion, source, *(1e3 * float(value) for value in values))
