"""Koopman eigenfunctions from data: the null space of the data for an eigenvalue λ, and sparse vectors in it."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError, FitWarning
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.lifting.base import Lifting, check_lifting
from koopmpc.lifting.composed import Eigenfunction
from koopmpc.models.fits.eigenfunction_rows import EigenfunctionRows, hold_weights


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
    null space of the matrix with the rows (ψ(x⁺) − e^{λ dt} ψ(x)) / dt − u (w₀ β(x) + w₁ β(x⁺)). So c minimises the
    residual for a gradient ∇φ of root-mean-square 1, which excludes constants and sums that are constant everywhere.
    Without inputs the rows are exact for any dt; w₀ and w₁ assume that β is linear over a step, with an error of dt².
    With eigenvalue=None the regression is explicit: λ and c are eigenpairs of the least squares of ψ(x⁺) on
    [ψ(x) u ψ(x)], and the implicit regression then refines each.

    Observables are added to φ in the order of their contribution until the residual is below `growth` times that of
    all observables. In a null space of several dimensions, alternating directions find the sparsest vectors. Finally
    each φ is predicted over held-out episodes from its first value, and is rejected if its error is above `tolerance`.

    Parameters
    ----------
    episodes
        Episodes with or without inputs. Inputs are constant over each sample.
    library
        ψ; it need not hold the states. β is a combination of these observables too. For a constant B it is ∇φ·B; if φ
        has a term linear in a state, β needs a `Constant`.
    eigenvalue
        λ [1/s], or None to find all of them.
    by
        "steps", as above; or "derivatives": the rows are ∇ψ(x)·ẋ − λ ψ(x) − u β(x), where ẋ are central differences of
        fourth order inside each episode. Inputs must then be smooth in time, and episodes have at least five samples.
    held_out
        Episodes for the validation; by default every fourth of `episodes`, or the last quarter of each if there are
        fewer than four.
    tolerance
        Largest error of a validated eigenfunction; see `Eigenfunction.error`.
    growth
        Factor ≥ 1 by which the residual may grow for fewer observables; 1 keeps all.
    count
        Largest number of candidates.

    Returns
    -------
    eigenfunctions
        A sequence of the validated ones, the smallest error first. Each is scaled so that its largest coefficient is 1.

    Raises
    ------
    DataError
        An option has another value; the library is constant on the data; episodes are too short for `by`.

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
    growth = float(checks.array(growth, "growth", ()))
    if growth < 1:
        raise DataError(f"growth is {growth:g}; pass a factor of at least 1")
    tolerance, count = checks.positive(tolerance, "tolerance"), checks.count(count, "count")
    bound = check_lifting(library).bind(episodes.states)
    train, test = _split_episodes(episodes) if held_out is None else (episodes, held_out)
    if (test.nx, test.nu) != (train.nx, train.nu):
        raise DataError("held_out has other states or inputs than the episodes; pass data of the same plant")
    rows = EigenfunctionRows.read(train, bound, by)
    pairs = rows.explicit(count) if eigenvalue is None else rows.implicit(complex(eigenvalue), count)
    candidates: list[Eigenfunction] = []
    for value, xi in pairs:
        phi = rows.sparse(value, xi, growth, free=eigenvalue is None)
        if phi is not None and all(_is_different(phi, other) for other in candidates):
            candidates.append(phi)
    judged = sorted((_with_error(phi, test, rows.spread) for phi in candidates), key=lambda phi: phi.error)
    valid = tuple(phi for phi in judged if phi.error <= tolerance)
    if not valid:
        best = f"the best has an error of {judged[0].error:.2g}" if judged else "the regression has no candidate"
        warnings.warn(
            f"no eigenfunction predicts held-out data within {tolerance:g}: {best}; pass a larger library or more data",
            FitWarning,
            stacklevel=2,
        )
    return Eigenfunctions(valid, tuple(phi for phi in judged if phi.error > tolerance))


@dataclass(frozen=True)
class Eigenfunctions(Sequence[Eigenfunction]):
    """The validated eigenfunctions, the smallest error first, and the rejected ones."""

    found: tuple[Eigenfunction, ...]
    rejected: tuple[Eigenfunction, ...] = ()

    def __getitem__(self, i: int) -> Eigenfunction:  # pyright: ignore[reportIncompatibleMethodOverride]  # no slices
        return self.found[i]

    def __len__(self) -> int:
        """Return the number of validated eigenfunctions."""
        return len(self.found)

    def __str__(self) -> str:
        """Return a line with formula, eigenvalue and error for each."""
        lines = [str(phi) for phi in self.found] + [f"rejected: {phi}" for phi in self.rejected]
        return "\n".join(lines) or "no eigenfunction"


def _split_episodes(episodes: Episodes) -> tuple[Episodes, Episodes]:
    """Return data to fit and data to validate: every fourth episode, or the last quarter of each if fewer than four."""
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


def _is_different(a: Eigenfunction, b: Eigenfunction) -> bool:
    """Return True if two scaled eigenfunctions differ in λ or in their coefficients."""
    if len(a.rates) != len(b.rates) or abs(a.eigenvalue - b.eigenvalue) > 1e-3 * max(abs(a.eigenvalue), 1e-3):
        return True
    return float(np.abs(a.coefficients - b.coefficients).max()) > 1e-3


def _with_error(phi: Eigenfunction, episodes: Episodes, spread: Float[np.ndarray, " nx"]) -> Eigenfunction:
    """Return φ with its error: φ_{k+1} = e^{λ dt} φ_k + dt u_k (w₀ β_k + w₁ β_{k+1}) over whole episodes."""
    before, after = hold_weights(phi.eigenvalue, episodes.dt)
    mu, missed, steepness, samples = np.exp(phi.eigenvalue * episodes.dt), 0.0, 0.0, 0
    for episode in episodes:
        phi_k, Z = phi.values(episode.X), phi.lifting(episode.X)
        beta = np.einsum("puj,kj->puk", phi.drive, Z)
        effect = beta[0] if len(beta) == 1 else beta[0] + 1j * beta[1]
        push = episodes.dt * np.sum(episode.U.T * (before * effect[:, :-1] + after * effect[:, 1:]), axis=0)
        ahead = np.empty(len(phi_k), dtype=complex)
        ahead[0] = phi_k[0]
        for k in range(len(push)):
            ahead[k + 1] = mu * ahead[k] + push[k]
        missed += float(np.sum(np.abs(ahead - phi_k) ** 2))
        steepness += float(np.sum(np.abs(phi.gradient(episode.X) * spread) ** 2))
        samples += len(phi_k)
    error = float(np.sqrt(missed / steepness)) if steepness > 0 else np.inf
    return replace(phi, error=error if np.isfinite(error) else np.inf)
