"""`design` chooses a controller with a learned model from data, a cost and limits, by closed loops on surrogates.

Its stages, each a file: the task on its data (pose), candidates in folds (trials), rounds of closed loops (rounds), the
choice and its confirmation (confirm), fresh loops (promise).
"""

import warnings
from typing import Any

from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import FitWarning, refuse_moved
from koopmpc.base.parallel import Workers
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source
from koopmpc.synthesis.confirm import choose_controller
from koopmpc.synthesis.designed import Design
from koopmpc.synthesis.loops.margin import check_share
from koopmpc.synthesis.options import DesignOptions, check_options
from koopmpc.synthesis.pose import ControlGoal, pose_task
from koopmpc.synthesis.promise import FEW, expect_loops
from koopmpc.synthesis.rounds import build_test, judge_rounds
from koopmpc.synthesis.trials import plan_trials


def design(
    data: Episodes | Source,
    cost: Cost,
    limits: Limits | None = None,
    *,
    reference: ArrayLike,
    horizon: int | None = None,
    starts: ArrayLike | None = None,
    options: DesignOptions | None = None,
    **moved: Any,
) -> Design:
    """Choose model and controller by closed loop on learned surrogates of the plant, and fit them to all data.

    1. Folds: episodes that went far away under ordinary inputs are left out, and the others are dealt into three folds.
       Every candidate model is fitted to two folds and forecasts the third over the horizon. A bilinear model is lifted
       at every step, as in its controller. The errors choose the ridges, the five models of each kind for the first
       round, and the two surrogates of the plant.
    2. Surrogates: the bilinear model with the smallest error, and the best one from another family of observables, each
       fitted to every two folds. Their one-step errors give the noise of their measurements.
    3. First round: each model, fitted to two folds, controls surrogates that know the third fold from several starts,
       by BilinearMPC, KoopmanMPC, and plain KoopmanMPC with Q_N = Q. A run takes three horizons, and as long as a
       linear loop on the data takes to settle, at most 120 steps.
    4. Final round: the best models are tried with every estimator and terminal cost, and one is fitted with weights
       around the states that its loops visit. Some surrogates have inputs that act 20 % more or less, since a plant
       differs from its logs.
    5. Choice: the score of a run is its cost × (1 + 10 max(0, violation − 0.5 %)), divided by the best on the same
       surrogate and start. It is at most 20, and 20 if the run leaves the data by half of their range. A controller is
       judged by the geometric mean of its scores, in which runs with inputs 20 % off count half. Of all controllers
       within 0.5 % of the best, whose worst run is within 3 %, the simplest is chosen and fitted to all data.
    6. Confirmation: if the fitted controller loses a run, or costs a quarter more on the surrogates than when fitted to
       two folds, the next best is chosen, and the notes say so.
    7. Finalists: up to three controllers with other models, whose scores are within 3 % of the best, run the same fresh
       loops as the chosen one, the best of them 300 in all. One that loses fewer, keeps more limits, or costs 2 % less
       takes its place. This is left out where a controller does not run as machine code, and with `loops=0`.
    8. Short plans: if one in twenty of 60 fresh loops breaks limits of states, plans have to end where an affine model
       can keep these for 40 more steps with nine tenths of the inputs. That stays if the same loops prefer it.
    9. Fresh loops: the controller runs from starts that took no part in the choice, on nearest neighbours of the data
       and on the surrogates. They give the interval and the bounds of `expected`, and say where it is outside the data.
       Of three records or fewer they start at rows all along them, with the past of these rows.

    Of long records whose input column is one row late the inputs are moved up, as in `select`.

    The choice depends only on the data and `rng`, never on time or on the number of workers.

    Parameters
    ----------
    data
        Episodes, or a Source that can be read again; the choice uses a sample of a source larger than memory.
    cost, limits
        Cost to minimise and limits to keep.
    horizon
        Horizon of the controllers in steps. None: half of the time in which a linear loop on the data settles, 8 to 40
        steps; the notes say which. A given one is kept.
    reference
        (nr,) of the tracked outputs, or rows (T+1, nr), of which the runs take stretches of three horizons, and of at
        least 120 steps where they move.
    starts
        (nx,) or (n, nx) states from which runs begin; by default first states of up to twelve episodes, inside the
        limits.
    options
        What is tried, what is done to the data first, the margin to the limits, fresh loops, and where it is computed,
        see `DesignOptions`.

    Raises
    ------
    DataError
        There are too few long episodes for three folds, no inputs, or NaN; or the data are a stream that can be read
        only once; feedthrough with measured disturbances.
    ShapeError
        Reference, starts, weights or limits have other sizes than the data.
    DefinitenessError
        A weight is indefinite.

    Warns
    -----
    FitWarning
        No input inside the limits holds the reference; the reference or a start lies outside the data; an episode is
        left out.
    """
    if moved:
        refuse_moved(moved, DesignOptions, "km.DesignOptions", {"tighten": "margin=None", "coverage": "margin=0.95"})
    options = check_options(options, DesignOptions)
    draw, few = checks.generator(options.rng), FEW if options.loops is None else options.loops
    if options.promised is not None:
        check_share(options.promised, few)
    posed = pose_task(data, ControlGoal(cost, limits, reference, horizon, starts), options)
    plan = plan_trials(posed, options, draw)
    with Workers(options.workers, options.scheduler) as pool:
        results, floor = plan.run(pool, options)
        test = build_test(plan, results, floor, options, pool)
        for sentence in test.doubts:
            warnings.warn(sentence, FitWarning, stacklevel=2)
        judged = judge_rounds(plan, results, floor, test, options, pool)
    chosen = choose_controller(judged, options, few, draw)
    return expect_loops(chosen, options, few, draw)
