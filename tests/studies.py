"""A small report's study: palpation of a box, of which two loads are played."""

import json
from dataclasses import asdict

import msgspec

from scenes.commands.report import QUICK_COUNTS
from scenes.report.finite_elements import FamilySpec, FemVariant
from scenes.report.learner import LearnerSpec
from scenes.report.reference import solve_beyond, solve_reference
from scenes.report.row import ReportRow
from scenes.report.study import ReportStudy
from sim.accuracy import TRAIN
from sim.effects import NodalForce, build_push_effects
from sim.fem import Fem
from sim.material import Material, to_tissue_json
from surrogate.data.simulate import simulate
from surrogate.data.tool_loads import draw

TISSUE = Material("neo-hookean", 3000.0, 0.45)
SPECS = (
    FemVariant("FEM"),
    FemVariant("linear law", law="linear"),
    LearnerSpec("linear"),
    FamilySpec("condensed"),
    FamilySpec("thin-plate"),
)


def nothing(count):
    """No progress is shown."""


def study_of(folder, box, count):
    """`count` loads on a box, and what the reference answers, in a folder."""
    fem = Fem(box, (*build_push_effects(box, TISSUE), NodalForce()), TRAIN, "cpu", element="p1")
    said = {"tissue": to_tissue_json(TISSUE), "element": "p1", "preset": "palpation"}
    simulate(folder / "data.h5", fem, draw("palpation", box, count, 0), said)
    return solved(ReportStudy(folder / "data.h5", folder, "cpu", loads=2, beyond=QUICK_COUNTS[2], timed=30))


def solved(study):
    """The study, when its reference is solved."""
    solve_reference(study, nothing, TRAIN)
    solve_beyond(study, nothing)
    return study


def read_back(row):
    """A row as a report keeps it and reads it again."""
    return msgspec.convert(json.loads(json.dumps(asdict(row))), ReportRow)
