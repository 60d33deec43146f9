"""PlanMap: the unconstrained plan and its limited outputs as one matrix, and the QP where that plan meets a limit."""

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.limits import Interval, Limits, Softness
from koopmpc.control.linear.condense import Condensed, Coordinates, condense
from koopmpc.control.linear.horizon import Horizon, end, stages
from koopmpc.control.linear.qp import Group, Program, Units, program, units
from koopmpc.control.riccati import one_step, recursion, stationary
from koopmpc.control.target import margin, targets_of
from koopmpc.control.tracking import LiftedTracking, lifted_tracking
from koopmpc.errors import ShapeError
from koopmpc.lifting.buffered import HUGE
from koopmpc.lifting.state import State
from koopmpc.predict.predictors import LinearPredictor


class PlanMap:
    """t = M [z; u_{−1}; g; 1] with low ≤ t ≤ high where the unconstrained plan is the optimum.

    t = [v; lowest and highest target], v the plan as in `Condensed`. u_{−1} is there where the change of inputs is
    weighed or limited, g = [w_0 … w_{N−1}; d] where disturbances are known. With a g the last column holds the part
    of a reference whose targets no limit moves, and the last rows of t show where one does: `correction` is then
    added. Without a g the last column holds all. The first `moves` entries of t are the inputs, `box` is their
    limits, and `deviation` tells how a solution of the QP moves them.

    Parameters
    ----------
    predictor, cost, limits
        As for KoopmanMPC.
    blocks
        Lengths of the blocks of held inputs.
    disturbed
        Whether g holds a d.
    coordinates
        Those of the QP.
    """

    def __init__(
        self,
        predictor: LinearPredictor,
        cost: Cost,
        limits: Limits,
        blocks: tuple[int, ...],
        *,
        disturbed: bool,
        coordinates: Coordinates,
    ) -> None:
        self.track = track = lifted_tracking(predictor, cost, limits)
        self.horizon = horizon = _horizon(predictor, cost, track, blocks, disturbed=disturbed)
        self.targets = found = targets_of(predictor, cost, track)
        law = recursion(stages(horizon, found), horizon.P_N, end(horizon, found))
        self.maps = condense(horizon, law, found, coordinates)
        self.moves = len(blocks) * predictor.nu
        measured = units(self.maps.hessian, self.maps.deviation[: self.moves], track.inputs, len(horizon.blocks))
        self.deviation = self.maps.deviation[: self.moves] * measured.columns
        self.hard = _program(self.maps, track, horizon, measured, soft_rows=False)
        softens = bool(np.isfinite(self.hard.most).any())
        self.soft = _program(self.maps, track, horizon, measured, soft_rows=True) if softens else None

        low, high = _bounds(track, horizon)
        nv = len(low)
        last, first = horizon.disturbance(horizon.N - 1), np.zeros((nv, 0))
        self._disturbance = np.zeros((predictor.nz, 0)) if last is None else last[:, :-1]
        ng = self._disturbance.shape[1]
        checked = np.zeros(len(found.low), dtype=np.bool_)
        if ng:
            checked = np.isfinite(found.low) | np.isfinite(found.high)
            from_disturbance = found.from_disturbance @ self._disturbance
            every = self.maps.from_target.reshape(nv, horizon.N + 1, -1).sum(axis=1)
            first = self.maps.from_drive + every @ from_disturbance
            moved = (found.rows @ from_disturbance + found.rows_disturbance @ self._disturbance)[checked]
            first = np.vstack([first, moved, moved])
            free = np.full(len(moved), np.inf)
            t_low, t_high = found.low[checked], found.high[checked]
            low = np.concatenate([low, t_low - margin(t_low), -free])
            high = np.concatenate([high, free, t_high + margin(t_high)])
        self._checked = checked
        self.planned = nv
        self.low, self.high = np.maximum(low, -HUGE), np.minimum(high, HUGE)  # inf meets no limit
        self.box = Interval(self.low[: self.moves], self.high[: self.moves])
        from_state = np.zeros((len(low), horizon.size))
        from_state[:nv] = self.maps.from_state
        self.matrix = np.ascontiguousarray(np.column_stack([from_state, first, np.zeros(len(low))]))

    def aim(self, R: Float[np.ndarray, "N1 nr"]) -> None:
        """Write the part of the reference rows into the last column; NaN where a row is."""
        column, maps, found = self.matrix[:, -1], self.maps, self.targets
        if not np.isfinite(R).all():
            column[:] = np.nan
            return
        driven = self._disturbance.shape[1] > 0
        alpha = found.nearest(R) if driven else found.coordinates(R)
        v = maps.from_reference @ R.ravel() + maps.from_target @ alpha.ravel() + maps.offset
        column[: self.planned] = v
        if driven:
            values = (alpha @ found.rows.T)[:, self._checked]
            column[self.planned :] = np.concatenate([values.min(axis=0), values.max(axis=0)])

    def correction(self, R: Float[np.ndarray, "N1 nr"], g: Float[np.ndarray, " ng"]) -> Float[np.ndarray, " nv"]:
        """Return what v gains from targets that a limit moves."""
        e, found = self._disturbance @ g, self.targets
        moved = found.coordinates(R, e) - found.nearest(R, e)
        return self.maps.from_target @ moved.ravel()


def _horizon(
    predictor: LinearPredictor,
    cost: Cost,
    track: LiftedTracking,
    blocks: tuple[int, ...],
    *,
    disturbed: bool,
) -> Horizon:
    """Return the horizon with the terminal weight that the cost asks for."""
    A, B, C, nz, nx = predictor.A, predictor.B, track.tracked, predictor.nz, predictor.nx
    with_rates = track.with_rates
    size = nz + predictor.nu * with_rates
    bounded = track.rates is not None
    CQ_N = None
    if cost.Q_N is None:
        step = one_step(A, B, C.T @ track.Q @ C, track.R, track.R_delta)
        found = stationary(step.A, step.B, step.Q, step.R, 10 * sum(blocks), step.M).P
    else:
        given = np.asarray(cost.Q_N)
        own = len(given) if given.ndim else nx
        on_state = own == nx and isinstance(cost.of, State) and cost.of.whole
        if own == nx != nz and not on_state:
            raise ShapeError(
                f"Q_N ({nx}, {nx}) weighs x_N − r_N, but the reference is not of the state; pass ({nz}, {nz})"
            )
        if own not in (nx, nz):
            raise ShapeError(f"Q_N has shape {given.shape}, expected ({nx}, {nx}) on the state or ({nz}, {nz}) on z")
        found = checks.weight(given, "Q_N", own)
        if on_state:
            CQ_N = C.T @ found
            found = CQ_N @ C
    P_N = np.zeros((size, size))
    P_N[: len(found), : len(found)] = found
    return Horizon(
        A=A,
        B=B,
        E=predictor.E,
        C=C,
        G=track.limited,
        Q=track.Q,
        R=track.R,
        R_delta=track.R_delta,
        P_N=P_N,
        CQ_N=CQ_N,
        blocks=blocks,
        with_rates=with_rates,
        bounded=bounded,
        disturbed=disturbed,
    )


def _bounds(track: LiftedTracking, horizon: Horizon) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
    """Return the limits of v."""
    moves = len(horizon.blocks)
    ends: list[Float[np.ndarray, " nv"]] = []
    for i in (0, 1):
        parts = [track.inputs[i]] if track.rates is None else [track.inputs[i], track.rates[i]]
        outputs = np.tile(track.outputs[i], horizon.N)
        ends.append(np.concatenate([*(np.tile(part, moves) for part in parts), outputs]))
    return ends[0], ends[1]


def _program(maps: Condensed, track: LiftedTracking, horizon: Horizon, measured: Units, *, soft_rows: bool) -> Program:
    """Return the QP, whose next stages are a step on: of outputs the next, of moves the one that then holds."""
    moves, N, nu = len(horizon.blocks), horizon.N, horizon.B.shape[1]
    starts = np.cumsum([0, *horizon.blocks[:-1]])
    of_step = np.append(np.repeat(np.arange(moves), horizon.blocks), moves)
    held = of_step[starts + 1]
    hard = Softness(np.full(nu, np.inf), np.zeros(nu))
    rates = None if track.rates is None else Group(track.rates, track.rate_softness, held)
    columns = measured.columns
    return program(
        maps.deviation * columns,
        maps.hessian * np.outer(columns, columns) / measured.curvature,
        Group(track.inputs, hard, held),
        rates,
        Group(track.outputs, track.softness, np.arange(1, N + 1)),
        maps.unit * measured.curvature,
        soft_rows=soft_rows,
    )
