"""Williams et al. 2015: EDMD finds eigenvalues and eigenfunctions.

M. Williams, I. Kevrekidis and C. Rowley, *A Data-Driven Approximation of the Koopman Operator: Extending Dynamic Mode
Decomposition*, J. Nonlinear Sci. 25 (2015), its linear example.

x⁺ = A x with A = [.9 −.04; 0 .8]; ψ holds all monomials of total degree 0 to 4. A linear plant maps them to themselves,
so EDMD is exact: its eigenvalues are .9ⁱ·.8ʲ with i + j ≤ 4, and its eigenfunctions (w₁ᵀx)ⁱ (w₂ᵀx)ʲ, where w are the
left eigenvectors of A. The data are {samples} states from a normal distribution and their successors.
"""

import numpy as np

from koopmpc.data.episodes import Episode, Episodes
from koopmpc.figures.plane import eigenfunctions
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.papers.registry import Claim, Tell, judged, short
from koopmpc.recording.page import Page

A = np.array([[0.9, -0.04], [0.0, 0.8]])
W = np.array([[1.0, -0.4], [0.0, 1.0]])  # rows: left eigenvectors of A
SAMPLES, DEGREE = 100, 4
POWERS = [(i, n - i) for n in range(DEGREE + 1) for i in range(n, -1, -1)]


def work(page: Page, quick: bool, tell: Tell) -> list[Claim]:
    """Fit EDMD on all monomials, and compare eigenvalues and eigenfunctions with the exact ones."""
    tell("EDMD")
    X = np.random.default_rng(0).standard_normal((SAMPLES, 2))
    data = Episodes([Episode(X=np.stack([x, A @ x])) for x in X], 1.0)
    model = edmd(data, Constant() + State() + Monomials(DEGREE))
    exact = np.array([0.9**i * 0.8**j for i, j in POWERS])
    order = [int(np.abs(model.eigenvalues - value).argmin()) for value in exact]
    found = model.eigenvalues[order]
    grid = np.stack(np.meshgrid(*[np.linspace(-2, 2, 21)] * 2), axis=-1).reshape(-1, 2)
    phi = model.eigenfunctions(grid)[:, order]
    off = [_angle(phi[:, k], (grid @ W[0]) ** i * (grid @ W[1]) ** j) for k, (i, j) in enumerate(POWERS)]
    gap, farthest = float(np.abs(found - exact).max()), float(np.max(off))
    page.text("## Eigenvalues and eigenfunctions", """The last column is the sine of the angle between φ and
        (w₁ᵀx)ⁱ (w₂ᵀx)ʲ on a grid over [−2, 2]².""")  # fmt: skip
    page.table(
        ("i, j", "exact λ", "|λ − exact|", "φ off by"),
        [
            (f"{i}, {j}", f"{value:.6g}", f"{abs(f - value):.0e}", f"{o:.0e}")
            for (i, j), value, f, o in zip(POWERS, exact, found, off, strict=True)
        ],
    )
    page.picture(
        "eigenfunctions",
        "Eigenfunctions of λ = .9, .8 and .72",
        eigenfunctions(model, [order[k] for k in (1, 2, 4)], (0, 1), ((-2.0, 2.0), (-2.0, 2.0))),
    )
    steps = np.arange(31)[:, None]
    curves = {"EDMD": (np.real(found) ** steps), "exact": exact**steps}
    page.curve("Powers of the eigenvalues", 1.0, [f"λ {i},{j}" for i, j in POWERS], curves)
    return [
        judged(
            "eigenvalues",
            "all 15 are .9ⁱ·.8ʲ, ± 1e-10",
            holds=gap <= 1e-10 and len(set(order)) == len(POWERS),
            why=f"farthest off by {gap:.0e}",
            required=True,
        ),
        judged(
            "eigenfunctions",
            "(w₁ᵀx)ⁱ (w₂ᵀx)ʲ, ± 1e-9 (ours)",
            holds=farthest <= 1e-9,
            why=f"farthest off by {farthest:.0e}",
            required=True,
        ),
    ]


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    """Return the sine of the angle between two vectors."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    return float(np.linalg.norm(a - np.vdot(b, a) * b))


paper = short("williams", (__doc__ or "").format(samples=SAMPLES), work)
