"""Runs to record: random ones of every form that a Run can take."""

from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st

import koopmpc as km

metadata = st.dictionaries(
    st.text(max_size=8),
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats() | st.text(max_size=5)
    | st.lists(st.floats(), max_size=3) | st.dictionaries(st.text(max_size=3), st.floats(), max_size=2),
    max_size=4,
)  # fmt: skip
units = ("[m]", "[rad]", "[m/s]", "[N m]")


# Keywords of `make_run`: NaN, infinities and denormals in the arrays, with or without plans, cost and limits.
options = st.fixed_dictionaries(
    {
        "nx": st.integers(1, 4),
        "nu": st.integers(1, 2),
        "T": st.integers(1, 12),
        "ny": st.sampled_from([None, 1]),
        "N": st.sampled_from([None, 1, 3]),
        "odd": st.floats(0, 1),
        "noisy": st.booleans(),
        "cost": st.booleans(),
        "limits": st.booleans(),
        "held": st.booleans(),
        "metadata": metadata,
        "seed": st.integers(0, 2**32 - 1),
    }
)


def make_run(
    *,
    nx=2,
    nu=1,
    T=20,
    ny=None,
    N=4,
    odd=0.0,
    noisy=True,
    cost=True,
    limits=True,
    held=True,
    metadata=None,
    seed=0,
) -> km.Run:
    rng = np.random.default_rng(seed)
    ny = nx if ny is None else ny

    def numbers(*shape: int) -> np.ndarray:
        values = rng.standard_normal(shape) * 10.0 ** rng.integers(-8, 8)
        special = rng.choice([np.nan, np.inf, -np.inf, -0.0, 5e-324, 1.7e308], shape)
        return np.where(rng.random(shape) < 0.3 * odd, special, values)

    states = tuple(f"state {i} {units[i % 4]}" for i in range(nx))
    X = numbers(T + 1, nx)
    Y = X.copy() if ny == nx else numbers(T + 1, ny)
    if noisy:
        Y[rng.integers(0, T + 1)] += 1.0
    return km.Run(
        X=X,
        Y=Y,
        U=numbers(T, nu),
        reference=numbers(T + 1, nx if cost else 3),
        status=tuple(rng.choice(list(km.Status), T)),
        fallback=tuple(rng.choice(list(km.control.Fallback), T)),
        solve_time=rng.random(T) * 1e-3,
        iterations=rng.integers(0, 4000, T),
        solver=tuple(rng.choice(["", "osqp", "daqp"], T).tolist()),
        cost=km.Cost(Q=rng.random(nx), R=np.eye(nu) / 3) if cost else None,
        limits=km.Limits(u_min=-np.inf, u_max=rng.random(nu), of=km.Fourier(2, [0]), y_max=1.0, slack=None)
        if limits
        else None,
        dt=float(rng.random()) + 1e-3,
        states=states,
        inputs=tuple(f"input {i}" for i in range(nu)),
        outputs=states if ny == nx else tuple(f"output {i}" for i in range(ny)),
        plans=None if N is None else km.loop.Plans(numbers(T, N + 1, nx), numbers(T, N, nu)),
        angles=(nx - 1,),
        metadata={} if metadata is None else metadata,
        slack=np.where(rng.random(T) < 0.5 * held, rng.random(T), 0.0),
        u_reference=np.where(rng.random((T, nu)) < 0.5 * held, numbers(T, nu), 0.0),
    )


def _planned(run: km.Run, k: int) -> Callable[[], km.control.Plan]:
    """Return what answers with the plan of step k, as a controller does."""
    return lambda: km.control.Plan(run.plans.X[k], run.plans.U[k])


def steps_of(run: km.Run) -> list[km.loop.Step]:
    """Return what an observer of `run` sees."""
    return [
        km.loop.Step(
            k=k,
            y=run.Y[k],
            u=run.U[k],
            reference=run.reference[k],
            move=km.Move(
                run.U[k],
                run.status[k],
                run.fallback[k],
                float(run.solve_time[k]),
                int(run.iterations[k]),
                float(run.slack[k]),
                run.solver[k],
            ),
            x=run.X[k],
            look_ahead=None if run.plans is None else _planned(run, k),
            x_next=run.X[k + 1],
            y_next=run.Y[k + 1],
            reference_next=run.reference[k + 1],
            u_reference=run.u_reference[k],
        )
        for k in range(run.steps)
    ]


def about(run: km.Run, **options) -> dict:
    """Return what a Recorder is told about `run` beforehand, with further options."""
    told = {name: getattr(run, name) for name in ("outputs", "angles", "metadata")} | options
    names = ("dt", "states", "inputs", "cost", "limits")
    return {name: getattr(run, name) for name in names} | {"options": km.recording.RecorderOptions(**told)}
