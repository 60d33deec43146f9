"""Networks of .onnx files as liftings: km.lifting.ONNX."""

import numpy as np
import pytest
import scipy.special

import koopmpc as km
from tests.compiler import find_compiler
from tests.docs.page import alike, run

onnx = pytest.importorskip("onnx", reason="the extra dev is not installed")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

STATES = ("theta [rad]", "omega [rad/s]", "current [A]")
LAYERS = {
    "Tanh": np.tanh,
    "Relu": lambda x: np.maximum(x, 0),
    "Sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "Elu": lambda x: np.where(x > 0, x, np.expm1(x)),
    "Softplus": lambda x: np.log1p(np.exp(x)),
    "LeakyRelu": lambda x: np.where(x > 0, x, np.float32(0.01).astype(float) * x),
    "Gelu": lambda x: x * (1 + scipy.special.erf(x / np.sqrt(2))) / 2,
    "Sin": np.sin,
}


def weights(nx, nz, width=6):
    rng = np.random.default_rng(3)
    shapes = {"W1": (nx, width), "b1": (width,), "W2": (width, nz), "b2": (nz,)}
    return {name: rng.normal(size=shape).astype(np.float32) for name, shape in shapes.items()}


def write(path, nodes, nx=2, nz=3, rows=1, tensors=None, outputs=("z",)):
    value = helper.make_tensor_value_info
    ends = [value(name, TensorProto.FLOAT, [rows, nz]) for name in outputs]
    held = [numpy_helper.from_array(array, name) for name, array in (tensors or {}).items()]
    graph = helper.make_graph(nodes, "net", [value("x", TensorProto.FLOAT, [rows, nx])], ends, held)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)
    path.write_bytes(model.SerializeToString())
    return path


def perceptron(path, layer="Tanh", nx=2, nz=3, rows="batch", matmul=False):
    """Write z = W2ᵀ layer(W1ᵀx + b1) + b2 and return the path and the function."""
    w, node = weights(nx, nz), helper.make_node
    first = [node("Gemm", ["x", "W1", "b1"], ["a"])]
    if matmul:
        first = [node("MatMul", ["x", "W1"], ["p"]), node("Add", ["p", "b1"], ["a"])]
    nodes = [*first, node(layer, ["a"], ["h"]), node("Gemm", ["h", "W2", "b2"], ["z"])]
    wide = {name: array.astype(np.float64) for name, array in w.items()}

    def forward(X):
        return LAYERS[layer](X @ wide["W1"] + wide["b1"]) @ wide["W2"] + wide["b2"]

    return write(path, nodes, nx, nz, rows, w), forward


@pytest.mark.parametrize("layer", LAYERS)
def test_a_network_computes_what_it_says_for_arrays_symbols_and_onnxruntime(layer, tmp_path):
    path, forward = perceptron(tmp_path / "net.onnx", layer, matmul=layer == "Tanh")
    lifting = km.lifting.ONNX(path).bind(STATES[:2])
    X = np.random.default_rng(0).normal(size=(50, 2))
    assert lifting.names == ("net0", "net1", "net2")
    assert lifting(X) == pytest.approx(forward(X), abs=1e-12)
    assert lifting.guarded_function()(X[0]).full().ravel() == pytest.approx(forward(X[0]), abs=1e-12)
    runtime = pytest.importorskip("onnxruntime", reason="the extra peers is not installed")
    session = runtime.InferenceSession(str(path))
    assert lifting(X) == pytest.approx(session.run(None, {"x": X.astype(np.float32)})[0], abs=3e-6, rel=1e-6)


S, B = np.linspace(0.5, 2, 6), np.linspace(-1, 1, 6)
V = np.linspace(0.1, 3, 6)
REWRITTEN = {
    "Dropout": (["a"], {}, lambda x: x),
    "Flatten": (["a"], {"axis": 1}, lambda x: x),
    "Softmax": (["a"], {"axis": -1}, lambda x: scipy.special.softmax(x, axis=-1)),
    "BatchNormalization": (["a", "S", "B", "B", "V"], {"epsilon": 1e-3}, lambda x: (x - B) / np.sqrt(V + 1e-3) * S + B),
    "LayerNormalization": (
        ["a", "S", "B"],
        {"axis": -1},
        lambda x: (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-5) * S + B,
    ),
}


@pytest.mark.parametrize("layer", REWRITTEN)
def test_layers_that_casadi_lacks_are_written_in_others(layer, tmp_path):
    inputs, told, formula = REWRITTEN[layer]
    w, node = weights(2, 3), helper.make_node
    held = w | {name: array.astype(np.float32) for name, array in (("S", S), ("B", B), ("V", V))}
    nodes = [node("Gemm", ["x", "W1", "b1"], ["a"]), node(layer, inputs, ["n"], **told), node("Tanh", ["n"], ["h"])]
    path = write(tmp_path / "net.onnx", [*nodes, node("Gemm", ["h", "W2", "b2"], ["z"])], rows=1, tensors=held)
    X = np.random.default_rng(1).normal(size=(20, 2))
    wide = {name: array.astype(np.float64) for name, array in w.items()}
    exact = np.tanh(formula(X @ wide["W1"] + wide["b1"])) @ wide["W2"] + wide["b2"]
    found = km.lifting.ONNX(path).bind(STATES[:2])(X)
    assert found == pytest.approx(exact, abs=3e-6)  # of parameters in single precision
    runtime = pytest.importorskip("onnxruntime", reason="the extra peers is not installed")
    session = runtime.InferenceSession(str(path))
    for x, z in zip(X, found, strict=True):
        assert z == pytest.approx(session.run(None, {"x": x[None].astype(np.float32)})[0][0], abs=3e-6, rel=1e-6)


def test_states_and_names_are_chosen_and_the_file_is_needed_no_more(tmp_path):
    path, forward = perceptron(tmp_path / "net.onnx", rows=1)
    lifting = km.State() + km.lifting.ONNX(path, states=["current", "theta"], names=["a", "b", "c"])
    path.unlink()
    bound = lifting.bind(STATES)
    assert bound.names == (*STATES, "a", "b", "c")
    x = np.array([0.4, -1.0, 0.7])
    assert bound(x)[3:] == pytest.approx(forward(x[[2, 0]]), abs=1e-12)


def test_a_model_on_a_network_is_saved_controlled_and_written_to_c(tmp_path):
    path, _ = perceptron(tmp_path / "net.onnx")
    plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    data = km.collect(plant, km.Uniform([-1, -2], [1, 2]), km.Noise(-5, 5), episodes=30, steps=20)
    model = km.edmd(data, km.State() + km.lifting.ONNX(path), ridge=1e-8)
    model.save(tmp_path / "model.npz")
    path.unlink()
    again = km.load_model(tmp_path / "model.npz")
    assert again.lift([0.3, 0.1]).tolist() == model.lift([0.3, 0.1]).tolist()
    mpc = km.KoopmanMPC(again, km.Cost(Q=[10, 1], R=0.1), km.Limits(-8, 8), horizon=10, solver="daqp")
    if find_compiler() is not None:
        fast = km.compiled(mpc)
        for y in ([0.5, 0.0], [-0.2, 1.0]):
            assert fast(y, [0.0, 0.0]).u == pytest.approx(mpc(y, [0.0, 0.0]).u, abs=1e-9)


def test_what_cannot_be_read_is_named(tmp_path):
    node, w = helper.make_node, weights(2, 3)
    nodes = [node("Gemm", ["x", "W1", "b1"], ["a"]), node("InstanceNormalization", ["a", "s", "s"], ["z"])]
    held = {"W1": w["W1"], "b1": w["b1"], "s": np.ones(6, np.float32)}
    path = write(tmp_path / "norm.onnx", nodes, nz=6, tensors=held)
    with pytest.raises(
        km.KoopmpcError, match=r"norm.onnx cannot be read as a network: .*InstanceNormalization.*for inference"
    ):
        km.lifting.ONNX(path)
    path = write(tmp_path / "foreign.onnx", [node("Foreign", ["x"], ["z"], domain="elsewhere")], nz=2)
    with pytest.raises(km.KoopmpcError, match="Foreign"):
        km.lifting.ONNX(path)
    two = [node("Tanh", ["x"], ["z"]), node("Relu", ["x"], ["y"])]
    with pytest.raises(km.KoopmpcError, match="has 1 inputs and 2 outputs"):
        km.lifting.ONNX(write(tmp_path / "two.onnx", two, nz=2, outputs=("z", "y")))
    with pytest.raises(km.KoopmpcError, match="there is no file"):
        km.lifting.ONNX(tmp_path / "none.onnx")
    path, _ = perceptron(tmp_path / "net.onnx")
    with pytest.raises(km.KoopmpcError, match=r"names has 1 names, net.onnx has 3 outputs"):
        km.lifting.ONNX(path, names=["a"])
    with pytest.raises(km.KoopmpcError, match="takes 2 inputs and is given 3 states: theta"):
        km.lifting.ONNX(path).bind(STATES)
    with pytest.raises(km.KoopmpcError, match="does not know its states yet"):
        km.lifting.ONNX(path).as_saved()


@pytest.mark.parametrize("layer", ["Tanh", "LayerNormalization"])
def test_damaged_files_are_read_right_or_refused(layer, tmp_path):
    path, _ = perceptron(tmp_path / "net.onnx")
    if layer not in LAYERS:
        w, node = weights(2, 3), helper.make_node
        nodes = [node("Gemm", ["x", "W1", "b1"], ["a"]), node(layer, ["a", "b1"], ["h"])]
        write(path, [*nodes, node("Gemm", ["h", "W2", "b2"], ["z"])], rows=1, tensors=w)
    whole, rng, refused = path.read_bytes(), np.random.default_rng(5), 0
    for k in range(300):
        damaged = bytearray(whole)
        place = int(rng.integers(len(whole)))
        if k % 3 == 0:
            damaged[place] = int(rng.integers(256))
        elif k % 3 == 1:
            damaged = damaged[:place]
        else:
            damaged[place:place] = rng.bytes(8)
        path.write_bytes(damaged)
        try:
            assert km.lifting.ONNX(path).bind(STATES[:2])([0.1, 0.2]).shape == (3,)
        except km.KoopmpcError:
            refused += 1
    assert refused > 100


def test_the_page_how_onnx_md_runs_with_a_network(tmp_path):
    perceptron(tmp_path / "encoder.onnx")
    ((shown, printed),) = run("how/onnx.md", tmp_path)[1]
    assert alike(shown, printed), printed
