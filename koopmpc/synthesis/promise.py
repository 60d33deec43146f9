"""expect_loops: fresh loops of the chosen controller, where it is blind, and what is said about it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from koopmpc.base.text import to_percent
from koopmpc.codegen.compiled import Compiled
from koopmpc.control.kinds.koopman_mpc import KoopmanMPC
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.synthesis.choice import DesignRow
from koopmpc.synthesis.confirm import ChosenController
from koopmpc.synthesis.designed import Design, Evidence
from koopmpc.synthesis.loops.abreast import explain_python, speed_up
from koopmpc.synthesis.loops.conditions import LoopTest
from koopmpc.synthesis.loops.finalists import compare_longer_horizon
from koopmpc.synthesis.loops.fresh import describe_outside, find_blind_range, find_blind_reference, run_fresh_loops
from koopmpc.synthesis.loops.judging import Outcome
from koopmpc.synthesis.options import DesignOptions
from koopmpc.synthesis.rates import KEPT, ExpectedLoop

MANY = 600  # fresh loops of a controller in machine code
FEW = 60  # fresh loops of one in Python
ALONG = "first rows of {count} records are few: fresh loops start at rows all along them, with the past they had there"
RARELY = 0.01  # share of the fresh loops above which violated limits are advice
_KEPT = 6000  # steps of the data that a saved design keeps, to compare new logs with
WORRY = 0.05  # a bound of lost loops above this is advice


def expect_loops(chosen: ChosenController, options: DesignOptions, few: int, rng: np.random.Generator) -> Design:
    """Return the design: its controller, fresh loops of it, where it is blind, and what would help."""
    judged, controller = chosen.judged, chosen.controller
    posed, test, rows, best = judged.plan.posed, judged.test, judged.rows, chosen.best
    near, memory = chosen.pool.neighbours, judged.plan.memory
    assert near is not None, "a design has nearest rows"
    notes, fresh = list(posed.notes), None
    held = next(one.u_reference for one in test.conditions if one.gain == 1.0)
    wide = find_blind_range(test.episodes, test.task, near) if few else []
    blind = find_blind_reference(test.episodes, test.task, near, held)
    if few:
        fast = speed_up(controller)
        count = MANY if options.loops is None and isinstance(fast, Compiled) else few
        if options.loops is None and count == few:
            why = explain_python(controller)
            notes.append(f"{few} fresh loops ran in place of {MANY}, for {why}; loops={MANY} takes longer")
        fresh = run_fresh_loops(chosen.pool, fast, count, rng)
        if test.task.along:
            notes.append(ALONG.format(count=len(posed.data.held)))
        blind = [*describe_outside(test.episodes, test.task, fresh), *blind, *wide]
        blind += compare_longer_horizon(chosen.pool, rows[best].recipe, controller, fast, rng)
    controller.reset()
    remembered: list[str] = []
    if memory is not None and rows[best].recipe.candidate.delays:
        remembered = [f"{memory}; models with delays were tried"]
    elif memory is not None:
        blind.append(f"{memory}, and the chosen model sees no past rows: measure that state, or compare delays=[4, 8]")
    expected = replace(_summarise_expected(test, judged.outcomes[best]), fresh=fresh, compared=chosen.compared)
    promise, place = chosen.promise, chosen.best_linear
    advice = [*test.doubts, *([] if promise is None or promise.holds else [str(promise)]), *blind]
    advice += [*_give_advice(rows, best, place, expected), *test.limits(judged.outcomes[best].band).capped]
    measured = posed.data.measured
    return Design(
        controller=controller,
        linear=chosen.linear if isinstance(chosen.linear, KoopmanMPC) else None,
        leaderboard=rows,
        chosen=best,
        chosen_linear=place,
        evidence=Evidence(
            test.task,
            test.surrogates,
            test.low,
            test.high,
            expected,
            test.holds,
            near,
            _keep_logs(measured),
            promise,
        ),
        advice=(*advice, *posed.advice),
        notes=(*notes, *judged.plan.notes, *chosen.notes, *remembered),
        standby=chosen.standby,
    )


def _keep_logs(measured: Episodes) -> Episodes:
    """Return episodes of about so many steps as a comparison with new logs needs, spread evenly over the data."""
    apart = max(sum(map(len, measured)) // _KEPT, 1)
    return measured.with_episodes([Episode(X=e.X, U=e.U, W=e.W) for e in list(measured)[::apart]])


def _summarise_expected(test: LoopTest, outcome: Outcome) -> ExpectedLoop:
    nominal = test.nominal
    off = [j for j in range(len(test.conditions)) if j not in nominal]
    near = [test.conditions[j] for j in nominal]
    known = outcome.broken[np.isfinite(outcome.cost)]
    return ExpectedLoop(
        cost=outcome.cost[nominal],
        cost_off=outcome.cost[off],
        violation=outcome.violation[nominal],
        violation_off=outcome.violation[off],
        broken=float(known.mean()) if known.size else 1.0,
        starts=np.array([one.x0 for one in near]),
        surrogate=tuple(one.surrogate for one in near),
        steps=test.task.steps,
    )


def _describe_violation(row: DesignRow, expected: ExpectedLoop) -> str:
    """Return by how much limits are violated, by fresh loops of the returned controller if any ran; "" if little."""
    if expected.fresh is None:
        return "" if row.violation <= KEPT else f"{to_percent(row.violation)} of their range"
    known = expected.fresh.violation[np.isfinite(expected.fresh.violation)]
    broken = int(np.sum(known > KEPT))
    if broken <= RARELY * len(known):
        return ""
    return (
        f"{to_percent(float(known.max()))} of their range, in {broken} of {len(expected.fresh.violation)} fresh loops "
        f"by more than {to_percent(KEPT)}"
    )


def _give_advice(rows: Sequence[DesignRow], best: int, linear: int | None, expected: ExpectedLoop) -> list[str]:
    """Return sentences on what limits the closed loop, and which data would help."""
    said: list[str] = []
    row, runs = rows[best], len(expected.cost) + len(expected.cost_off)
    if expected.lost:
        said.append(
            f"{expected.lost} of {runs} runs were lost: the loop went where there are no data, or fell over; collect "
            "episodes around the reference and on the way to it, ask for less, or start nearer; where the plant falls "
            "over by itself, km.stabilise finds a feedback under which it can be excited, from short episodes near its "
            "equilibrium, and without the plant at hand only logs taken under some feedback, with noise on top, will do"
        )
    if expected.fresh is not None and expected.lost_bound > WORRY and np.sum(~np.isfinite(expected.fresh.cost)) > 0:
        said.append(
            f"{int(np.sum(~np.isfinite(expected.fresh.cost)))} of {len(expected.fresh.cost)} fresh loops were lost, so "
            f"that up to {to_percent(expected.lost_bound)} may be: do not switch it on before a `koopmpc check`, and "
            "record episodes where `design.expected.fresh` is lost"
        )
    known = expected.cost[np.isfinite(expected.cost)]
    if not known.size:
        said.append("every run with inputs as in the data was lost: trust no controller of these data")
    if (over := _describe_violation(row, expected)) != "":
        said.append(
            f"limits are violated by up to {over}; collect data near the limits, or ask for limits further inside"
        )
    if row.worst > 2 and not expected.lost:
        said.append(
            f"in its worst run the controller costs {row.worst:.2g} times the best of all in that run: what is best "
            "differs from surrogate to surrogate; more episodes would make them agree"
        )
    if linear is None:
        said.append("no linear model came through")
    elif linear != best and rows[linear].score > 1.2 * row.score:
        said.append(
            f"the best linear controller costs about {rows[linear].score / row.score:.2g} times as much: what an input "
            "does depends on the state"
        )
    return said
