"""explain: what the words in tables, reports and pictures mean."""

from koopmpc.checks import nearest
from koopmpc.errors import ProblemError

TERMS: dict[str, str] = {
    "cost": (
        "What the run cost: Σ‖x − r‖²_Q + ‖u − u_r‖²_R over all steps. Q and R are the weights of the problem, r "
        "is the reference, and u_r is the input that holds it. A plant at rest on its reference costs nothing."
    ),
    "ratio": (
        "The cost of a run over that of nonlinear-mpc on the same case. That controller plans with the equations "
        "of the problem. Where the plant carries a load that the equations do not have, a ratio can be below 1."
    ),
    "settles": "The time until the weighted error stays below 2 % of its first value.",
    "within 5 %": (
        "The error over the last tenth of the run is below 5 % of its first value, but it does not stay below the "
        "2 % that settling asks for."
    ),
    "does not reach": (
        "Over the last tenth of the run the error is above 5 % of its first value: the controller did not bring "
        "the plant to its reference. This is a result, not a failure of the program."
    ),
    "off": "The largest entry of x − r at the end of the run, in the unit of that state.",
    "over": "How far a limit of a state or an output was broken, at most, as a share of that limit's size.",
    "p50": "The median time of a step, from the measurement to the input, in Python.",
    "p99": "The time that 99 of 100 steps stay below, from the measurement to the input, in Python.",
    "free": (
        "The best plan without limits meets all limits. It is the answer, and no optimisation was needed "
        "(Status.UNCONSTRAINED)."
    ),
    "optimal": "A limit is active, and an optimisation problem was solved to its tolerance (Status.OPTIMAL).",
    "softened": "The problem was solved, and a soft limit had to give way (Status.SOFTENED).",
    "clipped": "A feedback law asked for more than the input limits allow, and was cut to them (Status.SATURATED).",
    "unfinished": "The solver ended before its tolerance, and a fallback took over (Status.MAX_ITERATIONS).",
    "out of time": "The step took longer than it may (Status.TIME_LIMIT).",
    "infeasible": "No plan meets the hard limits, and a fallback took over (Status.INFEASIBLE).",
    "bad y": (
        "The measurement or the reference held NaN or infinity, and a fallback took over (Status.BAD_MEASUREMENT)."
    ),
    "failed": "The solver gave no usable answer, and a fallback took over (Status.FAILED).",
    "fallback": (
        "What replaces the answer of a failed step, always inside the input limits: the last plan moved on by a "
        "step, else a clipped feedback, else the last input."
    ),
    "unknown": (
        "Steps at which a learned model was beyond its data: state and input lay where the data were not, or what came "
        "was not what the model had predicted. About 2 of 100 steps are so by chance. Asked for by --monitor."
    ),
    "lost": "Only because of the fault the run did not reach its reference.",
    "–": (
        "No number: without the fault the run does not reach its reference either, or there is no run to compare with."
    ),
    "lqr": "Linear feedback on your equations, linearised at the equilibrium, cut to the input limits.",
    "koopman-lqr": "Linear feedback on the linear lifted model that was learned from data, cut to the input limits.",
    "linear-mpc": "Predictive control on your equations, linearised at the equilibrium.",
    "koopman-mpc": "Predictive control on the linear lifted model that was learned from data.",
    "offset-free": "koopman-mpc with an estimate of what the model misses, so that no error remains at rest.",
    "bilinear-mpc": (
        "Predictive control on the bilinear lifted model that was learned from data. It linearises the model "
        "along its plan once a step."
    ),
    "bilinear-offset": "bilinear-mpc with an estimate of what the model misses, so that no error remains at rest.",
    "adaptive": "koopman-mpc whose model goes on learning from every step of the run.",
    "designed": "The controller that km.design chooses, by closed loops on models learned from the same data.",
    "nonlinear-mpc": (
        "Predictive control on your equations as they are, solved to the end: slow, and the measure for all."
    ),
    "lifting": (
        "The observables z = ψ(x): functions of the state, such as sines or powers, in which the model is linear."
    ),
    "dictionary": (
        "All observables of a lifting. It is invariant where the next value of each is a combination of them."
    ),
    "rmse": "Root-mean-square error: the square root of the mean of the squared errors.",
    "band": (
        "An interval around a forecast that holds the given share of all held-out forecasts, at all of their steps."
    ),
    "spurious": (
        "An eigenvalue of the model that the data do not support: its residual is above 5 % a step. Read no "
        "frequency from it; forecasts may still be good."
    ),
    "residual": "How much a pair of eigenvalue and eigenfunction is off after one step, as a share of its size.",
    "spectral radius": "The largest |λ| of the model. Above 1 a forecast without feedback grows.",
    "coverage": "Where in the space of states and inputs the data have been, and where they never were.",
    "persistently exciting": "Inputs that vary enough to tell the effects of the last n inputs apart; n is the order.",
    "horizon": "How many steps a controller plans ahead, or how many steps a forecast is judged by.",
}
"""Term → what it means, in whole sentences."""


def explain(term: str) -> str:
    """Return what a term means.

    Raises
    ------
    ProblemError
        The term is unknown; the message names the nearest and all others.
    """
    known = {name.lower(): text for name, text in TERMS.items()}
    key = " ".join(term.lower().split())
    if key not in known:
        raise ProblemError(f"there is no term {term!r}{nearest(key, known)}; there are {', '.join(TERMS)}")
    return known[key]
