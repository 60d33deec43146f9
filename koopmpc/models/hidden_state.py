"""HiddenState: an embedding whose point is the output and a hidden state with dynamics of its own."""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base.values import freeze
from koopmpc.data.delay import Delay
from koopmpc.lifting.base import Lifting


@dataclass(frozen=True, eq=False)
class HiddenState(Delay):
    """The point p_k = [y_k; z_k] with z⁺ = A ψ(p) + B u + Σ uᵢ Nᵢ ψ(p) + L (y⁺ − C ẑ⁺ − c), ẑ⁺ the part without L.

    In a forecast y⁺ is C ẑ⁺ + c itself, so L plays no part and z is the model's own. Where y⁺ is measured, L corrects
    z, as an observer does. Past rows give the first state, z_0 = T [ζ_0; 1] with ζ of a `Delay`. A reading at a rail
    with a prediction beyond it corrects nothing.

    Parameters
    ----------
    steps, inputs, rails
        As in `Delay`: the past rows from which z begins.
    lifting
        ψ, bound to the names of p.
    A, B, N
        (n, nz), (n, nu) and (nu, n, nz).
    C, c
        (ny, n) and (ny,), the output of z.
    encoder, reach
        T, (n, nζ + 1), and the largest |z_0| that it gives, (n,).
    gain
        L, (n, ny).
    """

    lifting: Lifting = field(kw_only=True)
    A: Float[np.ndarray, "n nz"] = field(kw_only=True)
    B: Float[np.ndarray, "n nu"] = field(kw_only=True)
    N: Float[np.ndarray, "nu n nz"] = field(kw_only=True)
    C: Float[np.ndarray, "ny n"] = field(kw_only=True)
    c: Float[np.ndarray, " ny"] = field(kw_only=True)
    encoder: Float[np.ndarray, "n nzeta1"] = field(kw_only=True)
    reach: Float[np.ndarray, " n"] = field(kw_only=True)
    gain: Float[np.ndarray, "n ny"] = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        names = ("A", "B", "N", "C", "c", "encoder", "reach", "gain")
        freeze(self, **{name: np.ascontiguousarray(getattr(self, name), dtype=np.float64) for name in names})

    @property
    def order(self) -> int:
        """Order n of the hidden state."""
        return len(self.A)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the outputs and of the entries of z."""
        return self.states + hidden_names(self.order)

    def repeat(self, x: Float[np.ndarray, " nx"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " npoint"]:
        """Return p of a plant that has shown x, under u, for so many steps."""
        return np.concatenate([x, self._encode(super().repeat(x, u))])

    def spread(self, states: Float[np.ndarray, " nx"], inputs: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " np"]:
        """Return the sizes of the entries of p; a hidden state has a spread of one."""
        return np.concatenate([states, np.ones(self.order)])

    def shift(
        self,
        zeta: Float[np.ndarray, "*batch npoint"],
        u: Float[np.ndarray, "*batch nu"],
        x_next: Float[np.ndarray, "*batch nx"],
    ) -> Float[np.ndarray, "*batch npoint"]:
        """Return p⁺ of one p or of rows: z goes on by its own dynamics, and follows x⁺ where that is a reading."""
        z, shown = self._advance(zeta, u), self.clip(x_next)
        expected = self.clip(z @ self.C.T + self.c)
        gap = shown - expected
        return np.concatenate([shown, z + np.where(np.isnan(gap), 0.0, gap) @ self.gain.T], axis=-1)

    def bridge(self, zeta: Float[np.ndarray, " npoint"], u: Float[np.ndarray, " nu"]) -> Float[np.ndarray, " npoint"]:
        """Return p⁺ where no reading has come: the model's own output takes its place."""
        z = self._advance(zeta, u)
        return np.concatenate([self.clip(self.C @ z + self.c), z])

    def symbolic(self, zeta: ca.SX, u: ca.SX, x_next: ca.SX) -> ca.SX:
        """Return p⁺ for symbolic columns p, u and x⁺."""
        psi = self.lifting.symbolic(zeta)
        z = ca.DM(self.A) @ psi + ca.DM(self.B) @ u
        for i, Ni in enumerate(self.N):
            z += u[i] * (ca.DM(Ni) @ psi)
        shown = self.clip_symbolic(x_next)
        gap = shown - self.clip_symbolic(ca.DM(self.C) @ z + ca.DM(self.c))
        return ca.vertcat(shown, z + ca.DM(self.gain) @ gap)

    def _advance(
        self, point: Float[np.ndarray, "*batch npoint"], u: Float[np.ndarray, "*batch nu"]
    ) -> Float[np.ndarray, "*batch n"]:
        psi = self.lifting(point.reshape(-1, point.shape[-1])).reshape(*point.shape[:-1], -1)  # any batch
        z = psi @ self.A.T + u @ self.B.T
        for i, Ni in enumerate(self.N):
            z += u[..., i : i + 1] * (psi @ Ni.T)
        return z

    def _encode(self, zeta: Float[np.ndarray, "*batch nzeta"]) -> Float[np.ndarray, "*batch n"]:
        return np.clip(zeta @ self.encoder[:, :-1].T + self.encoder[:, -1], -self.reach, self.reach)

    def _points(
        self, X: Float[np.ndarray, "rows nx"], U: Float[np.ndarray, "steps nu"]
    ) -> Float[np.ndarray, "points npoint"]:
        """Return the rows p_d … p_T, each z from the past rows alone."""
        zeta = super()._points(X, U)
        return np.hstack([zeta[:, : X.shape[1]], self._encode(zeta)])


def hidden_names(order: int) -> tuple[str, ...]:
    """Return the names of the entries of a hidden state."""
    return tuple(f"hidden {i}" for i in range(1, order + 1))
