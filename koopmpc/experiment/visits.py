"""What the designed loop visits, and how uncertain the model is there before and after an experiment."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from koopmpc.control.move import Controller
from koopmpc.errors import KoopmpcError
from koopmpc.experiment.ensemble import FINE, Ensemble
from koopmpc.values import Value

FEATURES = 40  # Gaussian functions that stand for what the model's own observables cannot express
_FINEST = 0.3  # visits are spread at least by this share of the spread of all rows
_WIDTH = 0.5  # their width in standard deviations of the visits, times the root of the dimension
_MOST_ROWS = 600  # visits that weigh the value
_DOUBT = 9.0  # a visit counts at most this many times, where bootstrap models disagree more than noise explains


def visit_loop(
    ensemble: Ensemble,
    controller: Controller,
    member: int,
    x0: Float[np.ndarray, " nx"],
    reference: Float[np.ndarray, "rows nr"],
    steps: int,
) -> tuple[Float[np.ndarray, "steps n"], Float[np.ndarray, "steps nu"]]:
    """Return points and inputs of a controller on one member of the ensemble, up to a failure of the controller."""
    one = ensemble.pick(member)
    controller.reset(x0)
    point = one.start(x0, np.zeros(controller.nu))[None, None]
    points, inputs = list[np.ndarray](), list[np.ndarray]()
    last = len(reference) - 1
    for k in range(steps):
        rows = reference[np.minimum(np.arange(k, k + controller.horizon + 1), last)]
        try:
            u = np.asarray(controller(point[0, 0, : ensemble.nx], rows).u, dtype=np.float64)
        except KoopmpcError:
            break
        points.append(point[0, 0])
        inputs.append(u)
        point = one.step(point, u[None, None])
        if (np.abs(point[0, 0, : ensemble.nx]) > 10 * np.maximum(ensemble.scale, np.abs(x0))).any():
            break  # the model of this member is lost
    return np.array(points), np.array(inputs)


@dataclass(frozen=True, eq=False)
class Visits(Value):
    """Rows φ(ζ, u) that the designed loop visits, and the information that data hold about the model there.

    The variance of a one-step prediction, in units of the residuals, is v = φᵀ (G + Λ)⁻¹ φ with G = Σ φφᵀ of the data.
    φ also has Gaussian functions of (x, u) around the visits, with a prior as large as the residuals: they stand for
    misfit that more parameters of the model would not show, so that rows near the visits count.

    Attributes
    ----------
    ensemble
        The models.
    middle, width, centres
        (nx + nu,) mean and standard deviation of the visits, and (m, nx + nu) centres in these units.
    rows
        (K, q) visits.
    weights
        (K,) their weights, of sum 1: larger where bootstrap models disagree.
    information
        (q, q) G + Λ of the data.
    fineness
        Variance that matters over that of the residuals; 1 unless the data are almost free of errors.
    """

    ensemble: Ensemble
    middle: Float[np.ndarray, " n"]
    width: Float[np.ndarray, " n"]
    centres: Float[np.ndarray, "m n"]
    rows: Float[np.ndarray, "K q"]
    weights: Float[np.ndarray, " K"]
    information: Float[np.ndarray, "q q"]
    fineness: float

    def features(self, points: Float[np.ndarray, "M n"], U: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M q"]:
        """Return the rows φ of points and inputs."""
        own = self.ensemble.regressors(points, U) / self.ensemble.size
        return np.hstack([own, _bumps(self, points[:, : self.ensemble.nx], U)])

    def inform(self, points: Float[np.ndarray, "M n"], U: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M q"]:
        """Return the rows φ as they inform: more than once where the residuals are finer than what matters."""
        return np.sqrt(self.fineness) * self.features(points, U)

    def variance(self, information: Float[np.ndarray, "q q"]) -> float:
        """Return the weighted mean of v over the visits, for this information."""
        solved = np.linalg.solve(information, self.rows.T)
        return float(self.weights @ np.einsum("kq,qk->k", self.rows, solved))

    @cached_property
    def before(self) -> float:
        """The variance with the data as they are."""
        return self.variance(self.information)

    def gain(self, rows: Float[np.ndarray, "M q"], information: Float[np.ndarray, "q q"]) -> float:
        """Return by how much these further rows lower the variance: I-optimal, weighted by what the loop visits."""
        return self.variance(information) - self.variance(information + rows.T @ rows)

    def spread_gain(self, rows: Float[np.ndarray, "M q"]) -> float:
        """Return the D-optimal gain of these rows over the data: ½ log det of the information, in nats."""
        return 0.5 * float(
            np.linalg.slogdet(self.information + rows.T @ rows)[1] - np.linalg.slogdet(self.information)[1]
        )


def _bumps(visits: Visits, X: Float[np.ndarray, "M nx"], U: Float[np.ndarray, "M nu"]) -> Float[np.ndarray, "M m"]:
    with np.errstate(over="ignore", invalid="ignore"):
        V = (np.hstack([X, U]) - visits.middle) / visits.width
        reach = _WIDTH * np.sqrt(V.shape[1])
        distance = (V**2).sum(axis=1)[:, None] + (visits.centres**2).sum(axis=1) - 2 * V @ visits.centres.T
        bumps = np.exp(-0.5 * np.maximum(distance, 0.0) / reach**2)
        return bumps / np.sqrt(np.maximum((bumps**2).sum(axis=1, keepdims=True), 1.0))


def weigh_visits(
    ensemble: Ensemble,
    points: Float[np.ndarray, "M n"],
    U: Float[np.ndarray, "M nu"],
    known: Sequence[tuple[Float[np.ndarray, "T n"], Float[np.ndarray, "T nu"]]],
    rng: np.random.Generator,
) -> Visits:
    """Return the visits of these points and inputs, with the information of the `known` episodes of points."""
    if len(points) > _MOST_ROWS:
        chosen = np.linspace(0, len(points) - 1, _MOST_ROWS).astype(np.intp)
        points, U = points[chosen], U[chosen]
    V = np.hstack([points[:, : ensemble.nx], U])
    middle, width = V.mean(axis=0), V.std(axis=0)
    both = np.vstack([V, *(np.hstack([P[:, : ensemble.nx], W]) for P, W in known)])
    width = np.maximum(width, _FINEST * np.maximum(both.std(axis=0), 1e-12))
    centres = (V[rng.integers(len(V), size=FEATURES)] - middle) / width
    n = len(ensemble.size)
    empty = np.zeros((0, n + FEATURES))
    residual = np.sqrt(np.mean(ensemble.residuals**2, axis=0))
    noise = np.maximum(residual, FINE * ensemble.change)
    ratio = np.asarray(noise / np.maximum(residual, 1e-150), dtype=np.float64)
    fineness = min(max(float(np.mean(ratio**2)), 1.0), 1e6)
    blank = Visits(ensemble, middle, width, centres, empty, np.zeros(0), np.eye(n + FEATURES), fineness)
    rows = blank.features(points, U)
    prior = np.diag(np.concatenate([np.full(n, ensemble.prior), np.ones(FEATURES)]))
    information = prior + sum((F.T @ F for F in (blank.inform(P, W) for P, W in known)), np.zeros_like(prior))
    predicted = np.einsum("kp,mpx->mkx", rows[:, :n], ensemble.theta[1:] * ensemble.size[:, None])
    disagreement = np.mean((predicted.std(axis=0) / noise) ** 2, axis=1)
    expected = np.einsum("kq,qk->k", rows, np.linalg.solve(information, rows.T))
    weights = np.clip(disagreement / np.maximum(expected, 1e-12), 1.0, _DOUBT)
    return Visits(ensemble, middle, width, centres, rows, weights / weights.sum(), information, fineness)
