"""`find_drift` compares new logs with the data of a design: what has changed, by how much, and how surely."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import chdtri

from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.terminal import label_lines, render_text
from koopmpc.base.text import to_percent
from koopmpc.base.values import Value
from koopmpc.data.episodes import Episodes, episodes_of
from koopmpc.lifting.base import strip_unit
from koopmpc.validate.logs.log import Log, solve_weights


@dataclass(frozen=True)
class _Limits:
    """Limits of the comparison of new logs with old data."""

    sure: float = 5.0  # a change must be this many times its spread among parts of the old data
    least: float = 0.1  # smaller changes than this share are not named
    asked: float = 0.2  # where a change of this share would not be seen, nobody can say
    alike: float = 0.1  # coefficients that explain this share less than the best explanation cannot be told from it
    alike_gain: float = 0.25  # gains of inputs and sensors may explain this share less: they are the commoner cause
    close: float = 12.0  # nor can those that explain so much less in twice the log-likelihood
    blocks: int = 8  # parts of the old data that are compared with the others
    inside: float = 0.995  # share of the old rows whose leverage counts as inside the data
    fewest: int = 40  # rows inside the old data that a comparison needs
    nudge: float = 1e-3  # relative step of the differences
    part: float = 0.5  # a name should explain this share of what changed
    too_little: float = 1 / 3  # one that explains less than this is not named: the regression itself may not hold there


_LIMITS = _Limits()
TOLERANCE = 1.5  # errors may be this many times those of a model on its own data before it counts as changed
CHANCE = 1e-5  # or so large that chance makes them so in this share of cases
PAIRED = 1.5  # sensor noise e_k = v_{k+1} − A v_k makes neighbours alike: n errors tell as much as n / 1.5 at least


def exceeds_usual(errors: Float[np.ndarray, "n nx"], usual: Float[np.ndarray, " nx"]) -> bool:
    """Return whether errors of a model are larger than on its own data: by half, and by more than chance allows.

    The test of a change that `Adaptive` makes while it runs: the mean square of errors of a state over its usual one
    is compared with χ²_m / m at a level of 1e-5. Noise of a sensor is in two errors in sequence, whose correlation is
    down to −½, so that n errors count as m = n / 1.5: the variance of a mean square is that of 1 + 2 (½)² times white.
    """
    n = max(len(errors) / PAIRED, 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        found = np.asarray(np.sqrt((errors**2).mean(axis=0)), dtype=np.float64)
    bound = max(TOLERANCE, float(np.sqrt(chdtri(n, CHANCE) / n)))
    return not bool((found <= bound * usual).all())


@dataclass(frozen=True)
class PlantChange:
    """A change of the plant that may explain new logs.

    Attributes
    ----------
    name
        What changed, such as "the gain of F".
    share
        By how much, as a share: −0.2 is a fifth less.
    sure
        The change over its spread among parts of the old data.
    error
        Least share that would have been seen.
    explains
        What it explains of the new rows, as a rise of twice the log-likelihood.
    kind
        "input" for the gain of an input, "sensor" for that of a sensor, "coefficient", or "speed".
    """

    name: str
    share: float
    sure: float
    error: float
    explains: float
    kind: str

    def __str__(self) -> str:
        """Return the change in words."""
        return f"{self.name} is {to_percent(1 + self.share)} of what it was"


@dataclass(frozen=True, eq=False)
class DriftReport(Value):
    """What changed between old and new logs; `print` shows it.

    Attributes
    ----------
    verdict
        "unchanged", "changed" or "cannot say".
    changes
        The best explanation, and those that cannot be told apart from it.
    unseen
        Names of changes of a fifth that these logs would not show.
    rows, inside
        New rows, and those inside the old data, which alone are compared.
    sentences
        The report.
    """

    verdict: str
    changes: tuple[PlantChange, ...]
    unseen: tuple[str, ...]
    rows: int
    inside: int
    sentences: tuple[str, ...]

    def __str__(self) -> str:
        """Return the verdict and the sentences."""
        return render_text(label_lines([(self.verdict, self.sentences[0]), *(("", one) for one in self.sentences[1:])]))


def find_drift(old: Episodes, new: Episodes) -> DriftReport:
    """Compare new logs with the data that a controller was designed on, and name what changed.

    A regression x⁺ = Θᵀφ(x, u) + e of the old data predicts the new rows inside them. Each candidate, the gain of an
    input, the gain of a sensor, or a coefficient of a state's law, moves these predictions in a direction of its own.
    Its size a is fitted by generalised least squares, with the uncertainty of Θ, and a constant load in each new
    episode free. The same is done for parts of the old data against the others: a change is named if it is at least
    10 % and five times its spread there. On unchanged plants that is rarely so, even where the regression misfits.

    Parameters
    ----------
    old
        The data of the design.
    new
        Logs of the same states, inputs and dt.

    Returns
    -------
    report
        "cannot say" where new rows are outside of the old data, or do not excite what could have changed, or where no
        single change explains a third of the difference.

    Raises
    ------
    ShapeError, DataError
        States, inputs or dt differ, or there are no inputs.

    References
    ----------
    Chow, "Tests of equality between sets of coefficients in two linear regressions", Econometrica 28, 1960; Basseville
    & Nikiforov, "Detection of abrupt changes", 1993.
    """
    old, new = episodes_of(old), episodes_of(new)
    if (old.nx, old.nu) != (new.nx, new.nu):
        raise ShapeError(
            f"the new logs have {new.nx} states and {new.nu} inputs, the old data {old.nx} and {old.nu}; pass logs of "
            "the same signals"
        )
    if not old.nu:
        raise DataError("the data have no inputs, so a change cannot be told from a load")
    if abs(old.dt - new.dt) > 1e-9 * old.dt:
        raise DataError(f"the new logs have dt = {new.dt:g} s, the old data {old.dt:g} s; resample one of them")
    law = _Law.of(old)
    inside = [law.is_inside(e.X[:-1], e.U) for e in new]
    count, total = int(sum(np.sum(one) for one in inside)), sum(map(len, new))
    if count < _LIMITS.fewest:
        return DriftReport(
            "cannot say",
            (),
            (),
            total,
            count,
            (f"{count} of {total} new rows are inside the old data, {_LIMITS.fewest} are needed: nothing is compared",),
        )
    parts = [(e.X[:-1][one], e.U[one], e.X[1:][one]) for e, one in zip(new, inside, strict=True) if one.sum() > 1]
    blocks = list(_cut_blocks(old))
    null = [law.without(block).measure([block]) for block in blocks]
    found = law.measure(parts)
    return _judge(law, found, null, total, count)


def _cut_blocks(data: Episodes) -> Iterator["_Rows"]:
    """Yield parts of the data as long as others, episode by episode."""
    length = max(sum(map(len, data)) // _LIMITS.blocks, 10)
    kept: list[_Rows] = []
    for e in data:
        for k in range(0, len(e), length):
            kept.append((e.X[k : min(k + length, len(e))], e.U[k : k + length], e.X[k + 1 : k + 1 + length]))
            if sum(len(rows[0]) for rows in kept) >= length:
                yield _join_rows(kept)
                kept = []
    if sum(len(rows[0]) for rows in kept) > length // 2:
        yield _join_rows(kept)


def _join_rows(parts: Sequence["_Rows"]) -> "_Rows":
    X, U, after = (np.concatenate(part) for part in zip(*parts, strict=True))
    return X, U, after


_Rows = tuple[Float[np.ndarray, "n nx"], Float[np.ndarray, "n nu"], Float[np.ndarray, "n nx"]]


@dataclass(frozen=True, eq=False)
class _Measured:
    """For each candidate its size a, its formal error, and what it explains; `whole` is what all Θ free explains."""

    size: Float[np.ndarray, " c"]
    error: Float[np.ndarray, " c"]
    gain: Float[np.ndarray, " c"]
    whole: float


@dataclass(frozen=True, eq=False)
class _Law:
    """The regression of the old data: Θ, its information, and the noise."""

    log: Log
    rich: bool
    theta: Float[np.ndarray, "p nx"]
    gram: Float[np.ndarray, "p p"]
    cross: Float[np.ndarray, "p nx"]
    whitener: Float[np.ndarray, "nx nx"]
    bound: float

    @classmethod
    def of(cls, data: Episodes) -> "_Law":
        log = Log(data)
        X = np.concatenate([e.X[:-1] for e in data])
        U, T = log.U, np.concatenate([e.X[1:] for e in data])
        best: _Law | None = None
        least = np.inf
        for rich in (False, True):
            none = np.zeros((0, data.nx))
            one = cls(log, rich, none, np.zeros((0, 0)), none, np.eye(data.nx), 0.0)
            P = one.regressors(X, U)
            if len(P) < 6 * P.shape[1]:
                continue
            gram, cross = P.T @ P, P.T @ (T - X)
            theta = solve_weights(gram, cross)
            leverage = np.einsum("kp,pk->k", P, solve_weights(gram, P.T))
            E = T - X - P @ theta
            unseen = E / np.maximum(1 - leverage, 0.1)[:, None]  # as if each row had been left out
            value = float(np.sum(np.log(np.mean(unseen**2, axis=0) + 1e-300)))
            if value < least - 0.05 * data.nx:
                S = E.T @ E / max(len(E) - P.shape[1], 1)
                size = np.sqrt(np.mean((T - X) ** 2, axis=0))
                floor = 1e-12 * np.maximum(np.abs(X).max(axis=0), 1.0)
                S += np.diag(np.maximum(1e-4 * size, floor) ** 2)
                root = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
                whitener = np.ascontiguousarray(np.asarray(np.linalg.inv(root), dtype=np.float64).T)
                bound = float(np.quantile(leverage, _LIMITS.inside))
                best, least = cls(log, rich, theta, gram, cross, whitener, bound), value
        if best is None:
            raise DataError("the old data have too few rows for a regression; pass the logs of the design as a whole")
        return best

    def regressors(self, X: Float[np.ndarray, "n nx"], U: Float[np.ndarray, "n nu"]) -> Float[np.ndarray, "n p"]:
        if self.rich:
            return self.log.stack_regressors(X, U)
        Z, V = self.log.scale(X, U)
        return np.hstack([np.ones((len(Z), 1)), Z, V])

    def is_inside(self, X: Float[np.ndarray, "n nx"], U: Float[np.ndarray, "n nu"]) -> Bool[np.ndarray, " n"]:
        P = self.regressors(X, U)
        return np.asarray(np.einsum("kp,pk->k", P, solve_weights(self.gram, P.T)) <= self.bound)

    def without(self, rows: _Rows) -> "_Law":
        """Return the law of the other rows."""
        P = self.regressors(rows[0], rows[1])
        gram, cross = self.gram - P.T @ P, self.cross - P.T @ (rows[2] - rows[0])
        theta = solve_weights(gram, cross)
        return _Law(self.log, self.rich, theta, gram, cross, self.whitener, self.bound)

    def predict(self, X: Float[np.ndarray, "n nx"], U: Float[np.ndarray, "n nu"]) -> Float[np.ndarray, "n nx"]:
        return X + self.regressors(X, U) @ self.theta

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the candidates."""
        states = [strip_unit(name) for name in self.log.data.states]
        inputs = [strip_unit(name) for name in self.log.data.inputs]
        return (
            *(f"the gain of {u}" for u in inputs),
            *(f"the sensor of {x}" for x in states),
            *(f"the coefficient of {v} in the change of {x}" for x in states for v in (*states, *inputs)),
            *(f"the speed of {x}" for x in states),
        )

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kind of each candidate, in the order of `names`."""
        nx, nu = self.log.data.nx, self.log.data.nu
        return (*["input"] * nu, *["sensor"] * nx, *["coefficient"] * (nx * (nx + nu)), *["speed"] * nx)

    def directions(self, X: Float[np.ndarray, "n nx"], U: Float[np.ndarray, "n nu"]) -> Float[np.ndarray, "c n nx"]:
        """Return how the predictions move with a relative change of each candidate."""
        base, more = self.predict(X, U), 1 + _LIMITS.nudge
        nx, nu = X.shape[1], U.shape[1]
        found: list[np.ndarray] = []
        for j in range(nu):
            V = U.copy()
            V[:, j] *= more
            found.append((self.predict(X, V) - base) / _LIMITS.nudge)
        for i in range(nx):
            Y = X.copy()
            Y[:, i] /= more
            moved = self.predict(Y, U)
            moved[:, i] *= more
            found.append((moved - base) / _LIMITS.nudge)
        middle, centre = self.log.center[None], self.log.input_center[None]
        for i in range(nx):
            for k in range(nx + nu):
                ahead, aside = np.hstack([middle, centre]), np.hstack([middle, centre])
                size = np.concatenate([self.log.size, self.log.input_size])[k]
                ahead[0, k] += 0.5 * size
                aside[0, k] -= 0.5 * size
                slope = self.predict(ahead[:, :nx], ahead[:, nx:]) - self.predict(aside[:, :nx], aside[:, nx:])
                coefficient = float(slope[0, i]) / size - (1.0 if k == i else 0.0)
                column = np.zeros_like(X)
                column[:, i] = coefficient * np.hstack([X, U])[:, k]
                found.append(column)
        for i in range(nx):
            column = np.zeros_like(X)
            column[:, i] = base[:, i] - X[:, i]
            found.append(column)
        return np.array(found)

    def measure(self, parts: Sequence[_Rows]) -> _Measured:
        """Return size, error and gain of each candidate on new rows, an offset free in each part."""
        P = np.concatenate([self.regressors(X, U) for X, U, _ in parts])
        E = np.concatenate([T - self.predict(X, U) for X, U, T in parts]) @ self.whitener
        D = np.concatenate([self.directions(X, U) for X, U, _ in parts], axis=1) @ self.whitener
        group = np.repeat(np.arange(len(parts)), [len(X) for X, _, _ in parts])
        ones = (group[:, None] == np.arange(len(parts))).astype(np.float64)
        E, D, P = (rows - ones @ _mean_groups(ones, rows) for rows in (E, D, P))  # loads are free
        information = self.gram + P.T @ P
        stacked = np.concatenate([E[None], D])
        products = np.einsum("np,cnx->cpx", P, stacked)
        solved = np.array([solve_weights(information, one) for one in products])
        inner = np.einsum("anx,bnx->ab", stacked, stacked) - np.einsum("apx,bpx->ab", products, solved)
        diagonal = np.maximum(np.diag(inner)[1:], 1e-300)
        size = inner[0, 1:] / diagonal
        whole = float(inner[0, 0] - (np.sum(E**2) - np.sum(products[0] * _free(P, products[0]))))
        return _Measured(size, 1 / np.sqrt(diagonal), inner[0, 1:] ** 2 / diagonal, whole)


def _mean_groups(ones: Float[np.ndarray, "n g"], rows: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    return np.asarray((ones / ones.sum(axis=0)).T @ rows, dtype=np.float64)


def _free(P: Float[np.ndarray, "n p"], cross: Float[np.ndarray, "p nx"]) -> Float[np.ndarray, "p nx"]:
    """Return the weights of a regression of the new rows alone."""
    gram = P.T @ P
    return solve_weights(gram + 1e-9 * np.trace(gram) / len(gram) * np.eye(len(gram)), cross)


def _judge(law: _Law, found: _Measured, null: Sequence[_Measured], rows: int, inside: int) -> DriftReport:
    """Return the report: what is large beside the spread of parts of the old data."""
    scatter = np.sqrt(np.mean([(one.size / one.error) ** 2 for one in null], axis=0))
    spread = np.sqrt(np.mean([one.size**2 for one in null], axis=0))
    inflate = np.maximum(scatter, 1.0)
    error = np.maximum(found.error * inflate, np.minimum(spread, found.error * inflate * np.sqrt(_LIMITS.blocks)))
    sure, names = found.size / error, law.names
    unseen = [i for i in range(len(names)) if _LIMITS.sure * error[i] > _LIMITS.asked]
    changed = [
        i
        for i in range(len(names))
        if abs(sure[i]) >= _LIMITS.sure and abs(found.size[i]) >= _LIMITS.least and i not in unseen
    ]
    gains = range(law.log.data.nu)
    said: list[str] = []
    if inside < rows:
        said.append(f"{rows - inside} of {rows} new rows lie outside the old data and are compared with nothing")
    missed = tuple(names[i] for i in unseen)
    if not changed:
        if any(i in unseen for i in gains):
            hidden = ", ".join(names[i] for i in gains if i in unseen)
            first = f"the new logs do not excite the plant enough: a change of a fifth in {hidden} would not be seen"
            return DriftReport("cannot say", (), missed, rows, inside, (first, *said))
        first = "the new logs follow the law of the old data"
        return DriftReport("unchanged", (), missed, rows, inside, (first, *said))
    scaled = found.gain / inflate**2
    best = max(changed, key=lambda i: float(scaled[i]))
    part = float(found.gain[best] / max(found.whole, 1e-300))
    if part < _LIMITS.too_little:
        first = (
            "the new logs differ from the law of the old data, and no single change explains a third of it: more than "
            "one thing changed, or the law is not well known where the new rows lie"
        )
        return DriftReport("cannot say", (), missed, rows, inside, (first, *said))
    single = law.log.data.nu + law.log.data.nx  # gains stand first among the candidates
    share = np.where(np.arange(len(names)) < single, _LIMITS.alike_gain, _LIMITS.alike)
    near = [i for i in changed if scaled[i] >= scaled[best] - max(_LIMITS.close, float(share[i] * scaled[best]))]
    near.sort(key=lambda i: (i >= single, -float(scaled[i])))
    chosen = tuple(
        PlantChange(
            names[i],
            float(found.size[i]),
            float(sure[i]),
            float(_LIMITS.sure * error[i]),
            float(found.gain[i]),
            law.kinds[i],
        )
        for i in near
    )
    first = str(chosen[0]) if len(chosen) == 1 else " or ".join(map(str, chosen)) + ": these cannot be told apart"
    if part < _LIMITS.part:
        said.append(f"it explains {to_percent(part)} of what changed: more than one thing did")
    return DriftReport("changed", chosen, missed, rows, inside, (first, *said))
