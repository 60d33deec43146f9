"""Koopman eigenfunctions from data: factors of the data, their null space for any λ, sparse vectors that predict."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Inexact, Int

from koopmpc import checks
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import DataError, FitWarning
from koopmpc.lifting.base import Lifting, lifting_of
from koopmpc.lifting.composed import Eigenfunction, jacobians

_FLAT = 1e-9  # share of the largest gradient, or of its terms, below which a combination of observables is constant
_EXACT = 1e-6  # relative residual below which no observable more is taken
_REAL = 1e-6  # share of |λ|, or of the rate of the states, below which an imaginary part is rounding
_ZERO = 1e-7  # share of its gradient below which a function vanishes on the data
_GAP = 10.0  # times the smallest singular value up to which others belong to the same null space
_ALIKE = 0.99  # cosine of two gradient fields on the data from which on they are of one function
_ROWS = 4096  # rows that are reduced together

Eigenpair = tuple[complex, Inexact[np.ndarray, " nz"]]  # λ and ξ


def eigenfunctions(
    episodes: Episodes,
    library: Lifting,
    *,
    eigenvalue: complex | None = 0.0,
    by: Literal["steps", "derivatives"] = "steps",
    held_out: Episodes | None = None,
    tolerance: float = 0.05,
    growth: float = 2.0,
    count: int = 5,
) -> "Eigenfunctions":
    """Find φ(x) = Σ cⱼ ψⱼ(x) with φ̇ = λ φ + Σᵢ βᵢ(x) uᵢ, few c ≠ 0, that predict held-out data.

    With an eigenvalue (0 for conserved quantities) the regression is implicit: c and the coefficients of β are in the
    null space of the matrix with the rows (ψ(x⁺) − e^{λ dt} ψ(x)) / dt − u (w₀ β(x) + w₁ β(x⁺)), that is, c minimises
    the residual for a gradient ∇φ of root-mean-square 1. This rules out constants, and sums that are constant
    everywhere. Without inputs the rows are exact for any dt; w₀ and w₁ assume that β is linear over a step, with an
    error of dt². With eigenvalue=None the regression is explicit: λ and c are eigenpairs of the least squares of ψ(x⁺)
    on [ψ(x) u ψ(x)], and the implicit regression then refines each.

    Observables are added to φ in the order of their contribution until the residual is below `growth` times that of
    all of them. In a null space of several dimensions, alternating directions look for the sparsest vectors. Last, each
    φ is predicted over held-out episodes from its first value, and is rejected where it misses `tolerance`.

    Parameters
    ----------
    episodes
        With inputs or without. Inputs are held over each sample.
    library
        ψ; it need not hold the states. β is looked for in it too: where B is constant, as for an energy and a force,
        that is ∇φ·B, and the effect on a coordinate needs a `Constant`.
    eigenvalue
        λ [1/s], or None to look for all.
    by
        "steps", as above; or "derivatives": the rows are ∇ψ(x)·ẋ − λ ψ(x) − u β(x), where ẋ are central differences of
        fourth order inside each episode. They ask for inputs that are smooth in time, and need five samples.
    held_out
        Episodes to validate on; by default every fourth of `episodes`, or of fewer than four the last quarter of each.
    tolerance
        Largest error of a validated eigenfunction; see `Eigenfunction.error`.
    growth
        Factor ≥ 1 by which the residual may grow for fewer observables; 1 keeps all.
    count
        Largest number of eigenfunctions that are tried.

    Returns
    -------
    eigenfunctions
        A sequence of the validated ones, the smallest error first. Each is scaled so that its largest coefficient is 1.

    Raises
    ------
    DataError
        An option is none of the above; the library is constant on the data; episodes are too short for `by`.

    Warns
    -----
    FitWarning
        No eigenfunction passed the validation.

    References
    ----------
    Kaiser, Kutz & Brunton, "Data-driven discovery of Koopman eigenfunctions for control", Mach. Learn.: Sci.
    Technol. 2, 2021. Sparse vectors in a subspace: Qu, Sun & Wright, NIPS 27, 2014.
    """
    checks.kind(episodes, "episodes", Episodes, "collect or load some")
    if not checks.among(by, ("steps", "derivatives")):
        raise DataError(f'by is {by!r}; pass "steps" or "derivatives"')
    if growth < 1:
        raise DataError(f"growth is {growth:g}; pass a factor of at least 1")
    tolerance, count = checks.positive(tolerance, "tolerance"), checks.count(count, "count")
    bound = lifting_of(library).bind(episodes.states)
    train, test = _parted(episodes) if held_out is None else (episodes, held_out)
    if (test.nx, test.nu) != (train.nx, train.nu):
        raise DataError("held_out has other states or inputs than the episodes; pass data of the same plant")
    rows = EigenfunctionRows.read(train, bound, by)
    pairs = rows.explicit(count) if eigenvalue is None else rows.implicit(complex(eigenvalue), count)
    found: list[Eigenfunction] = []
    for value, xi in pairs:
        phi = rows.sparse(value, xi, growth, free=eigenvalue is None)
        if phi is not None and all(_different(phi, other) for other in found):
            found.append(phi)
    judged = sorted((_validated(phi, test, rows.spread) for phi in found), key=lambda phi: phi.error)
    kept = tuple(phi for phi in judged if phi.error <= tolerance)
    if not kept:
        best = f"the best has an error of {judged[0].error:.2g}" if judged else "the regression has no candidate"
        warnings.warn(
            f"no eigenfunction predicts held-out data within {tolerance:g}: {best}; pass a larger library or more data",
            FitWarning,
            stacklevel=2,
        )
    return Eigenfunctions(kept, tuple(phi for phi in judged if phi.error > tolerance))


@dataclass(frozen=True)
class Eigenfunctions(Sequence[Eigenfunction]):
    """The validated eigenfunctions, the smallest error first, and those that were rejected."""

    found: tuple[Eigenfunction, ...]
    rejected: tuple[Eigenfunction, ...] = ()

    def __getitem__(self, i: int) -> Eigenfunction:  # pyright: ignore[reportIncompatibleMethodOverride]  # no slices
        return self.found[i]

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.found)

    def __str__(self) -> str:
        """Return a line for each: formula, eigenvalue, error."""
        lines = [str(phi) for phi in self.found] + [f"rejected: {phi}" for phi in self.rejected]
        return "\n".join(lines) or "no eigenfunction"


def _parted(episodes: Episodes) -> tuple[Episodes, Episodes]:
    """Return the episodes to fit, and every fourth of them, or of fewer than four the last quarter of each."""
    whole = list(episodes)
    if len(whole) >= 4:
        train, test = [e for i, e in enumerate(whole) if i % 4 != 3], whole[3::4]
    else:
        cut = [max(1, 3 * len(e.U) // 4) for e in whole]
        if any(n == len(e.U) for n, e in zip(cut, whole, strict=True)):
            raise DataError("an episode is too short to hold its last quarter out; pass held_out, or longer episodes")
        train = [Episode(X=e.X[: n + 1], U=e.U[:n]) for n, e in zip(cut, whole, strict=True)]
        test = [Episode(X=e.X[n:], U=e.U[n:]) for n, e in zip(cut, whole, strict=True)]
    return episodes.with_episodes(train), episodes.with_episodes(test)


def _different(a: Eigenfunction, b: Eigenfunction) -> bool:
    """Return whether two eigenfunctions are not multiples of each other with one λ."""
    if len(a.rates) != len(b.rates) or abs(a.eigenvalue - b.eigenvalue) > 1e-3 * max(abs(a.eigenvalue), 1e-3):
        return True
    return float(np.abs(a.coefficients - b.coefficients).max()) > 1e-3


def _validated(phi: Eigenfunction, episodes: Episodes, spread: Float[np.ndarray, " nx"]) -> Eigenfunction:
    """Return φ with its error: φ_{k+1} = e^{λ dt} φ_k + dt u_k (w₀ β_k + w₁ β_{k+1}) over whole episodes."""
    before, after = weights(phi.eigenvalue, episodes.dt)
    mu, missed, steepness, samples = np.exp(phi.eigenvalue * episodes.dt), 0.0, 0.0, 0
    for episode in episodes:
        told, Z = phi.values(episode.X), phi.lifting(episode.X)
        beta = np.einsum("puj,kj->puk", phi.drive, Z)
        effect = beta[0] if len(beta) == 1 else beta[0] + 1j * beta[1]
        push = episodes.dt * np.sum(episode.U.T * (before * effect[:, :-1] + after * effect[:, 1:]), axis=0)
        ahead = np.empty(len(told), dtype=complex)
        ahead[0] = told[0]
        for k in range(len(push)):
            ahead[k + 1] = mu * ahead[k] + push[k]
        missed += float(np.sum(np.abs(ahead - told) ** 2))
        steepness += float(np.sum(np.abs(phi.gradient(episode.X) * spread) ** 2))
        samples += len(told)
    error = float(np.sqrt(missed / steepness)) if steepness > 0 else np.inf
    return replace(phi, error=error if np.isfinite(error) else np.inf)


class _Solved(NamedTuple):
    """c on all observables, the coefficients of β, and the residual [1/s] for ∇φ of root-mean-square 1."""

    c: Inexact[np.ndarray, " nz"]
    beta: Inexact[np.ndarray, "nu nz"]
    residual: float


@dataclass(frozen=True, eq=False)
class EigenfunctionRows:
    """The triangular factors of the data, from which the matrix of any λ follows.

    R is the factor of [ψ(x⁺) or ψ̇, ψ(x), u₁ψ(x) …, u₁ψ(x⁺) …], G that of ∇ψ in standard deviations of the states,
    which are `spread`. `speed` [1/s] is the root-mean-square of ẋ in these units.
    """

    lifting: Lifting
    dt: float
    by: str
    nu: int
    R: Float[np.ndarray, "n columns"]
    G: Float[np.ndarray, "rows nz"]
    spread: Float[np.ndarray, " nx"]
    speed: float

    @classmethod
    def read(cls, episodes: Episodes, lifting: Lifting, by: str) -> "EigenfunctionRows":
        """Reduce the episodes part by part; no pair of samples spans two of them."""
        spread = np.concatenate([e.X for e in episodes]).std(axis=0)
        spread = np.where(spread > 0, spread, 1.0)
        R, G, speed, samples = np.zeros((0, 0)), np.zeros((0, 0)), 0.0, 0
        for X, X_next, velocity, U in _chunks(episodes, by):
            Z, J = lifting(X), jacobians(lifting, X)
            later = lifting(X_next) if by == "steps" else np.einsum("mji,mi->mj", J, velocity)
            driven = [u[:, None] * Z for u in U.T] + [u[:, None] * later for u in U.T if by == "steps"]
            R = _factor(R, np.hstack([later, Z, *driven]))
            G = _factor(G, (J * spread).transpose(0, 2, 1).reshape(-1, lifting.nz))
            speed, samples = speed + float(np.sum((velocity / spread) ** 2)), samples + len(X)
        share = 1.0 / np.sqrt(samples)
        if not np.abs(G).max() > 0:
            raise DataError("the library is constant on the data; pass observables that vary with the state")
        found = float(np.sqrt(speed)) * share
        return cls(lifting, episodes.dt, by, episodes.nu, R * share, G * share, spread, found or 1.0)

    def parts(self, value: complex) -> tuple[Inexact[np.ndarray, "n nz"], Inexact[np.ndarray, "n nb"]]:
        """Return M_c and M_β with φ̇ − λφ − βu = M_c c + M_β β on the data; real for a real λ."""
        later, mu = self.R[:, : self.lifting.nz], value if value.imag else value.real
        if self.by == "derivatives":
            return later - mu * self._now, -self._effect(mu)
        return (later - np.exp(mu * self.dt) * self._now) / self.dt, -self._effect(mu)

    @property
    def _now(self) -> Float[np.ndarray, "n nz"]:
        """The columns of R that hold ψ(x)."""
        return self.R[:, self.lifting.nz : 2 * self.lifting.nz]

    def _effect(self, value: complex) -> Inexact[np.ndarray, "n nb"]:
        """Return βu, a column for each coefficient of β; over a step its mean, weighted as λ asks for."""
        driven, half = self.R[:, 2 * self.lifting.nz :], self.nu * self.lifting.nz
        if self.by == "derivatives":
            return driven
        before, after = weights(value, self.dt)
        return before * driven[:, :half] + after * driven[:, half:]

    def implicit(self, value: complex, count: int) -> list[Eigenpair]:
        """Return the sparsest vectors of the null space for λ: residuals near the smallest one, or near rounding."""
        every = np.arange(self.lifting.nz)
        least = self._solved(value, self._null(value, every, 0.0, 1)[:, 0]).residual
        null = self._null(value, every, max(_GAP * least, _EXACT * self.speed), count)
        size: Float[np.ndarray, " nz"] = np.linalg.norm(self.G, axis=0)
        if value:  # a Constant counts by its value, for x − 3 may be an eigenfunction where x is none
            null = null[:, [not self._vanishes(c) for c in null.T]]
            size = np.where(size > 0, size, np.linalg.norm(self._now, axis=0))
        return [(value, xi) for xi in _sparsest(null * size[:, None], size[:, None])]

    def explicit(self, count: int) -> list[Eigenpair]:
        """Return the eigenpairs of least squares with the smallest residuals, one of each conjugate pair."""
        nz = self.lifting.nz
        P = self.R[:, nz : (2 + self.nu) * nz]
        size = np.linalg.norm(P, axis=0)
        size = np.where(size > 0, size, 1.0)
        K = np.linalg.lstsq(P / size, self.R[:, :nz], rcond=1e-12)[0] / size[:, None]
        values, vectors = np.linalg.eig(K[:nz])
        sizes = np.vstack([self.G, self._now])
        pairs: list[tuple[float, Eigenpair]] = []
        for j, mu in enumerate(values):
            xi: Inexact[np.ndarray, " nz"] = vectors[:, j]
            steepness = float(np.linalg.norm(self.G @ xi))
            if abs(mu) < 1e-8 or steepness < _FLAT * float(np.linalg.norm(sizes * np.abs(xi))):
                continue
            rate = complex(np.log(mu) / self.dt if self.by == "steps" else mu)
            if abs(rate.imag) < _REAL * max(abs(rate), self.speed):
                rate, xi = complex(rate.real), np.real(_turned(xi))
            if rate.imag >= 0 and not self._vanishes(xi):
                M, F = self.parts(rate)
                missed = M @ xi
                missed = missed - F @ np.linalg.lstsq(F, missed, rcond=1e-10)[0]
                pairs.append((float(np.linalg.norm(missed)) / steepness, (rate, xi)))
        return [pair for _, pair in sorted(pairs, key=lambda each: each[0])[:count]]

    def _vanishes(self, c: Inexact[np.ndarray, " nz"]) -> bool:
        """Return whether φ is zero on all data, as H − H₀ is on one trajectory: any λ fits it."""
        return bool(np.linalg.norm(self._now @ c) <= _ZERO * np.linalg.norm(self.G @ c))

    def sparse(
        self, value: complex, xi: Inexact[np.ndarray, " nz"], growth: float, *, free: bool
    ) -> Eigenfunction | None:
        """Return φ on the fewest observables, those that contribute most to ξ; a `free` λ is fitted to each choice.

        None where λ is not 0 and φ vanishes on all data.
        """
        weight = np.abs(xi) * np.hypot(np.linalg.norm(self.G, axis=0), np.linalg.norm(self._now, axis=0))
        order = np.argsort(-weight, kind="stable")
        order = order[weight[order] > 0]
        xi = xi / np.linalg.norm(self.G @ xi)
        rate, solved = value, self._solved(value, xi)
        allowed = growth * max(solved.residual, _EXACT * self.speed)
        for n in range(1, len(order) + 1) if growth > 1 else ():
            support = np.sort(order[:n])
            if np.linalg.norm(self.G[:, support]) > 0:
                rate_n, found = self._refined(value, support, xi, allowed, free)
                if found.residual <= allowed and abs(np.vdot(self.G @ xi, self.G @ found.c)) >= _ALIKE:
                    rate, solved = rate_n, found
                    break
        if (rate or free) and self._vanishes(solved.c):
            return None
        beta, residual = self._sparse_effect(rate, solved, allowed)
        size = np.abs(solved.c)
        largest = float(size.max())
        last = int(np.flatnonzero(size > (1 - 1e-6) * largest)[-1])
        factor = abs(solved.c[last]) / solved.c[last] / largest
        p = 2 if rate.imag else 1  # a real φ has no imaginary part
        c, drive = (np.array([each.real, each.imag])[:p] for each in (solved.c * factor, beta * factor))
        return Eigenfunction(self.lifting, c, (rate.real, rate.imag)[:p], drive, residual=residual / self.speed)

    def _refined(
        self, value: complex, support: Int[np.ndarray, " s"], xi: Inexact[np.ndarray, " nz"], allowed: float, free: bool
    ) -> tuple[complex, _Solved]:
        """Return λ, where it is free the one that fits best, and the nearest to ξ of all c with an allowed residual."""
        solved = self._nearest(value, support, xi, allowed)
        for _ in range(5 if free else 0):
            pushed = self.dt * self._effect(value) if self.by == "steps" else self._effect(value)
            now, later = self._now @ solved.c, self.R[:, : self.lifting.nz] @ solved.c
            later = later - pushed @ solved.beta.ravel()
            mu = complex(np.vdot(now, later) / max(float(np.vdot(now, now).real), 1e-300))
            if self.by == "steps" and not abs(mu) > 0:
                break
            fitted = complex(np.log(mu) / self.dt if self.by == "steps" else mu)
            better = fitted if value.imag else complex(fitted.real)
            trial = self._nearest(better, support, xi, allowed)
            if not trial.residual < solved.residual * (1 - 1e-3):
                break
            value, solved = better, trial
        return value, solved

    def _null(
        self, value: complex, support: Int[np.ndarray, " s"], below: float, count: int
    ) -> Inexact[np.ndarray, "nz d"]:
        """Return c, a column each, of the singular values up to `below`, at least one, the smallest first."""
        M, F = self.parts(value)
        M, G = M[:, support], self.G[:, support]
        size = np.linalg.norm(G, axis=0)
        size = np.where(size > 0, size, 1.0)
        _, s, Vt = np.linalg.svd(G / size)
        s = np.pad(s, (0, len(Vt) - len(s)))
        steep = s > _FLAT * s[0]
        W, flat = Vt[steep].T / s[steep] / size[:, None], Vt[~steep].T / size[:, None]
        others = np.hstack([M @ flat, F])  # constants and β are free: what they explain costs nothing
        norms = np.linalg.norm(others, axis=0)
        others = others / np.where(norms > 1e-12 * max(self.speed, 1.0), norms, np.inf)
        U, t, _ = np.linalg.svd(others, full_matrices=False)
        U = U[:, t > 1e-10 * max(float(t.max(initial=0.0)), 1e-300)]
        T = M @ W
        _, sigma, Ah = np.linalg.svd(T - U @ (U.conj().T @ T))
        sigma = np.pad(sigma, (0, len(Ah) - len(sigma)))
        kept = [i for i in np.argsort(sigma) if sigma[i] <= max(below, sigma.min())][:count]
        A = Ah[kept].conj().T
        b = np.linalg.lstsq(others, -T @ A, rcond=1e-10)[0] / np.where(norms > 0, norms, 1.0)[:, None]
        c = np.zeros((self.lifting.nz, len(kept)), dtype=A.dtype)
        c[support] = W @ A + flat @ b[: flat.shape[1]]
        return c

    def _nearest(
        self, value: complex, support: Int[np.ndarray, " s"], xi: Inexact[np.ndarray, " nz"], allowed: float
    ) -> _Solved:
        """Return the c on the support nearest to ξ of the span of those with a residual up to `allowed`."""
        null = self._null(value, support, allowed, len(support))
        return self._solved(value, null @ np.linalg.lstsq(self.G @ null, self.G @ xi, rcond=1e-12)[0])

    def _solved(self, value: complex, c: Inexact[np.ndarray, " nz"]) -> _Solved:
        """Return c for ∇φ of root-mean-square 1, with the β that fits best and the residual."""
        steepness = float(np.linalg.norm(self.G @ c))
        c = c / steepness if steepness > 0 else c
        M, F = self.parts(value)
        missed = M @ c
        size = np.linalg.norm(F, axis=0)
        size = np.where(size > 0, size, 1.0)
        beta = np.linalg.lstsq(F / size, -missed, rcond=1e-10)[0] / size
        residual = float(np.linalg.norm(missed + F @ beta)) if steepness > 0 else np.inf
        return _Solved(c, beta.reshape(self.nu, self.lifting.nz), residual)

    def _sparse_effect(
        self, value: complex, solved: _Solved, allowed: float
    ) -> tuple[Inexact[np.ndarray, "nu nz"], float]:
        """Return β on the fewest terms for which the residual stays below `allowed`, and that residual."""
        M, F = self.parts(value)
        missed, beta = M @ solved.c, solved.beta.ravel()
        weight = np.abs(beta) * np.linalg.norm(F, axis=0)
        for n in range(int(np.sum(weight > 0))):
            chosen = np.argsort(-weight, kind="stable")[:n]
            few = np.zeros_like(beta)
            few[chosen] = np.linalg.lstsq(F[:, chosen], -missed, rcond=1e-10)[0]
            residual = float(np.linalg.norm(missed + F @ few))
            if residual <= allowed:
                return few.reshape(solved.beta.shape), residual
        return solved.beta, solved.residual


def _chunks(episodes: Episodes, by: str) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Yield x, x⁺, ẋ and u of many samples at once; ẋ by central differences of fourth order, or by one step."""
    waiting: list[tuple[np.ndarray, ...]] = []
    for i, episode in enumerate(episodes):
        X, U, dt = episode.X, episode.U, episodes.dt
        if by == "steps":
            waiting.append((X[:-1], X[1:], np.diff(X, axis=0) / dt, U))
        else:
            if len(X) < 5:
                raise DataError(f'episode {i} has {len(X)} samples; by="derivatives" needs five, or pass by="steps"')
            velocity = (X[:-4] - 8 * X[1:-3] + 8 * X[3:-1] - X[4:]) / (12 * dt)
            waiting.append((X[2:-2], X[3:-1], velocity, U[2:-1]))
        if sum(len(each[0]) for each in waiting) >= _ROWS or i == len(episodes) - 1:
            x, x_next, v, u = (np.concatenate(each) for each in zip(*waiting, strict=True))
            yield x, x_next, v, u
            waiting = []


def weights(value: complex, dt: float) -> tuple[complex, complex]:
    """Return w₀ and w₁ of ∫ e^{λ(dt − s)} β(s) ds / dt = w₀ β(0) + w₁ β(dt), exact where β is linear in time."""
    a = value * dt
    if abs(a) < 1e-3:
        after = 1 / 2 + a / 6 + a**2 / 24
        return 1 + a / 2 + a**2 / 6 - after, after
    after = (np.exp(a) - 1 - a) / a**2
    return (np.exp(a) - 1) / a - after, after


def _factor(R: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the triangular factor of the rows so far and these."""
    return np.asarray(np.linalg.qr(np.vstack([R.reshape(-1, rows.shape[1]), rows]), mode="r"))


def _turned(c: Inexact[np.ndarray, " nz"]) -> Inexact[np.ndarray, " nz"]:
    """Return c times the phase that makes its largest entry real."""
    largest = c[int(np.abs(c).argmax())]
    return c * (np.conj(largest) / abs(largest))


def _sparsest(null: Inexact[np.ndarray, "nz d"], size: Float[np.ndarray, "nz 1"]) -> list[Inexact[np.ndarray, " nz"]]:
    """Return d independent vectors of the span of `null`, the sparsest first, divided by `size` again.

    From each observable's own row as a start, alternate x = shrunk(N q) and q = Nᴴx / ‖Nᴴx‖ (Qu, Sun & Wright 2014).
    """
    size = np.where(size > 0, size, np.inf)
    d = null.shape[1]
    if d < 2:
        return [c / np.where(np.isfinite(size), size, 1.0)[:, 0] for c in null.T]
    N = np.linalg.qr(null)[0]
    tried: list[tuple[int, Inexact[np.ndarray, " nz"]]] = []
    for row in N:
        if not np.linalg.norm(row) > 1e-9:
            continue
        q = row.conj() / np.linalg.norm(row)
        for _ in range(500):
            v = N @ q
            x = v * np.maximum(1 - 0.5 / np.sqrt(len(v)) / np.maximum(np.abs(v), 1e-300), 0.0)
            new = N.conj().T @ x
            new = new / max(float(np.linalg.norm(new)), 1e-300)
            if np.abs(new - q).max() < 1e-12:
                break
            q = new
        v = N @ q
        tried.append((int(np.sum(np.abs(v) > 1e-4 * np.abs(v).max())), v))
    chosen: list[Inexact[np.ndarray, " nz"]] = []
    for _, v in sorted(tried, key=lambda each: each[0]):
        both = np.column_stack([*chosen, v])
        if len(chosen) < d and np.linalg.svd(both / np.linalg.norm(both, axis=0), compute_uv=False)[-1] > 1e-3:
            chosen.append(v)
    return [v / np.where(np.isfinite(size), size, 1.0)[:, 0] for v in chosen]
