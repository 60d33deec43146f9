"""The words of tables, reports and pictures, and the command that explains them."""

from typing import Annotated

import typer
from rich.text import Text

from koopmpc.apps.cli.console import console, friendly
from koopmpc.base.errors import ProblemError

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
    "starts there": (
        "The run begins on its reference, so that no time until it is there can be told: see its cost, and what it is "
        "off at the end."
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
        "The measurement or the reference held NaN or infinity, or the model overflows from there, and a fallback took "
        "over (Status.BAD_MEASUREMENT)."
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
    "lost": (
        "In a table of faults: only because of the fault the run did not reach its reference. In a design or a check: "
        "the run left the data by more than half of its range, or a state became NaN or infinite."
    ),
    "violation": (
        "How far a limit was broken, at most: in the unit of that limit, or as a share of its range where a % follows."
    ),
    "score": (
        "The mean over closed loops on stand-ins of a controller's cost, with a price on violations, over that of the "
        "best controller in the same loop: 1 is the best in every loop."
    ),
    "stand-in": (
        "A model of the plant from the same logs that the controller's own model does not know; it takes the plant's "
        "place in tests. Where the logs are blind, so is it."
    ),
    "Q_N": "The weight of the error at the end of the horizon; Q_N = Q is that of every other step.",
    "worst run": "The closed loop in which a controller's cost is the largest multiple of the best one's in that loop.",
    "certificate": (
        "A checked statement that the loop with the learned model is stable at the reference, from logs that the model "
        "has not seen; it says for which starts and errors, and nothing beyond them."
    ),
    "steps without a good status": (
        "Steps whose solve did not end as asked, whose fallback acted, or whose measurement was missing (NaN). "
        "Where a fault of the run causes them, the goal can be kept all the same."
    ),
    "surrogate": "Another word for a stand-in of the plant.",
    "corners": "The ends of the range of starts in the goal, at which loops begin that the logs may never have shown.",
    "fresh loops": (
        "Closed loops from new random starts, run after the choice of the controller, which had no part in it."
    ),
    "gain": (
        "How strongly an output answers an input; in a name such as offset-free (gain 0.1), how fast the controller "
        "learns an unknown load."
    ),
    "tail": "Steps after the horizon whose cost, without limits, the plan counts, so that it looks beyond its end.",
    "weighted": "The model is fitted again, with more weight on the states that its own closed loops visit.",
    "known": "A step of a learned model inside its data; the opposite of unknown.",
    "ridge": "A small penalty on the size of a model's coefficients in the fit; it keeps noise out of them.",
    "–": (
        "No number: without the fault the run does not reach its reference either, or there is no run to compare with."
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
"""Term → what it means, in whole sentences; the controllers' stand in their registry."""


def explain(
    term: Annotated[
        list[str] | None,
        typer.Argument(help="A word of a table, a report or a picture, or a case; all words if left out."),
    ] = None,
) -> None:
    """Explain a word that stands in a table, a report or a picture."""
    from koopmpc.apps.bench.controllers import CONTROLLERS
    from koopmpc.apps.bench.measured import describe_cases
    from koopmpc.base.checks import nearest

    out, terms = console(), TERMS | {name: entry.explanation for name, entry in CONTROLLERS.items()}
    if not term:
        for name, text in terms.items():
            out.print(Text.assemble((name, "bold"), f": {text}"))
        return
    known, asked = {name.lower(): text for name, text in terms.items()}, " ".join(term)
    key = " ".join(asked.lower().split())
    with friendly():
        if key not in known and (cases := describe_cases(asked)):
            for text in cases:
                out.print(Text(text))
            return
        if key not in known:
            raise ProblemError(f"there is no term {asked!r}{nearest(key, known)}; there are {', '.join(terms)}")
    out.print(Text(known[key]))
