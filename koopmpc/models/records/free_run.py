"""Records in standard units, and the free runs of many polynomial models at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.models.records.forward import Terms, evaluate_terms

PIECE = 1500  # rows of a free run, at most: a longer record is cut, and each piece starts at measured rows
ROWS = 12_000  # rows of all pieces together, at most
_LOST = 1e3  # a forecast stops at this many spreads of the output
HELD = 3.0  # a free run has diverged if it leaves this many times the range of the data


@dataclass(frozen=True, eq=False)
class Pieces:
    """Stretches of records as deviations from the mean, in standard deviations."""

    # states (rows + 1, nx) and inputs (rows, nu) of each piece
    Y: tuple[np.ndarray, ...]
    U: tuple[np.ndarray, ...]
    # of [x u]; the scale of a signal that does not move is 1
    mean: Float[np.ndarray, " nv"]
    scale: Float[np.ndarray, " nv"]

    @property
    def nx(self) -> int:
        """Number of states."""
        return self.Y[0].shape[1]

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self.U[0].shape[1]

    @property
    def rows(self) -> int:
        """Snapshot pairs in all pieces."""
        return sum(map(len, self.U))

    @classmethod
    def of(cls, episodes: Episodes) -> "Pieces":
        """Return the episodes in pieces of up to 1500 rows; of very long data evenly spread ones."""
        mean, scale = find_units(episodes)
        nx, pieces = episodes.nx, spread_pieces(episodes, ROWS, PIECE)
        Y = tuple((e.X - mean[:nx]) / scale[:nx] for e in pieces)
        return cls(Y, tuple((e.U - mean[nx:]) / scale[nx:] for e in pieces), mean, scale)


def find_units(episodes: Episodes) -> tuple[Float[np.ndarray, " nv"], Float[np.ndarray, " nv"]]:
    """Return mean and standard deviation of [x u]; 1 for a signal that does not move."""
    both = [np.concatenate([e.X for e in episodes]), np.concatenate([e.U for e in episodes])]
    mean = np.concatenate([rows.mean(axis=0) for rows in both])
    scale = np.concatenate([rows.std(axis=0) for rows in both])
    return mean, np.where(scale > 1e-12 * np.abs(mean), scale, 1.0)


def spread_pieces(episodes: Episodes, most: int, piece: int) -> list[Episode]:
    """Return pieces of up to `piece` rows, evenly spread so that they have `most` rows together, about."""
    pieces = [
        e.cut(len(e) * i // count, len(e) * (i + 1) // count)
        for e in episodes
        for count in [-(-len(e) // piece)]
        for i in range(count)
    ]
    return pieces[:: max(-(-sum(map(len, pieces)) // most), 1)]


def embed_rows(
    Y: Float[np.ndarray, "rows1 nx"], U: Float[np.ndarray, "rows nu"], delays: int
) -> tuple[Float[np.ndarray, "pairs nv"], Float[np.ndarray, "pairs nx"]]:
    """Return [1, ζ_k, u_k] and x_{k+1} of every row k that has its past, ζ_k = [x_k, u_{k−1}, x_{k−1}, …]."""
    rows = len(U)
    columns = [np.ones((rows - delays, 1)), Y[delays:rows]]
    for i in range(1, delays + 1):
        columns += [U[delays - i : rows - i], Y[delays - i : rows - i]]
    return np.hstack([*columns, U[delays:]]), Y[delays + 1 :]


@dataclass(frozen=True, eq=False)
class Models:
    """Nested polynomial models x⁺ᵢ = c₀ + Σ_t c_t v^{terms_t}, for each state i its terms and (s, 1 + terms) c.

    Model number q has its own coefficients on the same terms; those of terms that it lacks are zero. Forecasts end at
    `rails`, (2, nx), if sensors saturate.
    """

    delays: int
    terms: tuple[Terms, ...]
    coefficients: tuple[Float[np.ndarray, "s n1"], ...]
    rails: Float[np.ndarray, "2 nx"] | None = None

    @property
    def count(self) -> int:
        """Number of models s."""
        return len(self.coefficients[0])

    def keep(self, which: Sequence[int] | Int[np.ndarray, " k"]) -> "Models":
        """Return some of the models."""
        return Models(self.delays, self.terms, tuple(c[which] for c in self.coefficients), self.rails)


def run_freely(
    models: Models, Y: Sequence[np.ndarray], U: Sequence[np.ndarray], first: int
) -> Float[np.ndarray, "rows b s nx"]:
    """Return x̂_{first+1}, … of all models over pieces, from measured rows up to `first` and the inputs alone.

    Pieces that are shorter than the longest get inputs of zero behind their end.
    """
    d, nx, nu = models.delays, Y[0].shape[1], U[0].shape[1]
    length, block = max(map(len, U)) - first, nx + nu
    n = nx + d * block
    inputs = np.zeros((length, len(U), 1, nu))
    V = np.ones((len(U), models.count, 1 + n + nu))
    for b, (y, u) in enumerate(zip(Y, U, strict=True)):
        inputs[: len(u) - first, b, 0] = u[first:]
        V[b, :, 1 : 1 + n] = embed_rows(y[first - d : first + 2], u[first - d : first + 1], d)[0][0, 1 : 1 + n]
    out = np.empty((length, len(U), models.count, nx))
    ends = np.array([[-_LOST], [_LOST]]).repeat(nx, axis=1) if models.rails is None else models.rails
    ends = np.clip(ends, -_LOST, _LOST)
    constants = [c[:, 0] for c in models.coefficients]
    weights = [np.ascontiguousarray(c[:, 1:]) for c in models.coefficients]
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(length):
            V[..., 1 + n :] = inputs[k]
            for i, terms in enumerate(models.terms):
                value = np.einsum("bst,st->bs", evaluate_terms(terms, V), weights[i]) + constants[i]
                np.clip(value, *ends[:, i], out=out[k, :, :, i])
            if d:
                V[..., 1 + block : 1 + n] = V[..., 1 : 1 + n - block].copy()
                V[..., 1 + nx : 1 + block] = inputs[k]
            V[..., 1 : 1 + nx] = out[k]
    return np.where(np.isnan(out), _LOST, out)


def are_calm(models: Models, pieces: Pieces, first: int) -> Bool[np.ndarray, " s"]:
    """Return which models stay within three times the range of the data, run over each piece twice."""
    twice = [np.vstack([u, u]) for u in pieces.U]
    out = run_freely(models, pieces.Y, twice, first)
    range_of_data = np.max([np.abs(y).max(axis=0) for y in pieces.Y], axis=0)
    return np.asarray((np.abs(out) < HELD * range_of_data).all(axis=(0, 1, 3)))
