"""Learned models as ONNX files: one graph from loads to displacements and bounds, for programs without this project."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sim.errors import InputError
from sim.runtime.atomic_files import written_whole

from ..data.cortex_patch import open_patch
from ..model.conformal import LEVELS
from ..model.learned import Learned, Part
from .bound import Push, excess_of, place_of, promised, push_of, unpromised
from .graph import Port, Sheet, Wire
from .regressors import WIRED

if TYPE_CHECKING:
    from onnx import ModelProto

# Of names, shapes and meaning of inputs, outputs and metadata.
FORMAT = "sulcus onnx 1"
TEXT = (
    "Displacements of a brain under a pressing tool, and how far they may be off, as sulcus learnt them from finite "
    "elements. Loads are not checked: give finite numbers and positive radii. Research only; not a medical device."
)


def onnx_model(name: str, model: Learned, cortex: bool = False) -> ModelProto:
    """The graph of a model: of the tumour, or of all that it knows.

    Inputs, B loads at a time: `point` (B, 3) [m], `force` (B, 3) [N], `footprint` (B,) [m], as `sim.Pushed` has
    them. Where an answer stands on a compliance table, that of the cortex always, also `weight` (B, m): the share of
    the force that each of the nodes `pressed` (m,) of the open cortex bears, as `footprint_weights` of
    `sim.discretisation.footprint` integrates it over `Patch`: no operator of a graph could.

    Outputs, as `Learned.deform` answers: `displacement` (B, n, 3) [m] of the mesh vertices `nodes` (n,), which lie at
    `rest` (n, 3) [m]; `bound` (B, 2) [m] of the tumour, at the metadata's levels, NaN where nothing was calibrated;
    `excess` (B,), that of `Envelope`; and `extrapolated` (B,), whether it is more than zero. All in single precision,
    but in between in double where sums cancel.

    Raises
    ------
    InputError
        A regressor that has no graph; the package `onnx` not installed.
    """
    sheet, patch = Sheet(), open_patch(model.anatomy)
    push = push_of(
        sheet.input("point", ("B", 3), "where the tool touches the resting tissue [m], RAS"),
        sheet.input("force", ("B", 3), "of the tool on the tissue [N], RAS"),
        sheet.input("footprint", ("B",), "radius of the disc that it presses [m]"),
    )
    nodes = model.nodes if cortex else model.anatomy.tumour_nodes
    parts = [part for part in model.parts if np.isin(part.basis.nodes, nodes).any()]
    encoded = {"tool": _tool_features(push, model.envelope.force)}
    if any(part.encoder == "nodal" for part in parts):
        weight = sheet.input("weight", ("B", len(patch.nodes)), "share of the force on each of the nodes `pressed`")
        # (B, 3 m), as `nodal_shares`.
        encoded["nodal"] = (weight.shaped(0, -1, 1) * push.direction.shaped(0, 1, -1)).shaped(0, -1)
        sheet.output(sheet.constant(patch.nodes), Port("pressed", np.int64, patch.nodes.shape, "of the mesh"))
    responses = [_response(name, part, encoded[part.encoder], nodes) for part in parts]
    displacement = (push.magnitude * sum(responses[1:], responses[0])).shaped(0, -1, 3)
    place = place_of(patch, push)
    excess = excess_of(model.envelope, push, place)
    bound = (
        unpromised(push) if model.bounds is None else promised(model.bounds, push, place, excess, model.envelope.force)
    )
    rest = model.anatomy.mesh.nodes[nodes]
    sheet.output(displacement, Port("displacement", np.float32, ("B", len(nodes), 3), "of the vertices `nodes` [m]"))
    sheet.output(bound, Port("bound", np.float32, ("B", len(LEVELS)), "no tumour vertex is farther off [m]"))
    sheet.output(excess.shaped(-1), Port("excess", np.float32, ("B",), "how far outside the training range; 0 inside"))
    sheet.output((excess > 0.0).shaped(-1), Port("extrapolated", np.bool_, ("B",), "outside: do not rely on it"))
    sheet.output(sheet.constant(nodes), Port("nodes", np.int64, nodes.shape, "of the mesh"))
    sheet.output(sheet.constant(rest), Port("rest", np.float32, rest.shape, "where the vertices `nodes` lie [m], RAS"))
    return sheet.model(name, TEXT, version("sulcus"), _notes(name, model))


def write_onnx(path: str | Path, name: str, model: Learned, cortex: bool = False) -> None:
    """Write `onnx_model`; the file appears whole or not at all.

    Raises
    ------
    InputError
        As `onnx_model`; a path that does not end in .onnx, or a folder that cannot be written.
    """
    graph = onnx_model(name, model, cortex)
    with written_whole(path, ".onnx") as partial:
        partial.write_bytes(graph.SerializeToString())


def _tool_features(push: Push, taught: tuple[float, float]) -> Wire:
    """`tool_features` (B, 8): beyond the `taught` forces [N], of the nearest of them."""
    return push.point.sheet.joined(push.point, push.direction, push.magnitude.clip(*taught), push.footprint)


def _response(name: str, part: Part, features: Wire, nodes: np.ndarray) -> Wire:
    """Responses (B, 3 n) [m/N] of vertices `nodes` (n,), zero where the part does not know them."""
    kind = type(part.regressor)
    if kind not in WIRED:
        raise InputError(
            f"{name} has a part of the kind {kind.__name__}, which has no ONNX graph: export another learner."
        )
    modes = part.basis.modes.reshape(len(part.basis.modes), -1, 3)
    here, row = np.nonzero(nodes[:, None] == part.basis.nodes)
    wanted = np.zeros((len(modes), len(nodes), 3), np.float32)
    wanted[:, here] = modes[:, row]
    return WIRED[kind](features, part.regressor.state()) @ wanted.reshape(len(modes), -1)


def _notes(name: str, model: Learned) -> dict[str, str]:
    """Metadata: what the numbers mean, and all that is known of what was taught."""
    return {
        **model.training,
        "format": FORMAT,
        "learner": name,
        "anatomy": model.anatomy.digest,
        "frame": "RAS",
        "length_unit": "m",
        "force_unit": "N",
        "levels": ", ".join(map(str, LEVELS)),
    }
