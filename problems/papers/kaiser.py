"""Kaiser, Kutz & Brunton 2021: control in Koopman eigenfunctions.

E. Kaiser, J. N. Kutz and S. Brunton, *Data-Driven Discovery of Koopman Eigenfunctions for Control*, Mach. Learn.: Sci.
Technol. 2 (2021), called KRONIC there.

A conserved energy H is an eigenfunction with λ = 0, so Ḣ = ∇H·B u: a scalar system, whose LQR is a formula. For
Q = R = 1 it is u = −sign(∇H·B) (H − H_r); J = ∫ (H − H_r)² + u² dt. Pendulum ẋ = [x₂; −sin x₁] + B u from [.5, .5],
100 s; double well ẋ = [x₂; x₁ − x₁³ + u], 25 s; the feedback is `km.control.EigenfunctionLQR`, continuous inside the
integration, and beside it sampled at 0.01 s in the library's own loop.

Discovery: `km.identify.eigenfunctions` on one unforced trajectory of the double well (from [0, −2.8], 10 s at 0.01 s),
with monomials to degree 4. One fit takes the null space of Γ(x, ẋ) with ẋ from differences of fourth order, as in the
paper; the other takes that of ψ(x⁺) − ψ(x). EDMDc on the same monomials is fitted to the paper's forced trajectory,
u = 2 sin(0.2πt) sin(2πt), held over each sample. The asymmetric well, H = x₂²/2 + x₁⁴/4 − x₁²/2 − a x₁³/3 + a x₁ with
a = −¼, and the quartic one, H = x₂²/2 + x₁⁴/4, have two inputs, B = I, as in the authors' code.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

import koopmpc as km
from koopmpc import papers

from .plants import integrate_closed_loop, integrate_trajectories

DT = 0.01  # sample time [s]
KNOWN = {  # J of the pendulum in the paper by B and H_r, and the rounding of its digits
    ("[0; 1]", 1.0): (3.996, 0.005), ("[0; 1]", 0.0): (1.208, 0.005), ("[0; 1]", 2.0): (7.274, 0.005),
    ("[0; 1]", -1.0): (0.2355, 0.0005), ("[1; 0]", 1.0): (3.616, 0.005), ("[1; 0]", 0.0): (0.764, 0.0005),
    ("[1; 0]", 2.0): (10.16, 0.05), ("[1; 0]", -1.0): (0.1593, 0.0005),
}  # fmt: skip
WELLS = {(-2.0, 2.5): (11.58, 0.05), (0.0, 2.5): (5.280, 0.005), (2.5, 0.001): (35.70, 0.05)}
A = -0.25  # a in the energy of the asymmetric well
SADDLE = float(np.sort(np.roots([1.0, -A, -1.0, A]))[1])
POTENTIALS: dict[str, Callable[[ca.SX], ca.SX]] = {
    "pendulum": lambda q: -ca.cos(q),
    "double well": lambda q: q**4 / 4 - q**2 / 2,
    "asymmetric well": lambda q: q**4 / 4 - q**2 / 2 - A / 3 * q**3 + A * q,
    "quartic well": lambda q: q**4 / 4,
}
MATRICES = {"[0; 1]": ((0.0,), (1.0,)), "[1; 0]": ((1.0,), (0.0,)), "I": ((1.0, 0.0), (0.0, 1.0))}
LIBRARY = km.State() + km.Monomials(4) + km.Constant()


def reproduce_kaiser(page: papers.Page, quick: bool, progress: papers.TellPart) -> list[papers.Claim]:
    """Control known energies, find energies in data, and control by the energies from data."""
    progress("costs of the pendulum and of the double well")
    claims, energies = _control_known_energies(page, quick)
    papers.draw_curves(page, "energy", "Energy of the pendulum, B = [0; 1]", DT, ("H",), energies)
    progress("discovery")
    found = _discover_energy(page, claims)
    progress("control of what was found")
    _control_found_energies(page, claims, found)
    return claims


def make_energy(name: str) -> km.Lifting:
    """Return H = x₂²/2 + V(x₁) of a plant, as a lifting of one observable."""
    return km.Expressions(lambda x: [x[1] ** 2 / 2 + POTENTIALS[name](x[0])], ["H"]).bind(Well.states)


@dataclass(frozen=True)
class Well(km.Dynamics):
    """ẋ = [x₂; −V′(x₁)] + B u, with H = x₂²/2 + V(x₁)."""

    states = ("x1", "x2")
    inputs = ("u",)

    name: str  # of the potential V
    B: tuple[tuple[float, ...], ...] = ((0.0,), (1.0,))

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [∂H/∂x₂; −∂H/∂x₁] + B u."""
        return ca.vertcat(x[1], -ca.gradient(POTENTIALS[self.name](x[0]), x[0])) + ca.DM(self.B) @ u


class TwoInputs(Well):
    """A well with an input for each state."""

    inputs = ("u0", "u1")


def make_controller(
    H: km.Lifting, B: str, R: float = 1.0, eigenvalue: float | None = 0.0
) -> km.control.EigenfunctionLQR:
    """Return the controller of H with Q = 1."""
    return km.control.EigenfunctionLQR(H, km.Cost(Q=1.0, R=R, of=H), dt=DT, B=MATRICES[B], eigenvalue=eigenvalue)


def _control_known_energies(page: papers.Page, quick: bool) -> tuple[list[papers.Claim], dict[str, np.ndarray]]:
    cases: list[tuple[str, str, Sequence[float], float, float, tuple[float, float]]] = [
        ("pendulum", B, (0.5, 0.5), target, 100.0, known) for (B, target), known in KNOWN.items()
    ]
    cases += [("double well", "[0; 1]", start, 0.0, 25.0, known) for start, known in WELLS.items()]
    claims: list[papers.Claim] = []
    rows: list[tuple[object, ...]] = []
    curves: dict[str, np.ndarray] = {}
    arrivals: list[float] = []
    for name, B, start, target, seconds, (known, spread) in cases:
        H, plant = make_energy(name), Well(name, MATRICES[B])
        law = make_controller(H, B)
        run = integrate_closed_loop(
            plant,
            lambda x, law=law, r=target: law.law(x, r),
            lambda x, u, H=H, r=target: (H.symbolic(x) - r) ** 2 + ca.sumsqr(u),
            start,
            dt=DT,
            seconds=seconds,
        )
        where = f"{name}, B = {B}, from {[*start]}, H_r = {target:g}"
        claims.append(papers.compare_value(f"J: {where}", known, run.cost, spread, digits=4))
        off = np.abs(H(run.X)[:, 0] - target)
        late = np.flatnonzero(off > 1e-3)
        arrived = DT * (late[-1] + 1) if len(late) and late[-1] + 1 < len(off) else np.nan
        if name == "pendulum" and target != -1:
            arrivals.append(float(arrived))
        if name == "pendulum" and B == "[0; 1]":
            curves[f"H_r = {target:g}"] = H(run.X)[:4001]
        sampled = _simulate_sampled(law, plant, H, start, target, 2.0 if quick else seconds)
        rows.append((where, f"{run.cost:.4g}", "–" if quick else f"{sampled:.4g}", f"{arrived:.4g}", f"{off[-1]:.1e}"))
    page.text("## Known energies", "*Within* is the time from which on |H − H_r| < 10⁻³.")
    page.table(("plant", "J", "J in the sampled loop", "within [s]", "|H − H_r| at the end"), rows)
    says = "H stays within 1e-3 of H_r, from 5 to 12 s on, except for H_r = −1"
    why = f"from {min(arrivals):.1f} to {max(arrivals):.1f} s on"
    claims.append(
        papers.judge_claim("pendulum", says, holds=min(arrivals) > 4.5 and max(arrivals) < 12.5, why=why, required=True)
    )
    return claims, curves


def _simulate_sampled(
    law: km.control.EigenfunctionLQR, plant: Well, H: km.Lifting, start: Sequence[float], target: float, seconds: float
) -> float:
    """Return J in the library's closed loop, where the input is constant over each sample."""
    step_map = km.discretize(plant, DT, km.RK4(2))
    run = km.simulate(step_map, law, x0=start, reference=[target], steps=round(seconds / DT), cost=law.cost)
    e = H(run.X)[:, 0] - target
    return DT * float(np.sum((e[1:] ** 2 + e[:-1] ** 2) / 2) + np.sum(run.U**2))


def _discover_energy(page: papers.Page, claims: list[papers.Claim]) -> Any:
    """Find H of the double well by eigenfunctions and by EDMDc of the same degree; return φ from forced data."""
    plant = Well("double well")
    one = integrate_trajectories(plant, [0.0, -2.8], dt=DT, steps=1000)
    t = DT * np.arange(1000)
    u = 2 * np.sin(0.2 * np.pi * t) * np.sin(2 * np.pi * t)
    forced = km.collect(
        km.discretize(plant, DT, km.RK4(4)), [0.0, -2.8], lambda k, y, rng: u[[k]], episodes=1, steps=1000
    )
    others = integrate_trajectories(plant, np.random.default_rng(0).uniform(-1.5, 1.5, (20, 2)), dt=DT, steps=500)
    found = {
        "differences": km.identify.eigenfunctions(one, LIBRARY, by="derivatives", held_out=others)[0],
        "steps": km.identify.eigenfunctions(one, LIBRARY, held_out=others)[0],
        "forced data": km.identify.eigenfunctions(forced, LIBRARY, held_out=_add_zero_inputs(others))[0],
    }
    names = found["steps"].lifting.names
    exact = np.zeros(len(names))
    exact[[names.index(name) for name in ("x1^2", "x2^2", "x1^4")]] = -1.0, 1.0, 0.5
    for (name, phi), spread in zip(found.items(), (1e-6, 1e-9, 1e-3), strict=True):
        c = phi.coefficients[0]
        rest = int(np.sum(c[exact == 0] != 0))
        claims += [
            papers.compare_value(f"φ from {name}: x₁², x₂², x₁⁴", [-1.0, 1.0, 0.5], c[exact != 0], spread, digits=4),
            papers.judge_claim(
                f"φ from {name}", "no other observable", holds=not rest, why=f"{rest} others", required=True
            ),
        ]
    unit = found["differences"].coefficients[0]
    unit = unit / np.linalg.norm(unit)
    claims.append(
        papers.compare_value("φ from differences, of length 1", [-2 / 3, 2 / 3], unit[exact != 0][:2], 1e-5, digits=5)
    )
    with km.errors.hide_fit_warnings():
        model = km.edmd(forced, LIBRARY)
    H = np.array([make_energy("double well")(e.X)[0, 0] for e in others])
    told = {"EDMDc, H = cᵀz": _predict_energy(model, others, exact)}
    told |= {f"φ from {name}": np.array([phi.values(e.X) / 2 for e in others]) for name, phi in found.items()}
    later = (10, 100, 500)
    errors = {
        name: [float(np.sqrt(np.mean((values[:, k] - H) ** 2)) / H.std()) for k in later]
        for name, values in told.items()
    }
    page.text(
        "## Discovery",
        """What each model makes of H along 20 unforced trajectories that it was not fitted to, started in [−1.5, 1.5]²:
        the root-mean-square of Ĥ(t) − H as a share of the standard deviation of H over them. A conserved H stays.""",
    )
    page.table(
        ("model", *(f"after {DT * k:g} s [%]" for k in later)),
        [(name, *map(papers.percent, each)) for name, each in errors.items()],
    )
    claims.append(
        papers.judge_claim(
            "EDMDc of the same degree on forced data",
            "does not carry H",
            holds=errors["EDMDc, H = cᵀz"][-1] > 100 * errors["φ from forced data"][-1],
            why=f"after 5 s H is off by {papers.percent(errors['EDMDc, H = cᵀz'][-1])} %,"
            f" by φ from the same data {papers.percent(errors['φ from forced data'][-1])} %",
            required=True,
        )
    )
    return found["forced data"]


def _add_zero_inputs(data: km.Episodes) -> km.Episodes:
    """Return the episodes with an input that is 0."""
    return km.Episodes(
        [km.Episode(X=e.X, U=np.zeros((len(e.X) - 1, 1))) for e in data], data.dt, data.states, Well.inputs
    )


def _predict_energy(model: km.LinearPredictor, data: km.Episodes, c: np.ndarray) -> np.ndarray:
    """Return cᵀ Aᵏ ψ(x₀) / 2 of each episode."""
    Z = model.lift(np.array([e.X[0] for e in data]))
    rows = [Z @ c / 2]
    for _ in range(len(data[0].U)):
        Z = Z @ model.A.T
        rows.append(Z @ c / 2)
    return np.column_stack(rows)


def _control_found_energies(page: papers.Page, claims: list[papers.Claim], phi: Any) -> None:
    """Control the double well by φ from forced data, and the two other wells by φ from two unforced trajectories."""
    H = phi.scaled(0.5, "H")
    law = km.control.EigenfunctionLQR(H, km.Cost(Q=1.0, R=1.0, of=H), dt=DT)
    run = integrate_closed_loop(
        Well("double well"),
        lambda x: law.law(x, 0.0),
        lambda x, u: make_energy("double well").symbolic(x) ** 2 + ca.sumsqr(u),
        (-2.0, 2.5),
        dt=DT,
        seconds=25.0,
    )
    claims.append(papers.compare_value("J from [-2, 2.5] by φ from forced data", 11.58, run.cost, 0.05, digits=4))
    curves: dict[str, np.ndarray] = {}
    for name, start, R in (("quartic well", (0.001, 0.001), 1.0), ("asymmetric well", (-1.1, 0.0), 0.05)):
        plant, other = TwoInputs(name, MATRICES["I"]), (0.3, -0.9)
        data = integrate_trajectories(Well(name), [other, (-1.0, 0.5)], dt=DT, steps=1000)
        (H,) = km.identify.eigenfunctions(data, LIBRARY)
        H = H.scaled(0.5 / H.coefficients[0, H.lifting.names.index("x2^2")], "H")
        loop, step = make_controller(H, "I", R, None), km.discretize(plant, DT, km.RK4(2))
        top, low = (float(H([q, 0.0])[0]) for q in (SADDLE, 1.0))
        X = [np.array(start)]
        for _ in range(4000):
            target = 0.15 - float(make_energy(name)([0.0, 0.0])[0]) if name == "quartic well" else low
            if name == "asymmetric well" and X[-1][0] < SADDLE + 0.05:
                target = top + 0.02  # over the saddle first
            X.append(step(X[-1], loop(X[-1], [target]).u))
        curves[name] = np.column_stack([np.array(X), H(np.array(X))])
        x, last = np.array(X)[-1], float(H(np.array(X)[-1])[0])
        says, holds, why = "H is held at 0.15", abs(last - 0.15) < 1e-3, f"H = {last:.4f} at the end"
        if name == "asymmetric well":
            says, why = (
                "from rest in the upper well to rest in the lower one",
                f"x = [{x[0]:.3f}, {x[1]:.3f}] at the end",
            )
            holds = bool(np.linalg.norm(x - [1.0, 0.0]) < 0.1)
        claims.append(papers.judge_claim(f"{name}, φ from two trajectories", says, holds=holds, why=why, required=True))
    papers.draw_curves(
        page, "wells", "Asymmetric and quartic well, by their φ from data", DT, ("x₁", "x₂", "H"), curves
    )


paper = papers.make_paper("kaiser", __doc__, reproduce_kaiser)
