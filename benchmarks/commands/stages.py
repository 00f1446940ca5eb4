"""`python -m benchmarks stages`: time of each stage, as a table."""

import argparse
import json
import sys
from dataclasses import asdict

from scenes.options.patient_options import add_patient, build_requested_scene, choose_deformer, open_patient
from scenes.options.shared_options import add_json
from sim.arguments import check_integer
from sim.errors import InputError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    from scenes.cli import add_plugin

    parser.add_argument("scene", nargs="?", default="press", help="a built-in scene")
    add_patient(parser)
    add_plugin(parser)
    parser.add_argument("--solves", type=int, default=64, help="loads in the batch")
    parser.add_argument("--batch", type=int, default=64, help="loads solved together")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Measure the stages of a scene, and print them row by row."""
    from scenes.analysis.measurement import describe_machine
    from scenes.play.deformers import describe_solvers
    from scenes.script.scene import SCENES, find_scene
    from sim.effects import ToolForce

    from ..studies.stages import measure_stages

    check_integer("--batch", args.batch, 1)
    theatre = open_patient(args, args.scene)
    scene = build_requested_scene(args, args.scene, theatre)
    if not any(isinstance(effect, ToolForce) for effect in scene.effects):
        pushing = ", ".join(
            name
            for name in SCENES
            if find_scene(name).observation_model is None and ToolForce() in find_scene(name).effects
        )
        raise InputError(f"in the scene {scene.name} no tool pushes, which is what is measured: choose {pushing}.")
    name = choose_deformer(args, theatre, scene)
    player = theatre.build_player(name, scene)
    found, solvers = [], []
    where = describe_machine(args.device)
    table = sys.stderr if args.json else sys.stdout
    print(f"{where}\n\n| stage | median | p95 | | what |\n|---|---|---|---|---|", file=table)
    for row in measure_stages(theatre, player, name, args.solves, args.batch, solvers.append):
        found.append(row)
        p95 = "" if row.p95 is None else f"{row.p95:.3g}"
        print(f"| {row.name} | {row.median:.3g} | {p95} | {row.unit} | {row.note} |", file=table, flush=True)
    plan = tuple(line for fem in solvers for line in describe_solvers(fem))
    if plan:
        print("\nHow the finite elements go about a load:\n", *(f"- {line}" for line in plan), sep="\n", file=table)
    if args.json:
        print(json.dumps({"machine": where, "plan": plan, "rows": [asdict(row) for row in found]}))
    return 0
