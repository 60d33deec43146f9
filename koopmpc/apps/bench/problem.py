"""Problem: a plant, how to learn it, how to control it, and the cases to compare in."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import nearest
from koopmpc.base.errors import DataError, KoopmpcError, ProblemError, ShapeError
from koopmpc.base.scene import Scene
from koopmpc.control.ask.cost import Cost, check_cost_and_limits
from koopmpc.control.ask.limits import Limits
from koopmpc.data.collect import InputFunction, Uniform
from koopmpc.data.excitation import Excitation, OpenLoop
from koopmpc.lifting.base import Lifting
from koopmpc.loop.faults import Fault
from koopmpc.plants.dynamics import RK4, Dynamics, Euler, Integrator
from koopmpc.plants.plant import Plant
from koopmpc.plants.step_map import StepMap, discretize


@dataclass(frozen=True, eq=False)
class Training:
    """The collection of a problem's data: the arguments of `collect`.

    Attributes
    ----------
    x0
        Initial states: Uniform(low, high), or (episodes, nx).
    excitation
        u_k = excitation(k, y, rng): Noise, PRBS, Multisine, Chirp, Feedback, or a function.
    episodes, steps
        Number of episodes, and number of steps in each.
    seed
        Seed of the random numbers.
    measured
        w of a plant with measured disturbances: an excitation without feedback, (nw,), (steps, nw), or
        (episodes, steps, nw).

    Raises
    ------
    DataError
        There is no episode or no step.
    """

    x0: Uniform | ArrayLike
    excitation: Excitation | InputFunction
    episodes: int
    steps: int
    seed: int = 0
    measured: OpenLoop | ArrayLike | None = None

    def __post_init__(self) -> None:
        if self.measured is not None and not isinstance(self.measured, OpenLoop):
            object.__setattr__(self, "measured", np.atleast_1d(checks.array(self.measured, "Training.measured")))
        checks.count(self.episodes, "Training.episodes")
        checks.count(self.steps, "Training.steps")


@dataclass(frozen=True, eq=False)
class Case:
    """One initial state and one reference, the same for every controller.

    Attributes
    ----------
    x0
        (nx,) initial state.
    reference
        (nr,) held throughout, or (steps+1, nr): row k belongs to x_k.
    steps
        Length of the run.
    limits
        Limits of this case; by default those of the problem.
    plant
        The plant that is driven in this case, for example one with another mass, which no controller knows of. The
        training data still come from the problem's plant.
    noise
        Standard deviations (ny,) of the white noise that controllers measure in this case; the data are without.
    faults
        What is broken in this case, for example ``[km.faults.ActuatorDelay(1)]``, an input that comes a step late.
    measured
        w of a plant with measured disturbances, (nw,) held throughout or (steps, nw): they move the plant, and
        controllers get those of their horizon.

    Raises
    ------
    DataError, ShapeError
        x0, the reference or w holds NaN, x0 is no vector, or there is no step.
    """

    x0: ArrayLike
    reference: ArrayLike
    steps: int
    limits: Limits | None = None
    plant: Dynamics | StepMap | Plant | None = None
    noise: ArrayLike | None = None
    faults: Sequence[Fault] = ()
    measured: ArrayLike | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "x0", checks.array(self.x0, "Case.x0", (None,)))
        object.__setattr__(self, "reference", checks.array(self.reference, "Case.reference"))
        checks.count(self.steps, "Case.steps")
        if self.measured is not None:
            object.__setattr__(self, "measured", np.atleast_1d(checks.array(self.measured, "Case.measured")))


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """ẋ = f(x, u), the data and the lifting that learn it, the cost and limits that judge, and the cases.

    Attributes
    ----------
    dynamics
        The model that is given to controllers.
    dt
        Sampling time [s].
    equilibrium
        (x, u) where linear controllers linearise; (x, u, w) of a plant with measured disturbances.
    training
        Which data the Koopman model learns from.
    lifting, ridge
        z = ψ(x), and the weight of the regularisation of `edmd`.
    cost, limits, horizon
        What every controller gets.
    cases
        Cases by name, at least one.
    integrator
        The method that turns ẋ = f(x, u) into x⁺ = F(x, u).
    angles
        Indices of states whose errors wrap at ±π.
    plant
        The plant that data are collected from and that runs are made on; by default `dynamics`.
    controllers
        Names of the controllers that the bench compares; all by default. Where the cost is on observables that a
        linearisation lacks, such as sin θ, name only controllers that have them.
    scene
        scene(x, u) → shapes, always with the same names; recordings draw them.
    name, title
        The file's stem and the first line of its docstring; `load_problem` fills them in.
    file
        The file that the problem was loaded from, "" where it was made or changed in Python: worker processes load it.

    Raises
    ------
    ShapeError, DataError
        An initial state, a reference, the equilibrium, an angle, the cost, the limits or the measured disturbances do
        not fit; there is no case, or the name of one cannot be that of a file.

    Warns
    -----
    UserWarning
        The plant does not rest at the equilibrium.
    """

    dynamics: Dynamics
    dt: float
    equilibrium: tuple[ArrayLike, ArrayLike] | tuple[ArrayLike, ArrayLike, ArrayLike]
    training: Training
    lifting: Lifting
    cost: Cost
    limits: Limits
    horizon: int
    cases: Mapping[str, Case]
    integrator: Integrator = field(default_factory=RK4)
    ridge: float = 0.0
    angles: Sequence[int] = ()
    plant: Dynamics | StepMap | Plant | None = None
    controllers: Sequence[str] = ()
    scene: Scene | None = None
    name: str = "problem"
    title: str = ""
    file: str = field(default="", init=False)  # `replace` leaves it out, for the file no longer holds that problem

    def __post_init__(self) -> None:
        checks.members(self.dynamics, "dynamics", ("nx", "nu", "states", "inputs"), "pass Dynamics of yours")
        nx, nu, nw = self.dynamics.nx, self.dynamics.nu, self.dynamics.nw
        parts = "(x, u, w)" if nw else "(x, u)"
        checks.kind(self.equilibrium, "equilibrium", (tuple, list), f"pass {parts} of a resting plant")
        if len(self.equilibrium) != (3 if nw else 2):
            raise ShapeError(f"equilibrium has {len(self.equilibrium)} parts; pass {parts} of a resting plant")
        x, u, *w = self.equilibrium
        point = checks.array(x, "equilibrium x", (nx,)), checks.vector(u, "equilibrium u", nu)
        rest = point + tuple(checks.vector(each, "equilibrium w", nw) for each in w)
        object.__setattr__(self, "equilibrium", rest)
        object.__setattr__(self, "dt", checks.positive(self.dt, "dt", "s"))
        checks.count(self.horizon, "horizon")
        if self.ridge < 0:
            raise DataError(f"ridge is {self.ridge:g}; it must be zero or above")
        if not self.cases:
            raise DataError('a problem needs at least one case: cases={"name": km.Case(x0, reference, steps)}')
        names = self.dynamics.states, self.dynamics.inputs
        cost, limits = check_cost_and_limits(self.cost, self.limits, *names)
        object.__setattr__(self, "cost", cost)
        object.__setattr__(self, "limits", limits)
        nr = cost.of.bind(self.dynamics.states).nz
        cost.matrices(nr, nu)
        _fits(self.limits, self.dynamics, "limits")
        for name, case in self.cases.items():
            self._check_case(name, case, nr)
        _check_plant(self.plant, nw, "the problem")
        _check_measured(
            self.training.measured, self.dynamics, (self.training.episodes, self.training.steps), "training"
        )
        wrong = [i for i in self.angles if not 0 <= i < nx]
        if wrong:
            raise DataError(f"angles holds {wrong[0]}; pass indices of states, 0 to {nx - 1}")
        self._check_rest(*rest)

    def _check_case(self, name: str, case: Case, nr: int) -> None:
        nx, what = self.dynamics.nx, f"case {name!r}"
        if not name or any(sign.isspace() or sign in "/\\:" for sign in name):
            raise DataError(f"a case is called {name!r}; its logs are named after it: leave out spaces, /, \\ and :")
        size = np.shape(case.x0)
        if size != (nx,):
            raise ShapeError(f"{what}: x0 has shape {size}, expected ({nx},): {self.dynamics.states}")
        size = np.shape(case.reference) or (1,)
        if size not in ((nr,), (case.steps + 1, nr)):
            raise ShapeError(
                f"{what}: reference has shape {size}, expected ({nr},) or (steps+1, nr) = ({case.steps + 1}, {nr}): "
                f"the cost tracks {nr} outputs"
            )
        if case.limits is not None:
            _fits(case.limits, self.dynamics, f"{what}: limits")
        _check_measured(case.measured, self.dynamics, (case.steps,), what)
        _check_plant(case.plant, self.dynamics.nw, what)

    def _check_rest(
        self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"], w: Float[np.ndarray, " nw"] | None = None
    ) -> None:
        """Warn where the plant does not rest at the equilibrium: a state moves by 1 % of 1 + |x| in one step."""
        moved = discretize(self.dynamics, self.dt, Euler())(x, u, w) - x
        if not (np.abs(moved) <= 0.01 * (1 + np.abs(x))).all():
            i = int(np.argmax(np.abs(moved) / (1 + np.abs(x))))
            warnings.warn(
                f"the equilibrium does not rest: from it {self.dynamics.states[i]!r} moves by {moved[i]:.3g} in one "
                f"step of {self.dt:g} s; give x and u where the plant rests",
                UserWarning,
                stacklevel=4,
            )

    def select(self, case: str) -> "Problem":
        """Return the problem with this case alone.

        Raises
        ------
        ProblemError
            There is no such case; the message names the nearest.
        """
        if case not in self.cases:
            raise ProblemError(
                f"problem {self.name!r} has no case {case!r}{nearest(case, self.cases)}; "
                f"its cases are {', '.join(self.cases)}"
            )
        return replace(self, cases={case: self.cases[case]}).of_file(self.file)

    def of_file(self, file: str) -> "Problem":
        """Return this problem, with the file that holds it."""
        object.__setattr__(self, "file", file)
        return self

    def limits_of(self, case: str) -> Limits:
        """Return the limits that hold in this case."""
        own = self.cases[case].limits
        return self.limits if own is None else own.resolve(self.dynamics.states, self.dynamics.inputs)

    def measured_of(self, case: str) -> Float[np.ndarray, "T nw"] | None:
        """Return the measured disturbances of a case, a row a step; None where the plant has none."""
        own = self.cases[case]
        return None if own.measured is None else np.broadcast_to(own.measured, (own.steps, self.dynamics.nw))


def _fits(limits: Limits, dynamics: Dynamics, what: str) -> None:
    """Raise a ShapeError where limits have other sizes than the inputs, states and observables that they limit."""
    try:
        limits = limits.resolve(dynamics.states, dynamics.inputs)
        limits.inputs(dynamics.nu)
        limits.rates(dynamics.nu)
        limits.find_rows(dynamics.nx, 0 if limits.of is None else limits.of.bind(dynamics.states).nz)
    except KoopmpcError as error:
        raise ShapeError(f"{what}: {error}") from error


def _check_measured(
    measured: OpenLoop | ArrayLike | None, dynamics: Dynamics, rows: tuple[int, ...], what: str
) -> None:
    """Raise where measured disturbances are missing, are not those of the plant, or have another shape."""
    nw, names = dynamics.nw, ", ".join(dynamics.disturbances)
    if measured is None:
        if nw:
            raise DataError(f"{what}: the plant has measured disturbances ({names}); pass measured=, a row a step")
        return
    if not nw:
        raise DataError(f"{what}: measured is given, but the dynamics name no disturbances; name them, or leave it out")
    shapes = [(*rows[i:], nw) for i in range(len(rows), -1, -1)]
    if not isinstance(measured, OpenLoop) and np.shape(measured) not in shapes:
        expected = " or ".join(map(str, shapes))
        raise ShapeError(
            f"{what}: measured has shape {np.shape(measured)}, expected {expected}: a row a step, a column for {names}"
        )


def _check_plant(plant: Dynamics | StepMap | Plant | None, nw: int, what: str) -> None:
    """Raise where equations or a step map in place of the dynamics have another number of measured disturbances."""
    if isinstance(plant, (Dynamics, StepMap)) and plant.nw != nw:
        raise ShapeError(
            f"{what}: its plant has {plant.nw} measured disturbances, the dynamics {nw}; give both as many"
        )
