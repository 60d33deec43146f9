"""The discrete-time plant x⁺ = F(x, u, w), y = h(x), immutable: one step, and many episodes at once."""

import subprocess
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.scene import Scene
from koopmpc.base.values import Named, Value, freeze
from koopmpc.plants import routines
from koopmpc.plants.dynamics import (
    RK4,
    Dynamics,
    Integrator,
    build_output,
    build_right_side,
    check_integrator,
    find_scene,
    split_inputs,
)
from koopmpc.plants.graph import Graph
from koopmpc.plants.routines import Buffered, make_dense

_WORTH_COMPILING = 20_000  # compile F for a batch of at least so many steps: interpreting them takes as long, 0.2 s
_LONGEST = 5_000  # do not compile an F of more operations: the compiler's time grows faster than the code
_WIDE = 64  # use numpy columns from so many episodes on: they are then faster than one call a step
_CHUNK = 4096  # episodes that run at once, so that their columns stay in the cache


@dataclass(frozen=True, eq=False)
class Affine(Value):
    """x⁺ ≈ A x + B u + E w + c: A (nx, nx), B (nx, nu), c (nx,), E (nx, nw)."""

    A: Float[np.ndarray, "nx nx"]
    B: Float[np.ndarray, "nx nu"]
    c: Float[np.ndarray, " nx"]
    E: Float[np.ndarray, "nx nw"]


@dataclass(frozen=True, eq=False, init=False)
class StepMap(Named):
    """x⁺ = F(x, u), or F(x, u, w) with measured disturbances w, and y = h(x), one sample of dt [s].

    Parameters
    ----------
    F
        CasADi function of x (nx) and u (nu, may be 0) that returns x⁺ (nx). An F made of SX runs in batches. A third
        argument w (nw) holds measured disturbances, such as the weather; calls without w take it as zero.
    dt
        Sample time [s].
    h
        CasADi function of x that returns y (ny); by default y = x. Or of x and u, where an input acts on the output at
        once. The state then ends with u_{k−1}, and y_k = h(x_k, u_{k−1}) is what a controller reads before it chooses
        u_k; `simulate` and `collect` read so too.
    states, inputs, outputs
        Names with units; by default x0, x1, …; u0, …; and the states' names or y0, ….
    scene
        scene(x, u) → shapes, for the animation in the logs; pickling leaves it out.
    disturbances
        Names of w with units; by default w0, w1, ….

    Raises
    ------
    ShapeError
        F or h takes or returns other shapes, or there are more or fewer names than rows.
    DataError
        dt is not above zero, or a name of a state, an input or a disturbance is used twice.
    """

    F: ca.Function
    h: ca.Function
    dt: float
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    scene: Scene | None = field(default=None, compare=False)
    disturbances: tuple[str, ...] = ()

    @raise_swallowed()
    def __init__(
        self,
        F: ca.Function,
        dt: float,
        h: ca.Function | None = None,
        states: Sequence[str] | None = None,
        inputs: Sequence[str] | None = None,
        outputs: Sequence[str] | None = None,
        scene: Scene | None = None,
        disturbances: Sequence[str] | None = None,
    ) -> None:
        _check_signature(F, "F", 2)
        if F.n_in() > 2 and not F.size1_in(2):
            F = _hold(F, np.zeros(0))
        nx, nu = F.size1_in(0), F.size1_in(1)
        if F.size1_out(0) != nx:
            raise ShapeError(f"F returns {F.size1_out(0)} rows, expected {nx}, one a state")
        if h is None:
            x = ca.SX.sym("x", nx)
            h = ca.Function("h", [x], [x], ["x"], ["y"])
            outputs = checks.names(states, "states", "x", nx) if outputs is None else outputs
        _check_signature(h, "h", 1)
        if h.size1_in(0) != nx:
            raise ShapeError(f"h takes {h.size1_in(0)} states, F has {nx}; pass h of the same x")
        if h.n_in() > 1:
            if h.size1_in(1) != nu:
                raise ShapeError(f"h takes {h.size1_in(1)} inputs, F has {nu}; pass h of the same u")
            own, moves = checks.names(states, "states", "x", nx), checks.names(inputs, "inputs", "u", nu)
            outputs = checks.names(outputs, "outputs", "y", h.size1_out(0))
            F, h, scene = _keep_input(F), _read_before(h), _leave_input(scene, nx)
            nx, states = nx + nu, (*own, *map(_name_before, moves))
        freeze(
            self,
            F=make_dense(F),
            h=make_dense(h),
            dt=checks.positive(dt, "dt", "s"),
            states=checks.names(states, "states", "x", nx),
            inputs=checks.names(inputs, "inputs", "u", nu),
            outputs=checks.names(outputs, "outputs", "y", h.size1_out(0)),
            scene=scene,
            disturbances=checks.names(disturbances, "disturbances", "w", F.size1_in(2) if F.n_in() > 2 else 0),
        )
        checks.distinct(self.states, self.inputs, self.disturbances)

    @property
    def ny(self) -> int:
        """Number of outputs."""
        return len(self.outputs)

    def __call__(self, x: ArrayLike, u: ArrayLike, w: ArrayLike | None = None) -> Float[np.ndarray, " nx"]:
        """x⁺ = F(x, u, w): (nx,) from x (nx,), u (nu,) and w (nw,), which is zero by default.

        NaN passes through. If an implicit method finds no x⁺, the result is NaN and a RuntimeWarning says so.
        """
        x, u = _as_vector(x, "x", len(self.states)), _as_vector(u, "u", len(self.inputs))
        x_next = np.empty(self.nx)
        self.advance(x, u, x_next, None if w is None else _as_vector(w, "w", len(self.disturbances)))
        return x_next

    def advance(
        self,
        x: Float[np.ndarray, " nx"],
        u: Float[np.ndarray, " nu"],
        x_next: Float[np.ndarray, " nx"],
        w: Float[np.ndarray, " nw"] | None = None,
    ) -> None:
        """Write F(x, u, w) into `x_next`; unlike a call, this does not check the arguments."""
        step = self._step
        x_place, v_place = step.arguments
        x_place[:] = x
        if self.disturbances:
            v_place[: len(u)], v_place[len(u) :] = u, 0.0 if w is None else w
        else:
            v_place[:] = u
        try:
            step.evaluate()
        except RuntimeError as error:
            _warn_unsolved(error, x, u)
            x_next[:] = np.nan
        else:
            x_next[:] = step.results[0]

    def at(self, w: ArrayLike) -> "StepMap":
        """Return the map x⁺ = F(x, u, w) of constant measured disturbances w (nw,), which takes x and u alone."""
        values = checks.array(w, "w", (self.nw,))
        F = _hold(self.F, values) if self.nw else self.F
        return StepMap(F, self.dt, self.h, self.states, self.inputs, self.outputs, self.scene)

    def measure(self, x: ArrayLike) -> Float[np.ndarray, " ny"]:
        """Return y = h(x): (ny,) from x (nx,)."""
        if self.measures_all:
            return _as_vector(x, "x", len(self.states)).copy()
        output = self._output
        output.arguments[0][:] = _as_vector(x, "x", len(self.states))
        output.evaluate()
        return output.results[0].copy()

    def rollout(self, x0: ArrayLike, U: ArrayLike, W: ArrayLike | None = None) -> Float[np.ndarray, "steps nx"]:
        """x_{k+1} = F(x_k, u_k, w_k): X (T+1, nx) from x0 (nx,), U (T, nu) and W (T, nw), to the bit as single calls.

        Without W the measured disturbances are zero.
        """
        start = checks.array(x0, "x0", (self.nx,))
        moves = self._drive(checks.array(U, "U", (None, self.nu)), W)
        X = np.empty((len(moves) + 1, self.nx))
        X[0] = start
        _roll_out(self._step, X, moves)
        return X

    def rollouts(
        self, X0: ArrayLike, U: ArrayLike, W: ArrayLike | None = None
    ) -> Float[np.ndarray, "episodes steps nx"]:
        """x_{k+1} = F(x_k, u_k, w_k) for E episodes at once: X (E, T+1, nx) from X0 (E, nx), U (E, T, nu).

        W (E, T, nw) are the measured disturbances, zero by default.
        """
        starts = checks.array(X0, "X0", (None, self.nx))
        moves = self._drive(checks.array(U, "U", (len(starts), None, self.nu)), W)
        X = np.empty((len(starts), moves.shape[1] + 1, self.nx))
        X[:, 0] = starts
        self._batch.fill(X, moves)
        return X

    def _drive(self, U: Float[np.ndarray, "... nu"], W: ArrayLike | None) -> Float[np.ndarray, "... nv"]:
        """Return rows [u w]."""
        shape = (*U.shape[:-1], self.nw)
        rows = np.zeros(shape) if W is None else checks.array(W, "W", shape)
        return np.concatenate([U, rows], axis=-1) if self.nw else U

    def linearize(self, x: ArrayLike, u: ArrayLike, w: ArrayLike | None = None) -> Affine:
        """x⁺ ≈ A x + B u + E w + c about (x*, u*, w*): A, B, E = ∂F/∂x, ∂F/∂u, ∂F/∂w exactly; w* is zero by default.

        c = F(x*, u*, w*) − A x* − B u* − E w*.
        """
        x, u = checks.array(x, "x", (self.nx,)), checks.vector(u, "u", self.nu)
        w = np.zeros(self.nw) if w is None else checks.array(w, "w", (self.nw,))
        x_next, columns_A, columns_B = self._jacobians(x, np.concatenate([u, w]) if self.nw else u)
        A = np.ascontiguousarray(columns_A.reshape(self.nx, self.nx).T)
        B, E = np.split(columns_B.reshape(self.nu + self.nw, self.nx).T, [self.nu], axis=1)
        B, E = np.ascontiguousarray(B), np.ascontiguousarray(E)
        return Affine(A, B, x_next - A @ x - B @ u - E @ w, E)

    @cached_property
    @raise_swallowed()
    def _joint_map(self) -> ca.Function:
        """F as a function of x and [u; w]; F itself without disturbances."""
        if not self.nw:
            return self.F
        x, v = ca.MX.sym("x", self.nx), ca.MX.sym("v", self.nu + self.nw)
        F = ca.Function("F", [x, v], [self.F(x, v[: self.nu], v[self.nu :])], ["x", "v"], ["x_next"])
        return F.expand("F", {"cse": True}) if self.F.is_a("SXFunction") else F

    @cached_property
    def _step(self) -> Buffered:
        return Buffered(self._joint_map)

    @cached_property
    def _batch(self) -> "_Batch":
        return _Batch(self._step)

    @cached_property
    @raise_swallowed()
    def measures_all(self) -> bool:
        """True if y = x."""
        nx = len(self.states)
        x = ca.SX.sym("x", nx)
        return len(self.outputs) == nx and self.h.is_a("SXFunction") and ca.is_equal(self.h(x), x, 1)

    @cached_property
    def _output(self) -> Buffered:
        return Buffered(self.h)

    @cached_property
    @raise_swallowed()
    def _jacobians(self) -> Buffered:
        x, v = ca.MX.sym("x", self.nx), ca.MX.sym("v", self.nu + self.nw)
        x_next = self._joint_map(x, v)
        A, B = ca.densify(ca.jacobian(x_next, x)), ca.densify(ca.jacobian(x_next, v))
        together = ca.Function("linearize", [x, v], [x_next, A, B])
        return Buffered(together.expand("linearize", {"cse": True}) if self.F.is_a("SXFunction") else together)

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name != "scene"}


@raise_swallowed()
def discretize(dynamics: Dynamics, dt: float, integrator: Integrator = RK4()) -> StepMap:  # noqa: B008
    """Return x⁺ = F(x, u, w) of ẋ = f(x, u, w) over one sample with constant u and w.

    Parameters
    ----------
    dynamics
        ẋ = f(x, u), y = h(x), with the names of states and inputs.
    dt
        Sample time [s].
    integrator
        Euler, RK4, ImplicitMidpoint, Collocation or CVODES.

    Raises
    ------
    DataError
        dt is not above zero.
    ShapeError
        `dynamics.rhs` returns another number of rows than there are states.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> plant([0.1, 0.0], [0.0]).round(4)  # one step; plant.rollout(x0, U) takes many
    array([0.1006, 0.0245])
    >>> plant.linearize([0.0, 0.0], [0.0]).B.round(4)
    array([[0.0003],
           [0.0125]])
    """
    dt = checks.positive(dt, "dt", "s")
    check_integrator(integrator)
    F = split_inputs(integrator.step(build_right_side(dynamics), dt), dynamics.nu, dynamics.nw)
    h, outputs = build_output(dynamics)
    names = dynamics.states, dynamics.inputs, outputs
    return StepMap(F, dt, h, *names, find_scene(dynamics), dynamics.disturbances)


@raise_swallowed()
def _hold(F: ca.Function, w: Float[np.ndarray, " nw"]) -> ca.Function:
    """Return F(x, u) of F(x, u, w) for constant w."""
    x, u = ca.MX.sym("x", F.size1_in(0)), ca.MX.sym("u", F.size1_in(1))
    held = ca.Function("F", [x, u], [F(x, u, ca.DM(w))], ["x", "u"], ["x_next"])
    return held.expand("F") if F.is_a("SXFunction") else held


@raise_swallowed()
def _keep_input(F: ca.Function) -> ca.Function:
    """Return F of the state [x; u_{k−1}], which keeps u."""
    names = ["x", "u", "w"][: F.n_in()]
    v, u, *w = [ca.MX.sym(n, F.size1_in(i) + (i == 0) * F.size1_in(1)) for i, n in enumerate(names)]
    kept = ca.Function("F", [v, u, *w], [ca.vertcat(F(v[: F.size1_in(0)], u, *w), u)], names, ["x_next"])
    return kept.expand("F") if F.is_a("SXFunction") else kept


@raise_swallowed()
def _read_before(h: ca.Function) -> ca.Function:
    """Return h(x, u) of the state [x; u_{k−1}]."""
    v = ca.MX.sym("x", h.size1_in(0) + h.size1_in(1))
    y = ca.Function("h", [v], [h(v[: h.size1_in(0)], v[h.size1_in(0) :])], ["x"], ["y"])
    return y.expand("h") if h.is_a("SXFunction") else y


def _leave_input(scene: Scene | None, nx: int) -> Scene | None:
    """Return the scene of x alone."""
    return None if scene is None else lambda x, u: scene(x[:nx], u)


def _name_before(name: str) -> str:
    """Return ``"u[k-1] [N]"`` for ``"u [N]"``."""
    stem, bracket, unit = name.partition(" [")
    return f"{stem}[k-1]{bracket}{unit}"


def _as_vector(value: ArrayLike, name: str, length: int) -> Float[np.ndarray, " n"]:
    """Return `value` as float64 (length,), without a copy if it is one already: a control loop calls this each step."""
    if type(value) is np.ndarray and value.dtype == np.float64 and value.shape == (length,):
        return value
    result = checks.array(value, name, finite=False)
    return (
        result.reshape(1) if result.ndim == 0 and length == 1 else checks.array(result, name, (length,), finite=False)
    )


def _check_signature(function: ca.Function, name: str, arguments: int) -> None:
    checks.members(function, name, ("n_in", "n_out"), "pass a casadi Function")
    wanted = "(x, u)" if arguments == 2 else "(x)"
    given = function.n_in()
    if given not in {arguments, arguments + 1} or function.n_out() != 1:
        with_w = " or F(x, u, w)" if arguments == 2 else " or h(x, u)"
        raise ShapeError(
            f"{name} has {given} arguments and {function.n_out()} results, "
            f"expected {name}{wanted} with one result{with_w}"
        )
    sizes = [function.size2_in(i) for i in range(given) if function.size1_in(i)] + [function.size2_out(0)]
    if any(columns != 1 for columns in sizes):
        raise ShapeError(f"{name} is {function}, expected columns: {name}{wanted} with one column each")


class _Batch:
    """Fills X (E, T+1, nx) from X[:, 0] and U (E, T, nu).

    An F made of SX operations runs as generated C if there is a compiler and the batch is large enough, else as its
    expression graph over numpy columns. Any other F (implicit integrators, matrices) is called step by step.
    """

    def __init__(self, step: Buffered) -> None:
        self._step = step

    def fill(self, X: Float[np.ndarray, "E rows nx"], U: Float[np.ndarray, "E T nu"]) -> None:
        """Write x_{k+1} = F(x_k, u_k) for every episode."""
        episodes, steps = U.shape[:2]
        scalar = self._step.function.is_a("SXFunction")
        compiles = episodes * steps >= _WORTH_COMPILING or "_kernel" in self.__dict__
        if scalar and compiles and self._kernel is not None:
            self._kernel(X, U)
        elif scalar and episodes >= _WIDE and self._graph is not None:
            roll_out_columns(self._graph, X, U)
        else:
            for episode, moves in zip(X, U, strict=True):
                _roll_out(self._step, episode, moves)

    @cached_property
    def _kernel(self) -> routines.Kernel | None:
        F, command = self._step.function, routines.find_compiler()
        if command is None or F.n_instructions() > _LONGEST:
            return None
        try:
            return routines.compile_kernel(F, command, routines.find_private_cache())
        except (OSError, AttributeError, subprocess.SubprocessError) as error:
            failed = isinstance(error, subprocess.CalledProcessError)
            stderr = error.stderr.decode(errors="replace")[-500:] if failed else ""
            warnings.warn(
                f"{command[0]} could not compile the step map, batches run slower: {error} {stderr}",
                RuntimeWarning,
                stacklevel=5,
            )
            return None

    @cached_property
    def _graph(self) -> Graph | None:
        try:
            return Graph.trace(self._step.function)
        except DataError:
            return None


def _roll_out(step: Buffered, X: Float[np.ndarray, "rows nx"], U: Float[np.ndarray, "T nu"]) -> None:
    """Write x_1 … x_T after X[0], call by call; after a failure of an implicit method all rows are NaN."""
    (x, u), (x_next,), evaluate = step.arguments, step.results, step.evaluate
    x[:] = X[0]
    for k in range(len(U)):
        u[:] = U[k]
        try:
            evaluate()
        except RuntimeError as error:
            _warn_unsolved(error, x, u)
            X[k + 1 :] = np.nan
            return
        X[k + 1] = x_next
        x[:] = x_next


def roll_out_columns(graph: Graph, X: Float[np.ndarray, "E rows nx"], U: Float[np.ndarray, "E T nu"]) -> None:
    """Write x_1 … x_T after X[:, 0]; a numpy column holds one state of all episodes in a chunk."""
    nx = X.shape[2]
    for start in range(0, len(X), _CHUNK):
        states, moves = X[start : start + _CHUNK], U[start : start + _CHUNK]
        v, x_next = np.empty((graph.n, len(states))), np.empty((nx, len(states)))
        v[:nx] = states[:, 0].T
        scratch = graph.scratch(len(states))
        for k in range(U.shape[1]):
            v[nx:] = moves[:, k].T
            graph.run(v, x_next, scratch)
            states[:, k + 1] = x_next.T
            v[:nx] = x_next


def _warn_unsolved(error: RuntimeError, x: np.ndarray, u: np.ndarray) -> None:
    """Warn that an implicit step from (x, u) has no solution; this is a numerical outcome, so nothing is raised."""
    reason = str(error).strip().splitlines()[-1]
    warnings.warn(
        f"the integrator found no x⁺ from x={x}, u={u}; x⁺ is NaN, try a smaller dt ({reason})",
        RuntimeWarning,
        stacklevel=4,
    )
