"""Mistakes get a sentence of ours: what was got, and what to do."""

from dataclasses import replace
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import koopmpc as km
from tests.commands import koopmpc
from tests.faults.garbage import foreign
from tests.tiers import slow

pytestmark = pytest.mark.unhooked

PENDULUM = km.load_problem("pendulum")
PLANT = km.discretize(PENDULUM.dynamics, 0.05)


@pytest.fixture(scope="module")
def model():
    data = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-8, 8), episodes=30, steps=20)
    return km.edmd(data, km.State() + km.Fourier(1, states=[0]) + km.Constant())


@pytest.mark.parametrize("bad", [None, "x", [[1], [2, 3]], {}, object(), [1j, 0], [1, 2, 3], 5.0])
def test_lqr_says_what_is_wrong_with_its_reference_and_its_disturbance(model, bad):
    controller = km.LQR(model, PENDULUM.cost)
    with pytest.raises(km.errors.KoopmpcError, match="reference"):
        controller([0.0, 0.0], bad)
    if bad is not None:
        with pytest.raises(km.errors.KoopmpcError, match="w "):
            controller([0.0, 0.0], [0.0, 0.0], None, bad)


def test_a_number_is_no_path_of_a_controller():
    with pytest.raises(km.errors.KoopmpcError, match=r"3 is not a path; pass the .npz of a saved Controller or Design"):
        km.load_controller(3)


@pytest.fixture(scope="module")
def stateful(model):
    """Return everything that begins a run at a state."""
    cost, limits = PENDULUM.cost, PENDULUM.limits
    mpc = km.KoopmanMPC(model, cost, limits, 8)
    few = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-8, 8), episodes=30, steps=20)
    watched = km.KoopmanMPC(model, cost, limits, 8, monitor=few)
    online = km.OnlineEDMD(model.lifting, dt=0.05, states=model.states, inputs=model.inputs)
    found = {
        "LQR": km.LQR(model, cost),
        "LinearMPC": km.LinearMPC(PLANT, [0, 0], [0], cost, limits, 5),
        "KoopmanMPC": mpc,
        "estimated": km.KoopmanMPC(model, cost, limits, 8, estimator=km.LiftedDisturbance()),
        "filtered": km.KoopmanMPC(model, cost, limits, 8, estimator=km.LiftedKalman(model.states)),
        "BilinearMPC": km.BilinearMPC(PLANT, cost, limits, 5),
        "NonlinearMPC": km.NonlinearMPC(PLANT, cost, limits, 3),
        "Adaptive": km.supervise.Adaptive(km.KoopmanMPC(model, cost, limits, 8), online),
        "Guarded": km.supervise.Guarded(watched, km.LQR(model, cost)),
        "Station": km.supervise.Station(mpc, km.LQR(model, cost)),
        "plant": km.plants.SimulatedPlant(PLANT),
    }
    return found | {f"observer of {name}": found[name].observer for name in ("KoopmanMPC", "estimated", "filtered")}


NO_STATE = ["a", [1, 2, 3], [np.nan, 0], 5.0, {}, object(), [1j, 0], [[0.0, 0.0]], [[1], [2, 3]], [None, 1.0], "ab", []]


@pytest.mark.parametrize("bad", NO_STATE, ids=range(len(NO_STATE)))
def test_what_is_no_state_is_refused_where_a_run_begins(stateful, bad):
    for name, each in stateful.items():
        with pytest.raises(km.KoopmpcError, match="x0 "):
            each.reset(bad), name
        if "observer" in name or name == "plant":
            continue
        with pytest.raises(km.KoopmpcError, match="u_prev "):
            each.reset(None, bad if bad != 5.0 else [5.0, 5.0])
        each.reset([0.1, 0.0])
        assert np.isfinite(each([0.1, 0.0], [0.0, 0.0]).u).all()


GARBAGE = [None, 7, float("nan"), object(), [1, 2], [[1], [2, 3]], np.full((2, 2), np.nan), b"x", {1: 2}, len]
KEPT = {  # what is no garbage in some places: a function for an excitation, None for what may be left out
    "excitation": [len],
    "noise": [None],
    "trust train": [None],
    "simulate cost": [None],
    "simulate limits": [None],
    "recorder cost": [None],
    "recorder limits": [None],
    "train embedding": [None],
    "candidates": [None],
    "delays": [GARBAGE[4], None],
    "embedding": [None],
}
EPISODES = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-8, 8), episodes=4, steps=8)
LIFTED = km.edmd(EPISODES, km.State())
TAKES = {
    "states": lambda bad: replace(LIFTED, states=bad),
    "inputs": lambda bad: replace(LIFTED, inputs=bad),
    "lifting": lambda bad: replace(LIFTED, lifting=bad),
    "predictor": lambda bad: km.score(bad, EPISODES, 3),
    "held_out": lambda bad: km.score(LIFTED, bad, 3),
    "trust train": lambda bad: km.trust(LIFTED, EPISODES, 3, train=bad),
    "simulate cost": lambda bad: km.simulate(
        PLANT, km.LQR(LIFTED, PENDULUM.cost), x0=[0, 0], reference=[0, 0], steps=2, cost=bad
    ),
    "simulate limits": lambda bad: km.simulate(
        PLANT, km.LQR(LIFTED, PENDULUM.cost), x0=[0, 0], reference=[0, 0], steps=2, limits=bad
    ),
    "recorder cost": lambda bad: km.Recorder("run.rrd", dt=0.1, states=["a"], inputs=["u"], cost=bad),
    "recorder limits": lambda bad: km.Recorder("run.rrd", dt=0.1, states=["a"], inputs=["u"], limits=bad),
    "integrator": lambda bad: km.discretize(PENDULUM.dynamics, 0.05, integrator=bad),
    "train embedding": lambda bad: km.train(km.Gaussian([[0.0, 0.0]], 1.0), EPISODES, embedding=bad),
    "kic episodes": lambda bad: km.identify.kic(bad, km.State()),
    "candidates": lambda bad: km.select(EPISODES, horizon=2, folds=2, options=km.SearchOptions(candidates=bad)),
    "delays": lambda bad: km.select(
        EPISODES, horizon=2, folds=2, options=km.SearchOptions(candidates=[km.State()], delays=bad)
    ),
    "smoother": lambda bad: km.data.Smoother.of(bad),
    "mender": lambda bad: km.data.Mender.of(bad),
    "episodes": lambda bad: km.score(LIFTED, bad, 3),
    "data": lambda bad: km.identify.eigenfunctions(bad, km.State()),
    "embedding": lambda bad: km.edmd(EPISODES, km.State(), embedding=bad),
    "method": lambda bad: km.edmd(EPISODES, km.State(), method=bad),
    "towards": lambda bad: km.edmd(EPISODES, km.State(), towards=bad),
    "kernel": lambda bad: km.identify.kernel_edmd(EPISODES, bad),
    "noise": lambda bad: km.Feedback([[1.0, 2.0]], bad),
    "F": lambda bad: km.StepMap(bad, 0.1),
    "dynamics": lambda bad: km.discretize(bad, 0.1),
    "excitation": lambda bad: km.collect(PLANT, [[0.0, 0.0]], bad, episodes=1, steps=2),
    "names": lambda bad: km.Expressions(lambda x: [x[0]], bad),
    "online": lambda bad: km.OnlineEDMD(km.State(), dt=0.1, states=bad, inputs=("u",)),
    "black box": lambda bad: km.black_box(lambda x, u: x, dt=0.1, states=bad, inputs=("u",)),
    "folder": lambda bad: km.export(km.KoopmanMPC(LIFTED, PENDULUM.cost), bad),
    "problems": lambda bad: km.sweep(bad, ["lqr"], folder="nowhere"),
    "store": lambda bad: km.sweep([PENDULUM], ["lqr"], folder=bad),
    "continuous_eigenvalues": lambda bad: km.spectrum.continuous_eigenvalues(bad),
    "amplitudes": lambda bad: km.spectrum.amplitudes(bad, [0.0, 0.0]),
    "reconstruct": lambda bad: km.spectrum.reconstruct(bad, [0.0, 0.0], [0.0]),
    "evolution_error": lambda bad: km.spectrum.evolution_error(bad, EPISODES),
    "forecast": lambda bad: km.validate.forecast(LIFTED, bad),
    "runs": lambda bad: km.plot.runs(bad),
    "runs of a title": lambda bad: km.plot.runs({"a": bad}),
    "run of a name": lambda bad: km.plot.runs({"a": {"b": bad}}),
}


@pytest.mark.parametrize("calls", [400, *slow([20_000])])
@pytest.mark.filterwarnings("ignore")
def test_drawn_calls_end_in_a_value_or_an_error_of_ours(calls, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert list(foreign(calls, calls)) == []


@pytest.mark.parametrize("bad", [[1j, 0.0], np.array([1j, 0.0]), np.array([1 + 0j, 0.0])])
def test_complex_readings_are_refused_by_every_controller(stateful, bad):
    for name, each in stateful.items():
        if "observer" not in name and name != "plant":
            each.reset()
            with pytest.raises(km.KoopmpcError, match="y is complex"):
                each(bad, [0.0, 0.0])


@pytest.mark.parametrize("where", TAKES)
def test_garbage_is_refused_in_a_sentence(where):
    for bad in GARBAGE:
        if not any(bad is kept for kept in KEPT.get(where, [])):
            with pytest.raises(km.KoopmpcError):
                TAKES[where](bad)


def test_a_horizon_beyond_all_counting_is_refused():
    with pytest.raises(km.errors.DataError, match=r"horizon is 1e\+30; it must be at most 2147483647"):
        km.KoopmanMPC(LIFTED, PENDULUM.cost, PENDULUM.limits, 10**30)


BEYOND = 10**400  # an integer that no float holds


def test_an_integer_beyond_all_floats_is_refused_as_a_reading_and_as_a_count(stateful):
    with pytest.raises(km.errors.DataError, match=r"horizon is beyond 1e100; it must be at most 2147483647"):
        km.KoopmanMPC(LIFTED, PENDULUM.cost, PENDULUM.limits, BEYOND)
    with pytest.raises(km.errors.DataError, match=r"horizon is below -1e100; it must be at least 1"):
        km.KoopmanMPC(LIFTED, PENDULUM.cost, PENDULUM.limits, -(10**5000))
    for name in ("LQR", "KoopmanMPC", "BilinearMPC", "NonlinearMPC", "filtered"):
        stateful[name].reset()
        with pytest.raises(km.errors.DataError, match="too large to convert to float"):
            stateful[name]([BEYOND, 0], [0.0, 0.0])


@pytest.mark.parametrize("end", ["u_min", "u_max", "du_max", "x_min", "x_max"])
@pytest.mark.parametrize("value", [1e200, 1.7e308])
def test_a_limit_whose_square_overflows_is_refused_by_name_and_infinity_is_not(end, value):
    sign = -1 if "min" in end else 1
    for given in (sign * value, [sign * value], {"theta": sign * value}):
        with pytest.raises(km.errors.DataError, match=rf"{end} holds a number beyond 1e100; pass ±inf where"):
            km.Limits(**{end: given})
    assert np.isinf(getattr(km.Limits(**{end: sign * np.inf}), end))


def test_numbers_of_other_kinds_are_steps_and_what_only_has_the_name_of_a_method_is_refused(tmp_path):
    for dt in (Decimal("0.05"), Fraction(1, 20)):
        assert km.discretize(PENDULUM.dynamics, dt).dt == 0.05
    for bad in (range(3), slice(1)):
        with pytest.raises(km.errors.DataError, match="the integrator's step does not take 2 arguments; pass an"):
            km.discretize(PENDULUM.dynamics, 0.05, integrator=bad)
        with pytest.raises(km.errors.DataError, match=r"estimator is (range|slice).*; pass an object"):
            km.KoopmanMPC(LIFTED, PENDULUM.cost, PENDULUM.limits, 5, estimator=bad)
    with pytest.raises(km.errors.DataError, match=r"states is array.*pass a tuple of names"):
        km.Recorder(tmp_path / "run.rrd", dt=0.1, states=np.array("x"), inputs=["u"])
    for judge in (km.spectrum.linearity_error, km.spectrum.evolution_error):
        with pytest.raises(km.errors.DataError, match=r"has no __iter__; pass Episodes|the predictor has inputs"):
            judge(LIFTED, LIFTED)
    with pytest.raises(km.errors.DataError, match=r"keep is 1\.5; it must lie between 0 and 1"):
        km.OnlineEDMD(km.State(), dt=0.05, states=("x",), keep=Fraction(3, 2))


def test_a_controller_that_measures_one_state_does_not_adapt():
    online = km.OnlineEDMD.start(EPISODES, LIFTED.lifting)
    watched = km.KoopmanMPC(LIFTED, PENDULUM.cost, horizon=8, estimator=km.LiftedKalman(LIFTED.states[:1]))
    with pytest.raises(km.errors.DataError, match="takes 1 measurements, and Adaptive learns from all 2 states"):
        km.supervise.Adaptive(watched, online)


def test_a_goal_that_nests_too_deep_is_refused(tmp_path: Path):
    EPISODES.save(tmp_path / "logs.npz")
    (goal := tmp_path / "goal.toml").write_text("a = " + 5000 * "[" + 5000 * "]" + "\n")
    refused = koopmpc("fit", tmp_path / "logs.npz", "--goal", goal, "--logs", tmp_path)
    assert refused.exit_code == 2
    assert "nests its brackets too deep" in refused.stderr


@pytest.mark.parametrize("settings", ["max_iter", [("max_iter", 5)], 5])
def test_settings_of_a_solver_are_given_by_name(model, settings):
    with pytest.raises(km.errors.DataError, match=r"settings is an? \w+, expected a Mapping; pass the solver's own by"):
        km.KoopmanMPC(model, PENDULUM.cost, PENDULUM.limits, 5, settings=settings)


class Answering:
    dt, nu, horizon = 0.05, 1, 0

    def __init__(self, answer):
        self.answer, self.calls = answer, 0

    def reset(self, x0=None, u_prev=None):
        pass

    def __call__(self, y, reference, applied=None):
        self.calls += 1
        return self.answer(self.calls, reference)


def move(*_):
    return km.Move(np.zeros(1), km.Status.OPTIMAL, km.control.Fallback.NONE, 0.0, 0)


def writes(_, reference):
    reference[:] = 7
    return move()


def loop(plant, answer):
    return km.simulate(plant, Answering(answer), x0=[0.1, 0], reference=[0, 0], steps=5)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (lambda k, _: None, "returned is a NoneType .* return a km.Move"),
        (lambda k, _: move() if k < 3 else None, "returned is a NoneType .* return a km.Move"),
        (writes, "wrote into the reference, which is the Run's own; copy it first"),
    ],
)
def test_simulate_says_what_a_controller_did(answer, said):
    with pytest.raises(km.errors.DataError, match=said):
        loop(PLANT, answer)


class Returning:
    dt, states, inputs, outputs, state = 0.05, ("a", "b"), ("u",), ("a", "b"), None

    def __init__(self, y, first=(0.0, 0.0)):
        self.y, self.first = y, first

    def reset(self, x0, rng=0):
        return self.first

    def step(self, u):
        return self.y


@pytest.mark.parametrize("bad", [None, np.zeros(3), "x", 1.0])
def test_simulate_says_what_a_plant_returned(bad):
    with pytest.raises(km.errors.KoopmpcError, match=r"the plant returned .* at step 1"):
        loop(Returning(bad), move)
    if not isinstance(bad, np.ndarray):
        with pytest.raises(km.errors.KoopmpcError, match=r"the plant returned .* at step 0"):
            loop(Returning(np.zeros(2), first=bad), move)


@pytest.mark.parametrize("bad", [None, np.zeros(3), np.zeros((2, 2)), "x", [1.0]])
def test_collect_says_what_a_plant_returned(bad):
    start, noise = km.Uniform([-1, -1], [1, 1]), km.Noise(-1, 1)
    with pytest.raises(km.errors.KoopmpcError, match=r"the plant returned .* at step 1"):
        km.collect(Returning(bad), start, noise, episodes=1, steps=3)
    with pytest.raises(km.errors.KoopmpcError, match=r"the plant returned .* at step 0"):
        km.collect(Returning(np.zeros(2), first=bad), start, noise, episodes=1, steps=3)


def test_a_class_is_no_controller_and_no_plant():
    with pytest.raises(km.errors.DataError, match="the controller is the class LQR; pass one that was made of it"):
        km.simulate(PLANT, km.LQR, x0=[0.1, 0], reference=[0, 0], steps=5)
    with pytest.raises(km.errors.DataError, match="the plant is the class Returning; pass one"):
        loop(Returning, move)


def test_a_model_whose_cost_overflows_makes_no_controller(model):
    with pytest.raises(km.errors.DataError, match=r"forecast overflows within \d+ steps"):
        km.KoopmanMPC(replace(model, A=np.full_like(model.A, 1e49)), km.Cost(Q=[1.0, 1.0], R=1.0), km.Limits(-1, 1), 20)


HUGE = [1e101, 1e200, 1e308, -1e308]


@pytest.mark.parametrize("value", HUGE)
@pytest.mark.parametrize("name", ["B", "C", "E", "N"])
def test_a_model_whose_products_overflow_is_refused_before_a_decomposition_hangs(model, name, value):
    size = {"B": (model.nz, 1), "C": (2, model.nz), "E": (model.nz, 1), "N": (1, model.nz, model.nz)}[name]
    fields = {"A": model.A, "B": model.B, "C": model.C, "lifting": model.lifting, "dt": 0.1, name: np.full(size, value)}
    kind = km.BilinearPredictor if name == "N" else km.LinearPredictor
    with pytest.raises(
        km.errors.DataError, match=rf"{name} holds 1e.*, so products with {name} overflow; choose other"
    ):
        kind(states=model.states, inputs=model.inputs, **fields)


@pytest.mark.parametrize("value", HUGE)
@pytest.mark.parametrize("law", [km.lqr, km.dlqr])
@pytest.mark.parametrize("place", range(4))
def test_a_gain_of_matrices_that_overflow_is_refused_by_name(law, place, value):
    matrices = [np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[0.0], [0.1]]), np.eye(2), np.eye(1)]
    matrices[place] = np.full_like(matrices[place], value)
    with pytest.raises(km.errors.DataError, match=f"^{'ABQR'[place]} holds 1e"):
        law(*matrices)


def test_a_gain_that_rounding_spoils_blames_the_model_and_not_a_positive_R():
    A = [[-0.095, 0.44, -1.3e-4], [6.1e-6, -2180.0, 305855.0], [381.0, -1.2e-3, 17.6]]
    lifting = km.State() + km.Constant()
    model = km.LinearPredictor(A, [[2.7e-3], [-559.4], [153.2]], np.eye(2, 3), lifting, 0.1, ("a", "b"), ("u",))
    with pytest.raises(km.errors.DefinitenessError, match=r"though R is: the cost-to-go .* rounding hides R; fit"):
        km.LQR(model, km.Cost(Q=[1, 1], R=1e-6))


def test_what_overflows_only_together_is_said_so():
    A, B, C = [[1, 0.1, 0], [0, 0.9, 0], [0, 0, 1]], [[0], [1e19], [0]], 1e50 * np.eye(2, 3)
    model = km.LinearPredictor(A, B, C, km.State() + km.Constant(), 0.1, ("a", "b"), ("u",))
    limits = km.Limits(-1, 1, x_max=[1, 1])
    with pytest.raises(km.errors.DataError, match=r"products of the model, the weights and the limits overflow"):
        km.KoopmanMPC(model, km.Cost(Q=[1e-300, 1e-300], R=1), limits, 8)


def test_what_cannot_be_used_is_named(model, tmp_path: Path):
    huge = model.A.copy()
    huge[0, 0] = 1e308
    with pytest.raises(km.errors.DataError, match=r"A holds 1e.308"):
        replace(model, A=huge)
    with pytest.raises(km.errors.DataError, match="run is a LinearPredictor, expected a Run"):
        km.record(model, tmp_path / "run.rrd")
    with pytest.raises(km.errors.DataError, match=r"K is a Gain; pass its matrix, gain\.K"):
        km.Feedback(km.dlqr([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], np.eye(2), np.eye(1)), km.Noise(-1, 1))
    run = replace(loop(PLANT, move), scene=lambda x, u: [km.scene.Line("arm", [(0, 0), (float("nan"), 1)])])
    with pytest.raises(km.errors.DataError, match=r"step 0 draws 'arm' at NaN"):
        km.record(run, tmp_path / "run.rrd")
    assert not list(tmp_path.iterdir())


def table(path: Path, rows: int = 50, **cells: dict[int, float]) -> Path:
    columns = {"time": 0.1 * np.arange(rows), "x": np.sin(np.arange(rows)), "u": np.cos(np.arange(rows))}
    for name, changed in cells.items():
        for row, value in changed.items():
            columns[name][row] = value
    lines = [",".join(columns), *(",".join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True))]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("value", [1e9, 1e300])
def test_one_absurd_cell_is_named_with_row_and_column(tmp_path: Path, value: float):
    with pytest.raises(km.errors.DataError, match=r"log.csv: 'x' is 1e.* in row 8, where 99 % of its cells are within"):
        km.load_episodes(table(tmp_path / "log.csv", rows=300, x={7: value}))


def test_files_that_count_twice_are_named(tmp_path: Path):
    first = table(tmp_path / "a.csv")
    with pytest.raises(km.errors.DataError, match=r"a\.csv is given twice"):
        km.data.Files([first, first])
    (tmp_path / "b.csv").write_bytes(first.read_bytes())
    with pytest.warns(km.FitWarning, match=r"b\.csv holds the same bytes as .*a\.csv"):
        km.data.Files(tmp_path)


def test_resampling_beyond_memory_is_refused_with_the_number(tmp_path: Path):
    with pytest.raises(km.errors.DataError, match=r"resample=1e-12 makes 4.9e\+12 rows of 2 columns, .* GB are free"):
        km.load_episodes(table(tmp_path / "log.csv"), resample=1e-12)


def test_a_table_is_no_problem(tmp_path: Path):
    with pytest.raises(km.errors.ProblemError, match="is not a problem: a problem is a Python file; `koopmpc fit"):
        km.load_problem(str(table(tmp_path / "log.csv")))


def test_the_example_of_the_page_runs():
    text = (Path(__file__).parents[2] / "docs" / "what_can_go_wrong.md").read_text()
    namespace = {}
    exec(text.split("```python\n")[1].split("```")[0], namespace)
    assert namespace["mine"] is not namespace["mpc"]


@pytest.mark.parametrize("bad", [3, None, [1], object()])
def test_what_is_no_path_is_said_by_everything_that_reads_or_writes(model, bad, tmp_path):
    run = km.simulate(PLANT, km.LQR(model, PENDULUM.cost), x0=[0.1, 0], reference=[0, 0], steps=2)
    data = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-8, 8), episodes=2, steps=3)
    readers = (km.load_model, km.load_run, km.load_episodes, km.load_controller)
    writers = (model.save, data.save, lambda path: km.record(run, path))
    for call in (*readers, *writers):
        with pytest.raises(km.errors.DataError, match=" is not a path; pass "):
            call(bad)


def test_a_function_is_told_how_to_become_a_plant():
    def tank(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return x + 0.1 * u

    with pytest.raises(km.errors.DataError, match=r"km.black_box\(f, dt=…, states=…, inputs=…\)"):
        km.collect(tank, km.Uniform(0, 1), km.Noise(0, 1), episodes=1, steps=2)
    plant = km.black_box(tank, dt=0.1, states=["level [m]"], inputs=["inflow [m³/s]"])
    with pytest.raises(
        km.errors.DataError, match=r"the step map .* has no nx, measure; .* pass a Plant without a wrapper"
    ):
        km.plants.SimulatedPlant(plant)


def test_a_problem_whose_name_is_too_long_for_a_file_is_unknown():
    with pytest.raises(km.errors.ProblemError, match="there is no problem"):
        km.load_problem("x" * 300)


def test_things_of_another_kind_for_rows_solver_instruments_and_smooth_are_named(model):
    data = km.collect(PLANT, km.Uniform([-1, -1], [1, 1]), km.Noise(-8, 8), episodes=2, steps=20)
    for bad in (model, ("u_min", 3), "u_min"):
        with pytest.raises(km.errors.DataError, match="rows is"):
            km.Limits(-1, 1, rows=bad)
    with pytest.raises(km.errors.DataError, match="solver is"):
        km.KoopmanMPC(model, PENDULUM.cost, PENDULUM.limits, 5, solver=km.State())
    with pytest.raises(km.errors.DataError, match="instruments is a complex"):
        km.identify.instrumental_edmd(data, km.State(), 1j)
    with pytest.raises(km.errors.DataError, match="smooth is a list"):
        km.select(data, options=km.SearchOptions(candidates=[km.State()], smooth=[]))


def test_a_switch_that_is_no_bool_is_refused_by_one_name_of_a_bool():
    with pytest.raises(km.errors.DataError, match="feedthrough is an int, expected a bool; pass True or False"):
        km.ExtendedKalman(feedthrough=1)


def test_garbage_for_a_unit_a_prior_and_a_box_is_named(model):
    for given, said in (
        ({"path": 3}, r"3 is not a path; pass the path of an \.fmu file"),
        ({"interface": {}}, "interface is {}; pass"),
        ({"start_values": [1]}, "start_values is a list"),
        ({"integrator": 7}, "the integrator"),
    ):
        with pytest.raises(km.errors.DataError, match=said):
            km.plants.fmu(**{"path": "none.fmu", **given})
    with pytest.raises(km.errors.DataError, match="symmetric is a ndarray"):
        km.identify.Prior(symmetric=np.zeros((0, 2)))
    mpc = km.KoopmanMPC(model, PENDULUM.cost, PENDULUM.limits, 5)
    for bad in (mpc, (0, 1, 2)):
        with pytest.raises(km.errors.DataError, match=r"states is .*; pass \(low, high\)"):
            km.guarantees.bound_iterations(mpc, bad, (0, 0))
