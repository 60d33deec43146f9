"""Problem: a plant, how to learn it, how to control it, and the cases in which controllers are compared."""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.checks import nearest
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.data.collect import InputFunction, Uniform
from koopmpc.data.excitation import Excitation
from koopmpc.errors import DataError, KoopmpcError, ProblemError, ShapeError
from koopmpc.lifting.base import Lifting
from koopmpc.loop.faults import Fault
from koopmpc.plants.dynamics import RK4, Dynamics, Euler, Integrator
from koopmpc.plants.plant import Plant
from koopmpc.plants.step_map import StepMap, discretize
from koopmpc.scene import Scene

_REST = 0.01  # share of 1 + |x| that a state may move by in one step from the equilibrium


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

    def __post_init__(self) -> None:
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

    Raises
    ------
    DataError, ShapeError
        x0 or the reference holds NaN, x0 is no vector, or there is no step.
    """

    x0: ArrayLike
    reference: ArrayLike
    steps: int
    limits: Limits | None = None
    plant: Dynamics | StepMap | Plant | None = None
    noise: ArrayLike | None = None
    faults: Sequence[Fault] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "x0", checks.array(self.x0, "Case.x0", (None,)))
        object.__setattr__(self, "reference", checks.array(self.reference, "Case.reference"))
        checks.count(self.steps, "Case.steps")


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
        (x, u) where linear controllers linearise.
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
        An initial state, a reference, the equilibrium, an angle, the cost or the limits do not fit; there is no case,
        or the name of one cannot be that of a file.

    Warns
    -----
    UserWarning
        The plant does not rest at the equilibrium.
    """

    dynamics: Dynamics
    dt: float
    equilibrium: tuple[ArrayLike, ArrayLike]
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
        nx, nu = self.dynamics.nx, self.dynamics.nu
        x, u = self.equilibrium
        point = checks.array(x, "equilibrium x", (nx,)), checks.vector(u, "equilibrium u", nu)
        object.__setattr__(self, "equilibrium", point)
        object.__setattr__(self, "dt", checks.positive(self.dt, "dt", "s"))
        checks.count(self.horizon, "horizon")
        if self.ridge < 0:
            raise DataError(f"ridge is {self.ridge:g}; it must be zero or above")
        if not self.cases:
            raise DataError('a problem needs at least one case: cases={"name": km.Case(x0, reference, steps)}')
        nr = self.cost.of.bind(self.dynamics.states).nz
        self.cost.matrices(nr, nu)
        _fits(self.limits, self.dynamics, "limits")
        for name, case in self.cases.items():
            if not name or any(sign.isspace() or sign in "/\\:" for sign in name):
                raise DataError(
                    f"a case is called {name!r}; its logs are named after it: leave out spaces, /, \\ and :"
                )
            size = np.shape(case.x0)
            if size != (nx,):
                raise ShapeError(f"case {name!r}: x0 has shape {size}, expected ({nx},): {self.dynamics.states}")
            size = np.shape(case.reference) or (1,)
            if size not in ((nr,), (case.steps + 1, nr)):
                raise ShapeError(
                    f"case {name!r}: reference has shape {size}, expected ({nr},) or (steps+1, nr) = "
                    f"({case.steps + 1}, {nr}): the cost tracks {nr} outputs"
                )
            if case.limits is not None:
                _fits(case.limits, self.dynamics, f"case {name!r}: limits")
        wrong = [i for i in self.angles if not 0 <= i < nx]
        if wrong:
            raise DataError(f"angles holds {wrong[0]}; pass indices of states, 0 to {nx - 1}")
        self._check_rest(*point)

    def _check_rest(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> None:
        """Warn where the plant does not rest at the equilibrium: a state moves by 1 % of 1 + |x| in one step."""
        moved = discretize(self.dynamics, self.dt, Euler())(x, u) - x
        if not (np.abs(moved) <= _REST * (1 + np.abs(x))).all():
            i = int(np.argmax(np.abs(moved) / (1 + np.abs(x))))
            warnings.warn(
                f"the equilibrium is none: from it {self.dynamics.states[i]!r} moves by {moved[i]:.3g} in one step of "
                f"{self.dt:g} s; give x and u where the plant rests",
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
        return self.limits if own is None else own


def _fits(limits: Limits, dynamics: Dynamics, what: str) -> None:
    """Raise a ShapeError where limits have other sizes than the inputs, states and observables that they limit."""
    try:
        limits.inputs(dynamics.nu)
        limits.rates(dynamics.nu)
        limits.rows(dynamics.nx, 0 if limits.of is None else limits.of.bind(dynamics.states).nz)
    except KoopmpcError as error:
        raise ShapeError(f"{what}: {error}") from error
