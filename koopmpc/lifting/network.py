"""ONNX: a trained network, saved by PyTorch or another tool, as a lifting.

Layers that CasADi's import lacks, Dropout, Flatten, Softmax, BatchNormalization and LayerNormalization, are written in
others for a row x of n numbers; files are read as Protocol Buffers.
"""

import struct
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import count
from math import prod
from pathlib import Path
from typing import Any, cast

import casadi as ca

from koopmpc.base import checks
from koopmpc.base.errors import DataError, LogError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value, freeze
from koopmpc.lifting.base import Lifting, StateChoice, Traced, find_states, freeze_choice
from koopmpc.plants.graph import Graph

_MOST = 200_000  # operations of a network: C code and columns of more take minutes to compile


@dataclass(frozen=True, eq=False, init=False)
class ONNX(Lifting):
    """ψ(x) = the network of an .onnx file, read by CasADi as plain operations.

    Loading runs no code of the file. The network has one input, the states, and one output, the observables; its
    numbers are used in double precision. It is saved with the model and written to C as any other lifting.

    Parameters
    ----------
    path
        The file, with its weights inside. Export the network for inference.
    states
        The states that are the network's inputs, in this order, by index or name; all by default.
    names
        Names of the observables; by default the file's stem and a number: encoder0, encoder1, ….

    Raises
    ------
    LogError
        The file is missing or damaged, or holds a layer that CasADi's import does not know; the message names it.
    DataError
        The network has several inputs or outputs, an operation of it cannot be written as data, or there are more or
        fewer names than outputs.
    ShapeError
        When it is bound: the network takes another number of states.

    References
    ----------
    Open Neural Network Exchange, https://onnx.ai; Lusch, Kutz & Brunton, "Deep learning for universal linear
    embeddings of nonlinear dynamics", Nat. Commun. 9, 2018, for networks as liftings.
    """

    graph: Graph
    labels: tuple[str, ...]
    chosen: tuple[int | str, ...] | None

    def __init__(self, path: str | Path, states: StateChoice | None = None, names: Sequence[str] | None = None) -> None:
        checks.kind(path, "path", (str, Path), "pass the path of an .onnx file")
        file = Path(path)
        graph = _read_network(file)
        labels = tuple(f"{file.stem}{i}" for i in range(graph.m)) if names is None else checks.texts(names, "names")
        if len(labels) != graph.m:
            raise DataError(f"names has {len(labels)} names, {file.name} has {graph.m} outputs; name each of them")
        freeze(self, graph=graph, labels=labels, chosen=freeze_choice(states), bound=None)

    @raise_swallowed()
    def bind(self, states: Sequence[str]) -> Traced:
        """Return the list of operations on these states, which does not need the file."""
        x = ca.SX.sym("x", len(states))
        columns = find_states(self.chosen, states, "ONNX")
        if len(columns) != self.graph.n:
            raise ShapeError(
                f"the network takes {self.graph.n} inputs and is given {len(columns)} states: "
                f"{', '.join(states[i] for i in columns)}; choose them by states="
            )
        graph = Graph.trace(ca.Function("network", [x], [self.graph.symbolic(x[columns])]))
        traced = Traced(graph, self.labels, bound=tuple(states))
        _ = traced.names
        return traced

    def as_saved(self) -> Value:
        """Raise a DataError: what is saved is the bound lifting."""
        raise DataError("ONNX does not know its states yet; call .bind(states), and save that")

    def observables(self, states: tuple[str, ...]) -> tuple[str, ...]:
        """Return the names of the outputs."""
        return self.labels

    def formula(self, x: ca.SX) -> ca.SX:
        """Return the network's outputs of symbols."""
        return self.graph.symbolic(x)


def _open_network(path: Path) -> Any:
    """Return CasADi's reader of a network, with layers that it lacks written in others."""
    content = path.read_bytes()
    known = replace_layers(content)
    if known == content:
        return cast("Any", ca.GraphBuilder(str(path.resolve()), {}))
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / path.name
        file.write_bytes(known)
        return cast("Any", ca.GraphBuilder(str(file), {}))


@raise_swallowed()
def _read_network(path: Path) -> Graph:
    """Return the operations of a network, for one sample."""
    if not path.is_file():
        raise LogError(f"there is no file {path}; pass the path of an .onnx file")
    try:
        builder = _open_network(path)
        for name in builder.dynamic_params():
            builder.bind_dim(name, 1)
        network = cast("ca.Function", builder.create("network", {"symbolic": True})).expand()
    except (RuntimeError, NotImplementedError, ValueError) as error:  # ValueError: names that are not UTF-8
        reason = (str(error).strip().splitlines() or ["the file is damaged"])[-1].rpartition(": ")[2]
        raise LogError(
            f"{path.name} cannot be read as a network: {reason}; export it for inference, with its weights inside, of "
            "layers such as Gemm, MatMul, Add, Tanh, Relu and Sigmoid"
        ) from error
    if network.n_in() != 1 or network.n_out() != 1:
        raise DataError(
            f"{path.name} has {network.n_in()} inputs and {network.n_out()} outputs; a lifting has one of each: export "
            "the encoder alone"
        )
    shapes = network.size_in(0), network.size_out(0)
    if any(min(shape) > 1 for shape in shapes):
        raise DataError(f"{path.name} maps {shapes[0]} to {shapes[1]} numbers; a lifting maps one row to one row")
    x = ca.SX.sym("x", network.numel_in(0))
    z = ca.vec(network(ca.reshape(x, *shapes[0])))
    scalar = ca.Function("network", [x], [ca.densify(z)])
    if scalar.n_instructions() > _MOST:
        raise DataError(
            f"{path.name} has {scalar.n_instructions()} operations, at most {_MOST} are taken; use a smaller network"
        )
    try:
        return Graph.trace(scalar)
    except DataError as error:
        raise DataError(f"{path.name}: {error}") from error


Field = tuple[int, int, bytes | int]  # number, wire type, content


class _Number:
    """Numbers of fields in onnx.proto: of a model, a graph, a tensor, a node and an attribute."""

    GRAPH = 7  # of a model
    NODE = 1  # of a graph
    INITIALIZER = 5
    DIMS = 1  # of a tensor
    TENSOR_NAME = 8
    INPUT = 1  # of a node
    OUTPUT = 2
    OPERATION = 4
    ATTRIBUTE = 5
    NAME = 1  # of an attribute
    FLOAT = 2
    INTEGER = 3
    TYPE = 20


_SIZES = {1: 8, 5: 4}  # bytes of a wire type of fixed size


@dataclass
class Node:
    """An operation: its name, and those of its inputs and outputs; `attributes` are floats and whole numbers."""

    operation: str
    inputs: list[str]
    outputs: list[str]
    attributes: dict[str, float] = field(default_factory=dict[str, float])

    def encode(self) -> bytes:
        """Return the node as bytes; attributes are single floats."""
        parts: list[Field] = [(_Number.INPUT, 2, name.encode()) for name in self.inputs]
        parts += [(_Number.OUTPUT, 2, name.encode()) for name in self.outputs]
        parts.append((_Number.OPERATION, 2, self.operation.encode()))
        for name, value in self.attributes.items():
            said: list[Field] = [
                (_Number.NAME, 2, name.encode()),
                (_Number.FLOAT, 5, struct.pack("<f", value)),
                (_Number.TYPE, 0, 1),
            ]
            parts.append((_Number.ATTRIBUTE, 2, join_fields(said)))
        return join_fields(parts)


def replace_layers(model: bytes) -> bytes:
    """Return an ONNX model in which known layers stand for those that CasADi lacks; what is damaged stays as it is."""
    try:
        return join_fields(
            [
                (k, w, _replace(v) if k == _Number.GRAPH and isinstance(v, bytes) else v)
                for k, w, v in split_fields(model)
            ]
        )
    except (ValueError, IndexError, struct.error):  # CasADi says what is wrong with it
        return model


def _replace(graph: bytes) -> bytes:
    parts = list(split_fields(graph))
    sizes = dict(_read_size(v) for k, _, v in parts if k == _Number.INITIALIZER and isinstance(v, bytes))
    result: list[Field] = []
    for number, wire, content in parts:
        others = _rewrite(_read_node(content), sizes) if number == _Number.NODE and isinstance(content, bytes) else None
        result += [(number, wire, content)] if others is None else [(_Number.NODE, 2, each.encode()) for each in others]
    return join_fields(result)


def _rewrite(node: Node, sizes: dict[str, int]) -> list[Node] | None:
    """Return nodes that give the same result on one row; None where the node stays."""
    operation, told = node.operation, node.attributes
    if operation not in ("Dropout", "Flatten", "Softmax", "BatchNormalization", "LayerNormalization"):
        return None
    x, result, names = node.inputs[0], node.outputs[0], (f"{node.outputs[0]}/{k}" for k in count())
    nodes: list[Node] = []

    def add(operation: str, *inputs: str, **attributes: float) -> str:
        nodes.append(Node(operation, list(inputs), [next(names)], attributes))
        return nodes[-1].outputs[0]

    if operation in ("Dropout", "Flatten"):
        add("Identity", x)
    elif operation == "Softmax":
        if told.get("axis", -1) not in (-1, 1):
            return None
        powers = add("Exp", add("Sub", x, add("ReduceMax", x)))  # of no axes: of all, and there is one row
        add("Div", powers, add("ReduceSum", powers))
    else:
        epsilon = add("Constant", value_float=told.get("epsilon", 1e-5))
        scale, *rest = node.inputs[1:]
        if operation == "BatchNormalization":
            if told.get("training_mode", 0):
                return None
            offset, mean, variance = rest
            off = add("Sub", x, mean)
        else:
            if told.get("axis", -1) not in (-1, 1) or scale not in sizes:
                return None
            offset, n = next(iter(rest), ""), add("Constant", value_float=float(sizes[scale]))
            off = add("Sub", x, add("Div", add("ReduceSum", x), n))
            variance = add("Div", add("ReduceSum", add("Mul", off, off)), n)
        scaled = add("Mul", add("Div", off, add("Sqrt", add("Add", variance, epsilon))), scale)
        if offset:
            add("Add", scaled, offset)
    nodes[-1].outputs = [result]
    return nodes


def _read_node(content: bytes) -> Node:
    node = Node("", [], [])
    for number, _, value in split_fields(content):
        if not isinstance(value, bytes):
            continue
        if number == _Number.ATTRIBUTE:
            said = {k: v for k, _, v in split_fields(value)}
            name, real, whole = said.get(_Number.NAME), said.get(_Number.FLOAT), said.get(_Number.INTEGER)
            if isinstance(name, bytes) and isinstance(real, bytes):
                node.attributes[name.decode()] = float(struct.unpack("<f", real)[0])
            elif isinstance(name, bytes) and isinstance(whole, int):
                node.attributes[name.decode()] = whole - (1 << 64) * (whole >> 63)
        elif number in (_Number.INPUT, _Number.OUTPUT):
            (node.inputs if number == _Number.INPUT else node.outputs).append(value.decode())
        elif number == _Number.OPERATION:
            node.operation = value.decode()
    return node


def _read_size(tensor: bytes) -> tuple[str, int]:
    """Return the name of a tensor, and how many numbers it holds."""
    name, sizes = "", list[int]()
    for number, _, value in split_fields(tensor):
        if number == _Number.TENSOR_NAME and isinstance(value, bytes):
            name = value.decode()
        elif number == _Number.DIMS:
            sizes += [value] if isinstance(value, int) else list(_read_packed(value))
    return name, prod(sizes)


def _read_packed(content: bytes) -> Iterator[int]:
    place = 0
    while place < len(content):
        value, place = _read_varint(content, place)
        yield value


def split_fields(message: bytes) -> Iterator[Field]:
    """Yield the fields of a message in their order."""
    place = 0
    while place < len(message):
        key, place = _read_varint(message, place)
        number, wire = key >> 3, key & 7
        if wire == 0:
            value, place = _read_varint(message, place)
            yield number, wire, value
            continue
        size, place = (_SIZES[wire], place) if wire in _SIZES else _read_varint(message, place)
        if wire not in (1, 2, 5) or place + size > len(message):
            raise ValueError("no message")
        yield number, wire, message[place : place + size]
        place += size


def join_fields(parts: Sequence[Field]) -> bytes:
    """Return the message of these fields."""
    result = bytearray()
    for number, wire, value in parts:
        result += _write_varint(number << 3 | wire)
        if isinstance(value, int):
            result += _write_varint(value)
        else:
            result += (_write_varint(len(value)) if wire == 2 else b"") + value
    return bytes(result)


def _read_varint(message: bytes, place: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = message[place]
        value |= (byte & 127) << shift
        place, shift = place + 1, shift + 7
        if byte < 128:
            return value, place
        if shift > 63:
            raise ValueError("no number")


def _write_varint(value: int) -> bytes:
    result = bytearray()
    while value > 127:
        result.append(value & 127 | 128)
        value >>= 7
    result.append(value)
    return bytes(result)
