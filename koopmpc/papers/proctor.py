"""Proctor et al. 2016: DMD with control, and why feedback hides the input.

J. Proctor, S. Brunton and J. N. Kutz, *Dynamic Mode Decomposition with Control*, SIAM J. Appl. Dyn. Syst. 15 (2016),
its first example.

x⁺ = diag(1.5, 0.1) x + [1, 0] u is unstable, and u = −x₁ holds it: X = [4 2 1 .5 .25; 7 .7 .07 .007 .0007],
U = [−4 −2 −1 −.5]. DMD leaves the input out and sees the closed loop, which is stable. DMDc with B known finds A. With
B unknown the rows of [X; U] are dependent: infinitely many A and B fit these data, and the fit has to say so. Beyond
the paper: the same plant and feedback with small noise on the input, where both are found.
"""

import warnings

import numpy as np

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.errors import FitWarning
from koopmpc.identify.fits.dmd import dmd, dmdc
from koopmpc.papers.registry import Claim, Tell, compared, judged, short, show, written
from koopmpc.recording.page import Page

X = np.array([[4.0, 2.0, 1.0, 0.5, 0.25], [7.0, 0.7, 0.07, 0.007, 0.0007]]).T
U = np.array([[-4.0, -2.0, -1.0, -0.5]]).T
A, B = np.diag([1.5, 0.1]), np.array([[1.0], [0.0]])
FREE = np.array([1.0, 1.0])  # a start from which nothing holds the plant


def work(page: Page, quick: bool, tell: Tell) -> list[Claim]:
    """Fit the five samples with and without the input, and the plant with noise on its feedback."""
    tell("fits")
    fed = Episodes([Episode(X=X, U=U)], 1.0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        blind = dmdc(fed)
    said = [str(each.message) for each in caught if issubclass(each.category, FitWarning)]
    models = {
        "DMD": dmd(Episodes([Episode(X=X)], 1.0)),
        "DMDc, B known": dmdc(fed, B=B),
        "DMDc, B unknown": blind,
        "DMDc, B unknown, noise on u": dmdc(_shaken()),
    }
    steps = 6
    truth = _rollout(A, steps)
    page.text(
        "## What the models are",
        f"A step from [x; u] on, rounded to five digits. The fit with B unknown says: “{said[0] if said else '–'}”.",
    )
    page.table(
        ("model", "A", "B", "ρ(A)"),
        [
            (name, written(m.A, 5), written(m.B, 5) if m.nu else "–", f"{np.abs(m.eigenvalues).max():.4g}")
            for name, m in models.items()
        ],
    )
    page.text(f"Without input from [1, 1], the plant and the models ({steps} steps):")
    free = {name: m.rollout(FREE, np.zeros((steps, m.nu))) for name, m in models.items()}
    show(page, "free", "Without input", 1.0, ("x₁", "x₂"), {"plant": truth, **free})
    noisy = models["DMDc, B unknown, noise on u"]
    return [
        compared("DMD, A", np.diag([0.5, 0.1]), models["DMD"].A, 1e-12),
        compared("DMDc with B known, A", A, models["DMDc, B known"].A, 1e-12),
        compared("DMDc with B unknown, A", np.diag([0.25, 0.1]), blind.A, 1e-12),
        compared("DMDc with B unknown, B", [[-0.25], [0.0]], blind.B, 1e-12),
        judged(
            "DMDc with B unknown",
            "A and B cannot be told apart: a warning",
            holds=any("feedback made A and B inseparable" in sentence for sentence in said),
            why=said[0].split(":")[0] if said else "no warning",
            required=True,
        ),
        compared("noise on the input (ours), A and B", np.hstack([A, B]), np.hstack([noisy.A, noisy.B]), 1e-10),
    ]


def _shaken() -> Episodes:
    """Return 20 steps of the plant under u = −x₁ and noise of ±0.1."""
    noise, states, inputs = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 1)), np.zeros((21, 2)), np.zeros((20, 1))
    states[0] = X[0]
    for k in range(20):
        inputs[k] = noise[k] - states[k, 0]
        states[k + 1] = A @ states[k] + B @ inputs[k]
    return Episodes([Episode(X=states, U=inputs)], 1.0)


def _rollout(matrix: np.ndarray, steps: int) -> np.ndarray:
    return np.array([np.linalg.matrix_power(matrix, k) @ FREE for k in range(steps + 1)])


paper = short("proctor", __doc__, work)
