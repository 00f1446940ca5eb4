"""`sulcus export`: write a trained model as an ONNX file for other programs, or as a page that needs no server."""

import argparse
from pathlib import Path

from sim.errors import InputError

from ..options.outputs import add_force, check_output_path

ONNX, HTML = "onnx", "html"  # Kinds of file.
MODEL_SUFFIX = ".model.npz"  # Ending of a model file.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command to its parser."""
    parser.add_argument(
        "model",
        type=Path,
        nargs="?",
        metavar="MODEL.npz",
        help="from `sulcus train` (html only, default: the template's models)",
    )
    parser.add_argument(
        "--to",
        choices=(ONNX, HTML),
        help="onnx: graph for other programs. html: page of the scene press in one file, in which the tool is dragged "
        "without a server (default: by the ending of --out)",
    )
    parser.add_argument(
        "--out",
        required=True,
        metavar="MODEL.onnx",
        help="file to write, .onnx or .html; inputs and outputs of a graph carry descriptions",
    )
    parser.add_argument(
        "--learner",
        help="name of the model (default: the one with the smallest error bound; html: with the fewest numbers)",
    )
    parser.add_argument(
        "--anatomy", type=Path, help=f"anatomy it was trained on, .vtu (default: MESH.vtu next to MESH{MODEL_SUFFIX})"
    )
    parser.add_argument(
        "--cortex",
        action="store_true",
        help="onnx: also predict the open cortex; needs the footprint's weights at its nodes as input",
    )
    add_force(parser)


def run(args: argparse.Namespace) -> int:
    """Export a trained model to a file; return 0.

    Raises
    ------
    InputError
        The model or mesh is missing, the file has no model of this name, or `write_onnx` or `write_html` rejects the
        input.
    """
    if (args.to or Path(args.out).suffix[1:]) == HTML:
        return _write_page(args)
    from sim.bodies.meshfile import read_anatomy
    from surrogate.model.store import load
    from surrogate.onnx_export.export import write_onnx

    out = check_output_path(args.out, ".onnx", args.force)
    if args.model is None:
        raise InputError("no model is given: give MODEL.npz of `sulcus train`.")
    models = load(args.model, read_anatomy(_find_mesh(args)))
    name = args.learner or min(models, key=lambda each: models[each].bound)
    if name not in models:
        raise InputError(f"{args.model}: no learner is called {name} in it: choose from {', '.join(models)}.")
    write_onnx(out, name, models[name], args.cortex)
    print(f"{name}, the tumour{' and the open cortex' if args.cortex else ''}, written: {out}")
    return 0


def _find_mesh(args: argparse.Namespace) -> Path:
    """Return the path of the mesh that belongs to the model file."""
    if not args.model.is_file():
        raise InputError(f"{args.model}: no such file. Give a model of `sulcus train`.")
    mesh = args.anatomy
    if mesh is None:
        if not args.model.name.endswith(MODEL_SUFFIX):
            raise InputError(
                f"{args.model}: is not called MESH{MODEL_SUFFIX}, so its mesh is not known. Give the mesh by --anatomy."
            )
        mesh = args.model.with_name(args.model.name.removesuffix(MODEL_SUFFIX) + ".vtu")
    if not mesh.is_file():
        raise InputError(f"{mesh}: no such file, but {args.model} needs its mesh. Give the mesh by --anatomy.")
    return mesh


def _write_page(args: argparse.Namespace) -> int:
    """Write the model as an HTML page; return 0."""
    from ..html.document import write_html
    from ..play.deformers import open_theatre
    from ..script.scene import find_scene

    out = check_output_path(args.out, ".html", args.force)
    if args.cortex:
        raise InputError("--cortex is for ONNX: a page contains the cortex anyway. Leave it out.")
    mesh = args.anatomy if args.model is None else _find_mesh(args)
    found = write_html(out, open_theatre(mesh, args.model, "cpu"), find_scene("press"), args.learner)
    content = "the tumour and the open cortex" if found.cortex else "the tumour (with the open cortex it is too large)"
    print(f"{found.name}, {content}, written: {out} ({out.stat().st_size / 1e6:.1f} MB)")
    return 0
