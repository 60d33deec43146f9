"""Feedback on one Koopman eigenfunction, an energy say: EigenfunctionLQR."""

from collections.abc import Callable
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.checks import HUGE
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.control.ask.checks import FEEDBACK_FIELDS
from koopmpc.control.ask.cost import Cost, check_cost_and_limits, refuse_stage, refuse_steps
from koopmpc.control.ask.limits import Limits, require_known
from koopmpc.control.kinds import ControllerKind, register_controller
from koopmpc.control.move import Move, alone
from koopmpc.control.program import Restored, SavedController
from koopmpc.control.step.feedback import FeedbackLaw
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Eigenfunction
from koopmpc.plants.graph import Graph
from koopmpc.plants.routines import Buffered


class EigenfunctionLQR(FeedbackLaw):
    """u = u_r − R⁻¹ bᵀ k e with e = φ(x) − φ_r, b = β(x) and k = (λ + √(λ² + Q g)) / g, g = b R⁻¹ bᵀ.

    An eigenfunction obeys φ̇ = λ φ + β(x) u. With b held at its present value this is a scalar linear system, and k is
    its Riccati solution for ∫ Q e² + uᵀ R u dt. For a conserved energy, λ = 0, and one input it is
    u = −sign(b) √(Q/R) (φ − φ_r). The input u_r = −R⁻¹ bᵀ λ φ_r / g holds the reference; with u_target="zero" there is
    none. Where b = 0 no input moves φ, and u is 0. The input is clipped to the limits of its change and to its own
    (status SATURATED); other limits are not seen.

    One thread at a time may call it: a second one gets a ThreadError, and needs a copy of its own.

    Parameters
    ----------
    eigenfunction
        A real one of `km.identify.eigenfunctions`; or any bound lifting of one observable,
        ``km.Expressions(…).bind(states)`` say, with its `eigenvalue`.
    cost
        Q and R, and ``of`` this eigenfunction: the reference is φ_r. Q_N and tail have no meaning here.
    limits
        Input and rate limits.
    dt
        Sampling time [s] of the loop. The formula is for a continuous feedback: take a dt that is short against 1/|λ|
        and 1/(Q g / R)^½.
    B
        ∂ẋ/∂u, (nx, nu), or a function of the symbolic state x that returns it; then β = ∇φ·B. By default β is the one
        that was found together with the eigenfunction, from data with inputs.
    eigenvalue
        λ [1/s] of a lifting that is no Eigenfunction.

    Raises
    ------
    DataError
        The eigenfunction is complex, or its eigenvalue or the effect of the input is not known; the cost is of other
        outputs, has an R_delta, a u_target in numbers, a price, a stage or rows of weights; limits have rows in time.
    ShapeError
        B does not have a row for each state.
    DefinitenessError
        R is not positive definite.

    References
    ----------
    Kaiser, Kutz & Brunton, "Data-driven discovery of Koopman eigenfunctions for control", Mach. Learn.: Sci.
    Technol. 2, 2021 (KRONIC).
    """

    @raise_swallowed()
    def __init__(
        self,
        eigenfunction: Lifting,
        cost: Cost,
        limits: Limits | None = None,
        *,
        dt: float,
        B: ArrayLike | Callable[[ca.SX], ca.SX] | None = None,
        eigenvalue: float | None = None,
    ) -> None:
        checks.kind(eigenfunction, "eigenfunction", Lifting, "find one with km.identify.eigenfunctions")
        if eigenfunction.nz != 1:
            raise DataError(
                f"the eigenfunction has {eigenfunction.nz} observables ({', '.join(eigenfunction.names)}); pass a real"
                " one: of a complex φ, |φ|² is a real eigenfunction of 2 Re λ, to be found with eigenvalue=2 Re λ"
            )
        self.eigenfunction, self.cost, self.limits, self._B = eigenfunction, cost, limits, B
        if eigenvalue is None:
            if not isinstance(eigenfunction, Eigenfunction):
                raise DataError("eigenvalue is missing; pass that of the observable, 0 for a conserved quantity")
            eigenvalue = eigenfunction.rates[0]
        self._rate = float(eigenvalue)
        tracked = cost.of.bind(eigenfunction.bound_states).names
        if tracked != eigenfunction.names:
            raise DataError(
                f"the cost is of {', '.join(tracked)}, the controller moves {eigenfunction.names[0]}; pass a Cost(…,"
                " of=…) of the eigenfunction"
            )
        if cost.R_delta is not None or not isinstance(cost.u_target, str):
            raise DataError('the cost has an R_delta or a u_target in numbers; this formula takes Q, R and "zero"')
        x, aim = ca.SX.sym("x", len(eigenfunction.bound_states)), ca.SX.sym("phi_r")
        self._beta = ca.Function("beta", [x], [ca.densify(self._effect(x, B))])
        nu = int(self._beta.size2_out(0))
        self.cost, sized = check_cost_and_limits(cost, limits, eigenfunction.bound_states, [f"u{i}" for i in range(nu)])
        refuse_steps(self.cost, sized)
        refuse_stage(self.cost, "an EigenfunctionLQR")
        weights = cost.matrices(1, nu)
        self._Q = float(weights[0][0, 0])
        self._R_inverse = np.linalg.inv(checks.weight(weights[1], "R", nu, definite=True))
        kept = ca.if_else(ca.sum1(ca.fabs(x)) < HUGE, 1.0, np.nan) * x
        both = ca.densify(ca.vertcat(eigenfunction.symbolic(kept), self.law(kept, aim)))
        self._read = Buffered(ca.Function("u", [x, aim], [both], {"cse": True}))
        require_known(sized, "an EigenfunctionLQR", FEEDBACK_FIELDS)
        super().__init__(checks.positive(dt, "dt", "s"), x.numel(), sized.inputs(nu), sized.rates(nu))

    @raise_swallowed()
    def as_data(self) -> SavedController:
        """Return what the controller was made of; a function B becomes its graph.

        Raises
        ------
        DataError
            B holds an operation that cannot be written as data.
        """
        x, B = ca.SX.sym("x", self._nx), self._B
        if callable(B):
            B = Graph.trace(ca.Function("B", [x], [ca.densify(ca.vec(ca.SX(B(x))))], {"cse": True}))
        options = {"eigenfunction": self.eigenfunction, "dt": self.dt, "B": B, "eigenvalue": self._rate}
        return SavedController("EigenfunctionLQR", None, self.cost, self.limits, options=options)

    @classmethod
    def from_data(cls: type[Restored], saved: SavedController) -> Restored:
        """Return the controller that is made of these data."""
        options = dict(saved.options)
        graph = options["B"]
        if isinstance(graph, Graph):
            nx = graph.n

            def B(x: ca.SX) -> ca.SX:
                return ca.SX(ca.reshape(graph.symbolic(x), nx, -1))

            options["B"] = B
        build: Any = cls
        return build(options.pop("eigenfunction"), saved.cost, saved.limits, **options)

    def _effect(self, x: ca.SX, B: ArrayLike | Callable[[ca.SX], ca.SX] | None) -> ca.SX:
        """Return β(x), (1, nu)."""
        phi = self.eigenfunction
        if B is None:
            if not isinstance(phi, Eigenfunction) or not phi.nu:
                raise DataError(
                    "nothing says how inputs move the eigenfunction; pass B, or find it in data with inputs"
                )
            return phi.effect(x)
        matrix = ca.SX(B(x)) if callable(B) else ca.SX(ca.DM(checks.array(B, "B", (x.shape[0], None))))
        if matrix.shape[0] != x.shape[0]:
            raise ShapeError(f"B(x) has {matrix.shape[0]} rows, expected {x.shape[0]}, one a state")
        return ca.jacobian(phi.symbolic(x), x) @ matrix

    def law(self, x: ca.SX, phi_r: ca.SX | float) -> ca.SX:
        """Return u_r − R⁻¹ bᵀ k e, (nu, 1), without limits, in CasADi operations."""
        b, rate, Q = self._beta(x), self._rate, self._Q
        along = ca.DM(self._R_inverse) @ b.T
        g = b @ along
        moved = g > 1e-24  # below, no input moves φ
        size = ca.if_else(moved, g, 1.0)
        root = ca.sqrt(rate**2 + Q * size)
        k = (rate + root) / size if rate > 0 else Q / (root - rate + 1e-300)  # the same, without a difference
        hold = rate * phi_r / size if self.cost.u_target == "equilibrium" else 0.0
        return ca.SX(ca.if_else(moved, 1.0, 0.0) * -along * (k * (self.eigenfunction.symbolic(x) - phi_r) + hold))

    @alone
    def __call__(
        self,
        y: ArrayLike,
        reference: ArrayLike,
        applied: ArrayLike | None = None,
        w: ArrayLike | None = None,
    ) -> Move:
        """Return u for state y and φ_r, (1,), or rows of which the first counts; `w` is not seen."""
        start = perf_counter()
        x = checks.array(y, "y", (len(self.eigenfunction.bound_states),), finite=False)
        aim = float(checks.reference_rows(checks.numbers(reference, "reference"), 0, 1)[0, 0])
        self.take_applied(applied)
        both = self._read(x, np.array([aim]))[0]
        return self.limit_input(both[1:] if (np.abs(both) < HUGE).all() and abs(aim) < HUGE else None, start)


register_controller(ControllerKind(EigenfunctionLQR))
