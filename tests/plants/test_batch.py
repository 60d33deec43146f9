"""Batches of a plant and its machine code give what the interpreter gives."""

import gc
import stat
import subprocess
import warnings

import casadi as ca
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import koopmpc as km
from koopmpc.base.values import fingerprint
from koopmpc.plants import routines, step_map
from koopmpc.plants.graph import Graph
from koopmpc.plants.routines import Routine
from tests.compiler import avoid_compiling, needs_compiler
from tests.example_plants import CartPole, Pendulum

MAPS = {
    "euler": km.discretize(CartPole(), 0.02, km.plants.Euler()),
    "rk4": km.discretize(CartPole(), 0.02),
    "substeps": km.discretize(Pendulum(damping=0.1), 0.05, km.RK4(3)),
}


@pytest.fixture(scope="module")
def kernels(tmp_path_factory):
    command = routines.find_compiler()
    assert command is not None
    cache = tmp_path_factory.mktemp("cache")
    return {name: routines.compile_kernel(plant.F, command, cache) for name, plant in MAPS.items()}


def empty(X0, U):
    X = np.full((len(X0), U.shape[1] + 1, X0.shape[1]), np.nan)
    X[:, 0] = X0
    return X


def random_episodes(plant, episodes, steps, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(episodes, plant.nx)), 5 * rng.normal(size=(episodes, steps, plant.nu))


@needs_compiler
@pytest.mark.parametrize("name", MAPS)
@given(seed=st.integers(0, 2**32 - 1), episodes=st.sampled_from([1, 3, 70]), steps=st.sampled_from([0, 1, 9]))
def test_machine_code_graph_and_interpreter_agree_to_1e12_a_step(kernels, name, seed, episodes, steps):
    plant = MAPS[name]
    X0, U = random_episodes(plant, episodes, steps, seed)
    by_code, by_columns = empty(X0, U), empty(X0, U)
    kernels[name](by_code, U)
    step_map.roll_out_columns(Graph.trace(plant.F), by_columns, U)
    for X in (by_code, by_columns):
        assert X[:, 0].tolist() == X0.tolist()
        for e, k in np.ndindex(episodes, steps):
            want = plant(X[e, k], U[e, k])
            assert np.abs(X[e, k + 1] - want).max() <= 1e-12 * max(1.0, np.abs(want).max())


@needs_compiler
def test_threads_share_the_episodes(kernels, monkeypatch):
    X0, U = random_episodes(MAPS["rk4"], 1003, 5)
    alone, shared = empty(X0, U), empty(X0, U)
    kernels["rk4"](alone, U)
    monkeypatch.setattr(routines, "_STEPS_A_THREAD", 100)
    monkeypatch.setattr("os.cpu_count", lambda: 7)
    kernels["rk4"](shared, U)
    assert shared.tobytes() == alone.tobytes()


def test_columns_beyond_one_chunk():
    plant = MAPS["rk4"]
    X0, U = random_episodes(plant, step_map._CHUNK + 3, 2)
    X = empty(X0, U)
    step_map.roll_out_columns(Graph.trace(plant.F), X, U)
    for e in (0, step_map._CHUNK - 1, step_map._CHUNK, step_map._CHUNK + 2):
        np.testing.assert_allclose(X[e], plant.rollout(X0[e], U[e]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    "integrator",
    [km.plants.Euler(), km.RK4(2), km.plants.ImplicitMidpoint(), km.plants.Collocation(2), km.plants.CVODES()],
    ids=repr,
)
@pytest.mark.parametrize("episodes", [1, 70])
def test_rollouts_are_rollouts(integrator, episodes):
    plant = km.discretize(CartPole(), 0.02, integrator)
    X0, U = random_episodes(plant, episodes, 5)
    X = plant.rollouts(X0, U)
    assert X.shape == (episodes, 6, 4)
    for e in range(episodes):
        np.testing.assert_allclose(X[e], plant.rollout(X0[e], U[e]), rtol=1e-12, atol=1e-12)


def test_no_episodes_and_no_steps():
    plant = MAPS["rk4"]
    assert plant.rollouts(np.empty((0, 4)), np.empty((0, 5, 1))).shape == (0, 6, 4)
    assert plant.rollouts(np.ones((3, 4)), np.empty((3, 0, 1))).tolist() == np.ones((3, 1, 4)).tolist()


def test_functions_of_matrices_run_in_batches():
    x, u = ca.MX.sym("x", 2), ca.MX.sym("u", 1)
    A = np.array([[0.9, 0.1], [-0.2, 0.8]])
    plant = km.StepMap(ca.Function("F", [x, u], [ca.DM(A) @ x + u]), 0.1)
    X0, U = random_episodes(plant, 100, 3)
    X = plant.rollouts(X0, U)
    np.testing.assert_allclose(X[:, 1:], X[:, :-1] @ A.T + U, rtol=1e-13, atol=1e-14)


def test_operations_that_a_graph_refuses_run_in_batches():
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    plant = km.StepMap(ca.Function("F", [x, u], [ca.erf(x) + u]), 0.1)
    X0, U = random_episodes(plant, 100, 3)
    np.testing.assert_allclose(plant.rollouts(X0, U)[9], plant.rollout(X0[9], U[9]), rtol=1e-13)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    tmp_path.chmod(0o700)
    return tmp_path / "koopmpc"


@needs_compiler
def test_large_batches_compile_once_a_user(cache, monkeypatch):
    X0, U = random_episodes(MAPS["rk4"], 100, 200)
    first = km.discretize(CartPole(), 0.02).rollouts(X0, U)
    (library,) = cache.glob("*.so")
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700
    monkeypatch.setattr(routines, "_compile", lambda *_: pytest.fail("compiled twice"))
    assert km.discretize(CartPole(), 0.02).rollouts(X0, U).tobytes() == first.tobytes()
    assert list(cache.glob("*.so")) == [library]


@needs_compiler
def test_small_batches_do_not_compile(cache):
    X0, U = random_episodes(MAPS["rk4"], 99, 200)
    km.discretize(CartPole(), 0.02).rollouts(X0, U)
    assert not cache.exists()


@needs_compiler
@pytest.mark.parametrize("damage", ["a bit", "a cut", "no checksum"])
def test_damaged_machine_code_in_the_cache_is_not_loaded(cache, damage, monkeypatch):
    """Loading it could end the process: it is compiled again."""
    X0, U = random_episodes(MAPS["rk4"], 100, 200)
    want = km.discretize(CartPole(), 0.02).rollouts(X0, U)
    (library,) = cache.glob("*.so")
    data, compiled = bytearray(library.read_bytes()), []
    data[len(data) // 2] ^= 1
    library.unlink()
    library.write_bytes(data[: len(data) // (2 if damage == "a cut" else 1)])
    if damage == "no checksum":
        library.with_suffix(".sha256").unlink()
    compiler = routines._compile
    monkeypatch.setattr(routines, "_compile", lambda *given: compiled.append(given) or compiler(*given))
    for _ in range(2):
        assert km.discretize(CartPole(), 0.02).rollouts(X0, U).tobytes() == want.tobytes()
    assert len(compiled) == 1


@needs_compiler
def test_machine_code_of_another_kind_of_machine_is_written_again(cache):
    X0, U = random_episodes(MAPS["rk4"], 100, 200)
    want = km.discretize(CartPole(), 0.02).rollouts(X0, U)
    (library,) = cache.glob("*.so")
    library.unlink()
    library.write_bytes(b"no machine code here")
    library.with_suffix(".sha256").write_text(fingerprint(library.read_bytes()))
    assert km.discretize(CartPole(), 0.02).rollouts(X0, U).tobytes() == want.tobytes()


@needs_compiler
def test_without_a_private_folder_nothing_is_left_on_disk(tmp_path, monkeypatch):
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setattr(routines, "find_private_cache", lambda: None)
    X0, U = random_episodes(MAPS["rk4"], 100, 200)
    plant = km.discretize(CartPole(), 0.02)
    np.testing.assert_allclose(plant.rollouts(X0, U)[3, 1], plant(X0[3], U[3, 0]), rtol=1e-12)
    assert list(tmp_path.iterdir()) == []


def test_folders_that_others_can_write_are_not_trusted(cache):
    assert routines.find_private_cache() == cache
    cache.chmod(0o722)
    assert routines.find_private_cache() is None
    cache.chmod(0o700)
    cache.parent.chmod(0o777)
    assert routines.find_private_cache() is None
    cache.parent.chmod(0o700)
    cache.rmdir()
    real = cache.parent / "elsewhere"
    real.mkdir(0o700)
    cache.symlink_to(real)
    assert routines.find_private_cache() is None
    cache.unlink()
    cache.write_text("a file")
    assert routines.find_private_cache() is None


def test_a_compiler_that_fails_costs_one_warning(cache, tmp_path, monkeypatch):
    script = tmp_path / "broken-cc"
    script.write_text("#!/bin/sh\necho out of order >&2\nexit 1\n")
    script.chmod(0o700)
    monkeypatch.setenv("CC", str(script))
    plant = km.discretize(CartPole(), 0.02)
    X0, U = random_episodes(plant, 100, 200)
    with pytest.warns(RuntimeWarning, match=r"broken-cc could not compile the step map.*out of order") as caught:
        X = plant.rollouts(X0, U)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert plant.rollouts(X0, U).tobytes() == X.tobytes()
    np.testing.assert_allclose(X[5, 1], plant(X0[5], U[5, 0]), rtol=1e-12)


def test_the_compiler_may_have_arguments(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "sh -c")
    assert routines.find_compiler() == ["sh", "-c"]
    monkeypatch.setenv("CC", "no-such-compiler -m64")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert routines.find_compiler() is None


@needs_compiler
def test_flags_of_the_environment_come_last_and_code_of_other_flags_is_another_file(tmp_path, monkeypatch):
    command, text = routines.find_compiler(), "#ifdef __OPTIMIZE__\n#error\n#endif\nint told(void) { return TOLD; }"
    for told in (3, 4):
        monkeypatch.setenv("KOOPMPC_CFLAGS", f"-O0 -DTOLD={told}")
        for cache in (tmp_path, tmp_path, None):
            assert routines.load_library(text, command, cache).told() == told
    assert len(list(tmp_path.glob("*.so"))) == 2


@needs_compiler
@pytest.mark.parametrize("other", ["_describe_host", "_describe_compiler"])
def test_machines_that_share_a_home_share_no_code_of_another_processor_or_compiler(other, tmp_path, monkeypatch):
    command, text = routines.find_compiler(), "int told(void) { return 4; }"
    for count in (1, 2):
        for _ in range(2):
            assert routines.load_library(text, command, tmp_path, native=True).told() == 4
            assert len(list(tmp_path.glob("*.so"))) == count
        monkeypatch.setattr(routines, other, lambda *_: "another one")


@needs_compiler
def test_a_library_leaves_the_process_with_the_last_reference_to_its_functions(tmp_path):
    """A process that designs for days would else hold all libraries that it ever loaded."""
    command, gone = routines.find_compiler(), tmp_path / "gone"
    text = f"""#include <stdio.h>
int told(void) {{ return 4; }}
__attribute__((destructor)) static void leave(void) {{ fclose(fopen("{gone.as_posix()}", "w")); }}
"""
    code, again = (routines.load_library(text, command, tmp_path) for _ in range(2))
    told = code.told
    del code
    gc.collect()
    assert told() == again.told() == 4
    assert not gone.exists()
    del told, again
    gc.collect()
    assert gone.exists()


def test_a_compiler_that_hangs_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(routines, "_COMPILING", 0.05)
    with pytest.raises(subprocess.TimeoutExpired):
        routines.load_library("int f(void) { return 0; }", ["sh", "-c", "sleep 60"], tmp_path)
    assert not list(tmp_path.iterdir())


def test_without_a_compiler_batches_run_over_columns(monkeypatch):
    avoid_compiling(monkeypatch)
    plant = km.discretize(CartPole(), 0.02)
    X0, U = random_episodes(plant, 100, 200)
    X = plant.rollouts(X0, U)
    np.testing.assert_allclose(X[50, 1], plant(X0[50], U[50, 0]), rtol=1e-12)


def function() -> ca.Function:
    """Return a function with loops, matrices and elementary functions."""
    A, x = ca.SX.sym("A", 3, 3), ca.SX.sym("x", 3)
    step = ca.Function("step", [x, A], [ca.tanh(A @ x) + ca.sin(x)]).mapaccum("steps", 20)
    M, x0 = ca.MX.sym("M", 3, 60), ca.MX.sym("x0", 3)
    return ca.Function("march", [x0, M], [step(x0, M), ca.sum2(M**2)])


def results(routine_of) -> tuple[np.ndarray, np.ndarray, bool]:
    rng = np.random.default_rng(0)
    x, M = rng.standard_normal(3), rng.standard_normal((20, 3, 3))
    X, sums = np.zeros((20, 3)), np.zeros(3)
    routine = routine_of(function(), [x, M], [X, sums])
    routine.call()
    first = X.copy()
    x *= 2  # the same arrays are read again
    routine.call()
    assert not np.array_equal(first, X)
    return X, sums, routine.compiled


@needs_compiler
def test_machine_code_is_the_interpreter_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    fast = results(Routine)
    avoid_compiling(monkeypatch)
    slow = results(Routine)
    assert (fast[2], slow[2]) == (True, False)
    assert np.array_equal(fast[0], slow[0])
    assert np.array_equal(fast[1], slow[1])


def test_a_quote_without_an_end_names_no_compiler_and_fails_as_a_compiler_does(monkeypatch):
    monkeypatch.setenv("CC", "'gcc")
    assert routines.find_compiler() is None
    monkeypatch.setenv("KOOPMPC_CFLAGS", '-O2 "')
    with pytest.raises(OSError, match=r"KOOPMPC_CFLAGS is .* a quote has no end"):
        routines.load_library("int f(void) { return 0; }", ["cc"], None)
