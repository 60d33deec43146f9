"""The seven controllers of the bench: one cost, one set of limits and one horizon for all."""

from collections.abc import Callable, Iterable

from koopmpc.bench.names import nearest
from koopmpc.bench.prepare import Prepared
from koopmpc.control.bilinear_mpc import BilinearMPC
from koopmpc.control.koopman_mpc import KoopmanMPC
from koopmpc.control.limits import Limits
from koopmpc.control.linear_mpc import LinearMPC
from koopmpc.control.lqr import LQR
from koopmpc.control.move import Controller
from koopmpc.control.nonlinear_mpc import NonlinearMPC
from koopmpc.errors import ProblemError
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.predict.linear import LinearPredictor

Build = Callable[[Prepared, Limits], Controller]


def _lqr(parts: Prepared, limits: Limits) -> Controller:
    """Feedback of the model's linearisation at the equilibrium."""
    model = LinearPredictor.local(parts.step_map, *parts.problem.equilibrium)
    return LQR(model, parts.problem.cost, limits)


def _koopman_lqr(parts: Prepared, limits: Limits) -> Controller:
    """Feedback of the lifted state."""
    return LQR(parts.model, parts.problem.cost, limits)


def _linear_mpc(parts: Prepared, limits: Limits) -> Controller:
    """MPC on the model's linearisation at the equilibrium."""
    problem = parts.problem
    return LinearMPC(parts.step_map, *problem.equilibrium, problem.cost, limits, problem.horizon)


def _koopman_mpc(parts: Prepared, limits: Limits) -> Controller:
    """MPC on the lifted predictor, learned from data."""
    return KoopmanMPC(parts.model, parts.problem.cost, limits, parts.problem.horizon)


def _offset_free(parts: Prepared, limits: Limits) -> Controller:
    """MPC on the lifted predictor, with a disturbance of every lifted coordinate."""
    problem = parts.problem
    return KoopmanMPC(parts.model, problem.cost, limits, problem.horizon, estimator=LiftedDisturbance())


def _bilinear_mpc(parts: Prepared, limits: Limits) -> Controller:
    """Real-time iterations on the bilinear predictor, lifted anew at every step of the plan."""
    return BilinearMPC(parts.bilinear, parts.problem.cost, limits, parts.problem.horizon)


def _nonlinear_mpc(parts: Prepared, limits: Limits) -> Controller:
    """MPC on the model itself, the best of twelve starts: the oracle where the model is the truth."""
    return NonlinearMPC(parts.step_map, parts.problem.cost, limits, parts.problem.horizon, starts=12)


CONTROLLERS: dict[str, Build] = {
    "lqr": _lqr,
    "koopman-lqr": _koopman_lqr,
    "linear-mpc": _linear_mpc,
    "koopman-mpc": _koopman_mpc,
    "offset-free": _offset_free,
    "bilinear-mpc": _bilinear_mpc,
    "nonlinear-mpc": _nonlinear_mpc,
}

LEARNED = ("koopman-lqr", "koopman-mpc", "offset-free", "bilinear-mpc")


def chosen(names: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names of controllers, all seven by default.

    Raises
    ------
    ProblemError
        There is no such controller; the message names the nearest.
    """
    names = tuple(names or CONTROLLERS)
    for name in names:
        if name not in CONTROLLERS:
            raise ProblemError(
                f"there is no controller {name!r}{nearest(name, CONTROLLERS)}; there are {', '.join(CONTROLLERS)}"
            )
    return names
