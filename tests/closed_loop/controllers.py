"""The controllers that are judged, each with the library's default settings, and two yardsticks."""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np

import koopmpc as km
from tests.closed_loop.optimum import held
from tests.closed_loop.tasks import Task, UTarget


class NotApplicableError(Exception):
    """This controller cannot be asked for this task: it needs the whole state, and the task measures less."""


class Parts:
    """What the controllers of one task and one training seed share, each built when it is first asked for."""

    def __init__(self, task: Task, seed: int, u_target: UTarget | None = None) -> None:
        self.task, self.seed = task.but(u_target), seed
        self._u_target = u_target

    @cached_property
    def data(self) -> km.Episodes:
        """The training data."""
        return self.task.data(self.seed)

    @cached_property
    def selection(self) -> Any:
        """The models that cross-validation proposes for the task's horizon."""
        return km.select(self.data, horizon=self.task.horizon)

    @cached_property
    def design(self) -> Any:
        """What km.design makes of the training data, the cost and the limits."""
        rows = self.task.rows
        reference = rows if (rows != rows[0]).any() else rows[0]
        return km.design(self.data, self.cost(), self.task.limits, horizon=self.task.horizon, reference=reference)

    @property
    def linear(self) -> km.LinearPredictor:
        """The best linear model."""
        return self.selection.linear

    @cached_property
    def bilinear(self) -> km.BilinearPredictor:
        """The best bilinear model."""
        return self.selection.bilinear

    def cost(self, **more: Any) -> km.Cost:
        """Return the cost as a controller is given it."""
        task, target = self.task, self.task.u_target
        if target == "given":
            rows = held(task.name, "equilibrium")
            target = rows[0] if (rows == rows[0]).all() else rows
        of = km.State() if not task.measured else task.of  # a model of the output alone tracks all it has
        return km.Cost(Q=task.Q, R=task.R, of=of, u_target=target, **more)

    def plain(self, model: km.LinearPredictor) -> km.KoopmanMPC:
        """Return MPC without a terminal weight of its own: Q_N = Q."""
        task = self.task
        Q_N: Any = task.Q
        if task.tracked is not None and task.measured:  # only lifted coordinates can be weighed one by one
            C = np.array([[float(name == own) for own in model.lifting.names] for name in task.tracked])
            Q_N = C.T @ np.diag(task.Q) @ C
        return km.KoopmanMPC(model, self.cost(Q_N=Q_N), task.limits, task.horizon)

    @property
    def equations(self) -> km.StepMap:
        """The model equations, for those who measure what these need."""
        if not self.task.measured:
            raise NotApplicableError
        return self.task.equations


def _edmd(p: Parts) -> Any:
    """Textbook EDMD: state, constant and second-degree monomials, no ridge, Q_N = Q."""
    embedding = None if p.task.measured else km.Delay(2)
    lifting = km.State() + km.Constant() + km.Monomials(2)
    return p.plain(km.edmd(p.data, lifting, embedding=embedding, ridge=0))


def _dmdc(p: Parts) -> Any:
    """Plain DMDc, Q_N = Q."""
    if p.task.weather is not None:
        return p.plain(km.edmd(p.data, km.State()))  # the same fit, which knows W
    if p.task.measured:
        return p.plain(km.dmdc(p.data))
    return p.plain(km.edmd(p.data, km.State(), embedding=km.Delay(2)))


def _designed_linear(p: Parts) -> Any:
    """The best KoopmanMPC of the same design."""
    if p.design.linear is None:
        raise NotApplicableError
    return p.design.linear


def _plan(kind: Any, model: str, **more: Any) -> Callable[[Parts], Any]:
    """Return how a predictive controller with the library's settings is made of the model of that name."""
    return lambda p: kind(getattr(p, model), p.cost(), p.task.limits, p.task.horizon, **more)


def _linear_mpc(p: Parts) -> Any:
    x, u, *w = p.task.around
    return km.LinearMPC(p.equations, x, u, p.cost(), p.task.limits, p.task.horizon, w=w[0] if w else None)


OFFSET_FREE = {"estimator": km.LiftedDisturbance()}
CONTROLLERS: dict[str, Callable[[Parts], Any]] = {
    "edmd": _edmd,
    "dmdc": _dmdc,
    "lqr": lambda p: km.LQR(km.LinearPredictor.local(p.equations, *p.task.around), p.cost(), p.task.limits),
    "linear-mpc": _linear_mpc,
    "nonlinear-mpc": _plan(km.NonlinearMPC, "equations"),
    "bilinear-exact": _plan(km.BilinearMPC, "equations"),
    "koopman-mpc": _plan(km.KoopmanMPC, "linear"),
    "koopman-offset": _plan(km.KoopmanMPC, "linear", **OFFSET_FREE),
    "bilinear-mpc": _plan(km.BilinearMPC, "bilinear"),
    "bilinear-offset": _plan(km.BilinearMPC, "bilinear", **OFFSET_FREE),
}
# a design takes up to a minute of one core, so these are measured where they are named, and are not in the stored table
DESIGNED: dict[str, Callable[[Parts], Any]] = {
    "designed": lambda p: p.design.controller,  # km.design with no other option, one design for all starts of a task
    "designed-linear": _designed_linear,
    "guarded": lambda p: p.design.guarded(),  # the same design, with the plain linear controller outside the data
}
YARDSTICKS = ("edmd", "dmdc")
GIVEN = ("lqr", "linear-mpc", "nonlinear-mpc", "bilinear-exact")  # on equations: one seed is as good as three
