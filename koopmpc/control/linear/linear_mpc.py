"""LinearMPC: what a lifted MPC is compared with, the same class on a local linearisation."""

from typing import Any

from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Limits
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import LinearPredictor


class LinearMPC(KoopmanMPC):
    """Minimise the Cost over N steps of x⁺ ≈ F(x̄, ū) + A (x − x̄) + B (u − ū) within the Limits.

    A and B are the Jacobians of `step_map` at (x̄, ū). It is a KoopmanMPC on `LinearPredictor.local(step_map, x, u)`,
    whose observables are the state and a constant, and it steps, copies and fails like one.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.

    Parameters
    ----------
    step_map
        The plant, x⁺ = F(x, u).
    x, u
        (nx,) and (nu,), the point of the linearisation; it need not be an equilibrium.
    cost, limits
        What to minimise, within what, in the plant's own coordinates.
    horizon
        N steps of the plant's dt.
    **options
        The other keywords of `KoopmanMPC`, with the same meaning: `estimator`, `latency`, `moves`, `solver`,
        `settings`, `time_limit`.

    Raises
    ------
    ObservableError
        The cost or a limit is on an observable other than the states and the constant.
    DefinitenessError
        A weight, or R + BᵀPB, is not positive definite.
    DataError, ShapeError
        `step_map` is no StepMap; a horizon below 1, crossed limits, sizes that do not fit.

    References
    ----------
    Rawlings, Mayne & Diehl, "Model Predictive Control: Theory, Computation, and Design", 2nd ed., 2017, chapter 1.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> mpc = km.LinearMPC(plant, [0, 0], [0], cost, limits, horizon=40)
    >>> mpc([0.1, 0.0], [0.0, 0.0]).status.name
    'UNCONSTRAINED'
    """

    def __init__(
        self,
        step_map: StepMap,
        x: ArrayLike,
        u: ArrayLike,
        cost: Cost,
        limits: Limits | None = None,
        horizon: int = 20,
        **options: Any,
    ) -> None:
        checks.kind(step_map, "step_map", StepMap, "discretize the dynamics, or use KoopmanMPC for a predictor")
        super().__init__(LinearPredictor.local(step_map, x, u), cost, limits, horizon, **options)
