"""Tracing of ONNX graphs: NumPy functions that are called with a `Tensor` add the corresponding ONNX operator."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from sim.runtime.optional_packages import require_extra

from ..array_functions import QuantisedTable, compute_squared_distances, find_nonzero_columns, multiply_rows, take_rows

if TYPE_CHECKING:
    from onnx import ModelProto

OPSET = 17  # ONNX operator set of 2021: all current runtimes read it.
FORMAT_VERSION = 8  # ONNX format version of 2022: all current runtimes read it.
# Type numbers of `onnx.TensorProto`.
KINDS = {np.dtype(kind): number for kind, number in (("f4", 1), ("i8", 7), ("?", 9), ("f8", 11))}
OPERATORS = {
    np.add: "Add",
    np.subtract: "Sub",
    np.multiply: "Mul",
    np.true_divide: "Div",
    np.matmul: "MatMul",
    np.power: "Pow",
    np.maximum: "Max",
    np.minimum: "Min",
    np.greater: "Greater",
    np.less: "Less",
    np.equal: "Equal",
    np.negative: "Neg",
    np.absolute: "Abs",
    np.sqrt: "Sqrt",
    np.exp: "Exp",
    np.log: "Log",
    np.tanh: "Tanh",
}
"""ONNX operators that correspond to NumPy's universal functions."""


class Tensor(NDArrayOperatorsMixin):
    """Symbolic array of a graph, with the batch as first axis. NumPy operators and functions add nodes to the graph.

    Parameters
    ----------
    sheet
        Graph that the tensor belongs to.
    name
        Name of the tensor in the graph.
    sample
        Value for a batch of sample loads, which gives type and shape. No formula may depend on the length of the batch,
        as it differs in use.
    """

    def __init__(self, graph: GraphBuilder, name: str, sample: np.ndarray):
        self.sheet, self.name, self.sample = graph, name, np.asarray(sample)

    def __len__(self) -> int:
        return len(self.sample)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *operands: Operand, **_: object) -> Tensor:
        """Add a universal function to the graph; an in-place operation gives a new tensor."""
        if method == "__call__" and ufunc is np.arccos:
            return _compute_arccos(self)
        if method != "__call__" or ufunc not in OPERATORS:
            return NotImplemented
        return self.sheet.add_node(
            OPERATORS[ufunc], ufunc(*map(_get_sample, operands)), *self.sheet.to_common_type(operands)
        )

    def __array_function__(self, function: Callable, _: object, args: Sequence, kwargs: Mapping[str, Any]) -> Tensor:
        """Add a function of `FUNCTIONS` to the graph."""
        return FUNCTIONS[function](self.sheet, *args, **kwargs) if function in FUNCTIONS else NotImplemented

    def __getitem__(self, key: Any) -> Tensor:
        """Select along axes, or insert axes of length one; the batch axis must be selected as a whole."""
        out, axis = self, 0
        for each in key if isinstance(key, tuple) else (key,):
            if each is None:
                out = self.sheet.add_node("Unsqueeze", np.expand_dims(out.sample, axis), out, np.array([axis]))
            elif not isinstance(each, slice) or each != slice(None):
                index = np.arange(out.shape[axis])[each]
                out = self.sheet.add_node("Gather", out.sample.take(index, axis), out, index, axis=axis)
                axis -= index.ndim == 0
            axis += 1
        return out

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the tensor for the sample loads."""
        return self.sample.shape

    @property
    def T(self) -> Tensor:
        """Tensor with its axes in reverse order."""
        return self.sheet.add_node("Transpose", self.sample.T, self)

    def astype(self, dtype: type) -> Tensor:
        """Return the tensor converted to another data type."""
        if self.sample.dtype == dtype:
            return self
        return self.sheet.add_node("Cast", self.sample.astype(dtype), self, to=KINDS[np.dtype(dtype)])

    def reshape(self, *shape: int) -> Tensor:
        """Return the tensor in another shape; -1 stands for the batch axis."""
        return self.sheet.add_node("Reshape", self.sample.reshape(shape), self, np.array(shape))

    def argmin(self, axis: int) -> Tensor:
        """Return the index of the minimum along an axis."""
        return self.sheet.add_node("ArgMin", self.sample.argmin(axis), self, axis=axis, keepdims=0)

    def sum(self, axis: int, keepdims: bool = False) -> Tensor:
        """Return the sum along an axis."""
        sample = self.sample.sum(axis, keepdims=keepdims)
        return self.sheet.add_node("ReduceSum", sample, self, np.array([axis]), keepdims=int(keepdims))

    def min(self, axis: int) -> Tensor:
        """Return the minimum along an axis."""
        return self.sheet.add_node("ReduceMin", self.sample.min(axis), self, axes=(axis,), keepdims=0)

    def max(self, axis: int) -> Tensor:
        """Return the maximum along an axis."""
        return self.sheet.add_node("ReduceMax", self.sample.max(axis), self, axes=(axis,), keepdims=0)


Operand = Tensor | np.ndarray | float


class Port(NamedTuple):
    """Input or output of a graph: name, data type, shape, and description."""

    name: str
    dtype: type
    shape: tuple[int | str, ...]
    description: str


class GraphNode(NamedTuple):
    """Node of a graph: ONNX operator, names of its inputs and output, and its attributes."""

    operator: str
    inputs: tuple[str, ...]
    output: str
    attributes: Mapping[str, Any]


class GraphBuilder:
    """Graph under construction; equal operators on equal tensors become one node, and equal arrays one constant."""

    def __init__(self) -> None:
        self._inputs: list[Port] = []
        self._outputs: list[Port] = []
        self._nodes: list[GraphNode] = []
        self._constants: dict[str, np.ndarray] = {}
        self._made: dict[object, Tensor] = {}

    def add_node(self, operator: str, sample: np.ndarray, *inputs: Tensor | np.ndarray, **attributes: Any) -> Tensor:
        """Add an ONNX operator on tensors and constants; `sample` is its value for the sample loads."""
        names = tuple((each if isinstance(each, Tensor) else self.add_constant(each)).name for each in inputs)
        key = operator, names, tuple(attributes.items())
        if key not in self._made:
            self._made[key] = Tensor(self, f"{operator}_{len(self._nodes)}", sample)
            self._nodes.append(GraphNode(operator, names, self._made[key].name, attributes))
        return self._made[key]

    def to_common_type(self, operands: Sequence[Operand]) -> list[Tensor]:
        """Convert operands to tensors of their common NumPy type, because ONNX operators do not mix types."""
        kind = np.result_type(*map(_get_sample, operands))
        wires = (each if isinstance(each, Tensor) else self.add_constant(np.asarray(each, kind)) for each in operands)
        return [wire.astype(kind.type) for wire in wires]

    def add_constant(self, array: np.ndarray) -> Tensor:
        """Add a constant of the array's type (integers as int64), and return its tensor."""
        array = np.asarray(array, np.int64) if array.dtype.kind in "iu" else array
        key = array.dtype.str, array.shape, array.tobytes()
        if key not in self._made:
            self._made[key] = Tensor(self, f"constant_{len(self._constants)}", array)
            self._constants[self._made[key].name] = array
        return self._made[key]

    def add_input(self, name: str, sample: np.ndarray, description: str) -> Any:
        """Add an input (B, ...) in single precision; return it as a tensor in double precision, for the formulas."""
        self._inputs.append(Port(name, np.float32, ("B", *sample.shape[1:]), description))
        return Tensor(self, name, sample.astype(np.float32)).astype(np.float64)

    def add_output(self, wire: Tensor, port: Port) -> None:
        """Add a tensor as an output, converted to the port's type."""
        self._nodes.append(GraphNode("Identity", (wire.astype(port.dtype).name,), port.name, {}))
        self._outputs.append(port)

    @property
    def constants(self) -> Mapping[str, np.ndarray]:
        """Constant arrays of the graph, by name."""
        return self._constants

    def to_json(self) -> dict[str, list]:
        """Return names of inputs and outputs, and all nodes in order of evaluation, as plain types for JSON."""
        nodes = [[node.operator, node.inputs, node.output, _to_json_values(node.attributes)] for node in self._nodes]
        return {
            "inputs": [port.name for port in self._inputs],
            "outputs": [port.name for port in self._outputs],
            "nodes": nodes,
        }

    def build_model(self, name: str, description: str, version: str, metadata: Mapping[str, str]) -> ModelProto:
        """Build the ONNX model of the graph, with `metadata` as its properties.

        Raises
        ------
        InputError
            The package `onnx` is not installed.
        """
        with require_extra("onnx", "an ONNX graph needs"):
            from onnx import helper, numpy_helper

        def describe_ports(ports: list[Port]) -> list:
            kinds = [KINDS[np.dtype(port.dtype)] for port in ports]
            return [
                helper.make_tensor_value_info(port.name, kind, port.shape, port.description)
                for port, kind in zip(ports, kinds, strict=True)
            ]

        graph = helper.make_graph(
            [helper.make_node(node.operator, node.inputs, [node.output], **node.attributes) for node in self._nodes],
            name,
            describe_ports(self._inputs),
            describe_ports(self._outputs),
            [numpy_helper.from_array(array, name) for name, array in self._constants.items()],
        )
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=FORMAT_VERSION,
            producer_name="sulcus",
            producer_version=version,
            doc_string=description,
        )
        helper.set_model_props(model, dict(metadata))
        return model


def _to_json_values(attributes: Mapping[str, Any]) -> dict[str, Any]:
    """Convert node attributes to types that JSON supports."""
    return {name: value if isinstance(value, str | tuple) else int(value) for name, value in attributes.items()}


def _get_sample(operand: Operand) -> np.ndarray | float:
    return operand.sample if isinstance(operand, Tensor) else operand


def _concatenate(graph: GraphBuilder, arrays: Sequence[Operand], axis: int = 0) -> Tensor:
    sample = np.concatenate([_get_sample(each) for each in arrays], axis)
    return graph.add_node("Concat", sample, *graph.to_common_type(arrays), axis=axis)


def _stack_columns(graph: GraphBuilder, arrays: Sequence[Tensor]) -> Tensor:
    return _concatenate(graph, [each if len(each.shape) > 1 else each[:, None] for each in arrays], 1)


def _stack(graph: GraphBuilder, arrays: Sequence[Tensor]) -> Tensor:
    return _concatenate(graph, [each[None] for each in arrays])


def _select_where(graph: GraphBuilder, condition: Tensor, true_values: Operand, false_values: Operand) -> Tensor:
    sample = np.where(condition.sample, _get_sample(true_values), _get_sample(false_values))
    return graph.add_node("Where", sample, condition, *graph.to_common_type([true_values, false_values]))


def _sum_products(graph: GraphBuilder, equation: str, *operands: Any) -> Tensor:
    (first, second), out = equation.partition("->")[0].split(","), equation.partition("->")[2]
    if first == out + second[-1] and first.endswith(second):  # product and sum: ten times as fast in runtimes
        return (operands[0] * operands[1]).sum(axis=len(out))
    sample = np.einsum(equation, *map(_get_sample, operands))
    return graph.add_node("Einsum", sample, *graph.to_common_type(operands), equation=equation)


def _search_sorted(_: GraphBuilder, sites: np.ndarray, values: Tensor) -> Tensor:
    # Infinity at the end: no operator reads an empty array.
    return (values[:, None] > np.append(sites, np.inf)).astype(np.int64).sum(axis=1)


FUNCTIONS: dict[Callable, Callable[..., Tensor]] = {
    np.concatenate: _concatenate,
    np.column_stack: _stack_columns,
    np.stack: _stack,
    np.where: _select_where,
    np.einsum: _sum_products,
    np.searchsorted: _search_sorted,
    np.clip: lambda _, x, least, most: np.minimum(np.maximum(x, least), most),
    np.ones_like: lambda _, x: 0.0 * x + 1.0,
}
"""Further NumPy functions that graphs support; each is called with the graph and its arguments."""


def _compute_arccos(cosine: Tensor) -> Tensor:
    """Compute the arc cosine from the half chord, because runtimes have arc functions in single precision only."""
    half = np.sqrt(0.5 * np.maximum(1.0 - np.absolute(cosine), 0.0)).astype(np.float32)
    arc = 2.0 * cosine.sheet.add_node("Asin", np.arcsin(half.sample), half).astype(np.float64)
    return np.where(cosine < 0.0, np.pi - arc, arc)


@compute_squared_distances.register
def _(points: Tensor, sites: np.ndarray) -> Any:
    """Compute |x|^2 - 2 x y + |y|^2 in double precision, as differences x - y would need memory for B n f numbers."""
    x, y = points.astype(np.float64), sites.astype(np.float64)
    return np.maximum((x * x).sum(axis=1, keepdims=True) - x @ (2.0 * y.T) + (y * y).sum(axis=1), 0.0)


@take_rows.register
def _(index: Tensor, table: np.ndarray | QuantisedTable) -> Any:
    if not isinstance(table, QuantisedTable):
        return index.sheet.add_node("Gather", table[index.sample], table, index, axis=0)
    found = index.sheet.add_node("Gather", table.integers[index.sample], table.integers, index, axis=0)
    return found.astype(np.float32) * table.step


@multiply_rows.register
def _(rows: Tensor, table: QuantisedTable, index: np.ndarray) -> Any:
    return (rows @ rows.sheet.add_constant(table.integers[index]).astype(np.float32)) * table.step


@find_nonzero_columns.register
def _(rows: Tensor) -> np.ndarray:
    """Return all columns, because the zeros are not known before the graph runs."""
    return np.arange(rows.shape[1])
