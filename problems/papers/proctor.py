"""Three papers of Brunton, Proctor & Kutz: an exact lifting, DMD with control, and observables of the inputs."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any, cast

import casadi as ca
import numpy as np
from scipy.linalg import logm

import koopmpc as km
from koopmpc import papers

from .plants import integrate_closed_loop

# The slow manifold
START = (-5.0, 5.0)
SECONDS = 50.0  # length of a run [s]
DT = 0.01  # sample time [s]
# DMD with control: the paper's data (rows are samples) and its plant x⁺ = A x + B u
X = np.array([[4.0, 2.0, 1.0, 0.5, 0.25], [7.0, 0.7, 0.07, 0.007, 0.0007]]).T
U = np.array([[-4.0, -2.0, -1.0, -0.5]]).T
A = np.diag([1.5, 0.1])
B = np.array([[1.0], [0.0]])
FREE = np.array([1.0, 1.0])  # start of the runs without input


def reproduce_brunton(page: papers.Page, quick: bool, progress: papers.TellPart) -> list[papers.Claim]:
    """Brunton et al. 2016: the slow manifold, which three observables make linear.

    S. Brunton, B. Brunton, J. Proctor and N. Kutz, *Koopman Invariant Subspaces and Finite Linear Representations of
    Nonlinear Dynamical Systems for Control*, PLoS ONE 11 (2016).

    ẋ₁ = μ x₁, ẋ₂ = λ (x₂ − x₁²) + u with μ = −0.1 and λ = 1, from x₀ = [−5, 5] over 50 s; Q = I and R = 1. On
    z = [x₁, x₂, x₁²] the plant is ż = A z + B u exactly, with the eigenvalues μ, λ and 2μ. Three feedbacks are
    compared: LQR of the linearisation, LQR of the lifted plant, and feedback linearisation, which cancels x₁² and then
    is the first. The feedback is continuous, inside the integration; J = ∫ ‖x‖² + u² dt over the 50 s. Last, EDMD finds
    A and B from data, and `km.lqr` the gain from these.
    """
    mu, lam = -0.1, 1.0
    A = np.array([[mu, 0.0, 0.0], [0.0, lam, -lam], [0.0, 0.0, 2 * mu]])
    B = np.array([[0.0], [1.0], [0.0]])
    plant = km.load_problem("slow_manifold").dynamics
    progress("three feedbacks")
    local, lifted = km.lqr(A[:2, :2], B[:2], [1.0, 1.0], 1.0).K.ravel(), km.lqr(A, B, [1.0, 1.0, 0.0], 1.0)
    K = lifted.K.ravel()
    gains = {  # u = −k · [x₁, x₂, x₁²]
        "LQR, linearisation": [*local, 0.0],
        "LQR, [x₁, x₂, x₁²]": [*K],
        "feedback linearisation": [*local, -lam],
    }
    runs = {
        name: integrate_closed_loop(
            plant,
            lambda x, k=tuple(k): -ca.dot(ca.DM(k), ca.vertcat(x, x[0] ** 2)),
            lambda x, u: ca.sumsqr(x) + ca.sumsqr(u),
            START,
            dt=DT,
            seconds=SECONDS,
        )
        for name, k in gains.items()
    }
    curves = {name: np.column_stack([run.X, run.U, run.J]) for name, run in runs.items()}
    page.text("## The three feedbacks")
    papers.draw_curves(page, "costs", "States, input and cost so far", DT, ("x₁", "x₂", "u", "J"), curves)
    progress("the plant from data")
    step_map = km.discretize(plant, 0.05, km.RK4(10))
    data = km.collect(step_map, km.Uniform([-2.0, -2.0], [2.0, 2.0]), km.Noise(-1.0, 1.0), episodes=20, steps=40)
    model = km.edmd(data, km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x1²"]))
    both = np.block([[model.A, model.B], [np.zeros((1, 3)), np.ones((1, 1))]])
    found: np.ndarray = np.real(logm(both)) / data.dt
    gap = float(np.abs(found[:3] - np.hstack([A, B])).max())
    learned = km.lqr(found[:3, :3], found[:3, 3:], [1.0, 1.0, 0.0], 1.0).K.ravel()
    page.text(
        "## The plant from data",
        f"""EDMD on [x₁, x₂, x₁²] from {len(data)} episodes of 2 s under uniform noise, sampled at {data.dt:g} s. The
        logarithm of [A B; 0 1] over the sample time is the continuous plant; its largest entry off the exact one is
        {gap:.0e}.""",
    )
    rates, ours = np.sort(np.linalg.eigvals(A).real), np.sort(np.linalg.eigvals(found[:3, :3]).real)
    rows = [(name, f"{a:g}", f"{b:.8f}") for name, a, b in zip(("2μ", "μ", "λ"), rates, ours, strict=True)]
    page.table(("eigenvalue", "exact", "from data"), rows)
    start = np.array([*START, START[0] ** 2])
    return [
        papers.compare_value("K of the linearisation", [0.0, 2.414214], local, 5e-7, digits=7),
        papers.compare_value("K of the lifted plant", [0.0, 2.414214, -1.495597], K, 5e-7, digits=7),
        papers.compare_value("J, LQR of the linearisation", 4485.19, runs["LQR, linearisation"].cost, 0.005),
        papers.compare_value("J, LQR of the lifted plant", 990.174, runs["LQR, [x₁, x₂, x₁²]"].cost, 0.0005),
        papers.compare_value("z₀ᵀPz₀, its endless horizon", 990.180, float(start @ lifted.P @ start), 0.0005),
        papers.compare_value("J, feedback linearisation", 1373.95, runs["feedback linearisation"].cost, 0.005),
        papers.compare_value("K from data", [0.0, 2.414214, -1.495597], learned, 5e-6, digits=7),
    ]


brunton_paper = papers.make_paper("brunton", reproduce_brunton.__doc__, reproduce_brunton)


def reproduce_proctor(page: papers.Page, quick: bool, progress: papers.TellPart) -> list[papers.Claim]:
    """Proctor et al. 2016: DMD with control, and why feedback hides the input.

    J. Proctor, S. Brunton and J. N. Kutz, *Dynamic Mode Decomposition with Control*, SIAM J. Appl. Dyn. Syst. 15
    (2016), its first example.

    x⁺ = diag(1.5, 0.1) x + [1, 0] u is unstable, and u = −x₁ stabilises it: X = [4 2 1 .5 .25; 7 .7 .07 .007 .0007],
    U = [−4 −2 −1 −.5]. DMD leaves the input out and sees the closed loop, which is stable. DMDc with B known finds A.
    With B unknown the rows of [X; U] are dependent: infinitely many A and B fit these data, and the fit must warn.
    Beyond the paper: with small noise on the input of the same plant and feedback, the fit finds both.
    """
    progress("fits")
    fed = km.Episodes([km.Episode(X=X, U=U)], 1.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        blind = km.dmdc(fed)
    said = [str(each.message) for each in caught if issubclass(each.category, km.FitWarning)]
    models = {
        "DMD": km.dmd(km.Episodes([km.Episode(X=X)], 1.0)),
        "DMDc, B known": km.dmdc(fed, B=B),
        "DMDc, B unknown": blind,
        "DMDc, B unknown, noise on u": km.dmdc(_collect_noisy()),
    }
    steps = 6
    truth = np.array([np.linalg.matrix_power(A, k) @ FREE for k in range(steps + 1)])
    page.text(
        "## What the models are",
        f"A step from [x; u] on, rounded to five digits. The fit with B unknown says: “{said[0] if said else '–'}”.",
    )
    page.table(
        ("model", "A", "B", "ρ(A)"),
        [
            (
                name,
                papers.format_values(m.A, 5),
                papers.format_values(m.B, 5) if m.nu else "–",
                f"{np.abs(m.eigenvalues).max():.4g}",
            )
            for name, m in models.items()
        ],
    )
    page.text(f"Without input from [1, 1], the plant and the models ({steps} steps):")
    free = {name: m.rollout(FREE, np.zeros((steps, m.nu))) for name, m in models.items()}
    papers.draw_curves(page, "free", "Without input", 1.0, ("x₁", "x₂"), {"plant": truth, **free})
    noisy = models["DMDc, B unknown, noise on u"]
    return [
        papers.compare_value("DMD, A", np.diag([0.5, 0.1]), models["DMD"].A, 1e-12),
        papers.compare_value("DMDc with B known, A", A, models["DMDc, B known"].A, 1e-12),
        papers.compare_value("DMDc with B unknown, A", np.diag([0.25, 0.1]), blind.A, 1e-12),
        papers.compare_value("DMDc with B unknown, B", [[-0.25], [0.0]], blind.B, 1e-12),
        papers.judge_claim(
            "DMDc with B unknown",
            "A and B cannot be told apart: a warning",
            holds=any("feedback made A and B inseparable" in sentence for sentence in said),
            why=said[0].split(":")[0] if said else "no warning",
            required=True,
        ),
        papers.compare_value(
            "noise on the input (ours), A and B", np.hstack([A, B]), np.hstack([noisy.A, noisy.B]), 1e-10
        ),
    ]


def _collect_noisy() -> km.Episodes:
    """Return 20 steps of the plant under u = −x₁ and noise of ±0.1."""
    noise, states, inputs = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 1)), np.zeros((21, 2)), np.zeros((20, 1))
    states[0] = X[0]
    for k in range(20):
        inputs[k] = noise[k] - states[k, 0]
        states[k + 1] = A @ states[k] + B @ inputs[k]
    return km.Episodes([km.Episode(X=states, U=inputs)], 1.0)


dmdc_paper = papers.make_paper("proctor", reproduce_proctor.__doc__, reproduce_proctor)


LAM = 0.9  # λ
MU = 0.5  # μ
DELTA = 1.0  # δ
FEEDBACK = -0.3  # u = FEEDBACK x₁² in the data with feedback
LIFTING = km.State() + km.Expressions(lambda x: [x[0] ** 2], ["x₁²"])  # x₁, x₂, u, x₁²
STATES = [[LAM, 0.0, 0.0, 0.0], [0.0, MU, DELTA, LAM**2 - MU]]  # rows of K
ROWS = {"exogenous": [0.0] * 4, "constant": [0.0, 0.0, 1.0, 0.0], "state": [0.0, 0.0, 0.0, FEEDBACK * LAM**2]}
# Input as a function of x, the constant signal of the episode, and the random generator
InputRule = Callable[[np.ndarray, float, np.random.Generator], float]
LAWS: dict[str, InputRule] = {
    "exogenous": lambda x, held, rng: float(rng.uniform(-1, 1)),
    "constant": lambda x, held, rng: held,
    "state": lambda x, held, rng: FEEDBACK * float(x[0]) ** 2,
}
SAF = km.State() + km.Expressions(lambda x: [x[1] - 0.2 * x[0] ** 2], ["x₂ − 0.2 x₁²"])


def reproduce_kic(page: papers.Page, quick: bool, progress: papers.TellPart) -> list[papers.Claim]:
    """Proctor, Brunton & Kutz 2018: observables that hold inputs.

    J. Proctor, S. Brunton and J. N. Kutz, *Generalizing Koopman Theory to Allow for Inputs and Control*, SIAM J.
    Appl. Dyn. Syst. 17 (2018).

    x₁⁺ = λ x₁, x₂⁺ = μ x₂ + (λ² − μ) x₁² + δ u is linear on [x₁, x₂, u, x₁²]: ψ(x⁺, ∗) = K ψ(x, u), where ∗ says
    what the input becomes. It is 0 for an exogenous one (here random), u⁺ for one that is a function of the state
    (here −0.3 x₁²), and u for a constant signal. The rows of the states are the same each time; the row of the
    input is 0, the feedback, or 1. λ = 0.9, μ = 0.5, δ = 1; 20 episodes of 15 steps each. `km.identify.kic` is the
    fit.

    In addition the system of SafEDMD (Strässer et al. 2024), ẋ₁ = μ x₁, ẋ₂ = λ (x₂ − x₁²) + u with μ = −2, λ = 1,
    sampled at 0.01 s: on [x₁, x₂, x₂ − 0.2 x₁²] its input enters linearly, and the model is exact.
    """
    progress("three kinds of input")
    claims: list[papers.Claim] = []
    data = {kind: _collect_inputs(law) for kind, law in LAWS.items()}
    with km.errors.hide_fit_warnings():
        found = {kind: km.identify.kic(each, LIFTING, inputs=cast("Any", kind)) for kind, each in data.items()}
    page.text(
        "## K",
        """Rows and columns are x₁, x₂, u, x₁². Under feedback u and x₁² are dependent, and of all K that fit the one of
        least norm is found: it is exact on the data, and its entries are not.""",
    )
    rows: list[tuple[object, ...]] = []
    for kind, fit in found.items():
        exact, m = np.array([*STATES, ROWS[kind], [0.0, 0.0, 0.0, LAM**2]]), fit.model
        rows.append((kind, papers.format_values(m.A, 4), papers.format_values(np.sort(np.real(m.eigenvalues)), 4)))
        Z = m.lift(np.vstack([np.hstack([e.X[:-1], e.U]) for e in data[kind]]))
        missed = float(np.abs(Z @ (m.A - exact).T).max())
        claims.append(papers.compare_value(f"{kind}: largest misfit of K ψ on the data", 0.0, missed, 1e-10))
        if kind != "state":
            claims.append(papers.compare_value(f"{kind}: K", exact, m.A, 1e-10))
    page.table(("input", "K", "eigenvalues"), rows)
    free = found["exogenous"]
    linear, exact = free.linear(), [[LAM, 0, 0, 0], [0, MU, LAM**2 - MU, DELTA], [0, 0, LAM**2, 0]]
    claims.append(
        papers.compare_value("exogenous: [A B] of z⁺ = A z + B u", exact, np.hstack([linear.A, linear.B]), 1e-10)
    )
    _predict_sine(page, free, claims)
    progress("an input that enters as it is")
    claims += _check_safedmd(page)
    return claims


def _collect_inputs(law: InputRule) -> km.Episodes:
    rng, found = np.random.default_rng(0), list[km.Episode]()
    for _ in range(20):
        X, U, held = np.zeros((16, 2)), np.zeros((15, 1)), float(rng.uniform(-1, 1))
        X[0] = rng.uniform(-1, 1, 2)
        for k in range(15):
            U[k] = law(X[k], held, rng)
            X[k + 1] = _step_plant(X[k], U[k])
        found.append(km.Episode(X=X, U=U))
    return km.Episodes(found, 1.0, ("x1", "x2"), ("u",))


def _step_plant(x: np.ndarray, u: np.ndarray) -> np.ndarray:
    return np.array([LAM * x[0], MU * x[1] + (LAM**2 - MU) * x[0] ** 2 + DELTA * u[0]])


def _predict_sine(page: papers.Page, free: km.identify.InputPredictor, claims: list[papers.Claim]) -> None:
    """Predict the response to an input that the data do not contain."""
    U = np.sin(np.arange(40) / 4)[:, None]
    X = [np.array([1.0, -1.0])]
    for u in U:
        X.append(_step_plant(X[-1], u))
    told = free.rollout(X[0], U)
    claims.append(papers.compare_value("40 steps under a sine", 0.0, float(np.abs(told - X).max()), 1e-9))
    papers.draw_curves(
        page, "sine", "Under a sine, which no data held", 1.0, ("x₁", "x₂"), {"plant": np.array(X), "K": told}
    )


def _check_safedmd(page: papers.Page) -> list[papers.Claim]:
    slow = replace(cast("Any", km.load_problem("slow_manifold").dynamics), mu=-2.0, lam=1.0)
    plant = km.discretize(slow, 0.01, km.RK4(4))
    data = km.collect(plant, km.Uniform([-1.0, -1.0], [1.0, 1.0]), km.Noise(-1.0, 1.0), episodes=20, steps=20)
    model = km.edmd(data, SAF)
    pairs = data.snapshots()
    missed = model.lift(pairs.X_next) - model.lift(pairs.X) @ model.A.T - pairs.U @ model.B.T
    values: np.ndarray = np.sort(np.real(model.eigenvalues))
    page.text("## The system of SafEDMD")
    page.table(("A", "B"), [(papers.format_values(model.A, 8), papers.format_values(model.B, 8))])
    return [
        papers.compare_value("SafEDMD: eigenvalues", [0.960789, 0.980199, 1.010050], values, 5e-7, digits=7),
        papers.compare_value("SafEDMD: B", [[0.0], [0.01005017], [0.01005017]], model.B, 5e-9, digits=8),
        papers.compare_value("SafEDMD: residual of a step", 0.0, float(np.abs(missed).max()), 1e-12),
    ]


kic_paper = papers.make_paper("kic", reproduce_kic.__doc__, reproduce_kic)
