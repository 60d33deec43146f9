"""The regressions behind eigenfunctions: rows of differences or derivatives, their null space and explicit pairs."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Inexact, Int

from koopmpc.base.errors import DataError
from koopmpc.data.episodes import Episodes
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Eigenfunction, evaluate_jacobians


@dataclass(frozen=True)
class _Tolerances:
    """What counts as zero, as exact and as alike."""

    flat: float = 1e-9  # a combination of observables is constant below this share of the largest gradient
    exact: float = 1e-6  # add no more observables once the relative residual is below this
    real: float = 1e-6  # an imaginary part below this share of |λ|, or of the rate of the states, is a rounding error
    zero: float = 1e-7  # a function vanishes on the data if it is below this share of its gradient
    gap: float = 10.0  # singular values up to so many times the smallest belong to the same null space
    alike: float = 0.99  # two gradient fields are those of one function if their cosine on the data is at least this


_AT = _Tolerances()
ROWS = 4096  # number of rows that are reduced at once

Eigenpair = tuple[complex, Inexact[np.ndarray, " nz"]]  # λ and ξ


class _Candidate(NamedTuple):
    """c on all observables, the coefficients of β, and the residual [1/s] for ∇φ of root-mean-square 1."""

    c: Inexact[np.ndarray, " nz"]
    beta: Inexact[np.ndarray, "nu nz"]
    residual: float


@dataclass(frozen=True, eq=False)
class EigenfunctionRows:
    """The triangular factors of the data, which give the matrix of the implicit regression for any λ.

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
            Z, J = lifting(X), evaluate_jacobians(lifting, X)
            later = lifting(X_next) if by == "steps" else np.einsum("mji,mi->mj", J, velocity)
            driven = [u[:, None] * Z for u in U.T] + [u[:, None] * later for u in U.T if by == "steps"]
            R = _update_factor(R, np.hstack([later, Z, *driven]))
            G = _update_factor(G, (J * spread).transpose(0, 2, 1).reshape(-1, lifting.nz))
            speed, samples = speed + float(np.sum((velocity / spread) ** 2)), samples + len(X)
        share = 1.0 / np.sqrt(samples)
        if not np.abs(G).max() > 0:
            raise DataError("the library is constant on the data; pass observables that vary with the state")
        mean_speed = float(np.sqrt(speed)) * share
        return cls(lifting, episodes.dt, by, episodes.nu, R * share, G * share, spread, mean_speed or 1.0)

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
        """Return βu, a column for each coefficient of β; over a step, its mean weighted by e^{λ(dt − s)}."""
        driven, half = self.R[:, 2 * self.lifting.nz :], self.nu * self.lifting.nz
        if self.by == "derivatives":
            return driven
        before, after = hold_weights(value, self.dt)
        return before * driven[:, :half] + after * driven[:, half:]

    def implicit(self, value: complex, count: int) -> list[Eigenpair]:
        """Return the sparsest vectors of the null space for λ, with residuals near the smallest or near rounding."""
        support = np.arange(self.lifting.nz)
        least = self._solve_effect(value, self._null(value, support, 0.0, 1)[:, 0]).residual
        null = self._null(value, support, max(_AT.gap * least, _AT.exact * self.speed), count)
        size: Float[np.ndarray, " nz"] = np.linalg.norm(self.G, axis=0)
        if value:  # the size of a Constant is its value: x − 3 may be an eigenfunction although x is not
            null = null[:, [not self._vanishes(c) for c in null.T]]
            size = np.where(size > 0, size, np.linalg.norm(self._now, axis=0))
        return [(value, xi) for xi in _find_sparsest(null * size[:, None], size[:, None])]

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
            if abs(mu) < 1e-8 or steepness < _AT.flat * float(np.linalg.norm(sizes * np.abs(xi))):
                continue
            rate = complex(np.log(mu) / self.dt if self.by == "steps" else mu)
            if abs(rate.imag) < _AT.real * max(abs(rate), self.speed):
                rate, xi = complex(rate.real), np.real(_rotate_to_real(xi))
            if rate.imag >= 0 and not self._vanishes(xi):
                M, F = self.parts(rate)
                error = M @ xi
                error = error - F @ np.linalg.lstsq(F, error, rcond=1e-10)[0]
                pairs.append((float(np.linalg.norm(error)) / steepness, (rate, xi)))
        return [pair for _, pair in sorted(pairs, key=lambda item: item[0])[:count]]

    def _vanishes(self, c: Inexact[np.ndarray, " nz"]) -> bool:
        """Return True if φ is zero on all data, as H − H₀ is on one trajectory; then any λ fits."""
        return bool(np.linalg.norm(self._now @ c) <= _AT.zero * np.linalg.norm(self.G @ c))

    def sparse(
        self, value: complex, xi: Inexact[np.ndarray, " nz"], growth: float, *, free: bool
    ) -> Eigenfunction | None:
        """Return φ on the fewest observables, those that contribute most to ξ; a `free` λ is fitted to each choice.

        Return None if φ vanishes on all data and λ is not fixed at 0.
        """
        weight = np.abs(xi) * np.hypot(np.linalg.norm(self.G, axis=0), np.linalg.norm(self._now, axis=0))
        order = np.argsort(-weight, kind="stable")
        order = order[weight[order] > 0]
        xi = xi / np.linalg.norm(self.G @ xi)
        rate, solved = value, self._solve_effect(value, xi)
        allowed = growth * max(solved.residual, _AT.exact * self.speed)
        for n in range(1, len(order) + 1) if growth > 1 else ():
            support = np.sort(order[:n])
            if np.linalg.norm(self.G[:, support]) > 0:
                rate_n, candidate = self._refine(value, support, xi, allowed, free)
                if candidate.residual <= allowed and abs(np.vdot(self.G @ xi, self.G @ candidate.c)) >= _AT.alike:
                    rate, solved = rate_n, candidate
                    break
        if (rate or free) and self._vanishes(solved.c):
            return None
        beta, residual = self._sparse_effect(rate, solved, allowed)
        size = np.abs(solved.c)
        largest = float(size.max())
        last = int(np.flatnonzero(size > (1 - 1e-6) * largest)[-1])
        factor = abs(solved.c[last]) / solved.c[last] / largest
        p = 2 if rate.imag else 1  # a real φ has no imaginary part
        c, drive = (np.array([scaled.real, scaled.imag])[:p] for scaled in (solved.c * factor, beta * factor))
        return Eigenfunction(self.lifting, c, (rate.real, rate.imag)[:p], drive, residual=residual / self.speed)

    def _refine(
        self, value: complex, support: Int[np.ndarray, " s"], xi: Inexact[np.ndarray, " nz"], allowed: float, free: bool
    ) -> tuple[complex, _Candidate]:
        """Return λ, fitted if it is free, and the c nearest to ξ among those with an allowed residual."""
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
        """Return vectors c, one a column, with singular values up to `below`, the smallest first and at least one."""
        M, F = self.parts(value)
        M, G = M[:, support], self.G[:, support]
        size = np.linalg.norm(G, axis=0)
        size = np.where(size > 0, size, 1.0)
        _, s, Vt = np.linalg.svd(G / size)
        s = np.pad(s, (0, len(Vt) - len(s)))
        steep = s > _AT.flat * s[0]
        W, flat = Vt[steep].T / s[steep] / size[:, None], Vt[~steep].T / size[:, None]
        others = np.hstack([M @ flat, F])  # constants and β are free: their part of the residual is projected out
        norms = np.linalg.norm(others, axis=0)
        others = others / np.where(norms > 1e-12 * max(self.speed, 1.0), norms, np.inf)
        U, t, _ = np.linalg.svd(others, full_matrices=False)
        U = U[:, t > 1e-10 * max(float(t.max(initial=0.0)), 1e-300)]
        T = M @ W
        _, sigma, Ah = np.linalg.svd(T - U @ (U.conj().T @ T))
        sigma = np.pad(sigma, (0, len(Ah) - len(sigma)))
        smallest = [i for i in np.argsort(sigma) if sigma[i] <= max(below, sigma.min())][:count]
        A = Ah[smallest].conj().T
        b = np.linalg.lstsq(others, -T @ A, rcond=1e-10)[0] / np.where(norms > 0, norms, 1.0)[:, None]
        c = np.zeros((self.lifting.nz, len(smallest)), dtype=A.dtype)
        c[support] = W @ A + flat @ b[: flat.shape[1]]
        return c

    def _nearest(
        self, value: complex, support: Int[np.ndarray, " s"], xi: Inexact[np.ndarray, " nz"], allowed: float
    ) -> _Candidate:
        """Return the c nearest to ξ in the span of those on the support with a residual up to `allowed`."""
        null = self._null(value, support, allowed, len(support))
        return self._solve_effect(value, null @ np.linalg.lstsq(self.G @ null, self.G @ xi, rcond=1e-12)[0])

    def _solve_effect(self, value: complex, c: Inexact[np.ndarray, " nz"]) -> _Candidate:
        """Return c scaled to a ∇φ of root-mean-square 1, the β that fits best, and the residual."""
        steepness = float(np.linalg.norm(self.G @ c))
        c = c / steepness if steepness > 0 else c
        M, F = self.parts(value)
        missed = M @ c
        size = np.linalg.norm(F, axis=0)
        size = np.where(size > 0, size, 1.0)
        beta = np.linalg.lstsq(F / size, -missed, rcond=1e-10)[0] / size
        residual = float(np.linalg.norm(missed + F @ beta)) if steepness > 0 else np.inf
        return _Candidate(c, beta.reshape(self.nu, self.lifting.nz), residual)

    def _sparse_effect(
        self, value: complex, solved: _Candidate, allowed: float
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
    """Yield x, x⁺, ẋ and u of many samples at once; ẋ is a central difference of fourth order, or that of one step."""
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
        if sum(len(arrays[0]) for arrays in waiting) >= ROWS or i == len(episodes) - 1:
            x, x_next, v, u = (np.concatenate(arrays) for arrays in zip(*waiting, strict=True))
            yield x, x_next, v, u
            waiting = []


def hold_weights(value: complex, dt: float) -> tuple[complex, complex]:
    """Return w₀ and w₁ of ∫ e^{λ(dt − s)} β(s) ds / dt = w₀ β(0) + w₁ β(dt), exact where β is linear in time."""
    a = value * dt
    if abs(a) < 1e-3:
        after = 1 / 2 + a / 6 + a**2 / 24
        return 1 + a / 2 + a**2 / 6 - after, after
    after = (np.exp(a) - 1 - a) / a**2
    return (np.exp(a) - 1) / a - after, after


def _update_factor(R: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the triangular factor of [R; rows]."""
    return np.asarray(np.linalg.qr(np.vstack([R.reshape(-1, rows.shape[1]), rows]), mode="r"))


def _rotate_to_real(c: Inexact[np.ndarray, " nz"]) -> Inexact[np.ndarray, " nz"]:
    """Return c times the phase that makes its largest entry real."""
    largest = c[int(np.abs(c).argmax())]
    return c * (np.conj(largest) / abs(largest))


def _find_sparsest(
    null: Inexact[np.ndarray, "nz d"], size: Float[np.ndarray, "nz 1"]
) -> list[Inexact[np.ndarray, " nz"]]:
    """Return d independent vectors in the span of `null`, the sparsest first, each divided by `size`.

    Starting from each row of N, alternate x = shrink(N q) and q = Nᴴx / ‖Nᴴx‖ (Qu, Sun & Wright 2014).
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
    for _, v in sorted(tried, key=lambda item: item[0]):
        both = np.column_stack([*chosen, v])
        if len(chosen) < d and np.linalg.svd(both / np.linalg.norm(both, axis=0), compute_uv=False)[-1] > 1e-3:
            chosen.append(v)
    return [v / np.where(np.isfinite(size), size, 1.0)[:, 0] for v in chosen]
