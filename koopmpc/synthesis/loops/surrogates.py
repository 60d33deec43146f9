"""Surrogates: learned maps that replace the plant when controllers are judged."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np
from jaxtyping import Float

from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import Value
from koopmpc.control.ask.cost import Cost
from koopmpc.control.ask.limits import Limits
from koopmpc.control.nonlinear.equilibrium import Equilibria, Equilibrium
from koopmpc.control.nonlinear.stages import LearnedMap, learned_map
from koopmpc.control.plan.tracking import state_tracking
from koopmpc.data.episodes import Episodes
from koopmpc.plants.step_map import StepMap
from koopmpc.synthesis.search.cross_validation import HALF, Tried
from koopmpc.synthesis.search.recipe import Recipe
from koopmpc.synthesis.task import DesignTask
from koopmpc.validate.scoring import AnyPredictor, score

SECOND = 3.0  # the error of the second surrogate may be this many times that of the best
INVARIANT = 0.25  # the plant ignores a state that changes increments by less than this share; models err as much
GROWN = 2.0  # a plant is unstable if a deviation grows by this factor within a horizon
_SAMPLE = 500  # number of states on which ignored states are searched
_FAMILIES = ("monomials", "fourier", "gaussian", "thin plate", "random fourier")


Holding = Callable[[Float[np.ndarray, " nr"]], Equilibrium]  # reference row → equilibrium, kept for next time


@dataclass(frozen=True, eq=False)
class Surrogate(Value):
    """x⁺ = F(x, u_0 + gain (u − u_0)), F a learned model that is lifted afresh at every step, y = x + noise.

    u_0 is a standard deviation below the mean of the inputs: another gain is a constant load on inputs at their mean,
    and a controller without an estimator shows its offset there.

    Attributes
    ----------
    model
        The predictor.
    middle, w
        (nu,) inputs and (nw,) the measured disturbances that act: the means of the data.
    noise
        (nx,) standard deviation of the measurements: the model's one-step error over √2, of noise and misfit, and what
        a smoother took out of the data.
    spread
        (nu,) standard deviation of the inputs; (0,) in files of earlier designs, whose u_0 is the mean.
    feedthrough
        The model is one of log rows h(x_k, u_k), and a controller reads h(x_k, u_{k−1}): the model's next output under
        the input of the step before.
    """

    model: AnyPredictor
    middle: Float[np.ndarray, " nu"]
    w: Float[np.ndarray, " nw"]
    noise: Float[np.ndarray, " nx"]
    spread: Float[np.ndarray, " m"] = field(default_factory=lambda: np.zeros(0))
    feedthrough: bool = False

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, without their past."""
        return self.model.states

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""
        return self.model.inputs

    @raise_swallowed()
    def plant(self, gain: float = 1.0, *, reads: bool = True) -> StepMap:
        """Return the plant whose inputs act `gain` times as much as in the data; y is the state without its past.

        With feedthrough its state ends with the input of the step before, see `StepMap`, and y is what a controller
        reads; if not `reads`, they are as without.
        """
        model, given = self.model, self._map(gain)
        x, u = ca.SX.sym("x", given.nx), ca.SX.sym("u", model.nu)
        x_next = given.F(x, u, ca.DM(given.theta)) + ca.DM(given.E @ self.w)
        F = ca.Function("F", [x, u], [ca.densify(x_next)], ["x", "u"], ["x_next"], {"cse": True})
        h = ca.Function("h", [x], [x[: model.nx]])
        if self.feedthrough and reads:
            h = ca.Function("h", [x, u], [ca.densify(x_next)[: model.nx]], {"cse": True})
        names = model.point_names
        if h.n_in() > 1:  # the StepMap has u[k-1] of its own
            names = (*model.states, *(f"{name} of the row before" for name in names[model.nx :]))
        return StepMap(F, model.dt, h, names, model.inputs, model.states)

    def start(self, x0: Float[np.ndarray, " m"]) -> Float[np.ndarray, " n"]:
        """Return the point of the model, its past included, after a rest at x0; x0 itself if it includes its past."""
        embedding = self.model.embedding
        same = embedding is None or len(x0) == len(self.model.point_names)
        return x0 if same or embedding is None else embedding.repeat(x0, self.middle)

    def holding(self, cost: Cost, limits: Limits, gain: float = 1.0) -> "Holding":
        """Return the search for the equilibrium of this plant nearest to a row inside the limits, from the last one."""
        given = self._map(gain)
        equilibria = Equilibria(given, state_tracking(self.model.states, self.model.inputs, cost, limits, given.nx))
        push, known, last = given.E @ self.w, dict[bytes, Equilibrium](), list[Equilibrium]()

        def find(row: Float[np.ndarray, " nr"]) -> Equilibrium:
            key, before = row.tobytes(), last[-1] if last else None
            if key not in known:
                known[key] = equilibria.find(row, push, before) or before or equilibria.guess(row)
                last[:] = [known[key]]
            return known[key]

        return find

    def find_reference_inputs(
        self, cost: Cost, limits: Limits, rows: Float[np.ndarray, "T nr"], gain: float = 1.0
    ) -> Float[np.ndarray, "T nu"]:
        """Return the inputs that cost nothing: those that hold each reference row, unless the cost names others."""
        given, nu = cost.given_inputs(self.model.nu), self.model.nu
        if given is not None:
            return given[np.minimum(np.arange(len(rows)), len(given) - 1)]
        if cost.u_target != "equilibrium":
            return np.zeros((len(rows), nu))
        find = self.holding(cost, limits, gain)
        return np.array([find(row).u for row in rows])

    @raise_swallowed()
    def _map(self, gain: float) -> LearnedMap:
        given = learned_map(self.model)
        given = given.at(self.w)
        if gain == 1.0:
            return given
        x, u, theta = (ca.SX.sym(name, n) for name, n in (("x", given.nx), ("u", given.nu), ("t", len(given.theta))))
        origin = ca.DM(self.middle - self.spread if self.spread.size else self.middle)
        return replace(given, F=ca.Function("F", [x, u, theta], [given.F(x, origin + gain * (u - origin), theta)]))


def rank_results(results: Sequence[Tried], floor: float) -> list[tuple[float, Recipe]]:
    """Return the error in the worst fold of each model with its best ridge, and the recipe of that, the best first."""
    places = [(tried, tried.best(floor)) for tried in results]
    ranked = [(float(one.scores[k].max()), Recipe(one.candidate, one.ridges[k])) for one, k in places]
    return sorted(ranked, key=lambda each: each[0])


def choose_surrogates(results: Sequence[Tried], floor: float, hidden: bool = False) -> list[Recipe]:
    """Return the two models of the surrogates: the one with the smallest error, and the best of another family.

    They are bilinear if bilinear models were tried. A model with delays is taken only if it halves the error, which
    happens if a part of the state is not measured, or if the data show a `hidden` state and its error is less. The
    second family extrapolates differently, so closed loops show errors that only one of the models has. If the error
    of the best of another family is more than three times as large, the second best of the same family is taken, or
    the best itself. Where there are others, models with a hidden state are left out: at the start of a loop nobody
    knows their state.
    """
    results = [one for one in results if not one.candidate.has_hidden_state] or results
    ranked = rank_results(results, floor)
    bilinear = [one for one in ranked if one[1].candidate.bilinear] or ranked
    pool = [one for one in bilinear if not one[1].candidate.delays] or bilinear
    late = [one for one in bilinear if one[1].candidate.delays]
    if late and late[0][0] < (1.0 if hidden else HALF) * pool[0][0]:
        pool = late
    least, first = pool[0]
    rest = [recipe for error, recipe in pool[1:] if error <= SECOND * least]
    other = [recipe for recipe in rest if _find_family(recipe) != _find_family(first)]
    return [first, [*other, *rest, first][0]]


def fit_surrogate(
    recipe: Recipe, fitted: Episodes, held_out: Episodes, smoothed: Float[np.ndarray, " nx"]
) -> Surrogate:
    """Return the surrogate of a recipe that is fitted to some episodes; its noise is measured on others.

    `smoothed` is the (nx,) standard deviation of the noise that these data no longer hold.
    """
    model = recipe.fit(fitted)
    rows = np.concatenate([np.hstack([episode.U, episode.W]) for episode in fitted])
    driven, spread = rows.mean(axis=0), rows[:, : fitted.nu].std(axis=0)
    error = score(model, held_out, 1, relift=True).rmse[0]
    noise = np.hypot(np.where(np.isfinite(error), error, 0.0) / np.sqrt(2), smoothed)
    return Surrogate(model, driven[: fitted.nu], driven[fitted.nu :], noise, spread, recipe.feedthrough)


def find_ignored_states(one: Surrogate, X: Float[np.ndarray, "M nx"]) -> list[int]:
    """Return the states on which no increment x⁺ − x depends by more than a quarter: positions, mostly.

    Each state is exchanged for that of other data, and the change of the increments compared with their spread. On
    learned models of six plants, positions on which nothing depends changed them by 1 to 22 %, all other states by 83 %
    and more.
    """
    plant = one.plant(reads=False)
    if plant.nx != X.shape[1]:
        return []
    points = X[:: -(-len(X) // _SAMPLE)]
    U = np.tile(one.middle, (len(points), 1, 1))

    def increments(points: Float[np.ndarray, "M nx"]) -> Float[np.ndarray, "M nx"]:
        return plant.rollouts(points, U)[:, 1] - points

    usual = increments(points)
    size = np.maximum(usual.std(axis=0), 1e-12)
    found: list[int] = []
    for i in range(points.shape[1]):
        other = points.copy()
        other[:, i] = np.roll(points[:, i], len(points) // 2)
        change = increments(other) - usual
        if (np.sqrt(np.mean(change**2, axis=0)) < INVARIANT * size).all():
            found.append(i)
    return found


def is_unstable(surrogates: Sequence[Surrogate], task: DesignTask) -> bool:
    """Return whether deviations from the equilibrium at the reference grow within a horizon, on half of the surrogates.

    Of a moving reference this is asked at its first, middle and last row. A pair of integrators does not count.
    """
    places = (0, len(task.reference) // 2, -1) if task.moves else (0,)
    found: list[bool] = []
    for one in surrogates:
        plant, find = one.plant(reads=False), one.holding(task.cost, task.limits)
        for place in places:
            at = find(task.reference[place])
            A = plant.linearize(at.x, at.u).A
            modulus = np.abs(np.linalg.eigvals(A)).max() if np.isfinite(A).all() else np.inf
            found.append(bool(task.horizon * np.log(max(modulus, 1e-300)) > np.log(GROWN)))
    return bool(2 * sum(found) > len(found))


def _find_family(recipe: Recipe) -> str:
    name = recipe.candidate.name
    return next((family for family in reversed(_FAMILIES) if name.startswith(family)), name)
