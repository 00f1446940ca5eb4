"""`sulcus export`: a trained model as an ONNX file, for programs in other languages."""

from __future__ import annotations

import argparse
from pathlib import Path

from sim.errors import InputError

from ..options.outputs import add_force, check_output_path

MODEL_SUFFIX = ".model.npz"  # Ending of a model file.


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("model", type=Path, metavar="MODEL.npz", help="from `sulcus train`")
    parser.add_argument(
        "--out",
        required=True,
        metavar="MODEL.onnx",
        help="ONNX file to write; its inputs and outputs carry descriptions",
    )
    parser.add_argument("--learner", help="name of the model (default: the one with the smallest error bound)")
    parser.add_argument(
        "--anatomy", type=Path, help=f"anatomy it was trained on, .vtu (default: MESH.vtu next to MESH{MODEL_SUFFIX})"
    )
    parser.add_argument(
        "--cortex",
        action="store_true",
        help="include the open cortex; the graph then needs the footprint's weights at its nodes",
    )
    add_force(parser)


def run(args: argparse.Namespace) -> int:
    """Return 0 when the file is written.

    Raises
    ------
    InputError
        A model or a mesh that is not there, or a learner that is not in the file.
    """
    from sim.bodies.meshfile import read_anatomy
    from surrogate.model.store import load
    from surrogate.onnx_export.export import write_onnx

    out = check_output_path(args.out, ".onnx", args.force)
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
    models = load(args.model, read_anatomy(mesh))
    name = args.learner or min(models, key=lambda each: models[each].bound)
    if name not in models:
        raise InputError(f"{args.model}: no learner is called {name} in it: choose from {', '.join(models)}.")
    write_onnx(out, name, models[name], args.cortex)
    print(f"{name}, the tumour{' and the open cortex' if args.cortex else ''}, written: {out}")
    return 0
