"""Models of records with a hidden state: linear and polynomial ones, with rails and without, and neurons."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base.errors import KoopmpcError, hide_fit_warnings
from koopmpc.base.parallel import Progress
from koopmpc.data.episodes import Episodes
from koopmpc.models.base import sorted_eigen
from koopmpc.models.predictors import BilinearPredictor
from koopmpc.models.records.hidden_fit import fit_hidden
from koopmpc.models.records.hidden_structure import HiddenStructure, choose_hidden, find_rails
from koopmpc.models.records.narx import FOLDS
from koopmpc.models.records.state_space import search_hidden, search_neural
from koopmpc.models.records.subspace import choose_sizes
from koopmpc.synthesis.search.candidates import Candidate
from koopmpc.synthesis.search.free_runs import PAYS, FreeRun, cut_pieces, forecast_rows, judge_free_run, measure_spread
from koopmpc.synthesis.search.leaderboard import LeaderboardRow
from koopmpc.validate.scoring import AnyPredictor

FAR = 1.2  # a kind that errs by this many times the least error is left out
LOST = 1.0  # a model that errs by more spreads than this on one stretch is not taken where another one is calm
NEAR = 1.5  # else the best model with neurons is judged if it errs by less than this many times the least error
_NEURAL_ORDERS = (2, 3, 4)  # orders of hidden states with neurons
_SENSORS = 2  # neurons are tried on records of at most so many sensors: with more of them little is hidden
_ORDERS = (1, 2, 3, 4)  # orders of hidden states that simulation error is tried on
_RAILED = 2  # that many of them are tried with the rails of a sensor too
_PROPOSED = 2  # candidates with a hidden state that a design fits to each fold and judges in its loops, at most


def judge_hidden_states(
    measured: Episodes,
    first: int,
    horizon: int,
    bilinear: bool,
    rival: float = np.inf,
    *,
    ran: Mapping[str, FreeRun] | None = None,
    short: int | None = None,
    progress: Progress | None = None,
) -> list[tuple[LeaderboardRow, FreeRun]]:
    """Return the best models with a hidden state of each kind, and how they run over stretches that no fit saw.

    The kinds are the subspace model, the linear and the polynomial one of least simulation error, the latter with rails
    where a sensor rests at its least or largest reading and they gain; and for one or two sensors those with
    neurons, with the rails if the best one before has them. With neurons the best one and the smallest of other orders
    are judged, if they are calm and err by a tenth less than all others; else of those that err by less than half more.
    Where records are too short for a kind, it is left out; so is a model that on the first stretches errs by
    a tenth more than the best calm one so far, and one that does not err a tenth less than the calm one of its kind.
    `rival` is the least error of other models on unseen rows, and `ran` how the best of each kind ran. Forecasts of
    `short` steps judge, and the leaderboard shows the errors of `horizon` steps.
    """
    begun = perf_counter()
    found = search_hidden_states(measured, bilinear, rival, progress, near=NEAR)
    searched = (perf_counter() - begun) / max(len(found), 1)
    results: list[tuple[LeaderboardRow, FreeRun]] = []
    calm = {kind: run for kind, run in (ran or {}).items() if run.calm}
    for structure in found:
        others = [*calm.values(), *(run for _, run in results if run.calm)]
        best = min(others, key=lambda run: run.error, default=None)
        beaten = calm.get("bilinear" if structure.is_nonlinear else "linear")
        try:
            result = _judge(structure, measured, first, horizon, short or horizon, searched, best, beaten)
        except KoopmpcError:
            continue
        if result is not None:
            results.append(result)
    return results


def search_hidden_states(
    measured: Episodes, bilinear: bool, rival: float = np.inf, progress: Progress | None = None, *, near: float = PAYS
) -> list[HiddenStructure]:
    """Return the best structure of each kind, as `judge_hidden_states` lists them; of those that err far more, none.

    If no model with neurons errs by a tenth less, those count that err by less than `near` times the best of all.
    """
    rails = find_rails(measured)

    def ask(_: str, done: int, total: int) -> None:
        if progress is not None:
            progress(done, total)

    def search(how: Any, *args: Any, **more: Any) -> list[HiddenStructure]:
        try:
            return how(measured, *args, ask=ask, **more)
        except KoopmpcError:  # the records are too short for this kind
            return []

    found = search(_find_subspace)
    plain = search(search_hidden, _ORDERS, rails=None)
    railed = list[HiddenStructure]()
    if rails is not None:  # only orders that did best without
        ranked = dict.fromkeys(one.order for one in sorted(plain, key=lambda one: one.error))
        railed = search(search_hidden, tuple(ranked)[:_RAILED] or _ORDERS, rails=rails)
    for kind, tried in ((False, plain), (True, [*plain, *railed]))[: 1 + bilinear]:
        same = [one for one in tried if one.is_nonlinear is kind]
        found += [choose_hidden(same)] if same else []
    neural = list[HiddenStructure]()
    if bilinear and measured.nx <= _SENSORS:
        saturates = bool(found) and min(found, key=lambda one: one.error).rails is not None
        limits = rails if saturates else None
        with_neurons = search(search_neural, _NEURAL_ORDERS, degrees=(1,), rails=limits, quick=True)
        neural = _choose_neural(with_neurons, min([rival, *(one.error for one in found if one.calm)]), near)
    least = min([rival, *(one.error for one in (*found, *neural))])
    return [*(one for one in found if one.error < FAR * least), *neural]


def _find_subspace(measured: Episodes, *, ask: object) -> list[HiddenStructure]:
    del ask  # it takes no time
    (order,), (delays,), errors = choose_sizes(measured)
    return [HiddenStructure(order, 1, delays, 0, None, errors, True, order * (order + 1 + measured.nu))]


def _choose_neural(tried: Sequence[HiddenStructure], best: float, near: float) -> list[HiddenStructure]:
    """Return the smallest order and the best one of those with neurons; where no model gains, of those nearly as good.

    One quarter hardly tells models apart: the others may.
    """
    calm = [[one for one in tried if one.calm and one.error < share * best] for share in (PAYS, near)]
    same = calm[0] or calm[1]
    orders = sorted({one.order for one in same})
    each = [choose_hidden([one for one in same if one.order == order]) for order in orders]
    each.sort(key=lambda one: one.parameters)
    best_one = min(each, key=lambda one: one.error, default=None)
    return [one for one in each if one is each[0] or one is best_one]  # the best one races against the smallest


def propose_hidden_states(episodes: Episodes, bilinear: bool, progress: Progress | None = None) -> list[Candidate]:
    """Return the two best candidates with a hidden state; none where the records are too short."""
    found: list[Candidate] = []
    structures = search_hidden_states(episodes, bilinear, progress=progress)
    for structure in sorted(structures, key=lambda one: (not one.calm, one.error))[:_PROPOSED]:
        try:
            with hide_fit_warnings():
                model = fit_hidden(structure, episodes, quick=True)
        except KoopmpcError:
            continue
        name = _name_structure(structure)
        found.append(Candidate(name, model.lifting, model.embedding, isinstance(model, BilinearPredictor), structure))
    return found


def _name_structure(structure: HiddenStructure) -> str:
    rails = "" if structure.rails is None else ", saturating sensor"
    how = "simulation error" if structure.horizon else "subspace"
    name = f"hidden state of order {structure.order}"
    if structure.neurons:
        name += f", {structure.neurons} neuron{'s' * (structure.neurons != 1)}"
    else:
        name += f", degree {structure.degree}" if structure.is_nonlinear else f", {how}"
    return name + rails


def _judge(
    structure: HiddenStructure,
    measured: Episodes,
    first: int,
    horizon: int,
    short: int,
    searched: float,
    rival: FreeRun | None,
    beaten: FreeRun | None,
) -> tuple[LeaderboardRow, FreeRun] | None:
    """Return the line of the leaderboard and the free runs of a structure; None where a rival does much better.

    `beaten` is as in `judge_free_run`.
    """
    begun, models = perf_counter(), list[AnyPredictor]()

    def fit(episodes: Episodes) -> AnyPredictor:
        with hide_fit_warnings():
            models.append(fit_hidden(structure, episodes, quick=True))
        return models[-1]

    start = max(first, structure.delays)
    known = True if structure.neurons and structure.calm else None  # from other states too, and the last fit sees again
    run = judge_free_run(
        fit, measured, measured, start, short, relift=structure.is_nonlinear, rival=rival, beaten=beaten, calm=known
    )
    if len(models) <= FOLDS and not (known and run.calm):  # it was given up
        return None
    run = replace(run, calm=run.calm and bool(run.errors.max() < LOST))
    errors, whole = _errors_ahead(models, measured, start, horizon), models[-1]
    radius = float(np.abs(sorted_eigen(whole.A)[0][0]))
    row = LeaderboardRow(
        name=_name_structure(structure),
        bilinear=isinstance(whole, BilinearPredictor),
        nz=whole.nz,
        size=structure.parameters,
        delays=structure.delays,
        ridge=0.0,
        first=float(errors[0]),
        middle=float(errors[max(horizon // 2, 1) - 1]),
        last=float(errors[-1]),
        median=float(np.median(run.errors)),
        worst=float(run.errors.max()),
        deviation=0.0,
        radius=radius,
        growth=1.0,
        seconds=perf_counter() - begun + searched,
        lifting=whole.lifting,
        embedding=whole.embedding,
        structure=replace(structure, errors=run.errors, calm=run.calm),
    )
    return row, run


def _errors_ahead(
    models: list[AnyPredictor], data: Episodes, first: int, horizon: int
) -> Float[np.ndarray, " horizon"]:
    """Return the error of each step ahead, in spreads, each model on the quarter that it did not learn from."""
    pieces = cut_pieces(data)
    scale = measure_spread(pieces)
    squares, count = np.zeros(horizon), 0
    for fold, model in enumerate(models[:FOLDS]):
        for e in pieces:
            low, high = max(len(e) * fold // FOLDS, first), len(e) * (fold + 1) // FOLDS
            starts = [*range(low, high - horizon + 1, horizon)]
            if starts:
                relift = isinstance(model, BilinearPredictor)
                gaps = forecast_rows(model, pieces.with_episodes([e]), starts, horizon, relift) / scale
                squares += np.sum(np.minimum(np.abs(gaps), 1e3) ** 2, axis=(1, 2)) / gaps.shape[2]
                count += gaps.shape[1]
    return np.sqrt(squares / max(count, 1))
