"""`python -m benchmarks gym`: steps per second of the Gymnasium environments."""

import argparse
import sys
from dataclasses import asdict

from scenes.options.shared_options import add_device, add_json, to_json_line
from sim.arguments import check_integer

# The tasks of scenes.gym, which loads Gymnasium and is imported only as this runs.
TASKS = ("palpate", "retract", "debulk")
OBSERVATIONS = ("states", "rgbd")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"of {', '.join(TASKS)} (default: all)")
    parser.add_argument("--envs", type=int, default=64, help="environments, stepped together")
    parser.add_argument("--processes", action="store_true", help="one process for each environment, by Gymnasium")
    parser.add_argument(
        "--observation",
        nargs="+",
        choices=OBSERVATIONS,
        default=list(OBSERVATIONS),
        help="observation: states, or also images (default: both)",
    )
    parser.add_argument("--size", default="160x120", metavar="WxH", help="size of images [pixel]")
    parser.add_argument("--steps", type=int, default=40, help="steps of each environment in a repeat")
    parser.add_argument("--repeats", type=int, default=5, help="number of repeats; the median is reported")
    parser.add_argument("--anatomy", default="template", help="a .vtu file (default: the template that ships)")
    parser.add_argument("--model", help="file of trained models (default: that next to the anatomy)")
    parser.add_argument("--physics", default="auto", help="auto, model or fem")
    add_device(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Step the environments under their scripted policies."""
    from gymnasium import make_vec
    from tqdm import tqdm

    from scenes.analysis.measurement import describe_machine
    from scenes.gym.tasks import find_task

    from ..studies.frame import parse_image_size
    from ..studies.gym_rates import measure_rate

    for name in ("envs", "steps", "repeats"):
        check_integer(f"--{name}", getattr(args, name), 1)
    size, rows = parse_image_size(args.size), []
    apart = ", each in a process of its own" if args.processes else ""
    where = f"{describe_machine(args.device)}; {args.envs} environments{apart}, pictures of {size[0]} x {size[1]}"
    for task in args.tasks or TASKS:
        for observation in args.observation:
            process = {"vectorization_mode": "async", "vector_kwargs": {"context": "spawn"}} if args.processes else {}
            environment = make_vec(
                f"scenes.gym:sulcus/{find_task(task).name.capitalize()}-v0", args.envs, **process, anatomy=args.anatomy,
                observation=observation, physics=args.physics, device=args.device, size=size, model=args.model,
            )  # fmt: skip
            with tqdm(desc=f"{task}, {observation}", total=args.repeats + 1, unit="repeat", file=sys.stderr) as bar:
                rows.append(measure_rate(environment, task, observation, args.steps, args.repeats, bar.update))
            environment.close()
    if args.json:
        print(to_json_line({"machine": where, "rows": [asdict(row) for row in rows]}))
        return 0
    print(f"{where}\n\n| task | observation | steps/s: median | least | most | in contact |\n|---|---|---|---|---|---|")
    for row in rows:
        print(
            f"| {row.task} | {row.observation} | {row.median:.0f} | {row.least:.0f} | {row.most:.0f} | "
            f"{100.0 * row.touching:.0f} % |"
        )
    return 0
