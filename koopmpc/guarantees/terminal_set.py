"""`find_terminal_set`: where the plans of a linear predictor may end so that the tail's feedback keeps the limits."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from scipy.linalg import block_diag

from koopmpc.base import checks
from koopmpc.base.errors import CertificateError, DataError
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.ask.terminal import TerminalFeedback, TerminalSet
from koopmpc.control.plan.tracking import LiftedTracking, lifted_tracking
from koopmpc.control.riccati import Stage, find_gain, one_step, stationary
from koopmpc.control.target import targets_of
from koopmpc.guarantees.invariant_set import find_invariant_set
from koopmpc.models.predictors import LinearPredictor

MOST_COORDINATES = 12  # beyond that a polytope has too many rows to find in a minute
_ITERATIONS = 10_000  # of the Riccati equation


class TailLoop(NamedTuple):
    """ξ⁺ = (A − B K) ξ around the set point, ξ = z or [z; u_{k−1}] without the Constant, and its limits H ξ ≤ h.

    V = ξᵀP ξ falls in every step: it is the cost-to-go, and what the last input cost where only its limits count.
    """

    transition: Float[np.ndarray, "n n"]
    K: Float[np.ndarray, "nu n"]
    P: Float[np.ndarray, "n n"]
    H: Float[np.ndarray, "p n"]
    h: Float[np.ndarray, " p"]
    center: Float[np.ndarray, " n"]
    kept: Int[np.ndarray, " nk"]
    with_input: bool
    u: Float[np.ndarray, " nu"]


def find_terminal_set(
    predictor: LinearPredictor,
    cost: Cost,
    limits: Limits,
    reference: ArrayLike,
    *,
    kind: Literal["polytope", "ellipsoid"] = "polytope",
    error: ArrayLike | None = None,
    most_steps: int = 200,
) -> TerminalSet:
    """Return a set in which the feedback of the infinite tail keeps the limits for ever, around a reference.

    The feedback u = u_r − K (ξ − ξ_r) is the solution of the stationary Riccati equation of the cost. The set is of
    ξ = z without its Constant, with the last input behind it where rates have limits or R_delta acts. As the terminal
    set of a `KoopmanMPC` with the same cost and limits it makes a plan that is feasible once feasible for ever, if the
    plant is the model: z⁺ = A z + B u.

    Parameters
    ----------
    predictor
        The linear model.
    cost, limits
        Those of the controller; margins of the limits are part of the set.
    reference
        (nr,) a steady reference strictly inside the limits.
    kind
        "polytope": the largest such set, up to 12 coordinates. "ellipsoid": the largest level set of the cost-to-go
        inside the limits, of any size.
    error
        (nz,) or a number: the largest error of each lifted coordinate in a step, by which the polytope is tightened.
    most_steps
        As in `find_invariant_set`.

    Returns
    -------
    TerminalSet
        For ``Limits(terminal=…)``.

    Raises
    ------
    DataError
        The limits exclude the set point; the feedback does not stabilise the model.
    CertificateError
        More than 12 coordinates, or a polytope that does not end.

    References
    ----------
    Gilbert & Tan, IEEE Trans. Automat. Contr. 36, 1991; Rawlings, Mayne & Diehl, "Model Predictive Control", 2017,
    chapter 2.

    Examples
    --------
    >>> import koopmpc as km
    >>> import scipy.signal
    >>> system = scipy.signal.dlti([[1.0, 0.1], [0.0, 1.0]], [[0.0], [0.1]], [[1.0, 0.0]], [[0.0]], dt=0.1)
    >>> model = km.LinearPredictor.from_state_space(system)
    >>> cost, limits = km.Cost(Q=[1, 0], R=0.1), km.Limits(u_min=-1, u_max=1, x_min=-1, x_max=1)
    >>> found = km.guarantees.find_terminal_set(model, cost, limits, [0.0, 0.0])
    >>> safe = km.Limits(u_min=-1, u_max=1, x_min=-1, x_max=1, terminal=found, terminal_slack=None)
    >>> km.KoopmanMPC(model, cost, safe, horizon=10)([0.5, 0.0], [0.0, 0.0]).status.name
    'OPTIMAL'
    """
    checks.kind(predictor, "predictor", LinearPredictor, "a bilinear model has a certificate: use km.certify")
    if not checks.among(kind, ("polytope", "ellipsoid")):
        raise DataError(f"kind is {kind!r}; pass 'polytope' or 'ellipsoid'")
    loop = build_tail_loop(predictor, cost, limits, reference)
    kept = tuple(int(i) for i in loop.kept)
    of = predictor.lifting if predictor.embedding is None and predictor.lifting.nz == predictor.nz else None
    law = TerminalFeedback(loop.u, -loop.K)
    if kind == "ellipsoid":
        if error is not None:
            raise DataError("an ellipsoid is not tightened by errors; take kind='polytope', or leave error out")
        if np.linalg.eigvalsh(loop.P)[0] <= 0:
            raise DataError(
                "the cost-to-go does not grow in every direction, so its level sets do not end; weigh every state, and"
                " every input whose rate is limited"
            )
        # max H_i ξ over ξᵀP ξ ≤ α is √(α H_i P⁻¹ H_iᵀ)
        reach = np.einsum("ij,ij->i", loop.H, np.linalg.solve(loop.P, loop.H.T).T)
        level = float((loop.h**2 / np.maximum(reach, 1e-300)).min())
        return TerminalSet(loop.center, of=of, W=loop.P / level, with_input=loop.with_input, kept=kept, feedback=law)
    n = len(loop.center)
    if n > MOST_COORDINATES:
        raise CertificateError(
            f"the set has {n} coordinates, and a polytope is found for up to {MOST_COORDINATES}; take kind='ellipsoid',"
            " or a model of fewer observables"
        )
    grown = None
    if error is not None:
        sizes = checks.vector(error, "error", predictor.nz)[loop.kept]
        grown = np.concatenate([sizes, np.zeros(n - len(sizes))])
    found = find_invariant_set(loop.transition, loop.H, loop.h, error=grown, most_steps=most_steps)
    return TerminalSet(loop.center, of=of, H=found.H, h=found.h, with_input=loop.with_input, kept=kept, feedback=law)


def build_tail_loop(predictor: LinearPredictor, cost: Cost, limits: Limits, reference: ArrayLike) -> TailLoop:
    """Return the loop of the stationary feedback around a reference, and all limits on it."""
    track = lifted_tracking(predictor, cost, limits)
    targets = targets_of(predictor, track)
    row = checks.vector(reference, "reference", len(track.tracked))[None]
    alpha = targets.coordinates(row)[0]
    z_r, u_r = targets.z0 + targets.Z @ alpha, targets.u0 + targets.W @ alpha
    missed = float(np.abs(predictor.A @ z_r + predictor.B @ u_r - z_r).max())
    if missed > 1e-7 * (1 + float(np.abs(z_r).max())):
        raise DataError(
            "the reference has no equilibrium with the inputs that the cost asks for; use u_target='equilibrium', or a"
            " steady reference"
        )
    constant = predictor.lifting.constant_index
    kept = np.array([i for i in range(predictor.nz) if i != constant], dtype=np.intp)
    A, B = predictor.A[np.ix_(kept, kept)], predictor.B[kept]
    C = track.tracked[:, kept]
    stage: Stage = one_step(A, B, C.T @ track.Q @ C, track.R, track.R_delta)
    P = stationary(stage, _ITERATIONS).P
    K, _ = find_gain(stage, P)
    transition = stage.A - stage.B @ K
    nk, nu = B.shape
    if track.rates is not None and track.R_delta is None:  # the last input counts for its limits alone
        K = np.hstack([K, np.zeros((nu, nu))])
        transition = np.block([[A - B @ K[:, :nk], np.zeros((nk, nu))], [-K]])
        P = block_diag(P, track.R)  # V⁺ + uᵀR u = V − xᵀQ x
    radius = float(np.abs(np.linalg.eigvals(transition)).max())
    if radius >= 1 - 1e-9:
        raise DataError(
            f"the tail's feedback leaves modes of spectral radius {radius:.6g}, so no plan can end in a set around a"
            " rest; weigh every state, or take a model without modes that no input moves"
        )
    H, h = _list_limits(track, K, kept, z_r, u_r, len(transition))
    center = np.concatenate([z_r[kept], u_r]) if len(transition) > nk else z_r[kept]
    return TailLoop(transition, K, P, H, h, center, kept, len(transition) > nk, u_r)


def _list_limits(
    track: LiftedTracking,
    K: Float[np.ndarray, "nu n"],
    kept: Int[np.ndarray, " nk"],
    z_r: Float[np.ndarray, " nz"],
    u_r: Float[np.ndarray, " nu"],
    n: int,
) -> tuple[Float[np.ndarray, "p n"], Float[np.ndarray, " p"]]:
    """Return H, h of the outputs, of the inputs u_r − K ξ, and of their changes, around the set point."""
    nu, nk = len(u_r), len(kept)
    G = np.hstack([track.limited[:, kept], np.zeros((len(track.limited), n - nk))])
    value = track.limited @ z_r
    margin = track.margin.max(axis=0) if len(track.margin) else np.zeros(len(value))
    rows: list[np.ndarray] = [G, -G, -K, K]
    room: list[np.ndarray] = [
        track.outputs.high - margin - value,
        value - track.outputs.low - margin,
        track.inputs.high - u_r,
        u_r - track.inputs.low,
    ]
    if track.rates is not None:
        change = -K - np.hstack([np.zeros((nu, nk)), np.eye(nu)])
        rows += [change, -change]
        room += [track.rates.high, -track.rates.low]
    H, h = np.vstack(rows), np.concatenate(room)
    limited = np.isfinite(h)
    H, h = H[limited], h[limited]
    if not len(h):
        raise DataError("there are no limits, so every plan may end anywhere; leave the terminal set out")
    # share of a limit that a set point has to be inside it
    if (h <= 1e-9 * (1 + np.abs(h).max())).any():
        raise DataError("the set point of this reference is not strictly inside the limits; move it, or widen them")
    return H, h
