"""Brunton et al. 2016: the slow manifold, which three observables make linear.

S. Brunton, B. Brunton, J. Proctor and N. Kutz, *Koopman Invariant Subspaces and Finite Linear Representations of
Nonlinear Dynamical Systems for Control*, PLoS ONE 11 (2016).

ẋ₁ = μ x₁, ẋ₂ = λ (x₂ − x₁²) + u with μ = −0.1 and λ = 1, from x₀ = [−5, 5] over 50 s; Q = I and R = 1. On
z = [x₁, x₂, x₁²] the plant is ż = A z + B u exactly, with the eigenvalues μ, λ and 2μ. Three feedbacks are compared:
LQR of the linearisation, LQR of the lifted plant, and feedback linearisation, which cancels x₁² and then is the
first. The feedback is continuous, inside the integration; J = ∫ ‖x‖² + u² dt over the 50 s. Last, EDMD finds A and B
from data, and `km.lqr` the gain from these.
"""

import casadi as ca
import numpy as np
from scipy.linalg import logm

from koopmpc.bench.library import load_problem
from koopmpc.control.lqr import lqr
from koopmpc.data.collect import Uniform, collect
from koopmpc.data.excitation import Noise
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.state import Expressions, State
from koopmpc.papers.plants import closed_loop
from koopmpc.papers.registry import Claim, Tell, compared, short, show
from koopmpc.plants.integrators import RK4
from koopmpc.plants.step_map import discretize
from koopmpc.recording.page import Page

START, SECONDS, DT = (-5.0, 5.0), 50.0, 0.01
MU, LAM = -0.1, 1.0
A = np.array([[MU, 0.0, 0.0], [0.0, LAM, -LAM], [0.0, 0.0, 2 * MU]])
B = np.array([[0.0], [1.0], [0.0]])
LIFTING = State() + Expressions(lambda x: [x[0] ** 2], ["x1²"])


def work(page: Page, quick: bool, progress: Tell) -> list[Claim]:
    """Compare three feedbacks, and find the lifted plant from data."""
    plant = load_problem("slow_manifold").dynamics
    progress("three feedbacks")
    local, lifted = lqr(A[:2, :2], B[:2], [1.0, 1.0], 1.0).K.ravel(), lqr(A, B, [1.0, 1.0, 0.0], 1.0)
    K = lifted.K.ravel()
    gains = {  # u = −k · [x₁, x₂, x₁²]
        "LQR, linearisation": [*local, 0.0],
        "LQR, [x₁, x₂, x₁²]": [*K],
        "feedback linearisation": [*local, -LAM],
    }
    runs = {
        name: closed_loop(
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
    show(page, "costs", "States, input and cost so far", DT, ("x₁", "x₂", "u", "J"), curves)
    progress("the plant from data")
    step_map = discretize(plant, 0.05, RK4(10))
    data = collect(step_map, Uniform([-2.0, -2.0], [2.0, 2.0]), Noise(-1.0, 1.0), episodes=20, steps=40)
    model = edmd(data, LIFTING)
    both = np.block([[model.A, model.B], [np.zeros((1, 3)), np.ones((1, 1))]])
    found: np.ndarray = np.real(logm(both)) / data.dt
    gap = float(np.abs(found[:3] - np.hstack([A, B])).max())
    learned = lqr(found[:3, :3], found[:3, 3:], [1.0, 1.0, 0.0], 1.0).K.ravel()
    page.text(
        "## The plant from data",
        f"""EDMD on [x₁, x₂, x₁²] from {len(data)} episodes of 2 s under uniform noise, sampled at {data.dt:g} s. The
        logarithm of [A B; 0 1] over the sample time is the continuous plant; its largest entry off the exact one is
        {gap:.0e}.""",
    )
    page.table(("eigenvalue", "exact", "from data"), _eigenvalues(found[:3, :3]))
    start = np.array([*START, START[0] ** 2])
    return [
        compared("K of the linearisation", [0.0, 2.414214], local, 5e-7, digits=7),
        compared("K of the lifted plant", [0.0, 2.414214, -1.495597], K, 5e-7, digits=7),
        compared("J, LQR of the linearisation", 4485.19, runs["LQR, linearisation"].cost, 0.005),
        compared("J, LQR of the lifted plant", 990.174, runs["LQR, [x₁, x₂, x₁²]"].cost, 0.0005),
        compared("z₀ᵀPz₀, its endless horizon", 990.180, float(start @ lifted.P @ start), 0.0005),
        compared("J, feedback linearisation", 1373.95, runs["feedback linearisation"].cost, 0.005),
        compared("K from data", [0.0, 2.414214, -1.495597], learned, 5e-6, digits=7),
    ]


def _eigenvalues(found: np.ndarray) -> list[tuple[str, str, str]]:
    exact, ours = np.sort(np.linalg.eigvals(A).real), np.sort(np.linalg.eigvals(found).real)
    return [(name, f"{a:g}", f"{b:.8f}") for name, a, b in zip(("2μ", "μ", "λ"), exact, ours, strict=True)]


paper = short("brunton", __doc__, work)
