"""Models with a hidden state in standard units, their simulation error over segments, and its derivatives."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from koopmpc.models.records.forward import Terms, evaluate_terms, list_terms

_ROWS = 2000  # so many rows, and eight steps at least, are multiplied at once
_FAR = 1e3  # a state beyond this many spreads has left the model


@dataclass(frozen=True, eq=False)
class HiddenModel:
    """z⁺ = E φ(z, u), y = H [z; 1] and z = T [ζ; 1], φ = [1; products; u times products; tanh(V [z; 1])].

    All signals are deviations from their means, in standard deviations.
    """

    terms: Terms  # the factors of each product as indices of [1, z, u], from 1, padded with 0
    # (n, 1 + terms + q), (ny, n + 1) and (n, nζ + 1)
    E: Float[np.ndarray, "n nphi"]
    H: Float[np.ndarray, "ny n1"]
    T: Float[np.ndarray, "n nzeta1"]
    # (n,) in terms with two factors of z or more, |z| counts as this at most: outside of the data they are constant
    bound: Float[np.ndarray, " n"]
    # (q, n + 1) slopes and offsets of the neurons tanh(V [z; 1]); None without any
    V: Float[np.ndarray, "q n1"] | None = None

    @property
    def neurons(self) -> Float[np.ndarray, "q n1"]:
        """V, of no rows without neurons."""
        return np.zeros((0, self.order + 1)) if self.V is None else self.V

    @property
    def order(self) -> int:
        """Order n of the hidden state."""
        return len(self.E)

    @property
    def parameters(self) -> Float[np.ndarray, " p"]:
        """All entries of E, H, T and V in one row."""
        return np.concatenate([self.E.ravel(), self.H.ravel(), self.T.ravel(), self.neurons.ravel()])

    def with_parameters(self, p: Float[np.ndarray, " p"]) -> "HiddenModel":
        """Return the model with other entries of E, H, T and V."""
        shapes = self.E.shape, self.H.shape, self.T.shape, self.neurons.shape
        parts = np.split(p, np.cumsum([a * b for a, b in shapes])[:-1])
        E, H, T, V = (part.reshape(shape) for part, shape in zip(parts, shapes, strict=True))
        return replace(self, E=E, H=H, T=T, V=V if len(V) else None)

    def add_neurons(self, V: Float[np.ndarray, "q n1"]) -> "HiddenModel":
        """Return the same model with further neurons, their coefficients zero."""
        E = np.hstack([self.E, np.zeros((self.order, len(V)))])
        return replace(self, E=E, V=np.vstack([self.neurons, V]))

    def raise_degree(self, degree: int) -> "HiddenModel":
        """Return the same model with all products up to a degree, the new ones with coefficients of zero."""
        nu = int(self.terms.max(initial=self.order)) - self.order
        terms = list_terms(self.order, nu, degree)
        place = {tuple(int(v) for v in term if v): i for i, term in enumerate(terms, 1)}
        E = np.zeros((self.order, len(terms) + 1))
        E[:, 0] = self.E[:, 0]
        for j, term in enumerate(self.terms, 1):
            E[:, place[tuple(int(v) for v in term if v)]] = self.E[:, j]
        return replace(self, terms=terms, E=E)


@dataclass(frozen=True, eq=False)
class RecordSegments:
    """Segments of records: the points ζ they start from, (m, nζ), and inputs and outputs, (steps, m, n).

    A reading at a rail of its sensor tells only that the output lies there or beyond: `low` and `high` say which.
    """

    points: Float[np.ndarray, "m nzeta"]
    inputs: Float[np.ndarray, "steps m nu"]
    outputs: Float[np.ndarray, "steps m ny"]
    low: np.ndarray | None = None
    high: np.ndarray | None = None


Sets = Sequence[RecordSegments]
"""Segments of several lengths; each length has the same weight."""


class SimulationError:
    """The mean squared error of ŷ_1, ŷ_2, … over sets of segments, z_0 = T ζ, and its derivatives by E, H and T.

    With D_k = ∂z_k/∂θ and J = ∂(E φ)/∂z the derivative follows D_{k+1} = D_k Jᵀ + I ⊗ φ. Where a reading is at a rail
    and ŷ lies beyond it, the error is zero.
    """

    def __init__(self, model: HiddenModel, noise: float = 0.0) -> None:
        self.model, self._noise = model, noise
        self._encoder = np.arange(model.T.size).reshape(model.T.shape)[:, :-1].ravel() + model.E.size + model.H.size
        n, limited = model.order, bool(np.isfinite(model.bound).all())
        factors = [tuple(v for v in term if v) for term in model.terms.tolist()]
        place = {(): 0} | {term: t for t, term in enumerate(factors, 1)}
        # ∂(v₁ v₂ v₃)/∂v₁ is a shorter product: term, entry of z, the product that is left, how often the entry occurs
        self._slopes = [
            (t, j - 1, place[term[: term.index(j)] + term[term.index(j) + 1 :]], term.count(j), limited and bends)
            for t, (term, bends) in enumerate(zip(factors, is_nonlinear(model.terms, n).tolist(), strict=True), 1)
            for j in sorted({v for v in term if v <= n})
        ]

    def evaluate(self, theta: Float[np.ndarray, " p"], data: Sets) -> float:
        """Return the mean squared error; inf where a state leaves the model."""
        plain = sum(self._evaluate(theta, part) for part in data) / len(data)
        return plain + self._weight(data) * float(np.sum(theta[self._encoder] ** 2))

    def derivatives(
        self, theta: Float[np.ndarray, " p"], data: Sets
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
        """Return half the gradient of `evaluate`, and the Gauss-Newton matrix."""
        gradient, matrix = np.zeros(len(theta)), np.zeros((len(theta), len(theta)))
        for part in data:
            own = self._derivatives(theta, part)
            gradient, matrix = gradient + own[0], matrix + own[1]
        gradient, matrix, weight = gradient / len(data), matrix / len(data), self._weight(data)
        gradient[self._encoder] += weight * theta[self._encoder]
        matrix[self._encoder, self._encoder] += weight
        return gradient, matrix

    def _weight(self, data: Sets) -> float:
        return self._noise**2 / min(len(part.inputs) for part in data)

    def begin(self, model: HiddenModel, data: RecordSegments) -> Float[np.ndarray, "m n"]:
        """Return the state z_0 of each segment."""
        return start_states(model, data.points)

    def _evaluate(self, theta: Float[np.ndarray, " p"], data: RecordSegments) -> float:
        model = self.model.with_parameters(theta)
        z = list_states(model, self.begin(model, data), data.inputs)[1:]
        if not (np.abs(z) < _FAR).all():
            return np.inf
        return float(np.mean(find_gap(z @ model.H[:, :-1].T + model.H[:, -1], data) ** 2))

    def _derivatives(
        self, theta: Float[np.ndarray, " p"], data: RecordSegments
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
        """Return both by E, H and V and by the state z_0 of each segment, which T ζ gives."""
        model = self.model.with_parameters(theta)
        (steps, m, ny), n, nphi = data.outputs.shape, model.order, model.E.shape[1]
        first, last, own = model.E.size, model.E.size + model.H.size, np.arange(n)
        weighed = np.flatnonzero(model.E[:, nphi - len(model.neurons) :].any(axis=0))  # V of others changes nothing
        bends: Int[np.ndarray, " q"] = nphi - len(model.neurons) + weighed
        C, W, q = model.H[:, :-1], np.repeat(model.E[:, bends], n + 1, axis=1), len(bends)
        z = list_states(model, self.begin(model, data), data.inputs)
        out = np.concatenate([z, np.ones((steps + 1, m, 1))], axis=2)
        y = z[1:] @ C.T + model.H[:, -1]
        gap, told = find_gap(y, data), None if data.low is None else ~_is_silent(y, data)
        moving = n + first + q * (n + 1)  # columns: z_0, E, V, then H and the gap, which do not go on
        D, spare = np.zeros((m, n, moving)), np.empty((m, n, moving))
        D[:, own, own] = 1.0
        columns, most = moving + model.H.size + 1, max(_ROWS // (m * ny), 8)
        table = np.zeros(min(most, steps) * m * ny * columns)
        total, starts = np.zeros((columns - n, columns - n)), np.zeros((m, n, columns))
        for low in range(0, steps, most):
            now = slice(low, min(low + most, steps))
            count = now.stop - low
            J = table[: count * m * ny * columns].reshape(m, count, ny, columns)
            phi, turned = self._features(model, z[now].reshape(-1, n), data.inputs[now].reshape(count * m, -1))
            phi, turned = phi.reshape(count, m, nphi), turned.reshape(count, m, n, n)
            bent = ((1 - phi[..., bends] ** 2)[..., None] * out[now, :, None]).reshape(count, m, q * (n + 1))
            for i in range(count):
                np.matmul(turned[i], D, out=spare)
                D, spare = spare, D
                for j in range(n):  # row j of E moves z_j alone, those of V all that have a weight
                    D[:, j, n + j * nphi : n + (j + 1) * nphi] += phi[i]
                    D[:, j, n + first :] += bent[i] * W[j]
                np.matmul(C, D, out=J[:, i, :, :moving])
            J[..., moving:-1] = 0.0
            for i in range(ny):
                J[:, :, i, moving + i * (n + 1) : moving + (i + 1) * (n + 1)] = out[1:][now].swapaxes(0, 1)
            if told is not None:
                J *= told[now].swapaxes(0, 1)[..., None]
            J[..., -1] = gap[now].swapaxes(0, 1)
            rows, by_segment = J.reshape(-1, columns)[:, n:], J.reshape(m, count * ny, columns)
            total += rows.T @ rows
            starts += np.matmul(by_segment[..., :n].swapaxes(1, 2), by_segment)
        by_neurons = last + model.T.size + weighed[:, None] * (n + 1) + np.arange(n + 1)
        others: Int[np.ndarray, " width"] = np.concatenate(
            [np.arange(first), by_neurons.ravel(), np.arange(first, last)]
        )
        by_others, by_starts = (total[:-1, -1], total[:-1, :-1]), (starts[..., -1], starts[..., n:-1], starts[..., :n])
        gradient, matrix = self._assemble(len(theta), others, by_others, by_starts, data.points)
        return gradient / data.outputs.size, matrix / data.outputs.size

    def _assemble(
        self,
        size: int,
        others: Int[np.ndarray, " width"],
        by_others: tuple[Float[np.ndarray, " width"], Float[np.ndarray, "width width"]],
        by_starts: tuple[Float[np.ndarray, "m n"], Float[np.ndarray, "m n width"], Float[np.ndarray, "m n n"]],
        points: Float[np.ndarray, "m nzeta"],
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p p"]]:
        """Return sums by all parameters: those of E, H and V, and those of T by what they are by each z_0."""
        (slope, both), (early, cross, square) = by_others, by_starts
        m, n, width = cross.shape
        gradient, matrix, first = np.zeros(size), np.zeros((size, size)), self.model.E.size + self.model.H.size
        encoder = np.arange(first, first + self.model.T.size)
        zeta = np.hstack([points, np.ones((m, 1))])  # z_0 = T [ζ; 1], row after row of T
        gradient[others], gradient[encoder] = slope, (early.T @ zeta).ravel()
        matrix[np.ix_(others, others)] = both
        mixed = (zeta.T @ cross.reshape(m, -1)).reshape(-1, n, width).swapaxes(0, 1).reshape(-1, width)
        matrix[np.ix_(encoder, others)], matrix[np.ix_(others, encoder)] = mixed, mixed.T
        pairs = (zeta[:, :, None] * zeta[:, None]).reshape(m, -1).T @ square.reshape(m, -1)
        count = len(zeta[0])
        matrix[np.ix_(encoder, encoder)] = (
            pairs.reshape(count, count, n, n).transpose(2, 0, 3, 1).reshape(n * count, n * count)
        )
        return gradient, matrix

    def _features(
        self, model: HiddenModel, z: Float[np.ndarray, "m n"], u: Float[np.ndarray, "m nu"]
    ) -> tuple[Float[np.ndarray, "m nphi"], Float[np.ndarray, "m n n"]]:
        """Return φ and ∂(E φ)/∂z."""
        n, E, bound, products = z.shape[1], model.E, model.bound, 1 + len(model.terms)
        phi = read_features(model, z, u)
        near, inside = phi[:, :products], np.abs(z) < bound
        if not inside.all():
            near = np.ones((len(z), products))
            near[:, 1:] = evaluate_terms(model.terms, np.hstack([near[:, :1], np.clip(z, -bound, bound), u]))
        weights = np.zeros((2, products, n, n))  # of terms that bounds do not concern, and of others
        for t, j, rest, times, bounded in self._slopes:
            weights[int(bounded), rest, :, j] += times * E[:, t]
        slope, bounded = (near @ each.reshape(products, -1) if each.any() else 0.0 for each in weights)
        slope = slope + bounded * np.tile(inside, n)
        if q := len(model.neurons):
            by_bend = E[:, -q:].T[:, :, None] * model.neurons[:, None, :-1]
            slope = slope + (1 - phi[:, -q:] ** 2) @ by_bend.reshape(q, -1)
        return phi, slope.reshape(-1, n, n)


def simulate_hidden(
    model: HiddenModel, points: Float[np.ndarray, "m nzeta"], inputs: Float[np.ndarray, "steps m nu"]
) -> Float[np.ndarray, "steps m ny"]:
    """Return ŷ_1, ŷ_2, … from several points ζ."""
    return list_states(model, start_states(model, points), inputs)[1:] @ model.H[:, :-1].T + model.H[:, -1]


def list_states(
    model: HiddenModel, z: Float[np.ndarray, "m n"], inputs: Float[np.ndarray, "steps m nu"]
) -> Float[np.ndarray, "steps1 m n"]:
    """Return z_0, z_1, …, which stop at `_FAR` spreads."""
    features, out = FeatureTable(model), np.empty((len(inputs) + 1, z.shape[1], len(z)))
    E, out[0] = model.E[:, features.order], z.T
    with np.errstate(over="ignore", invalid="ignore"):
        for k, u in enumerate(inputs.swapaxes(1, 2)):
            ahead = np.matmul(E, features.fill(out[k], u), out=out[k + 1])
            np.maximum(ahead, -_FAR, out=ahead)
            np.minimum(ahead, _FAR, out=ahead)
    return np.ascontiguousarray(out.swapaxes(1, 2))


def bound_states(model: HiddenModel, data: RecordSegments, reach: float) -> HiddenModel:
    """Return the model with bounds at `reach` times the largest |z| that occurs on these stretches."""
    model = replace(model, bound=np.full(model.order, np.inf))
    z = list_states(model, start_states(model, data.points), data.inputs)
    return replace(model, bound=reach * np.abs(z).max(axis=(0, 1)))


def join_segments(parts: Sequence[RecordSegments]) -> RecordSegments:
    """Return the segments of several records as one set."""
    points = np.concatenate([part.points for part in parts])
    names = ("inputs", "outputs") if parts[0].low is None else ("inputs", "outputs", "low", "high")
    return RecordSegments(points, *(np.concatenate([getattr(part, name) for part in parts], axis=1) for name in names))


def start_states(model: HiddenModel, points: Float[np.ndarray, "m nzeta"]) -> Float[np.ndarray, "m n"]:
    """Return z_0 = T [ζ_0; 1], inside of the bound."""
    return np.clip(points @ model.T[:, :-1].T + model.T[:, -1], -model.bound, model.bound)


def read_features(
    model: HiddenModel, z: Float[np.ndarray, "m n"], u: Float[np.ndarray, "m nu"]
) -> Float[np.ndarray, "m nphi"]:
    """Return φ(z, u)."""
    return np.ascontiguousarray(FeatureTable(model).read(z.T, u.T).T)


class FeatureTable:
    """φ of many states and inputs, a row for each feature. Each product is a shorter one times one more factor."""

    def __init__(self, model: HiddenModel) -> None:
        self._model, self._limited = model, bool(np.isfinite(model.bound).any())
        factors = [tuple(v for v in term if v) for term in model.terms.tolist()]
        sorted_terms = sorted(range(len(factors)), key=lambda t: (len(factors[t]), factors[t]))
        ends = len(factors) + 1, model.E.shape[1]
        self.order: Int[np.ndarray, " nphi"] = np.array(
            [0, *(t + 1 for t in sorted_terms), *range(*ends)], dtype=np.intp
        )
        place = {(): 0} | {factors[t]: row for row, t in enumerate(sorted_terms, 1)}
        self._blocks: list[tuple[slice, Int[np.ndarray, " k"], Int[np.ndarray, " k"]]] = []
        for size in range(2, max(map(len, factors), default=0) + 1):
            same = [factors[t] for t in sorted_terms if len(factors[t]) == size]
            shorter = np.array([place[term[:-1]] for term in same], dtype=np.intp)
            last = np.array([place[term[-1:]] for term in same], dtype=np.intp)
            self._blocks.append((slice(place[same[0]], place[same[-1]] + 1), shorter, last))
        bends = is_nonlinear(model.terms, model.order)
        self._curved = np.array([row for row, t in enumerate(sorted_terms, 1) if bends[t]], dtype=np.intp)
        self._curved_terms = model.terms[self.order[self._curved] - 1]
        self._phi = np.empty((0, 0))

    def read(self, z: Float[np.ndarray, "n m"], u: Float[np.ndarray, "nu m"]) -> Float[np.ndarray, "nphi m"]:
        """Return φ(z, u), a column for each column of z and u."""
        phi = np.empty((len(self.order), z.shape[1]))
        phi[self.order] = self.fill(z, u)
        return phi

    def fill(self, z: Float[np.ndarray, "n m"], u: Float[np.ndarray, "nu m"]) -> Float[np.ndarray, "nphi m"]:
        """Return φ(z, u) with its entries in `order`, shorter products first, in an array that the next call fills."""
        model, n = self._model, len(z)
        if self._phi.shape[1] != z.shape[1]:
            self._phi = np.ones((len(self.order), z.shape[1]))
        phi = self._phi
        phi[1 : 1 + n], phi[1 + n : 1 + n + len(u)] = z, u
        for rows, shorter, last in self._blocks:
            np.multiply(phi[shorter], phi[last], out=phi[rows])
        if self._limited and len(self._curved) and (np.abs(z) > model.bound[:, None]).any():
            signals = phi[: 1 + n + len(u)].copy()
            signals[1 : 1 + n] = np.clip(z, -model.bound[:, None], model.bound[:, None])
            phi[self._curved] = evaluate_terms(self._curved_terms, signals.T).T
        if model.V is not None:
            bent = phi[1 + len(model.terms) :]
            np.matmul(model.V[:, :-1], z, out=bent)
            np.tanh(np.add(bent, model.V[:, -1:], out=bent), out=bent)
        return phi


def is_nonlinear(terms: Terms, order: int) -> Bool[np.ndarray, " nt"]:
    """Return which terms have two factors of z or more."""
    return np.sum((terms > 0) & (terms <= order), axis=1) > 1


def _is_silent(y: Float[np.ndarray, "steps m ny"], data: RecordSegments) -> Bool[np.ndarray, "steps m ny"]:
    """Return which readings say nothing: they are at a rail and y lies beyond it."""
    assert data.low is not None
    assert data.high is not None
    return (data.low & (y < data.outputs)) | (data.high & (y > data.outputs))


def find_gap(y: Float[np.ndarray, "steps m ny"], data: RecordSegments) -> Float[np.ndarray, "steps m ny"]:
    """Return ŷ − y; zero where a reading says nothing."""
    gap = y - data.outputs
    return gap if data.low is None else np.where(_is_silent(y, data), 0.0, gap)
