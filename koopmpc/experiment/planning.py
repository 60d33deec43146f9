"""`next_experiment` plans which data to record next, so that a model learns where its controller will work."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.control.cost import Cost
from koopmpc.control.kinds import build_controller
from koopmpc.control.limits import Limits
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.errors import DataError, KoopmpcError, hide_fit_warnings
from koopmpc.experiment.ensemble import Ensemble, Fit, calibrate_bands, fit_ensemble
from koopmpc.experiment.plan import ExperimentPlan
from koopmpc.experiment.planner import Planner, UnsafePlanError
from koopmpc.experiment.standing import check_standing
from koopmpc.experiment.visits import Visits, visit_loop, weigh_visits
from koopmpc.identify.fits.bilinear import bilinear_edmd
from koopmpc.identify.fits.edmd import edmd
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.predict.hidden_state import HiddenState
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor
from koopmpc.synthesis.asked import DesignTask, check_task
from koopmpc.synthesis.cross_validation import take_sample
from koopmpc.synthesis.designed import Design
from koopmpc.text import with_unit
from koopmpc.validate.scoring import score

Model = LinearPredictor | BilinearPredictor
SAMPLE = 20_000  # snapshot pairs that a plan is made from
_HORIZON = 20  # steps that the controller looks ahead, where no design says
_LOOPS = 4  # starts from which the designed loop is simulated
_DOUBTED = 3  # bootstrap models that it is simulated on beside the model itself
_MARGIN = 0.1  # starts keep this share of the distance of two limits from both
_ROOM = 0.5  # a start may be outside the data by this share of their range
_AHEAD = 10  # steps over which models are compared
_DEGREES = ((2, 8), (3, 4))  # degrees of products, and the entries of a point up to which models hold them
_RIDGE = 1e-8  # weight of these fits, on columns of unit size
_ALIKE = 1.1  # a model with this many times the least error is as good
_NEAR = 2.0  # a rival may have this many times the least error
_SHORTEST = 8  # steps of the shortest plan that is tried where no longer one is safe
_RIVALS = 2  # models of other structures that say where the structure is in doubt


def next_experiment(
    data: Episodes | Source,
    cost: Cost,
    limits: Limits,
    *,
    reference: ArrayLike | None = None,
    model: Model | None = None,
    design: Design | None = None,
    controller: Any = None,
    starts: ArrayLike | None = None,
    steps: int = 200,
    episodes: int = 1,
    level: float = 0.9,
    rng: np.random.Generator | int = 0,
) -> ExperimentPlan:
    """Plan the experiment that teaches a model most where its controller will work, inside the limits.

    1. The designed loop is simulated on the model, and on bootstrap models of the data. Its rows φ weigh what is
       to be learned; rows on which bootstrap models disagree more than noise explains weigh up to nine times.
    2. A library of excitations is simulated: random steps, sums of sines, loops with moved set points and dither, each
       in several sizes, inside the limits of inputs and rates.
    3. A candidate is safe if its band is inside the limits of states and observables. The band is q times the spread of
       bootstrap models that run the same plan with residuals of the data; forecasts of unseen rows give q.
    4. Of the safe candidates each episode takes the one that lowers the mean variance φᵀ(G + Λ)⁻¹φ over the visits
       most, given the episodes before it (I-optimal; Pukelsheim, "Optimal Design of Experiments", 1993).

    Parameters
    ----------
    data
        Episodes, or a source that can be read again: what is known of the plant.
    cost, limits
        Those of the controller that is to be designed. Limits of inputs and rates hold for the plan; an input without
        limits stays in its range in the data.
    reference
        (nr,) or rows of the outputs that the cost weighs; by default that of the design.
    model
        The model that plans; by default that of the design, or the best of up to six that are fitted to the data. If
        rows are few and a dictionary is known to suffice, plan with a model of it, and fit it to the new logs as well.
    design
        A design whose controller is simulated; by default a KoopmanMPC or a BilinearMPC on the model.
    controller
        The controller under which the plant stands, with the outputs of the cost as set points: the result is then a
        plan of set points.
    starts
        (nx,) or (n, nx) states from which the episodes begin, in turn; by default first states of the data.
    steps, episodes
        Steps of an episode, and number of episodes. Where no plan of so many steps is safe, half of them are tried,
        then a quarter, down to eight; a note says so.
    level
        Probability with which a whole episode stays inside its band.
    rng
        Random generator or seed.

    Returns
    -------
    plan
        An excitation for `collect` and `realtime`. `plan.is_worth_it` is False where nothing is left to learn.

    Raises
    ------
    DataError
        No safe plan exists, a start is outside the limits or far from the data, an episode is not longer than the past
        that the model needs, the data have no inputs, or the reference is missing.
    ShapeError
        Sizes do not fit.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, [0.1, 0.0], km.Feedback([[40, 15]], km.Noise(-1, 1)), episodes=6, steps=40)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25, x_min=[-1, -4], x_max=[1, 4])
    >>> plan = km.next_experiment(data, cost, limits, reference=[0, 0], starts=[0.1, 0.0], steps=60)
    >>> new = km.collect(plant, plan.starts, plan, episodes=plan.episodes, steps=plan.steps)
    >>> bool((abs(new[0].X) < [1, 4]).all())
    True
    """
    draw, steps, episodes = checks.generator(rng), checks.count(steps, "steps"), checks.count(episodes, "episodes")
    level = checks.positive(level, "level")
    if level >= 1:
        raise DataError(f"level is {level:g}; pass a probability between 0 and 1, such as 0.9")
    held, notes = take_sample(source_of(data), SAMPLE)
    if not held.nu:
        raise DataError("the data have no inputs, so there is nothing to plan; give each Episode its U")
    still = [name for name, low, high in zip(held.inputs, *_find_ends(held), strict=True) if low == high]
    if still:
        raise DataError(
            f"{', '.join(still)} never moves in the data, so no model says what a plan would do; record a first log "
            "with small steps of it by hand"
        )
    if design is not None:
        checks.kind(design, "design", Design, "pass what km.design returns")
        if design.best.recipe.feedthrough:
            raise DataError("loops of a design with feedthrough are not planned for; leave design= out")
        reference = design.evidence.asked.reference if reference is None else reference
    if reference is None:
        raise DataError("no reference is given: pass reference=, where the controller is to work, or design=")
    horizon = _HORIZON if design is None else design.controller.horizon
    asked = check_task(held, cost, limits, horizon, reference, starts, ())
    if starts is None:
        asked = replace(asked, starts=choose_starts(asked, held, max(episodes, _LOOPS)))
    refuse_starts(asked, held)
    if model is None and design is not None:
        own = getattr(design.controller, "predictor", None)
        model = own if isinstance(own, Model) and not isinstance(own.embedding, HiddenState) else None
    embedding = None
    if model is not None:
        checks.kind(model, "model", (LinearPredictor, BilinearPredictor), "pass what km.edmd or bilinear_edmd returns")
        embedding = model.embedding
    if isinstance(embedding, HiddenState):
        raise DataError("the model has a hidden state, which a row of a log does not show; pass one without, or none")
    past = 0 if embedding is None else embedding.steps
    if steps <= past:
        raise DataError(
            f"an episode of {steps} steps is not longer than the {past} past steps that the model needs; pass steps "
            f"above {past}, better ten times as many"
        )
    held = held if model is None else model.align(held)
    fits = rank_fits(held, embedding, draw)
    with hide_fit_warnings():
        model, rivals = (fits[0](held), fits[1:]) if model is None else (model, fits[:_RIVALS])
        ensemble = fit_ensemble(model, held, draw, rivals=rivals)
        reach = calibrate_bands(model, held, ensemble, steps, level, draw, rivals)
    visits = simulate_visits(ensemble, model, held, asked, design, draw)
    if controller is not None:
        notes = (*notes, *check_standing(controller, held))
    planner = Planner(asked, held, ensemble, visits, reach, steps, draw, free=starts is None)
    try:
        return planner.plan(episodes, level, model, controller, notes)
    except UnsafePlanError as unsafe:
        longest, refusal = steps, unsafe
    while planner.steps > max(2 * past, _SHORTEST):  # a band grows with the steps
        with hide_fit_warnings():
            steps = max(planner.steps // 2, past + 1, _SHORTEST)
            reach = calibrate_bands(model, held, ensemble, steps, level, draw, rivals)
        planner = replace(planner, reach=reach, steps=steps)
        note = f"no plan of {longest} steps is safe, so this one has {steps}: {refusal.worst}"
        try:
            return planner.plan(episodes, level, model, controller, (*notes, note))
        except UnsafePlanError:
            continue
    raise refusal


def choose_starts(asked: DesignTask, data: Episodes, count: int) -> Float[np.ndarray, "n nx"]:
    """Return first states of the data inside the limits, else any rows inside, far from one another.

    Raises
    ------
    DataError
        No row of the data is inside the limits.
    """
    low, high = asked.limits.states(data.nx)
    room = _MARGIN * np.where(np.isfinite(high - low), high - low, 0.0)
    for rows in ([e.X[0] for e in data], np.concatenate([e.X for e in data])):
        points = np.unique(np.array(rows), axis=0)
        points = points[((points >= low + room) & (points <= high - room)).all(axis=1)]
        if len(points):
            break
    else:
        raise DataError("no row of the data is inside the limits, so no experiment can begin there; pass starts=")
    Z = (points - np.median(points, axis=0)) / np.maximum(asked.high - asked.low, 1e-12)
    central = np.argsort((Z**2).sum(axis=1), kind="stable")[: max(-(-len(Z) // 2), min(count, len(Z)))]
    picked = [int(central[0])]
    while len(picked) < min(count, len(central)):
        apart = np.min([((Z[central] - Z[i]) ** 2).sum(axis=1) for i in picked], axis=0)
        picked.append(int(central[apart.argmax()]))
    return points[picked]


def refuse_starts(asked: DesignTask, data: Episodes) -> None:
    """Raise where a start is outside the limits, or far outside the data."""
    low, high = asked.limits.states(data.nx)
    room = _ROOM * np.maximum(asked.high - asked.low, 1e-12)
    for x in asked.starts:
        for i, name in enumerate(data.states):
            shown = with_unit(name, f"= {x[i]:.4g}")
            if not low[i] <= x[i] <= high[i]:
                raise DataError(
                    f"a start is outside the limits: {shown}, limits {low[i]:.4g} to {high[i]:.4g}; pass starts= inside"
                )
            if not asked.low[i] - room[i] <= x[i] <= asked.high[i] + room[i]:
                raise DataError(
                    f"a start is outside the data: {shown}, the data reach from {asked.low[i]:.4g} to "
                    f"{asked.high[i]:.4g}; start where the logs were, and let a later plan go on from there"
                )


def rank_fits(data: Episodes, embedding: Delay | None, rng: np.random.Generator) -> list[Fit]:
    """Return fits of several structures, the best first, by re-lifted forecasts of a third of the data.

    The best is the smallest whose error is at most a tenth above the least; those with an error above twice that are
    left out. Products have a ridge by cross-validation, since the data need not decide them.
    """
    longest = max(len(e) for e in data)
    pieces = [piece for e in data for piece in _cut(e, max(longest // 3, 4))] if len(data) < 6 else list(data)
    past = 0 if embedding is None else embedding.steps
    pieces = [piece for piece in pieces if len(piece) > past]
    train, test = data.with_episodes(pieces).split(2 / 3, rng) if len(pieces) > 1 else (data, data)
    ahead = max(min(_AHEAD, min(len(e) for e in test) - past), 1)
    plain = State() + Constant()
    entries = data.nx if embedding is None else data.nx + past * (data.nx + data.nu)
    liftings = [plain] + [plain + Monomials(degree) for degree, most in _DEGREES if entries <= most]
    kinds = (edmd, bilinear_edmd) if not data.nw else (edmd,)
    fits: list[Fit] = [
        partial(kind, lifting=lifting, embedding=embedding, ridge=_RIDGE if lifting is plain else "gcv")
        for lifting in liftings
        for kind in kinds
    ]
    spread = np.maximum(np.concatenate([e.X for e in data]).std(axis=0), 1e-12)
    errors = np.full(len(fits), np.inf)
    with hide_fit_warnings():
        for i, fit in enumerate(fits):
            try:
                found = score(fit(train), test, ahead, relift=True)
            except KoopmpcError:  # too few rows for so many columns
                continue
            error = float(np.linalg.norm(found.rmse / spread))
            errors[i] = error if np.isfinite(error) else np.inf
    least = float(errors.min())
    if not np.isfinite(least):
        raise DataError("no model can be fitted to these data; pass longer logs, or model=")
    first = int(np.flatnonzero(errors <= _ALIKE * least + 1e-9)[0])
    others = [int(i) for i in np.argsort(errors, kind="stable") if i != first and errors[i] <= _NEAR * least + 1e-9]
    return [fits[first], *(fits[i] for i in others[:_RIVALS])]


def _cut(episode: Episode, length: int) -> list[Episode]:
    ends = range(0, len(episode), length)
    return [episode.cut(k, min(k + length, len(episode))) for k in ends if min(k + length, len(episode)) - k > 1]


def build_law(model: Model, asked: DesignTask) -> KoopmanMPC | BilinearMPC:
    """Return the predictive controller of a model; without limits of observables that its lifting lacks."""
    kind: Any = BilinearMPC if isinstance(model, BilinearPredictor) else KoopmanMPC
    try:
        return kind(model, asked.cost, asked.limits, asked.horizon)
    except KoopmpcError:
        if asked.limits.of is None:
            raise
        plain = replace(asked.limits, of=None, y_min=None, y_max=None, slack="auto")
        return kind(model, asked.cost, plain, asked.horizon)


def _find_ends(data: Episodes) -> tuple[Float[np.ndarray, " nu"], Float[np.ndarray, " nu"]]:
    U = np.concatenate([e.U for e in data])
    return U.min(axis=0), U.max(axis=0)


def simulate_visits(
    ensemble: Ensemble, model: Model, data: Episodes, asked: DesignTask, design: Design | None, rng: np.random.Generator
) -> Visits:
    """Return what the designed loop visits on the model and on some bootstrap models."""
    law = build_controller(design.controller.as_data()) if design is not None else build_law(model, asked)
    chosen = asked.starts[:_LOOPS]
    runs = [
        visit_loop(ensemble, law, member, x0, asked.reference, asked.steps)
        for x0 in chosen
        for member in range(1 + min(_DOUBTED, len(ensemble.theta) - 1))
    ]
    runs = [(points, U) for points, U in runs if len(U)]
    if not runs:
        raise DataError("the controller gives no input on its own model; see the report of the fit, or pass model=")
    points, inputs = (np.concatenate(parts) for parts in zip(*runs, strict=True))
    known = [(e.X[:-1], e.U) for e in model.embed(data)]
    return weigh_visits(ensemble, points, inputs, known, rng)
