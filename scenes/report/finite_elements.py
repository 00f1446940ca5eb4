"""Rows of FEM variants and model families: each test load is solved alone, from the undeformed configuration."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sim.accuracy import MIN_TOLERANCE, Accuracy, Precision
from sim.anatomy import Anatomy
from sim.bodies.meshfile import read_anatomy, write_anatomy
from sim.bodies.refine import refine
from sim.bodies.subject import MeshPlan, make_anatomy
from sim.bodies.template import Tumour, build_template_subject
from sim.deformation import Deformation, Deformer, Outcome
from sim.discretisation.footprint import find_nearest_point
from sim.effects import Elasticity, build_push_effects
from sim.errors import InputError
from sim.families.registry import build_family
from sim.fem import Fem
from sim.geometry.locate import locate
from sim.loads import Loads, Pushed
from sim.material import IsotropicTissue, Material, Tissue

from ..analysis.measurement import time_work
from .adaptation import debulk_tumour
from .pose import measure_pose_error
from .row import (
    DIFFERENCE,
    ERROR,
    TOLERANCE_ALONE,
    ReportRow,
    compare_with_reference,
    compute_load_errors,
    summarise_times,
)
from .study import ReportStudy

OWN_MESH, HALVED_MESH = "own", "halved"  # Meshes: that of the data; with every edge halved.
STANDARD_TOLERANCE = 1e-4  # Solver tolerance of data sets.
GEOMETRY, SPRINGS, MECHANICS = "geometry", "springs", "other mechanics"  # Kinds of families.
KINDS = {
    **dict.fromkeys(("kelvinlets", "thin-plate", "lattice"), GEOMETRY),
    **dict.fromkeys(("mass-spring", "xpbd"), SPRINGS),
    **dict.fromkeys(("boundary-elements", "condensed", "explicit", "element-free"), MECHANICS),
}
"""Kind of each model family; a plot has one colour for each kind."""


@dataclass(frozen=True)
class FemVariant:
    """Variant of the FEM model; None for law or element means the value of the data set.

    `mesh` is `OWN_MESH`, `HALVED_MESH` (every edge is halved), or the number of nodes of a template mesh. The default
    precision is single, or double if single precision cannot reach the tolerance; the default device is the study's.
    """

    name: str
    law: str | None = None
    element: str | None = None
    mesh: str = OWN_MESH
    tolerance: float = STANDARD_TOLERANCE
    precision: Precision | None = None
    device: str | None = None

    @property
    def accuracy(self) -> Accuracy:
        """Accuracy settings of the solver."""
        precision: Precision = "float32" if self.tolerance >= MIN_TOLERANCE["float32"] else "float64"
        return Accuracy(tolerance=self.tolerance, precision=self.precision or precision)


@dataclass(frozen=True)
class FamilySpec:
    """Model family of `FAMILIES`, on the mesh of the data set."""

    name: str


def measure_elements(study: ReportStudy, spec: FemVariant) -> ReportRow:
    """Measure errors and times of an FEM variant, as a row of the report.

    Raises
    ------
    InputError
        Input that `Fem` rejects, or a law for which the data set's tissue has no constants.
    """
    body = find_body(study, spec.mesh)
    fem, set_up = time_work(_build_fem, study, spec, body)
    loads = study.test_loads if spec.mesh == OWN_MESH else move_pushes_onto(body, study.test_loads)
    law, element = spec.law or get_law_name(study.tissue) or "default", spec.element or study.element
    row = ReportRow(
        spec.name,
        "finite elements",
        against=describe_difference(study, spec),
        set_up=set_up,
        plan=fem.plan.explain(),
        command=f"sulcus simulate --material {law} --element {element} --tolerance {spec.tolerance:g} --out DATA.h5",
    )
    row = _measure_loads(study, row, fem, loads)
    if not study.thorough and spec != FemVariant(spec.name):
        return row
    debulked = debulk_tumour(body)
    adapt = time_work(lambda: _build_fem(study, spec, debulked).deform(loads.select(np.array([0]))))[1]
    return replace(row, adapt=adapt)


def measure_family(study: ReportStudy, spec: FamilySpec) -> ReportRow:
    """Measure errors and times of a model family, as a row of the report.

    Raises
    ------
    InputError
        The family rejects the tissue or the anatomy.
    """

    def build(body: Anatomy) -> Deformer:
        return build_family(spec.name, body, build_push_effects(body, study.get_tissue_on(body)), study.device)

    model, set_up = time_work(build, study.anatomy)
    command = f"sulcus render press --deformer {spec.name}"
    row = ReportRow(spec.name, KINDS[spec.name], set_up=set_up, command=command)
    row = _measure_loads(study, row, model, study.test_loads)
    debulked, first = debulk_tumour(study.anatomy), study.test_loads.select(np.array([0]))
    return replace(row, adapt=time_work(lambda: build(debulked).deform(first, at=debulked.tumour_nodes))[1])


def _measure_loads(study: ReportStudy, row: ReportRow, model: Deformer, loads: Loads) -> ReportRow:
    """Return `row` with the errors and times of `model`, which solves the loads one by one, and in a batch."""
    own, drawn = study.anatomy, study.read_nodes
    same = model.anatomy is own
    located = None if same else locate(model.anatomy.mesh, own.mesh.nodes[drawn])
    model.deform(loads.select(np.array([0])), at=drawn if same else None)  # kernels are compiled at their first launch
    fields, outcomes, seconds = [], [], []
    (pushed,) = loads.get_all(Pushed)

    def read(result: Deformation) -> np.ndarray:
        return result.displacement if located is None else located.interpolate(result.displacement)

    def solve(rows: np.ndarray, force: np.ndarray) -> np.ndarray:
        pushes = Pushed(pushed.point[rows], force, pushed.footprint[rows])
        return read(model.deform(replace(loads.select(rows), causes=(pushes,)), at=drawn if same else None))

    for number in range(len(loads)):
        result, spent = time_work(model.deform, loads.select(np.array([number])), None, drawn if same else None)
        seconds.append(spent)
        fields.append(read(result)[0])
        outcomes.append(result.outcome[0])
    work = model.deform, loads, None, drawn if same else None
    together = time_work(*work)[1] if study.thorough or study.on_card else None
    field, tumour = np.array(fields), np.isin(drawn, own.tumour_nodes)
    good = np.array([outcome is not Outcome.NOT_FINITE for outcome in outcomes])
    return replace(
        row,
        reference=compare_with_reference(study, field[:, tumour], good, own.tumour_nodes),
        outcomes=dict(Counter(outcome.name for outcome in outcomes)),
        batch_ms=None if together is None else 1e3 * together / len(loads),
        pose=measure_pose_error(study, solve) if study.thorough else None,
        **compute_load_errors(study, field, good, drawn),
        **summarise_times(seconds),
    )


def _build_fem(study: ReportStudy, spec: FemVariant, body: Anatomy) -> Fem:
    """Build the FEM solver of a variant for single loads on `body`."""
    effects = build_push_effects(body, change_law(study.get_tissue_on(body), spec.law))
    return Fem(
        body, effects, spec.accuracy, spec.device or study.device, None, spec.element or study.element, live=True
    )


def describe_difference(study: ReportStudy, spec: FemVariant) -> str:
    """Return the kind of difference from the reference: `ERROR`, `DIFFERENCE` or `TOLERANCE_ALONE`."""
    if change_law(study.tissue, spec.law) != study.tissue:
        return DIFFERENCE
    same = (spec.element or study.element) == study.reference_element and spec.mesh == (
        HALVED_MESH if study.thorough else OWN_MESH
    )
    return TOLERANCE_ALONE if same else ERROR


def find_body(study: ReportStudy, mesh: str) -> Anatomy:
    """Return the anatomy on the mesh `mesh` of a `FemVariant`; template meshes are built once and stored."""
    if mesh == OWN_MESH:
        return study.anatomy
    if mesh == HALVED_MESH:
        return refine(study.anatomy)
    return read_anatomy(build_template_mesh(study.folder / "meshes", int(mesh)))


def build_template_mesh(folder: Path, size: int) -> Path:
    """Return the path of a template mesh of about `size` nodes; build the mesh if the file does not exist."""
    return build_mesh_once(folder / f"template_{size}.vtu", Tumour(), MeshPlan(size))


def build_mesh_once(path: Path, tumour: Tumour, plan: MeshPlan) -> Path:
    """Return `path` of a template mesh with a tumour; build the mesh if the file does not exist."""
    if not path.exists():
        write_anatomy(path, make_anatomy(build_template_subject(tumour), plan))
    return path


def get_law_name(tissue: Elasticity) -> str | None:
    """Return the name of the brain's material law; None if the tissue has no default law."""
    return None if tissue.default is None else tissue.default.law


def change_law(tissue: Elasticity, law: str | None) -> Elasticity:
    """Return the tissue with another material law and unchanged constants in all regions (None: the same tissue).

    Raises
    ------
    InputError
        The constants of a tissue are not E and nu.
    """
    if law is None:
        return tissue

    def obeying(one: Tissue | None) -> Tissue:
        if not isinstance(one, IsotropicTissue):
            has = "a law for each region" if one is None else f"{one.law}, whose constants no other law has"
            raise InputError(f"the data's tissue obeys {has}: nothing to compare.")
        return one if one.law == law else Material(law, one.young, one.poisson, one.prony)

    return Elasticity(obeying(tissue.default), {label: obeying(one) for label, one in tissue.regions.items()})


def move_pushes_onto(body: Anatomy, loads: Loads) -> Loads:
    """Return the loads with each push moved to the nearest point of the open cortex of `body`."""
    (pushed,) = loads.get_all(Pushed)
    corners = body.mesh.nodes[body.open_surface]
    return Loads(
        (replace(pushed, point=np.array([find_nearest_point(corners, point) for point in pushed.point])),), loads.time
    )
