"""Predictors with a hidden state and the same models in standard units, one from the other; segments of records."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.errors import DataError
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.lifting.base import Lifting, Sum
from koopmpc.lifting.composed import Projected, Saturated
from koopmpc.lifting.neurons import Neurons
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.models.base import FitReport
from koopmpc.models.hidden_state import HiddenState, hidden_names
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.models.records.forward import Terms, list_terms
from koopmpc.models.records.free_run import embed_rows, find_units
from koopmpc.models.records.hidden import HiddenModel, RecordSegments, join_segments, read_features, start_states
from koopmpc.models.shared.regression import compute_scale_factor


@dataclass(frozen=True)
class _GainSearch:
    """The search for the gain that corrects a hidden state."""

    observed: float = 0.999  # an observer's spectral radius is below this
    followed: int = 40  # steps in which readings correct the state
    forecast: int = 20  # steps of the forecasts behind them, which judge
    segments: int = 200  # of the records that judge, about
    alike: float = 1.05  # squared errors within this factor are alike
    far: float = 1e3  # a state stays within this many spreads
    passes: int = 300  # steps of the Riccati equation


_SEARCH = _GainSearch()
_RATIOS = tuple(10.0**power for power in range(-6, 5))  # variances of process noise beside that of the sensors


@dataclass(frozen=True, eq=False)
class SignalUnits:
    """Means and standard deviations of [y u], the rails of y in these units, and the number of outputs."""

    mean: Float[np.ndarray, " nv"]
    scale: Float[np.ndarray, " nv"]
    rails: Float[np.ndarray, "2 ny"] | None
    ny: int

    @classmethod
    def of(cls, episodes: Episodes, rails: Float[np.ndarray, "2 ny"] | None) -> "SignalUnits":
        """Return the units of these records."""
        mean, scale = find_units(episodes)
        ny = episodes.nx
        return cls(mean, scale, None if rails is None else (rails - mean[:ny]) / scale[:ny], ny)

    def apply(self, e: Episode) -> tuple[Float[np.ndarray, "rows1 ny"], Float[np.ndarray, "rows nu"]]:
        """Return outputs and inputs in these units."""
        ny = self.ny
        return (e.X - self.mean[:ny]) / self.scale[:ny], (e.U - self.mean[ny:]) / self.scale[ny:]

    def zeta(self, delays: int) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """Return mean and scale of ζ."""

        def repeat(v: Float[np.ndarray, " nv"]) -> Float[np.ndarray, " n"]:
            return np.concatenate([v[: self.ny], np.tile(np.roll(v, len(v) - self.ny), delays)])

        return repeat(self.mean), repeat(self.scale)


def is_hidden(model: LinearPredictor | BilinearPredictor) -> bool:
    """Return whether the model has a hidden state that `HiddenModel` can hold: [T ζ, 1], or a `HiddenState`."""
    if isinstance(model.embedding, HiddenState):
        return isinstance(model, BilinearPredictor)
    lifting = model.lifting
    return (
        isinstance(model, LinearPredictor)
        and model.nw == 0
        and model.embedding is not None
        and model.embedding.inputs
        and isinstance(lifting, Sum)
        and len(lifting.parts) == 2
        and isinstance(lifting.parts[0], Projected)
        and isinstance(lifting.parts[0].lifting, State)
        and lifting.parts[0].lifting.selects_all
        and isinstance(lifting.parts[1], Constant)
    )


def to_standard(model: LinearPredictor | BilinearPredictor, units: SignalUnits) -> HiddenModel:
    """Return a model with a hidden state in standard units; z itself is not scaled."""
    embedding, nu, ny = model.embedding, model.nu, model.nx
    assert embedding is not None, "a hidden state begins with past rows"
    mean_u, scale_u = units.mean[ny:], units.scale[ny:]
    if isinstance(embedding, HiddenState):
        n, psi = embedding.order, embedding.lifting
        A, B, N, T = embedding.A, embedding.B, embedding.N, embedding.encoder
        C = np.hstack([embedding.C, embedding.c[:, None]])
    else:
        assert isinstance(model.lifting, Sum)
        assert isinstance(model.lifting.parts[0], Projected)
        n, psi = model.nz - 1, model.lifting
        A, B, N, C = model.A[:n], model.B[:n], np.zeros((nu, n, n + 1)), model.C
        T = np.hstack([model.lifting.parts[0].basis.T, np.zeros((n, 1))])
    # in standard units z⁺ = (A + Σ ūᵢ Nᵢ) ψ + B ū + Σ v (scale B + scale N ψ), ψ = [z, 1, monomials]
    A = A + np.einsum("i,inz->nz", mean_u, N)
    A[:, n] += B @ mean_u
    V = _weights_of(psi)
    q = 0 if V is None else len(V)
    degree = max([1, *map(_degree_of, psi.names[n + 1 : psi.nz - q])])
    terms, places, width = _order_columns(n, nu, degree)
    count = len(places)
    E = np.zeros((n, 1 + len(terms) + q))
    E[:, :count], E[:, 1 + len(terms) :] = A[:, places], A[:, count:]
    for i, size in enumerate(scale_u):
        first = count + i * width
        E[:, first : first + width] = size * N[i][:, places[:width]]
        E[:, first] += size * B[:, i]
    mean, scale = units.zeta(embedding.steps)
    encoder = np.hstack([T[:, :-1] * scale, (T[:, -1] + T[:, :-1] @ mean)[:, None]])
    H = C / units.scale[:ny, None]
    H[:, -1] -= units.mean[:ny] / units.scale[:ny]
    bound = np.full(n, np.inf)
    if isinstance(embedding, HiddenState):
        bound = embedding.reach
    return HiddenModel(terms, E, H, encoder, bound, V)


def _weights_of(lifting: Lifting) -> Float[np.ndarray, "q n1"] | None:
    """Return the weights of the neurons that end a lifting; None without any."""
    last = lifting.parts[-1] if isinstance(lifting, Sum) else lifting
    return last.weights if isinstance(last, Neurons) else None


def _degree_of(name: str) -> int:
    """Return the total degree of a monomial by its name."""
    return sum(int(factor.partition("^")[2] or 1) for factor in name.partition("|")[0].split("*"))


def _order_columns(n: int, nu: int, degree: int) -> tuple[Terms, Int[np.ndarray, " count"], int]:
    """Return the terms of φ, the place in ψ = [z, 1, monomials] of its first columns, and how many each input has.

    φ begins with [1, z, monomials]; then each input multiplies the first ones of these.
    """
    terms, count = list_terms(n, nu, degree), 1 + len(list_terms(n, 0, degree))
    places = np.concatenate([[n], np.arange(n), np.arange(n + 1, count)]).astype(np.intp)
    return terms, places, (1 + len(terms) - count) // max(nu, 1)


def from_standard(
    found: HiddenModel, units: SignalUnits, episodes: Episodes, delays: int, report: FitReport | None
) -> LinearPredictor | BilinearPredictor:
    """Return the predictor: a linear one on [T ζ, 1], a nonlinear one with a `HiddenState`."""
    n, ny, nu, degree, q = found.order, units.ny, episodes.nu, found.terms.shape[1], len(found.neurons)
    mean_u, scale_u = units.mean[ny:], units.scale[ny:]
    mean, scale = units.zeta(delays)
    T = found.T[:, :-1] / scale
    encoder = np.hstack([T, (found.T[:, -1] - T @ mean)[:, None]])
    C = found.H * units.scale[:ny, None]
    C[:, -1] += units.mean[:ny]
    terms, places, width = _order_columns(n, nu, degree)
    count = len(places)
    A, N, B = np.zeros((n, count + q)), np.zeros((nu, n, count + q)), np.zeros((n, nu))
    A[:, places], A[:, count:] = found.E[:, :count], found.E[:, 1 + len(terms) :]
    for i in range(nu):
        first = count + i * width
        N[i][:, places[:width]] = found.E[:, first : first + width] / scale_u[i]
        B[:, i], N[i][:, n] = N[i][:, n], 0.0
    A = A - np.einsum("i,inz->nz", mean_u, N)
    A[:, n] -= B @ mean_u
    rails = None if units.rails is None else units.rails * units.scale[:ny] + units.mean[:ny]
    if degree == 1 and not q:
        return _build_linear((A, B, C, encoder), Delay(delays, rails=rails), episodes, report)
    gain = _fit_gain(found, units, episodes, delays) / units.scale[:ny]
    embedding = HiddenState(
        delays,
        rails=rails,
        bound=(episodes.states, episodes.inputs),
        lifting=_build_lifting(found, ny).bind((*episodes.states, *hidden_names(n))),
        A=A,
        B=B,
        N=N,
        C=C[:, :-1],
        c=C[:, -1],
        encoder=encoder,
        reach=found.bound,
        gain=gain,
    )
    nz = count + q
    whole, output = np.zeros((nz, nz)), np.zeros((ny, nz))
    whole[:n], whole[n, n], output[:, : n + 1] = A, 1.0, C
    products = np.zeros((nu, nz, nz))
    products[:, :n] = N
    Z = np.concatenate([embedding.lifting(e.X[:-1]) for e in embedding(episodes)])
    return BilinearPredictor(
        whole,
        np.vstack([B, np.zeros((nz - n, nu))]),
        products,
        output,
        embedding.lifting,
        episodes.dt,
        episodes.states,
        episodes.inputs,
        report,
        embedding=embedding,
        scale=compute_scale_factor(Z, len(Z)),
    )


def _build_lifting(found: HiddenModel, ny: int) -> Lifting:
    """Return ψ(p) = [z, 1, monomials, neurons] of a point p = [y; z]."""
    names, degree = hidden_names(found.order), found.terms.shape[1]
    lifting: Lifting = State(names) + Constant()
    if degree > 1:
        monomials: Lifting = Monomials(degree, states=names)
        if np.isfinite(found.bound).all():
            high = np.concatenate([np.full(ny, np.inf), found.bound])
            monomials = Saturated(monomials, -high, high)
        lifting = lifting + monomials
    return lifting if found.V is None else lifting + Neurons(found.V, states=names)


def _build_linear(
    matrices: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    delay: Delay,
    episodes: Episodes,
    report: FitReport | None,
) -> LinearPredictor:
    """Return the model on z = T ζ without an offset: z less the offset of the encoder takes the place of z."""
    (A, B, C, encoder), n = matrices, len(matrices[0])
    T, offset = encoder[:, :-1], encoder[:, -1]
    A[:, n] += A[:, :n] @ offset - offset
    C[:, -1] += C[:, :-1] @ offset
    bound = delay.bind(episodes.states, episodes.inputs)
    psi = (Projected(State(), np.ascontiguousarray(T.T)) + Constant()).bind(bound.names)
    Z = np.concatenate([psi(e.X[:-1]) for e in bound(episodes)])
    return LinearPredictor(
        np.vstack([A, np.eye(1, n + 1, n)]),
        np.vstack([B, np.zeros((1, B.shape[1]))]),
        C,
        psi,
        episodes.dt,
        episodes.states,
        episodes.inputs,
        report,
        embedding=bound,
        scale=compute_scale_factor(Z, len(Z)),
    )


def _fit_gain(found: HiddenModel, units: SignalUnits, episodes: Episodes, delays: int) -> Float[np.ndarray, "n ny"]:
    """Return the fastest L of z + L (y − ŷ) after which the records are forecast as well as with any.

    Candidates are steady Kalman gains of the linear part, for process noise from far below to far above that of the
    sensors. Each follows segments of the records for 40 steps; the error of the next 20 steps decides.
    """
    n, ny, A, C = found.order, units.ny, found.E[:, 1 : 1 + found.order], found.H[:, :-1]
    gains = [_steady_gain(A, C, ratio) for ratio in _RATIOS]
    gains = [one for one in gains if np.abs(np.linalg.eigvals(A - one @ C @ A)).max() < _SEARCH.observed]
    if not gains:
        return np.zeros((n, ny))
    steps = max(min(_SEARCH.followed + _SEARCH.forecast, max(map(len, episodes)) - delays), 1)
    apart = max(steps // 2, sum(map(len, episodes)) // _SEARCH.segments, 1)
    part = join_segments(cut_segments(episodes, units, delays, steps, apart))
    followed = steps - min(_SEARCH.forecast, -(-steps // 3))
    errors: list[float] = []
    for gain in gains:
        z, total = start_states(found, part.points), 0.0
        for k, (u, y) in enumerate(zip(part.inputs, part.outputs, strict=True)):
            z = np.clip(read_features(found, z, u) @ found.E.T, -_SEARCH.far, _SEARCH.far)
            shown = z @ C.T + found.H[:, -1]
            if units.rails is not None:
                shown = np.clip(shown, *units.rails)
            if k < followed:
                z = z + (y - shown) @ gain.T
            else:
                total += float(np.sum((y - shown) ** 2))
        errors.append(total)
    return gains[max(i for i, error in enumerate(errors) if error <= _SEARCH.alike * min(errors))]


def _steady_gain(A: Float[np.ndarray, "n n"], C: Float[np.ndarray, "ny n"], ratio: float) -> Float[np.ndarray, "n ny"]:
    """Return the steady Kalman gain for process noise of this variance and sensors with noise of variance one."""
    n, ny = len(A), len(C)
    P, gain = ratio * np.eye(n), np.zeros((n, ny))
    for _ in range(_SEARCH.passes):
        gain = np.linalg.solve(C @ P @ C.T + np.eye(ny), C @ P).T
        P = A @ (P - gain @ C @ P) @ A.T + ratio * np.eye(n)
    return gain


def cut_segments(
    episodes: Episodes,
    units: SignalUnits,
    delays: int,
    horizon: int,
    apart: int,
    spans: Sequence[tuple[int, int]] | None = None,
) -> list[RecordSegments]:
    """Return segments of `horizon` steps that begin every `apart` rows, inside of the spans of rows."""
    found: list[RecordSegments] = []
    ny, nu = units.ny, episodes.nu
    spans = [(0, len(e)) for e in episodes] if spans is None else spans
    for e, (a, b) in zip(episodes, spans, strict=True):
        first = max(a - delays, 0)
        if b - max(a, delays) < max(horizon, 1):
            continue
        part = e.cut(first, b)
        V, Y = embed_rows(*units.apply(part), delays)
        zeta, U = V[:, 1 : 1 + ny + delays * len(units.mean)], V[:, -nu:] if nu else V[:, :0]
        starts = np.arange(0, len(zeta) - horizon + 1, apart)
        rows = np.arange(horizon)[:, None] + starts
        outputs = Y[rows]
        low = high = None
        if units.rails is not None:
            low, high = outputs <= units.rails[0] + 1e-9, outputs >= units.rails[1] - 1e-9
        found.append(RecordSegments(zeta[starts], U[rows], outputs, low, high))
    if not found:
        raise DataError(
            f"no record has the {horizon + delays} rows of a segment and its past; pass a shorter horizon, fewer "
            "delays, or longer records"
        )
    return found
