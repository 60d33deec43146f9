"""PlanMap: the unconstrained plan and its limited outputs as one matrix, and the QP where that plan meets a limit."""

import numpy as np
from jaxtyping import Float

from koopmpc.control.cost import Cost, LiftedTracking
from koopmpc.control.limits import Interval
from koopmpc.control.linear.condense import Coordinates, condense, scaled
from koopmpc.control.linear.horizon import horizon_of, stages, terminal_of
from koopmpc.control.linear.qp import groups, step_qp
from koopmpc.control.riccati import recursion
from koopmpc.control.target import margin, targets_of
from koopmpc.lifting.base import HUGE
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
    predictor, cost
        As for KoopmanMPC.
    track
        What they track and limit.
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
        track: LiftedTracking,
        blocks: tuple[int, ...],
        *,
        disturbed: bool,
        coordinates: Coordinates,
    ) -> None:
        self.track = track
        self.targets = found = targets_of(predictor, cost, track)
        self._given, self.given_rows = track.given, 0 if track.given is None else len(track.given)
        horizon = horizon_of(predictor, track, blocks, disturbed=disturbed)
        end = terminal_of(predictor, cost, horizon, found)
        law = recursion(stages(horizon, found), end.P, end.p)
        self.maps = scaled(condense(horizon, law, end, found, coordinates), track.inputs, len(blocks))
        self.moves = len(blocks) * predictor.nu
        self.deviation = self.maps.deviation[: self.moves]
        limits_of_plan = groups(track, horizon)
        self.qp = step_qp(self.maps, limits_of_plan)

        low, high = (
            np.concatenate([np.tile(group.bounds[i], len(group.next)) for group in limits_of_plan]) for i in (0, 1)
        )
        nv = len(low)
        last, first = horizon.disturbance(horizon.N - 1), np.zeros((nv, 0))
        self._disturbance = np.zeros((predictor.nz, 0)) if last is None else last[:, :-1]
        ng = self._disturbance.shape[1]
        checked = np.zeros(len(found.low), dtype=np.bool_)
        self._aimed = bool(self.maps.from_target.any())  # else no target enters the plan
        if ng:
            first = self.maps.from_drive
        if ng and self._aimed:
            checked = np.isfinite(found.low) | np.isfinite(found.high)
            from_disturbance = found.from_disturbance @ self._disturbance
            every = self.maps.from_target.reshape(nv, horizon.N + 1, -1).sum(axis=1)
            first = first + every @ from_disturbance
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

    def aim(self, R: Float[np.ndarray, "N1 nr"], row: int = 0) -> None:
        """Write the part of the reference rows into the last column, NaN where a row is.

        Of a u_target that is given in rows, the plan starts at `row`.
        """
        column, maps, found = self.matrix[:, -1], self.maps, self.targets
        if not np.isfinite(R).all():
            column[:] = np.nan
            return
        v = maps.from_reference @ R.ravel() + maps.offset
        if self._given is not None:
            rows = self._given[np.minimum(np.arange(row, row + len(R)), self.given_rows - 1)]
            v += maps.from_given @ rows.ravel()
        if self._aimed:
            driven = self._disturbance.shape[1] > 0
            alpha = found.nearest(R) if driven else found.coordinates(R)
            v += maps.from_target @ alpha.ravel()
            if driven:
                values = (alpha @ found.rows.T)[:, self._checked]
                column[self.planned :] = np.concatenate([values.min(axis=0), values.max(axis=0)])
        column[: self.planned] = v

    def correction(self, R: Float[np.ndarray, "N1 nr"], g: Float[np.ndarray, " ng"]) -> Float[np.ndarray, " nv"]:
        """Return what v gains from targets that a limit moves."""
        e, found = self._disturbance @ g, self.targets
        moved = found.coordinates(R, e) - found.nearest(R, e)
        return self.maps.from_target @ moved.ravel()
