"""`sulcus judge`: evaluate models on an independent data set: errors, and coverage of their bounds."""

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from sim.errors import InputError

from ..options.shared_options import add_json


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument("model", metavar="MODEL.npz", help="models from `sulcus train`")
    parser.add_argument(
        "data", metavar="FRESH.h5", help="test loads from `sulcus simulate` on the same mesh, with another --seed"
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Evaluate the models, and report errors and coverage; return 0 regardless of the results.

    Raises
    ------
    InputError
        The loads are at positions of the models' training, or have another tissue or element type.
    """
    from sim.bodies.tip_distance import build_tip_gauge
    from surrogate.data.dataset import read_dataset
    from surrogate.data.tool_loads import compute_rejected_share, describe_rejected_loads
    from surrogate.evaluation.coverage import compute_coverage, measure_distance_coverage
    from surrogate.evaluation.score import compare_forces, format_scores, score
    from surrogate.model.store import load

    data = read_dataset(args.data)
    models = load(args.model, data.anatomy)
    loads = data.loads.select(np.flatnonzero(data.good))
    nodes = data.anatomy.tumour_nodes
    truth = data.read_displacement(nodes)[data.good]
    for name, model in models.items():
        trained, here = _get_physics(model.training), _get_physics(data.provenance)
        for setting in here:
            if trained[setting] != here[setting]:
                raise InputError(
                    f"{args.data}: its {setting} is {here[setting]}, but {name} was trained on {trained[setting]}: "
                    "the error would include this difference. Simulate with that of the model."
                )
    for name, model in models.items():
        if model.envelope.is_training_point(model.to_input(loads).point, data.anatomy.mesh.nodes):
            raise InputError(
                f"{args.data}: holds loads at places where {name} was trained: simulate others, with another --seed."
            )
    scores = [score(name, model, loads, truth, nodes) for name, model in models.items()]
    bounds = {name: compute_coverage(model, loads, truth) for name, model in models.items() if model.bounds is not None}
    gauge = build_tip_gauge(data.anatomy)
    distance = gauge.compute_distances(loads, data.read_displacement(gauge.nodes)[data.good], gauge.nodes, data.tool)
    ranged = {
        name: measure_distance_coverage(model, loads, distance)
        for name, model in models.items()
        if model.tip is not None and model.tip.bound is not None
    }
    reaction = data.read_reaction()
    forces = {
        name: compare_forces(model, loads, reaction[data.good, 0, :3])
        for name, model in models.items()
        if model.force is not None and reaction is not None
    }
    motion = 1e3 * float(np.linalg.norm(truth, axis=2).mean())
    preset = "" if data.tool is not None else data.provenance.get("preset", "")
    if args.json:
        covered, of_tip = ({name: asdict(found) for name, found in each.items()} for each in (bounds, ranged))
        figures = {"scores": [asdict(row) for row in scores], "coverage": covered, "distance_coverage": of_tip}
        figures["force"] = {name: asdict(found) for name, found in forces.items()}
        print(json.dumps({**figures, "motion_mm": motion, "nominal_refused": compute_rejected_share(preset)}))
    else:
        print(f"{len(loads)} loads, compared with their FEM solutions:\n{format_scores(scores, motion)}")
        if describe_rejected_loads(preset):
            print(describe_rejected_loads(preset))
        for name in models:
            for bound, coverage in (("bounds", bounds), ("bounds of the distance from tip to tumour", ranged)):
                print(f"{name}: {bound} cover {coverage[name]}" if name in coverage else f"{name}: has no {bound}")
            if name in forces:
                print(f"{name}: the tool's force: {forces[name]}")
    return 0


def _get_physics(facts: Mapping[str, str]) -> dict[str, object]:
    """Return the properties that must agree in a comparison of models and data: tissue of all regions, and element."""
    from surrogate.data.solution_rows import TISSUE_KEY, read_tissue_text

    return {"tissue": read_tissue_text(facts) if TISSUE_KEY in facts else None, "element": facts.get("element")}
