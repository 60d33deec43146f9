"""Functions of C as tables: the same numbers as line by line and as Python, and no more source than there are tables."""

import ctypes
from functools import partial
from importlib.resources import files

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.codegen import functions
from koopmpc.codegen.functions import EXPRESSIONS, Language, plan_runs, write_functions
from koopmpc.codegen.tables import CFunction
from koopmpc.plants.graph import OPERATIONS, Graph
from koopmpc.plants.routines import load_library
from tests.compiler import find_compiler, needs_compiler

HEAD = "#include <math.h>\ntypedef double koopmpc_real;\n#define KOOPMPC_FN(name) name\n"


def run_in_c(graph: Graph, rows: np.ndarray) -> np.ndarray:
    """Return the results of the C of a graph, row by row; each is written over its own argument."""
    command = find_compiler()
    assert command is not None
    text = HEAD + write_functions({"f": CFunction(graph, {"v": graph.n}, "out")}, Language())
    code = load_library(text, command, None)
    results = np.zeros((len(rows), max(graph.n, graph.m)))
    results[:, : graph.n] = rows
    for row in results:
        code.f(ctypes.c_void_p(row.ctypes.data), ctypes.c_void_p(row.ctypes.data))
    return results[:, : graph.m]


@needs_compiler
@pytest.mark.parametrize("place", [0, 1, 2, None])
def test_the_largest_of_a_row_is_no_number_where_an_entry_is_none(place):
    """A solution with a NaN in it must not pass the test of its residuals, wherever the NaN stands."""
    command = find_compiler()
    assert command is not None
    step = files("koopmpc").joinpath("codegen/c/koopmpc_step.h").read_text()
    code = step[
        step.index("static inline koopmpc_real koopmpc_abs") : step.index("static inline koopmpc_real koopmpc_dot")
    ]
    wrapped = "double largest(const double *a, int n) { return koopmpc_largest(a, n); }\n"
    largest = load_library(f"{HEAD}#define KOOPMPC_HUGE 1e30\n{code}{wrapped}", command, None).largest
    largest.restype = ctypes.c_double
    row = np.array([-3.0, 1.0, 2.0])
    if place is not None:
        row[place] = np.nan
    assert np.array_equal(largest(ctypes.c_void_p(row.ctypes.data), 3), np.abs(row).max(), equal_nan=True)


def trace_all_operations() -> Graph:
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    narrow, positive = ca.sin(a) * 0.9, ca.fabs(a) + 1.1
    of = dict.fromkeys(("asin", "acos", "atanh"), narrow)
    of |= dict.fromkeys(("acosh", "log", "log1p", "sqrt", "pow", "constpow"), positive)
    return Graph.trace(
        ca.Function(
            "all",
            [a, b],
            [ca.vertcat(*(one.symbol(*(of.get(name, a), b)[: one.operands]) for name, one in OPERATIONS.items()))],
        )
    )


@needs_compiler
def test_every_operation_is_the_same_in_a_table(monkeypatch):
    graph = trace_all_operations()
    assert set(EXPRESSIONS) == set(OPERATIONS)
    rows = 2 * np.random.default_rng(0).normal(size=(50, 2))
    lines = run_in_c(graph, rows)
    monkeypatch.setattr(functions, "_LARGEST", 0)
    table = run_in_c(graph, rows)
    assert np.array_equal(table, lines)
    np.testing.assert_allclose(table, graph.evaluate(rows), rtol=1e-13, atol=1e-15)


@given(st.integers(1, 4), st.integers(1, 60), st.integers(0, 999))
@settings(max_examples=30)
def test_the_runs_of_a_graph_compute_what_it_does_in_registers_that_nothing_still_reads(n, count, seed):
    rng, x = np.random.default_rng(seed), ca.SX.sym("x", n)
    terms = [x[i] for i in range(n)] + [ca.SX(0.5)]
    for _ in range(count):
        a, b = (terms[int(rng.integers(len(terms)))] for _ in range(2))
        terms.append([a + b, ca.sin(a), a * b, a - 0.3 * b][int(rng.integers(4))])
    wanted = ca.vertcat(*(terms[int(i)] for i in rng.integers(len(terms), size=3)), terms[-1])
    graph = Graph.trace(ca.Function("f", [x], [wanted], {"cse": True}))
    plan = plan_runs(graph)
    rows = rng.uniform(-1, 1, (5, n))
    registers, result = np.full((plan.registers, 5), np.nan), np.full((graph.m, 5), np.nan)
    registers[:n] = rows.T
    steps = iter(plan.places.tolist())
    for word, times in plan.runs:
        for _ in range(times):
            target, first, second = next(steps)
            if word == "output":
                result[target] = registers[first]
            elif word == "constant":
                registers[target] = graph.constants[first]
            else:
                operands = [registers[first].copy(), registers[second].copy()][: OPERATIONS[word].operands]
                OPERATIONS[word].columns(*operands, registers[target])
    assert next(steps, None) is None
    assert np.array_equal(result.T, graph.evaluate(rows))


def test_a_long_sum_is_one_run():
    x = ca.SX.sym("x", 100)
    plan = plan_runs(Graph.trace(ca.Function("f", [x], [ca.sum1(ca.sin(x))])))
    assert [word for word, _ in plan.runs].count("add") == 1
    assert ("sin", 100) in plan.runs


def test_a_register_is_taken_again_after_its_last_reader():
    x = value = ca.SX.sym("x")
    for _ in range(50):
        value = ca.sin(value)
    assert plan_runs(Graph.trace(ca.Function("f", [x], [value]))).registers <= 3


KINDS = {
    "thin plate": lambda n, rng: km.ThinPlate(rng.uniform(-2, 2, (n, 2))),
    "gaussian": lambda n, rng: km.Gaussian(rng.uniform(-2, 2, (n, 2)), 1.0),
    "random fourier": lambda n, rng: km.RandomFourier(n // 2, 1.0, rng),
    "fourier": lambda n, rng: km.Fourier(n // 4),
    "monomials": lambda n, rng: km.Monomials(round((2 * n) ** 0.5)),
    "products": lambda n, rng: km.Fourier(int(n**0.5) // 4) * km.Monomials(round(n**0.25)) * km.Fourier(2),
}


def trace_model(kind: str, n: int, what: str) -> Graph:
    """Return a lifting of about n observables, the map C (A ψ + B u + Σ uᵢ Nᵢ ψ), or its Jacobian, as a graph."""
    rng = np.random.default_rng(0)
    lifting = (km.State() + km.Constant() + KINDS[kind](n, rng)).bind(("a", "b"))
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u", 1)
    z = lifting.symbolic(x)
    if what == "lift":
        return Graph.trace(ca.Function("f", [x], [ca.densify(z)], {"cse": True}))
    M = rng.standard_normal((2, 2, lifting.nz)) / lifting.nz
    step = ca.DM(M[0]) @ z + u * (ca.DM(M[1]) @ z)
    v = ca.vertcat(x, u)
    out = step if what == "map" else ca.vertcat(step, ca.vec(ca.jacobian(step, v)))
    return Graph.trace(ca.Function("f", [x, u], [ca.densify(out)], {"cse": True}))


@needs_compiler
@pytest.mark.slow
def test_a_controller_of_a_thousand_observables_compiles_and_moves_as_in_python(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    rng = np.random.default_rng(0)
    plant = km.discretize(km.load_problem("pendulum").dynamics, 0.05)
    data = km.collect(plant, km.Uniform([-2, -2], [2, 2]), km.Noise(-3, 3), episodes=40, steps=25)
    lifting = km.State() + km.Constant() + km.ThinPlate(rng.uniform(-2, 2, (1000, 2)))
    model = km.bilinear_edmd(data, lifting, ridge=1e-4)
    cost, limits = km.Cost(Q=np.eye(2), R=[[0.1]], tail=0), km.Limits(u_min=[-3], u_max=[3])
    mpc = km.BilinearMPC(model, cost, limits, 10)
    twin = km.compiled(mpc)
    assert twin is not mpc
    x = np.array([1.0, 0.2])
    for _ in range(5):
        u = mpc(x, np.zeros(2)).u
        assert twin(x, np.zeros(2)).u == pytest.approx(u, abs=1e-9)
        x = plant(x, u)


@needs_compiler
@pytest.mark.parametrize("single", [False, True])
def test_a_long_array_holds_its_numbers_to_the_bit(single):
    count, kind = functions._LONG, np.float32 if single else np.float64
    values = np.random.default_rng(0).standard_normal(count) * 10.0 ** np.arange(-35, 35).repeat(72)[:count]
    values[:4] = -0.0, 1e300, -np.inf, 5e-324
    head = f"typedef {'float' if single else 'double'} koopmpc_real;\n{Language(single).array('numbers', values)}\n"
    code = load_library(head + "koopmpc_real look(int i) { return numbers[i]; }\n", find_compiler(), None, "-O1")
    code.look.restype = ctypes.c_float if single else ctypes.c_double
    found = np.array([code.look(i) for i in range(count)], dtype=kind)
    assert found.tobytes() == np.clip(values, -1e30, 1e30).astype(kind).tobytes()


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("what", ["lift", "map", "slopes"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_thousand_observables_compile_and_agree_with_python(kind, what):
    graph = trace_model(kind, 1000, what)
    rows = np.random.default_rng(1).uniform(-1, 1, (20, graph.n))
    expected = graph.evaluate(rows)
    size = np.abs(expected).max(axis=0) + 1e-300
    assert np.abs((run_in_c(graph, rows) - expected) / size).max() <= 1e-9


@pytest.mark.parametrize("kind", ["fourier", pytest.param("thin plate", marks=pytest.mark.slow)])
def test_source_grows_as_its_tables_do(kind):
    write = partial(write_functions, language=Language())
    lines, table = [], []
    for n in (250, 500):
        graph = trace_model(kind, n, "slopes")
        lines.append(write({"f": CFunction(graph, {"x": 2, "u": 1}, "y")}).count("\n"))
        table.append(len(graph.steps))
    assert lines[1] / lines[0] <= 1.05 * table[1] / table[0]
    assert lines[1] < table[1] / 2
