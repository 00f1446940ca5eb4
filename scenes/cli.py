"""Simulate brain deformation under surgical tools, and draw the tumour into camera images."""

import argparse
import importlib
import os
import re
import sys
import warnings
from collections.abc import Sequence

from sim.errors import InputError
from sim.runtime.kernel_cache import ensure_writable_cache
from sim.runtime.user_script import run_script
from sim.runtime.versions import get_version

from .commands.guidance import format_guidance
from .commands.interrupt import INTERRUPTED_CODE
from .options.help import CommandParser, replace_former_options

# Commands with their descriptions, by section. A command's module is imported only when it is called: `sulcus solve`
# does not wait for torch.
GROUPS = {
    "Start": {
        "demo": "play a scene in the browser",
        "scenes": "list the built-in scenes: effects, deformation models, images and cost",
        "patient": "build all that the scenes need from a label map: anatomy, data set, models",
    },
    "Patient model, step by step": {
        "anatomy": "build a tetrahedral brain with a tumour, from a label map or synthetic in a healthy head",
        "simulate": "sample loads of a tool and solve them by FEM, into a data set",
        "train": "fit surrogate models to a data set, and compare their errors on held-out cortex",
        "judge": "evaluate models on test loads: errors, and coverage of their bounds",
    },
    "Scenes without display": {
        "render": "write the frames of a scene as images",
        "collect": "write a scene as one episode: images, depth, segmentation, forces, tumour",
        "check": "play scenes, and fail where an image or a number exceeds its bound",
    },
    "Locate the tumour from the exposed cortex": {
        "locate": "estimate the tumour position from observations of the open cortex, with covariance",
        "locator": "precompute the ensemble for `locate` and for scenes that locate the tumour",
        "fit": "estimate a patient's tissue and skull from observations of the open cortex in several frames",
    },
    "Cameras and tracking": {
        "markers": "write printable pages: markers of tool and patient, and the board that calibrates cameras",
        "calibrate": "estimate a camera's intrinsics, a tool's tip, or a hand-eye transform, with covariance",
        "register": "register a scan to the patient's reference from touched points, with covariance",
        "track": "follow the tool and the patient's reference through a video: poses, covariances, gaps",
        "overlay": "draw the tumour into a video or a live camera, by the tracked reference and tool",
        "film": "render a scene as a tracked camera records it, with printed targets and ground truth",
        "budget": "estimate the error budget of an overlay on a tracked camera, and its largest contributions",
    },
    "Accuracy and cost": {
        "report": "measure error and time of every deformation model, as a page",
        "uncertainty": "estimate the error of a scene's tumour position, and the contribution of each source",
        "sensitivity": "measure how the tumour's motion depends on tissue, skull, tool and element",
        "effects": "measure the cost of each effect of a scene, and its influence",
    },
    "Data sets": {
        "episodes": "make thousands of simulated surgeries, sampled from a plan, on many processes and machines",
        "convert": "write episodes as LeRobot, robomimic, images and tables or XDMF, or write a data set's card",
        "validate": "check that episodes are complete: arrays, images, checksums and silhouettes",
    },
    "Other programs": {
        "solve": "compute the static equilibrium of any tetrahedral mesh",
        "warp": "write a deformed brain for 3D Slicer and ITK: fields, the patient's images, meshes, points",
        "link": "send the tumour to 3D Slicer, PLUS and others by OpenIGTLink, live, from the poses that they send",
        "export": "write a trained model as an ONNX file, or as a page that needs no server",
    },
}
# Descriptions of all commands, by name.
COMMANDS = {name: text for group in GROUPS.values() for name, text in group.items()}

MODEL_MAKING_COMMANDS = ("train", "patient")  # Commands that make models; their learners may be user-defined.
# Commands that read models; their learners may be user-defined.
MODEL_READING_COMMANDS = (
    "judge", "export", "scenes", "effects", "demo", "render", "film", "overlay", "link", "collect", "sensitivity",
    "uncertainty", "budget", "check",
)  # fmt: skip


MAX_THREADS = 4  # Maximum number of threads of a library: BLAS does not scale on these small products.

POINT_PATTERN = re.compile(r"-[\d.][^,]*,[^,]+,[^,]+(?:,[^,]+)?")
"""Pattern of a point or load with a negative first coordinate, which argparse would read as an option."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns 0 (done), 1 (the result misses a requirement) or 2 (bad input)."""
    if argv is None:
        limit_threads()
    arguments = join_points(replace_former_options(sys.argv[1:] if argv is None else argv))
    asked = arguments[0] if arguments else None
    if asked == "bench":
        print("sulcus bench: is now `python -m benchmarks NAME`, from a checkout of the repository.", file=sys.stderr)
        return 2
    parser, _ = make_parsers(asked)
    return run_command(parser.parse_args(arguments), "scenes")


def run_command(args: argparse.Namespace, package: str) -> int:
    """Run a command of `package`, and report invalid input. Returns as `main`."""
    warnings.formatwarning = lambda message, *rest: f"{args.program}: {message}\n"
    try:
        ensure_writable_cache()
        for path in getattr(args, "plugin", ()):
            run_script(path)
        return importlib.import_module(f"{package}.commands.{args.command}").run(args)
    except InputError as error:
        print(f"{args.program}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"{args.program}: stopped", file=sys.stderr)
        return INTERRUPTED_CODE


def limit_threads() -> None:
    """Limit libraries that are not loaded yet to `MAX_THREADS`, here and in child processes, unless already set."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, str(min(MAX_THREADS, os.cpu_count() or 1)))


def make_parsers(*names: str | None) -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """Return the parser of `sulcus`, and that of each command by name.

    Only the requested commands get arguments and examples.
    """
    parser = CommandParser(prog="sulcus", description=__doc__, epilog=_list_commands())
    parser.add_argument("--version", action="version", version=f"sulcus {get_version('sulcus')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        command = commands.add_parser(name, description=text[0].upper() + text[1:] + ".")
        command.set_defaults(program=f"sulcus {name}")
        if name in names:
            command.epilog = format_guidance(name)
            importlib.import_module(f"scenes.commands.{name}").add_arguments(command)
            if name in MODEL_MAKING_COMMANDS + MODEL_READING_COMMANDS:
                add_plugin(command)
    return parser, dict(commands.choices)


def _list_commands() -> str:
    """List the commands by group, with their purposes, and the first steps."""
    lines = []
    for title, group in GROUPS.items():
        lines += [f"{title}:", *(f"  {name:<12}{text}" for name, text in group.items()), ""]
    return "\n".join(
        [*lines, "First: `sulcus demo`, then `sulcus patient --help`. Research only; not a medical device."]
    )


def add_plugin(parser: argparse.ArgumentParser) -> None:
    """Declare `--plugin`, files that register model types."""
    parser.add_argument(
        "--plugin",
        action="append",
        default=[],
        metavar="FILE.py",
        help="Python file that registers user-defined model types; the file is executed",
    )


def join_points(arguments: Sequence[str]) -> list[str]:
    """Return the arguments, with a point joined to the option before it: `--opening-at=-3,4,5`."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1].startswith("--") and POINT_PATTERN.fullmatch(argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


if __name__ == "__main__":
    sys.exit(main())
