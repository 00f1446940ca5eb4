"""Export of trained models to ONNX, for use in other programs: one graph from loads to displacements and bounds.

The graph is traced: the model's own formulas run on `Tensor` instead of arrays, so that each is implemented only once.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sim.errors import InputError
from sim.loads import Pushed
from sim.runtime.atomic_files import write_atomically
from sim.runtime.versions import get_version

from ..data.cortex_patch import open_patch
from ..data.encode import compute_tool_features, distribute_forces, scale_by_sqrt_force
from ..model.conformal import LEVELS
from ..model.learned import Learned
from ..model.training_range import measure_loads
from ..regressors.baselines import Ann, Pcr, Svr
from ..regressors.force_series import ForcePairs, RemainderGp, Series
from ..regressors.gp import Gp
from ..regressors.protocol import Linear
from .graph import GraphBuilder, Port

if TYPE_CHECKING:
    from onnx import ModelProto

# Regressors whose formulas use only operations that `Tensor` supports.
TRACEABLE = (Linear, Pcr, Ann, Svr, Gp, RemainderGp, Series, ForcePairs)
FORMAT = "sulcus onnx 1"  # Version of the names, shapes and meanings of inputs, outputs and metadata.
DESCRIPTION = (  # Description in the ONNX file.
    "Displacements of a brain under a pressing tool, and how far they may be off, as sulcus learned them from finite "
    "elements. Loads are not checked: give finite numbers and positive radii. Research only; not a medical device."
)


def build_onnx_model(name: str, model: Learned, cortex: bool = False) -> ModelProto:
    """Build the ONNX model of the graph that `build_graph` traces.

    Raises
    ------
    InputError
        See `build_graph`, or the package `onnx` is not installed.
    """
    return build_graph(name, model, cortex).build_model(
        name, DESCRIPTION, get_version("sulcus"), _build_metadata(name, model)
    )


def build_graph(name: str, model: Learned, cortex: bool = False) -> GraphBuilder:
    """Trace the graph of a model, for the tumour's vertices or (`cortex`) for all vertices of the model.

    The inputs have B loads: `point` (B, 3) [m], `force` (B, 3) [N], `footprint` (B,) [m], as in `sim.Pushed`. If the
    result depends on a compliance matrix, as the cortex always does, there is also `weight` (B, m). It is the share of
    the force on each node `pressed` (m,) of the open cortex: the footprint's integral over `Patch`, by
    `compute_footprint_weights` of `sim.discretisation.footprint`, for which ONNX has no operator.

    The outputs are as in `Learned.deform`: `displacement` (B, n, 3) [m] of the mesh vertices `nodes` (n,), with
    undeformed positions `rest` (n, 3) [m]; `bound` (B, 2) [m] for the tumour at the levels in the metadata, NaN without
    calibration; `excess` (B,), as in `Excess`; and `extrapolated` (B,), True if `excess` is above zero. Numbers are in
    single precision; intermediate values have the precision of the model.

    Raises
    ------
    InputError
        A regressor has no graph, or the model includes relaxation over time.
    """
    if model.series:
        raise InputError(f"{name} follows tissue that relaxes in time, which no graph does: export another model.")
    sheet, patch, envelope = GraphBuilder(), open_patch(model.anatomy), model.envelope
    nodes = model.nodes if cortex else model.anatomy.tumour_nodes
    for part in model.parts:
        if np.isin(part.basis.nodes, nodes).any() and type(part.regressor) not in TRACEABLE:
            kind = type(part.regressor).__name__
            raise InputError(f"{name} has a part of the kind {kind}, which has no ONNX graph: export another learner.")
    # Two arbitrary loads in the training range determine the types and shapes of all arrays.
    down = np.array([0.0, 0.0, -envelope.force[1]])
    pushed = Pushed(
        sheet.add_input(
            "point", np.tile(patch.points[0], (2, 1)), "where the tool touches the resting tissue [m], RAS"
        ),
        sheet.add_input("force", np.tile(down, (2, 1)), "of the tool on the tissue [N], RAS"),
        sheet.add_input("footprint", np.full(2, envelope.footprint[1]), "radius of the disc that it presses [m]"),
    )

    @cache
    def add_weight_input() -> Any:
        """Add the input `weight` once, for all parts that use it."""
        sample = np.full((2, len(patch.nodes)), 1.0 / len(patch.nodes))
        sheet.add_output(sheet.add_constant(patch.nodes), Port("pressed", np.int64, patch.nodes.shape, "of the mesh"))
        return sheet.add_input("weight", sample, "share of the force on each of the nodes `pressed`")

    encoders = {
        "tool": compute_tool_features,
        "nodal": lambda _, pushed: distribute_forces(add_weight_input(), pushed),
        "rooted": lambda _, pushed: scale_by_sqrt_force(distribute_forces(add_weight_input(), pushed), pushed),
    }
    displacement: Any = model.predict_motion(pushed, nodes, encoders)
    known = measure_loads(patch, pushed)
    outside = envelope.compute_excess(pushed, known)
    excess: Any = outside.excess
    bound: Any = model.compute_bounds(model.bounds, pushed, known, outside)
    rest = model.anatomy.mesh.nodes[nodes]
    sheet.add_output(
        displacement, Port("displacement", np.float32, ("B", len(nodes), 3), "of the vertices `nodes` [m]")
    )
    sheet.add_output(bound.T, Port("bound", np.float32, ("B", len(LEVELS)), "no tumour vertex is farther off [m]"))
    sheet.add_output(excess, Port("excess", np.float32, ("B",), "how far outside the training range; 0 inside"))
    sheet.add_output(excess > 0.0, Port("extrapolated", np.bool_, ("B",), "outside: do not rely on it"))
    sheet.add_output(sheet.add_constant(nodes), Port("nodes", np.int64, nodes.shape, "of the mesh"))
    sheet.add_output(
        sheet.add_constant(rest), Port("rest", np.float32, rest.shape, "where the vertices `nodes` lie [m], RAS")
    )
    return sheet


def write_onnx(path: str | Path, name: str, model: Learned, cortex: bool = False) -> None:
    """Write the ONNX model of `build_onnx_model` to a file, atomically.

    Raises
    ------
    InputError
        See `build_onnx_model`; the path does not end in .onnx, or the folder cannot be written.
    """
    graph = build_onnx_model(name, model, cortex)
    with write_atomically(path, ".onnx") as partial:
        partial.write_bytes(graph.SerializeToString())


def _build_metadata(name: str, model: Learned) -> dict[str, str]:
    """Return the metadata of the graph: format, units, levels, and the provenance of the training."""
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
