"""Formulas as ONNX graphs: wires add, multiply and compare as arrays do, and the graph is what they did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sim.errors import InputError

if TYPE_CHECKING:
    from onnx import ModelProto

# Of 2021 and 2022: every runtime of today reads them.
OPSET, FORMAT_VERSION = 17, 8
# As `onnx.TensorProto` numbers them.
KINDS: dict[type, int] = {np.float32: 1, np.int64: 7, np.bool_: 9, np.float64: 11}


@dataclass(frozen=True, eq=False)
class Wire:
    """A named array of a graph; operators follow numpy's rules of shapes.

    Parameters
    ----------
    sheet
        Where it is written.
    name
        Its own there.
    real
        The precision in which constants meet it.
    """

    sheet: Sheet
    name: str
    real: type = np.float32

    # numpy leaves `array - wire` to the wire.
    __array_ufunc__ = None

    def through(self, kind: str, *others: Operand, **attributes: int | tuple[int, ...]) -> Wire:
        """The outcome of an ONNX operator whose first input this is."""
        return self.sheet.put(kind, self, *others, **attributes)

    def __add__(self, other: Operand) -> Wire:
        return self.through("Add", other)

    def __sub__(self, other: Operand) -> Wire:
        return self.through("Sub", other)

    def __rsub__(self, other: Operand) -> Wire:
        return self.sheet.put("Sub", other, self)

    def __mul__(self, other: Operand) -> Wire:
        return self.through("Mul", other)

    __radd__, __rmul__ = __add__, __mul__

    def __truediv__(self, other: Operand) -> Wire:
        return self.through("Div", other)

    def __matmul__(self, other: Operand) -> Wire:
        return self.through("MatMul", other)

    def __gt__(self, other: Operand) -> Wire:
        return self.through("Greater", other)

    def __lt__(self, other: Operand) -> Wire:
        return self.through("Less", other)

    def of(self, kind: type) -> Wire:
        """The same numbers as one of `KINDS`."""
        return replace(self.through("Cast", to=KINDS[kind]), real=np.float64 if kind is np.float64 else np.float32)

    def clip(self, least: Operand, most: Operand) -> Wire:
        """Between two numbers."""
        return self.through("Clip", least, most)

    def columns(self, *index: int | np.integer) -> Wire:
        """Some of the last axis, in this order."""
        return self.through("Gather", np.array(index), axis=-1)

    def shaped(self, *shape: int) -> Wire:
        """In another shape: 0 keeps the length that stands there, -1 takes what is left."""
        return self.through("Reshape", np.array(shape))

    def argmin(self) -> Wire:
        """Where the last axis is least (whole numbers), which stays with length one."""
        return replace(self.through("ArgMin", axis=-1), real=np.float32)

    def sum(self) -> Wire:
        """Over the last axis, which stays with length one."""
        return self.through("ReduceSum", np.array([-1]))

    def least(self) -> Wire:
        """Over the last axis, which stays with length one."""
        return self.through("ReduceMin", axes=(-1,))


Operand = Wire | np.ndarray | float


class Port(NamedTuple):
    """An input or output: its name, kind and shape, and a sentence on it."""

    name: str
    kind: type
    shape: tuple[int | str, ...]
    text: str


class Node(NamedTuple):
    """An operator, its inputs, its output, and its attributes."""

    kind: str
    inputs: tuple[str, ...]
    output: str
    attributes: Mapping[str, Any]


class Sheet:
    """A graph that is being written. The same operator on the same wires is one node, equal arrays are one constant."""

    def __init__(self) -> None:
        self._inputs: list[Port] = []
        self._outputs: list[Port] = []
        self._nodes: list[Node] = []
        self._constants: dict[str, np.ndarray] = {}
        self._made: dict[object, Wire] = {}

    def put(self, kind: str, *inputs: Operand, **attributes: int | tuple[int, ...]) -> Wire:
        """The outcome of an ONNX operator on wires and constants."""
        real = next((each.real for each in inputs if isinstance(each, Wire)), np.float32)
        names = tuple((each if isinstance(each, Wire) else self.constant(each, real)).name for each in inputs)
        key = kind, names, tuple(attributes.items())
        if key not in self._made:
            self._made[key] = Wire(self, f"{kind}_{len(self._nodes)}", real)
            self._nodes.append(Node(kind, names, self._made[key].name, attributes))
        return self._made[key]

    def constant(self, value: np.ndarray | float, real: type = np.float32) -> Wire:
        """An array or a number: in `real` precision, if not in half; in 64 bits, if whole."""
        array = np.asarray(value)
        array = array.astype({"f4": real, "f8": real, "i4": np.int64}.get(array.dtype.str[1:], array.dtype))
        key = array.dtype.str, array.shape, array.tobytes()
        if key not in self._made:
            self._made[key] = Wire(self, f"constant_{len(self._constants)}", real)
            self._constants[self._made[key].name] = array
        return self._made[key]

    def joined(self, *wires: Wire) -> Wire:
        """Side by side along the last axis."""
        return self.put("Concat", *wires, axis=-1)

    def input(self, name: str, shape: tuple[int | str, ...], text: str) -> Wire:
        """Numbers (float32) that the graph is given."""
        self._inputs.append(Port(name, np.float32, shape, text))
        return Wire(self, name)

    def output(self, wire: Wire, port: Port) -> None:
        """What the graph answers."""
        self._nodes.append(Node("Identity", (wire.name,), port.name, {}))
        self._outputs.append(port)

    def model(self, name: str, text: str, version: str, notes: Mapping[str, str]) -> ModelProto:
        """The graph as ONNX has it; `notes` are its metadata.

        Raises
        ------
        InputError
            Where the package `onnx` is not installed.
        """
        try:
            from onnx import helper, numpy_helper
        except ImportError as error:
            raise InputError("the package onnx is not installed: pip install onnx.") from error

        def told(ports: list[Port]) -> list:
            return [helper.make_tensor_value_info(port.name, KINDS[port.kind], port.shape, port.text) for port in ports]

        graph = helper.make_graph(
            [helper.make_node(node.kind, node.inputs, [node.output], **node.attributes) for node in self._nodes],
            name,
            told(self._inputs),
            told(self._outputs),
            [numpy_helper.from_array(array, name) for name, array in self._constants.items()],
        )
        model = helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=FORMAT_VERSION,
            producer_name="sulcus",
            producer_version=version,
            doc_string=text,
        )
        helper.set_model_props(model, dict(notes))
        return model
