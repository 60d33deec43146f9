"""What the report on Snyder & Song (2021) says around its tables; numbers stand in braces and are filled in."""

OPENING = """\
G. Snyder and Z. Song, *Koopman Operator Theory for Nonlinear Dynamic Modeling using Dynamic Mode
Decomposition*, 2021: DMD and EDMD of a pendulum and a cart-pole, uncontrolled and under LQR. `koopmpc reproduce
snyder` writes this page, its figures, and one Rerun recording of all curves. What the paper says is told in our
words. Of {total} claims {summary}."""

SETTINGS = """\
Masses, lengths, weights, starts, and the kinds of observables are the paper's. The rest it leaves open, and we
chose: g = 9.81 m/s², one trajectory of 10 s sampled at 0.01 s, reconstruction from its first state with
b = Φ⁺ψ(x₁), unscaled snapshots, truncated SVD. *Full rank* keeps every singular value above 10⁻¹⁰ σ₁; beside it
stands rank n, the number of states. Monomials include the states and the constant; Fourier observables are x,
sin kxᵢ, cos kxᵢ of every state. Where we differ: the pendulum starts at rest from π/4 but hangs at θ = 0, and the
cart-pole, which shifts by 2 m under LQR, starts 0.1 rad off where it is uncontrolled, for the paper's start is an
equilibrium. All numbers are ours; they are compared with what the paper says, not with numbers that it prints."""

FEEDBACK = """\
The feedback is continuous, inside the integration (RK4, eight substeps a sample). With an input that is held
over each sample the errors under LQR that are above 10⁻⁴ % change by {change} % at most."""

MEASURES = """\
*Error* is ‖x̂ − x‖ / ‖x‖ over all samples and states. *Held out* is its median over {others} trajectories of
the same system from other starts. *Leading φ* is ‖φ(x_k) − λᵏ φ(x₀)‖ / ‖φ‖ over the 10 s for the eigenfunction
with the largest share of the first state, and *φ within 5 %* says how many of all stay below 5 %, as a constant
always does. σ₁/σ_r is the condition number of the snapshots at the rank that is kept."""

FIGURES = """\
Each column is one trajectory: its states over time, the truth beneath the reconstructions, and at the bottom the
error ‖x̂_k − x_k‖ / max ‖x‖ of each sample. A curve that leaves a panel is cut off there; its error is not. The
figures have names, not the numbers of the paper's."""

DMDC = """\
We know no claim of the paper's on these figures. Inputs are held over a sample. Uncontrolled,
DMDc is DMD. Under u = −K x the rows of [X; U] are dependent: the trajectory is rebuilt, and B is not found.
With B known, or with an input that excites, what remains is the error of a linear model of a pendulum at π/4."""

VARIANTS = """\
The upright pendulum, gravity of 10 m/s², and the cart-pole of the databook that the paper takes its plant from
(damping 1 N s/m, Q = I, R = 10⁻⁴, started 0.1 rad off): with the exact Jacobian, and labelled as legacy with
the Jacobian as printed there, whose sign of ∂v̇/∂θ is wrong. Also what the paper does not show of its own two
plants."""

GAINS = "u = −K (x − x_ref), continuous-time LQR on the exact Jacobian unless it says otherwise."

FREQUENCY = """\
√(g/L) = {small:.5f} rad/s for small angles; {right:.5f} rad/s at an amplitude of π/4, by the complete elliptic
integral. A fit of one trajectory finds the frequency of its amplitude. On a larger or smaller swing that is
wrong, which is what the held-out error shows."""

EQUATIONS = """\
Each is one public function. The last column is its relative distance to the formula written out in NumPy, on
the pendulum's trajectory with Fourier observables of first order, reduced to rank {rank} of {width}; numbers as in
the paper."""

SIDES = """\
*Left against right.* Θ⁺Θ′ is the transpose of A_Y: the ξ of eigenfunctions are left eigenvectors of A_Y, and
its right eigenvectors are the modes. φ = Θ ξ misses λ φ(x_k) = φ(x_{{k+1}}) by {left} % a step (median,
monomials 3); the same formula with right eigenvectors by {right} %."""

CAUSES = """\
Under LQR the state settles at (1, 0, π, 0). Its motion about that point has four eigenvalues of its own, and to
stay away from the origin takes a fifth, λ = 1: one more than DMD on four states has, and one more than rank 4
keeps of any lifting. Rank 5 does little better, for a truncated SVD keeps the directions of largest variance,
which are not those of the motion. With the origin at the target, or a constant among the observables, DMD is
right; with all singular values kept, EDMD is. No fault of Koopman theory is needed to explain what happens under
LQR."""

INPUTS = """\
Under u = −K x the input is a function of the state: a fit without B tells the closed loop, and a fit with B
cannot tell A and B apart. Noise on top of the feedback shows both. *Feedback data* are the one trajectory of the
figures, with its input held over each sample; *exciting data* are {episodes} episodes of {lasting:g} s under the
same feedback and uniform noise of ±{pendulum:g} N m or ±{cart_pole:g} N. Medians over ten episodes of 2 s that were
not fitted, relative to ‖x − x_ref‖, each lifted once at its start."""

CONTROL = """\
LQR and MPC on lifted models identified from exciting data, under the paper's weights (pendulum Q = diag(0, 10),
R = 1; cart-pole Q = diag(5, 10, 0, 0), R = 1), sampled at 0.05 s; the observables are the paper's and a
constant. The data of each task are {episodes} episodes of {lasting:g} s under uniform noise, on top of LQR where the
plant would fall: {noise}, in N m or N. Costs are 0.05 Σ (‖x − r‖²_Q + ‖u‖²_R) over {seconds:g} s, and in brackets
their ratio to nonlinear MPC on the true model with a horizon of {ahead:g} s."""

LESSONS = (
    """\
- Hanging, with these weights, no limit, and time that is not sampled, u = −√10 ω is optimal for the nonlinear
pendulum too: 2√10 times its energy solves the Hamilton–Jacobi–Bellman equation. There no lifted model can do better
than LQR on the linearisation.""",
    """\
- Monomials of degree 3 rebuild the hanging pendulum best, and steer it at {cubic:.2f} times the best cost: a
small reconstruction error does not make a control model.""",
    """\
- Upright, from π/4, LQR on Fourier observables takes {lifted:.4f} times the best cost and LQR on the
linearisation {local:.4f}: there the lifted model does see what the linearisation does not.""",
    """\
- In the shift of the cart-pole, which stays within 0.04 rad of upright, all models are alike.""",
)
