"""ONNX: a trained network, saved by PyTorch or another tool, as a lifting."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import casadi as ca

from koopmpc.base import checks
from koopmpc.base.errors import DataError, LogError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value, freeze
from koopmpc.lifting.base import Lifting, StateChoice, Traced, find_states, freeze_choice
from koopmpc.lifting.onnx_layers import replace_layers
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
