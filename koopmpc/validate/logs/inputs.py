"""Faults of the inputs: they do not move enough, have no effect, or follow from the state."""

from collections.abc import Iterator

import numpy as np

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.lifting.base import short
from koopmpc.validate.identifiability import persistency
from koopmpc.validate.logs.alignment import better, rows
from koopmpc.validate.logs.log import Log, LogFault, fitted, information
from koopmpc.validate.text import percent

_PAST = 10  # inputs of the past that may tell the next one
_EXPLAINED = 0.8  # share of an input that the state of the same row explains: feedback
_NEWS = 0.02  # share of what is new in an input that this state must explain then
_FREE = 1e-4  # share of an input that its own past must leave open
_ENOUGH = 200  # rows without which no effect is looked for


def constant(log: Log) -> Iterator[LogFault]:
    """Find inputs that never move."""
    U = np.concatenate([e.U for e in log.data])
    for j in np.flatnonzero(np.ptp(U, axis=0) == 0):
        name = short(log.data.inputs[j])
        yield LogFault(
            "constant input",
            f"{name} is {U[0, j]:.4g} throughout: what it does cannot be learned",
            f"excite {name}, with km.Noise or km.PRBS, or leave it out",
            (log.data.inputs[j],),
        )


def together(log: Log) -> Iterator[LogFault]:
    """Find inputs of which one follows from the others."""
    U = np.concatenate([e.U for e in log.data])
    moving = [j for j in range(log.data.nu) if np.ptp(U[:, j]) > 0]
    V = (U[:, moving] - U[:, moving].mean(axis=0)) / np.maximum(U[:, moving].std(axis=0), 1e-300)
    for n, j in enumerate(moving):
        if n and float((fitted(V[:, :n], V[:, [n]]) ** 2).mean()) < 1e-4:
            others = ", ".join(short(log.data.inputs[i]) for i in moving[:n])
            yield LogFault(
                "inputs together",
                f"{short(log.data.inputs[j])} follows from {others}: their effects cannot be told apart",
                "excite each input by its own noise",
                (log.data.inputs[j],),
            )


def excitation(log: Log) -> Iterator[LogFault]:
    """Find inputs that excite to a lower order than the plant has states."""
    U = np.concatenate([e.U for e in log.data])
    order = log.data.nx + 1
    for j in np.flatnonzero(np.ptp(U, axis=0) > 0):
        long = [e for e in log.data if len(e) > order + 1]
        if not long:
            continue
        # differences, for a constant level raises the order by one and excites nothing
        alone = Episodes([Episode(X=e.X[1:], U=np.diff(e.U[:, [j]], axis=0)) for e in long], log.data.dt)
        found = persistency(alone, order)
        good = int((found.conditions < 1e7).sum())
        if good < min(order, 3):
            name = short(log.data.inputs[j])
            yield LogFault(
                "little excitation",
                f"{name} excites to order {good} only, and {log.data.nx} states ask for {order}: a sine, or steps "
                "that hardly ever come",
                f"excite {name} with km.Noise, km.PRBS or km.Multisine",
                (log.data.inputs[j],),
            )


def without_effect(log: Log) -> Iterator[LogFault]:
    """Find inputs that move and change no state within a few steps."""
    nu = log.data.nu
    near = rows(log, margin=6)
    if not nu or len(near.X) < max(_ENOUGH, 4 * near.regressors(log).shape[1]):
        return
    V = np.concatenate([_past(e.U, 6, e.U.shape[0] - 6, 6) for e in log.data if len(e) >= 15])[: len(near.X)]
    for j in range(nu):
        own = V[:, j::nu] / log.input_size[j]
        if np.ptp(own) == 0:
            continue
        rest = [i for i in range(nu) if i != j]
        base = log.regressors(near.X)
        kept = np.hstack(
            [base, (near.before - log.center) / log.size, *(V[:, i::nu] / log.input_size[i] for i in rest)]
        )
        Y = (near.after - near.X) / log.size
        E, other = fitted(kept, Y), fitted(np.hstack([kept, own]), Y)
        chance = own.shape[1] * Y.shape[1] / (2 * len(Y))
        gain = information(other, log.fine)[0] - information(E, log.fine)[0]
        if gain < 4 * chance + 2e-4 and not better(log, E, other, 1e-3):
            name = short(log.data.inputs[j])
            yield LogFault(
                "input without effect",
                f"{name} moves, and no state follows within {6} steps",
                f"check that {name} was applied and is in the right column; excite it more strongly; else leave it out",
                (log.data.inputs[j],),
            )


def _past(U: np.ndarray, first: int, last: int, count: int) -> np.ndarray:
    """Return rows [u_k, u_{k−1}, …, u_{k−count+1}] for k = first + 1 … last − 1."""
    k = np.arange(first + 1, last)
    return np.hstack([U[k - lag] for lag in range(count)])


def feedback(log: Log) -> Iterator[LogFault]:
    """Find inputs u_k that follow from the state x_k of the same row.

    An input that was chosen freely may be told by the state as well, where the plant is much faster than the input is
    changed. Two signs tell a feedback u = K x from that: x_k knows more of u_k than of u_{k−1}, although that one has
    acted already, and it tells a part of u_k that earlier inputs do not.
    """
    U = [e.U for e in log.data if len(e) > 2 * _PAST]
    X = [e.X for e in log.data if len(e) > 2 * _PAST]
    if not U or not log.data.nu:
        return
    now = np.concatenate([u[_PAST + 1 :] for u in U])
    past = np.concatenate([_past(u, _PAST, len(u), _PAST + 1)[:, u.shape[1] :] for u in U])
    state = np.concatenate([x[_PAST + 1 : -1] for x in X])
    if len(now) < max(_ENOUGH, 4 * (past.shape[1] + state.shape[1])):
        return
    V = (now - log.input_center) / log.input_size
    own = (past - np.tile(log.input_center, _PAST)) / np.tile(log.input_size, _PAST)
    one, Z = np.ones((len(V), 1)), (state - log.center) / log.size
    left = (fitted(np.hstack([one, own]), V) ** 2).mean(axis=0)
    after = (fitted(np.hstack([one, own, Z]), V) ** 2).mean(axis=0)
    alone, acted = np.split((fitted(np.hstack([one, Z]), np.hstack([V, own[:, : V.shape[1]]])) ** 2).mean(axis=0), 2)
    around = np.maximum((V**2).mean(axis=0) - V.mean(axis=0) ** 2, 1e-300)
    for j in np.flatnonzero(around > 1e-12):
        told = 1 - after[j] / max(left[j], 1e-300)
        exact = alone[j] < 1e-8 * around[j]
        known = alone[j] < (1 - _EXPLAINED) * around[j] and alone[j] < acted[j]
        if exact or (known and told > _NEWS and left[j] > _FREE * around[j]):
            name = short(log.data.inputs[j])
            yield LogFault(
                "feedback",
                f"the states tell {percent(1 - alone[j] / around[j])} of {name}: it was a feedback, so that A and B "
                "cannot be told apart",
                f"add noise to {name} while logging: km.Feedback(K, km.Noise(…))",
                (log.data.inputs[j],),
            )
