"""Cost: the quadratic cost that every controller and every metric shares."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.errors import DataError
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.state import State
from koopmpc.values import Value


@dataclass(frozen=True, eq=False)
class Cost(Value):
    """Σ_{k=1}^{N−1} ‖of(x_k) − r_k‖²_Q + Σ_{k=0}^{N−1} (‖u_k − u_r‖²_R + ‖u_k − u_{k−1}‖²_{R_delta}) + terminal weight.

    The terminal term is ‖z_N − z_r‖²_{Q_N}, or ‖x_N − r_N‖²_{Q_N} for an (nx, nx) weight. By default Q_N is the P
    of the infinite horizon; with R_delta that P weighs [z_N − z_r; u_{N−1} − u_r], for u_N has its price too.

    Parameters
    ----------
    Q
        Weight of the tracked outputs, ⪰ 0; a scalar or a vector is a diagonal.
    R
        Weight of the inputs, ⪰ 0; a scalar or a vector is a diagonal. R + BᵀPB must be positive definite.
    Q_N
        Terminal weight, (nx, nx) or (nz, nz). None takes the limit of the Riccati difference equation.
    of
        The tracked outputs as observables of the state; the references have as many columns. A controller on a
        lifted predictor finds them in its own lifting by name: any lifted coordinates may be tracked.
    u_target
        "equilibrium": u_r holds the reference, found for each reference inside the limits; "zero": u_r = 0.
    R_delta
        Weight of the changes of the inputs from step to step, ⪰ 0; a scalar or a vector is a diagonal.

    Raises
    ------
    DefinitenessError
        A weight is indefinite or not symmetric.
    """

    Q: ArrayLike
    R: ArrayLike
    Q_N: ArrayLike | None = None
    of: Lifting = field(default_factory=State)
    u_target: Literal["equilibrium", "zero"] = "equilibrium"
    R_delta: ArrayLike | None = None

    def __post_init__(self) -> None:
        checks.kind(self.of, "of", Lifting, 'for example km.State("theta"), or km.Fourier(1, states="theta")')
        for name in ("Q", "R", "Q_N", "R_delta"):
            value = getattr(self, name)
            if value is None and name in ("Q", "R"):
                raise DataError(f"{name} is None; pass a weight, 0 for none")
            if value is not None:
                stored = checks.array(value, name)
                checks.weight(stored, name)
                object.__setattr__(self, name, stored)
        if self.u_target not in ("equilibrium", "zero"):
            raise DataError(f'u_target is {self.u_target!r}; pass "equilibrium" or "zero"')

    def matrices(self, nr: int, nu: int) -> tuple[Float[np.ndarray, "nr nr"], Float[np.ndarray, "nu nu"]]:
        """Return Q (nr, nr) and R (nu, nu) for `nr` tracked outputs and `nu` inputs."""
        return checks.weight(self.Q, "Q", nr), checks.weight(self.R, "R", nu)

    def rate(self, nu: int) -> Float[np.ndarray, "nu nu"] | None:
        """Return R_delta (nu, nu), None where the changes of the inputs cost nothing."""
        if self.R_delta is None:
            return None
        R_delta = checks.weight(self.R_delta, "R_delta", nu)
        return R_delta if R_delta.any() else None
