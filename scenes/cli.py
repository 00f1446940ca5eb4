"""The command line: `sulcus COMMAND ...`."""

from __future__ import annotations

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
from sim.runtime.versions import version_of

from .commands.guidance import guidance
from .commands.interrupt import INTERRUPTED

# A command's module is imported only when it is asked for: `sulcus solve` does not wait for torch.
COMMANDS = {
    "anatomy": "make a tetrahedral brain with a tumour, from a label volume or drawn in a healthy head",
    "solve": "find the static equilibrium of any tetrahedral mesh",
    "simulate": "draw loads of a tool and answer them by finite elements, into a data set",
    "train": "fit surrogate models to a data set, and compare their errors on cortex that was left out",
    "judge": "test models on loads that they have never seen: errors, and whether their bounds hold",
    "export": "write a trained model as an ONNX file, for programs in other languages",
    "patient": "make all that the scenes need from a label volume: anatomy, data set, models",
    "locate": "tell where the tumour is from what is seen of the open cortex, and how surely",
    "locator": "make what `locate`, and scenes in which a tumour is located, need of an anatomy",
    "fit": "find a patient's tissue and skull from what is seen of the open cortex in several frames",
    "scenes": "list the built-in scenes: effects, who can play them, pictures and cost",
    "effects": "measure what each effect of a scene costs, and what it changes",
    "demo": "play a scene on a page in the browser",
    "render": "write the frames of a scene as pictures, without display",
    "collect": "write a scene as one episode: pictures, depth, segmentation, forces, tumour",
    "episodes": "make thousands of scripted surgeries, drawn from a plan, by many processes and machines",
    "convert": "write episodes as LeRobot, robomimic, pictures and tables or XDMF, or the card of a data set",
    "validate": "look whether episodes are whole: their arrays, pictures, checksums and silhouettes",
    "markers": "write the pages to print: markers of tool and patient, and the board that calibrates cameras",
    "track": "follow the tool and the patient's reference through a film: poses, covariances, and where they are lost",
    "warp": "write a deformed brain for 3D Slicer and ITK: fields, the patient's own images, meshes, points",
    "film": "film a scene as a real camera would, with printed targets in view, and write down what is true of it",
    "overlay": "draw where the tumour is into a film or what a camera sees, by the tracked reference and tool",
    "link": "send where the tumour is to 3D Slicer, PLUS and others by OpenIGTLink, live, by the poses that they send",
    "calibrate": "find a camera's intrinsics, a tool's tip, or how two tracked bodies lie together, and how surely",
    "register": "find how a scan lies beside the patient's reference, from points that were touched, and how surely",
    "sensitivity": "measure how the tumour's motion changes with tissue, skull, tool and element, one at a time",
    "uncertainty": "measure how far a scene's tumour may be from where it is in a patient, and what of that is whose",
    "budget": "tell how many millimetres to believe of an overlay on a tracked camera, and what takes most of them",
    "report": "measure what accuracy costs in time, for every deformer, as a page",
    "check": "play scenes without display, and fail where a picture is farther off than its stated bounds",
}

# Commands that make or read models, whose learners may be a user's own.
MAKING = ("train", "patient")
READING = (
    "judge", "export", "scenes", "effects", "demo", "render", "film", "overlay", "link", "collect", "sensitivity",
    "uncertainty", "budget", "check",
)  # fmt: skip


# More threads of a library's wait for one another: products here are small.
MOST_THREADS = 4

POINT = re.compile(r"-[\d.][^,]*,[^,]+,[^,]+(?:,[^,]+)?")
"""A point, or a load there, whose first coordinate is negative: argparse would take it for an option."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command. Returns 0 (done), 1 (ran, but did not reach what was asked) or 2 (bad input)."""
    if argv is None:
        limit_threads()
    arguments = with_points(sys.argv[1:] if argv is None else argv)
    asked = arguments[0] if arguments else None
    if asked == "bench":
        print("sulcus bench: is now `python -m benchmarks NAME`, from a checkout of the repository.", file=sys.stderr)
        return 2
    parser, _ = make_parsers(asked)
    return carried_out(parser.parse_args(arguments), "scenes")


def carried_out(args: argparse.Namespace, package: str) -> int:
    """Run a command, of `package`, and say what is wrong with its input. Returns as `main`."""
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
        return INTERRUPTED


def limit_threads() -> None:
    """Hold libraries that are not loaded yet to `MOST_THREADS`, here and in processes to come, if nobody said more."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, str(min(MOST_THREADS, os.cpu_count() or 1)))


def make_parsers(*asked: str | None) -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """The parser of `sulcus`, and that of each command by name; those asked for know their arguments and examples."""
    parser = argparse.ArgumentParser(
        prog="sulcus",
        description=__doc__,
        epilog="First steps: `sulcus demo`, then `sulcus patient --help`. Research only; not a medical device.",
    )
    parser.add_argument("--version", action="version", version=f"sulcus {version_of('sulcus')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, text in COMMANDS.items():
        command = commands.add_parser(
            name,
            help=text,
            description=text[0].upper() + text[1:] + ".",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        command.set_defaults(program=f"sulcus {name}")
        if name in asked:
            command.epilog = guidance(name)
            importlib.import_module(f"scenes.commands.{name}").add_arguments(command)
            if name in MAKING + READING:
                add_plugin(command)
    return parser, dict(commands.choices)


def add_plugin(parser: argparse.ArgumentParser) -> None:
    """Declare the files that bring learners."""
    parser.add_argument(
        "--plugin",
        action="append",
        default=[],
        metavar="FILE.py",
        help="a file with learners of your own; it is run as Python",
    )


def with_points(arguments: Sequence[str]) -> list[str]:
    """The arguments, with a point joined to the option before it: `--opening-at=-3,4,5`."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1].startswith("--") and POINT.fullmatch(argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


if __name__ == "__main__":
    sys.exit(main())
