"""`observe_iterations`: the most solver iterations of random cold steps, and how probably a further one takes more."""

from dataclasses import dataclass

import numpy as np

from koopmpc import checks
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.errors import DataError
from koopmpc.guarantees.certify import Corners
from koopmpc.validate.binomial import bound_failure_rate
from koopmpc.values import Value


@dataclass(frozen=True)
class ObservedIterations(Value):
    """The largest number of solver iterations that was seen; no bound that is proved.

    Attributes
    ----------
    most
        Largest number of iterations of a step.
    samples
        Number of independent steps.
    confidence
        Of `exceeded`.
    exceeded
        With this confidence, a further step drawn alike takes more than `most` iterations at most so probably.
    """

    most: int
    samples: int
    confidence: float
    exceeded: float

    def __str__(self) -> str:
        """Return the figure, and what it is."""
        return (
            f"at most {self.most} iterations in {self.samples} random cold steps; with {100 * self.confidence:g} % "
            f"confidence at most {100 * self.exceeded:.2g} % of such steps take more. This is observed, not proved"
        )


def observe_iterations(
    controller: KoopmanMPC,
    states: Corners,
    references: Corners,
    *,
    samples: int = 2000,
    confidence: float = 0.95,
    rng: np.random.Generator | int = 0,
) -> ObservedIterations:
    """Return the most iterations of cold steps from states and references drawn uniformly from boxes.

    Of n independent steps none takes more than the largest of them, so that a further one does so with a probability of
    at most 1 − β^(1/n), with confidence 1 − β. Every step starts without the one before it; steps of a loop start warm.

    Parameters
    ----------
    controller
        Its state and its last input are forgotten.
    states, references
        (low, high) of the measured state and of the reference, numbers or vectors.
    samples
        n.
    confidence
        1 − β, above 0 and below 1.
    rng
        Draws the steps.

    Raises
    ------
    DataError
        A box is upside down, or the confidence is not inside (0, 1).

    References
    ----------
    Clopper & Pearson, Biometrika 26, 1934. A proved bound would need the certification of Arnström & Axehill, 2022.

    Examples
    --------
    >>> import koopmpc as km
    >>> import scipy.signal
    >>> system = scipy.signal.dlti([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], [[1.0, 0.0]], [[0.0]], dt=0.1)
    >>> model = km.LinearPredictor.from_state_space(system)
    >>> mpc = km.KoopmanMPC(model, km.Cost(Q=1, R=0.1), km.Limits(u_min=-1, u_max=1), horizon=10)
    >>> seen = km.guarantees.observe_iterations(mpc, (-1, 1), (-1, 1), samples=59)
    >>> seen.samples, round(seen.exceeded, 2)
    (59, 0.05)
    """
    checks.kind(controller, "controller", KoopmanMPC, "a KoopmanMPC or a LinearMPC")
    count, draw = checks.count(samples, "samples"), checks.generator(rng)
    boxes: list[tuple[np.ndarray, np.ndarray]] = []
    for corners, name, size in (
        (states, "states", controller.predictor.nx),
        (references, "references", controller.cost.of.bind(controller.predictor.states).nz),
    ):
        low, high = checks.vector(corners[0], name, size), checks.vector(corners[1], name, size)
        if (low > high).any():
            raise DataError(f"{name} is {low.tolist()} … {high.tolist()}; pass (low, high) with low ≤ high")
        boxes.append((low, high))
    exceeded = bound_failure_rate(0, count, confidence=confidence)
    most = 0
    for _ in range(count):
        controller.reset()
        x, r = (draw.uniform(low, high) for low, high in boxes)
        most = max(most, controller(x, r).iterations)
    controller.reset()
    return ObservedIterations(most, count, confidence, exceeded)
