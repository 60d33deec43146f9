"""Korda & Mezić 2018: linear predictors of nonlinear plants, and MPC on them.

M. Korda and I. Mezić, *Linear predictors for nonlinear dynamical systems: Koopman operator meets model predictive
control*, Automatica 93 (2018). Three plants, with the paper's coefficients.

Van der Pol: ẋ₁ = 2x₂, ẋ₂ = −0.8x₁ + 2x₂ − 10x₁²x₂ + u. 1000 trajectories of 200 steps of 0.01 s, u uniform in ±1,
starts uniform in [−1, 1]²; the lifting is x and N thin plates r² ln r with centres in [−1, 1]². Predicted are 3 s
under u_i = (−1)^⌊i/30 + ½⌋ from 100 starts.

The bilinear motor, scaled: ẋ₁ = 19.10828025 − 39.3153x₁ − 32.2293x₂u, ẋ₂ = −3.333333333 − 1.6599x₂ + 22.9478x₁u,
y = x₂. 200 trajectories of 1000 steps of 0.01 s, one delay, 100 thin plates on ζ = [y_k, u_k₋₁, y_k₋₁]. MPC with
N = 100, Q = Q_N = 1, R = 0.01, |u| ≤ 1; the cost is Σ (y − r)² + 0.01u² over 300 steps, r held over the horizon, no
preview. In the case *step* r is −0.3, then 0.3, from x₀ = [0, .6]; in *cosine* it is .5 cos(2πk/300) with |y| ≤ .4,
from [−.1, .1].

Korteweg–de Vries: y_t + y y_x + y_xxx = Σ uᵢ exp(−25(x − cᵢ)²) with three forces |u| ≤ 1 on a ring of 128 points,
0.01 s a step. 1000 trajectories of 200 steps, the lifting [y, 1, yᵢyᵢ₊₁, y²], MPC with N = 10, Q = I and R = 0 over
50 s.

Data are random, so figures have a spread; where the paper leaves a choice open, the section says ours. Times are those
of the machine that wrote this page, and no requirement of it.
"""

from koopmpc.papers.korda import kdv, motor, van_der_pol
from koopmpc.papers.registry import Claim, Tell, short
from koopmpc.recording.page import Page


def work(page: Page, quick: bool, tell: Tell) -> list[Claim]:
    """Reproduce the three examples."""
    return [claim for part in (van_der_pol, motor, kdv) for claim in part.work(page, quick, tell)]


paper = short("korda", __doc__, work)
