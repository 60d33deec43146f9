"""Mistakes at data say what was got and what to do."""

from typing import Any

import numpy as np
import pytest

import koopmpc as km
from tests.data.test_collect import BOX, PENDULUM, unstable
from tests.data.test_disturbances import A, B, E
from tests.data.test_disturbances import data as disturbed

DATA, SHAPE = km.errors.DataError, km.errors.ShapeError
X, U = np.zeros((4, 2)), np.zeros((3, 1))
PUSHED, FREE = km.Episode(X=X, U=U, W=np.zeros((3, 1))), km.Episode(X=X, U=U)
NAMED = km.Episodes([PUSHED], 0.1, ("a", "b"), ("u",), ("gust",))
MODEL = km.edmd(disturbed(), km.State())


def generator(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def zeros(rows: int, moves: int, nx: int = 2, nu: int = 1) -> km.Episode:
    return km.Episode(X=np.zeros((rows, nx)), U=np.zeros((moves, nu)))


MISTAKES = [
    (
        DATA,
        "episode 1 is NaN or infinite from step 6 on: the plant diverged; start nearer, excite less",
        lambda: km.collect(unstable(), [[0.1], [3.0]], km.Noise(-0.1, 0.1), episodes=2, steps=20),
    ),
    (
        DATA,
        "episode 1 is NaN or infinite from step 6 on",
        lambda: km.collect(unstable(), [[0.1], [3.0]], km.Feedback([[0.0]]), episodes=2, steps=20),
    ),
    (
        DATA,
        "episode 1 is NaN or infinite from step 6 on",
        lambda: km.collect(
            km.plants.SimulatedPlant(unstable()), [[0.1], [3.0]], km.Feedback([[0.0]]), episodes=2, steps=20
        ),
    ),
    (
        SHAPE,
        r"the excitation gives 2 inputs, the plant takes 1 \(torque \[N m\]\); pass one level for each input",
        lambda: km.collect(PENDULUM, BOX, km.Noise([-1, -1], [1, 1]), episodes=1, steps=2),
    ),
    (
        SHAPE,
        r"the excitation's u has shape \(2,\), expected \(1,\) or a scalar",
        lambda: km.collect(PENDULUM, BOX, lambda k, y, rng: [1, 2], episodes=1, steps=2),
    ),
    (
        SHAPE,
        r"x0 gives shape \(2, 2\), expected \(3, 2\): an episode a row, a state a column; pass Uniform",
        lambda: km.collect(PENDULUM, [[0, 0], [1, 1]], km.Noise(-1, 1), episodes=3, steps=2),
    ),
    (
        SHAPE,
        r"x0 gives shape \(3, 1\), expected \(3, 2\)",
        lambda: km.collect(PENDULUM, km.Uniform([0], [1]), km.Noise(-1, 1), episodes=3, steps=2),
    ),
    (DATA, "x0 holds 1 NaN", lambda: km.collect(PENDULUM, [0, np.nan], km.Noise(-1, 1), episodes=3, steps=2)),
    (DATA, "episodes is 0; it must be", lambda: km.collect(PENDULUM, BOX, km.Noise(-1, 1), episodes=0, steps=2)),
    (DATA, "steps is 0; it must be", lambda: km.collect(PENDULUM, BOX, km.Noise(-1, 1), episodes=1, steps=0)),
    (DATA, "initial state limits cross at index 1: lower 1 is above upper 0", lambda: km.Uniform([0, 1], [1, 0])),
    (SHAPE, r"high has shape \(3,\), expected \(2,\) or a scalar", lambda: km.Uniform([0, 1], [1, 2, 3])),
    (SHAPE, "U has 5 rows and X 5: X must have one row more than U; x_0 … x_T, u_0 … u_{T-1}", lambda: zeros(5, 5)),
    (SHAPE, "U has 5 rows and X 3: X must have one row more", lambda: zeros(3, 5)),
    (SHAPE, "X has no row; an episode holds x_0 at least", lambda: km.Episode(X=np.zeros((0, 2)))),
    (SHAPE, r"X has shape \(2,\), expected \(any, any\)", lambda: km.Episode(X=[1.0, 2.0])),
    (DATA, r"X holds 1 NaN or inf, the first at \(1, 0\); remove", lambda: km.Episode(X=[[1.0], [np.nan]])),
    (DATA, "U holds 1 NaN or inf", lambda: km.Episode(X=[[1.0], [2.0]], U=[[np.inf]])),
    (DATA, "there is no episode; pass at least one", lambda: km.Episodes([], 0.1)),
    (
        DATA,
        "episode 1 is too short: X has 1 row and so no step; an episode needs at least 2 rows, drop it",
        lambda: km.Episodes([zeros(4, 3), zeros(1, 0)], 0.1),
    ),
    (
        SHAPE,
        "episode 1 has 3 states and 1 inputs, episode 0 has 2 and 1; episodes of one set come from one plant",
        lambda: km.Episodes([zeros(4, 3), zeros(4, 3, nx=3)], 0.1),
    ),
    (DATA, "dt is -0.1 s; it must be above zero", lambda: km.Episodes([zeros(4, 3)], -0.1)),
    (
        SHAPE,
        "states has 1 names, expected 2; give one name each",
        lambda: km.Episodes([zeros(4, 3)], 0.1, states=["a"]),
    ),
    (DATA, "inputs is 'u'; pass a tuple of names", lambda: km.Episodes([zeros(4, 3)], 0.1, inputs="u")),
    (
        DATA,
        "two states or inputs are named 'a'; rename one",
        lambda: km.Episodes([zeros(4, 3)], 0.1, states=["a", "b"], inputs=["a"]),
    ),
    (
        DATA,
        "the second set has dt = 0.2 s, the first set has 0.1 s; resample one of them",
        lambda: km.Episodes([zeros(4, 3)], 0.1) + km.Episodes([zeros(4, 3)], 0.2),
    ),
    (
        DATA,
        "the second set names the states 'a', 'b', the first set 'x0', 'x1'; rename them, or leave it out",
        lambda: km.Episodes([zeros(4, 3)], 0.1) + km.Episodes([zeros(4, 3)], 0.1, states=["a", "b"]),
    ),
    (DATA, "excitation limits cross at index 0: lower 1 is above upper -1; swap", lambda: km.Noise(1, -1)),
    (SHAPE, r"low has shape \(2,\), expected \(3,\) or a scalar", lambda: km.Noise([-1, -1], [1, 1, 1])),
    (SHAPE, r"low has shape \(1, 1\), expected \(any,\)", lambda: km.Noise([[1]], 2)),
    (DATA, "low holds 1 NaN or inf", lambda: km.Noise(np.nan, 2)),
    (DATA, "hold is 0; it must be at least 1", lambda: km.Noise(-1, 1, hold=0)),
    (DATA, "order is 2; choose 3 … 16", lambda: km.data.PRBS(-1, 1, order=2)),
    (DATA, "period is 0 s; it must be above zero", lambda: km.data.Multisine(1, 0.0, 3)),
    (
        DATA,
        "period is 0.12 s, no multiple of dt 0.05 s; choose 0.1",
        lambda: km.data.Multisine(1, 0.12, 1).sequence(9, 0.05, generator(0)),
    ),
    (
        DATA,
        "harmonic 5 of 10 samples a period is not below the Nyquist frequency; lengthen the period or drop it",
        lambda: km.data.Multisine(1, 0.5, 5).sequence(9, 0.05, generator(0)),
    ),
    (
        DATA,
        "a chirp up to 10 Hz needs dt below 0.05 s, dt is 0.05 s; lower the frequency",
        lambda: km.data.Chirp(1, 1, 10, 5).sequence(9, 0.05, generator(0)),
    ),
    (SHAPE, r"K has shape \(2,\), expected \(any, any\)", lambda: km.Feedback([1, 2])),
    (
        SHAPE,
        "noise has 2 inputs and K 1 rows; pass one level for each input",
        lambda: km.Feedback([[1, 2]], km.Noise([-1, -1], [1, 1])),
    ),
    (DATA, "u limits cross at index 0", lambda: km.Feedback([[1, 2]], u_min=1, u_max=0)),
    (
        SHAPE,
        r"K has 2 columns, the plant measures 3; pass K of shape \(1, 3\)",
        lambda: km.Feedback([[1, 2]]).start(3, 0.1, generator(0))(0, np.zeros(3)),
    ),
    (SHAPE, r"W has 2 rows and U 3; both have one a step", lambda: km.Episode(X=X, U=U, W=[[0], [0]])),
    (
        SHAPE,
        r"episode 1 has 0 measured disturbances, episode 0 has 1; measure the same ones throughout",
        lambda: km.Episodes([PUSHED, FREE], 0.1),
    ),
    (
        SHAPE,
        r"disturbances has 2 names, expected 1; give one name each",
        lambda: km.Episodes([PUSHED], 0.1, disturbances=("p", "q")),
    ),
    (DATA, r"which dmdc does not fit; use edmd on State\(\)", lambda: km.dmdc(disturbed())),
    (
        SHAPE,
        r"the episodes have disturbances \(gust\), the predictor has \(load \[N\], wind \[m/s\]\)",
        lambda: km.score(MODEL, NAMED, 2),
    ),
    (
        DATA,
        r"the second set names the disturbances 'w0', the first set 'gust'; rename them",
        lambda: NAMED + km.Episodes([PUSHED], 0.1, ("a", "b"), ("u",)),
    ),
    (SHAPE, r"W has shape \(3, 1\), expected \(3, 2\)", lambda: MODEL.rollout([0, 0], U, [[0]] * 3)),
    (
        SHAPE,
        r"disturbances has 1 names and E 2 columns; give one name each",
        lambda: km.LinearPredictor(A, B, np.eye(2), km.State(), 0.1, ("a", "b"), ("u",), E=E, disturbances=("p",)),
    ),
]


@pytest.mark.parametrize(("error", "text", "mistake"), MISTAKES, ids=[text for _, text, _ in MISTAKES])
def test_a_mistake_says_what_was_got_and_what_to_do(error: Any, text: str, mistake: Any) -> None:
    with pytest.raises(error, match=text):
        mistake()
