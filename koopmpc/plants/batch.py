"""Many episodes of x⁺ = F(x, u) at once, by the fastest route that F allows; all give the same numbers."""

import subprocess
import warnings
from functools import cached_property

import numpy as np
from jaxtyping import Float

from koopmpc.errors import DataError
from koopmpc.plants import routines
from koopmpc.plants.graph import Graph

_WORTH_COMPILING = 20_000  # steps that the interpreter makes in 0.2 s, the time of a compiler
_LONGEST = 5_000  # operations of F; the compiler's time grows faster than its code
_WIDE = 64  # episodes from which numpy columns beat one call a step
_CHUNK = 4096  # episodes at a time, so that the columns stay in the cache


class Batch:
    """Fills X (E, T+1, nx) from X[:, 0] and U (E, T, nu).

    F made of SX operations runs as generated C where there is a compiler and the batch is large enough, else as its
    expression graph over numpy columns. Any other F (implicit integrators, matrices) is called step by step.
    """

    def __init__(self, step: routines.Buffered) -> None:
        self._step = step

    def fill(self, X: Float[np.ndarray, "E rows nx"], U: Float[np.ndarray, "E T nu"]) -> None:
        """Write x_{k+1} = F(x_k, u_k) for every episode."""
        episodes, steps = U.shape[:2]
        scalar = self._step.function.is_a("SXFunction")
        worth = episodes * steps >= _WORTH_COMPILING or "_kernel" in self.__dict__
        if scalar and worth and self._kernel is not None:
            self._kernel(X, U)
        elif scalar and episodes >= _WIDE and self._graph is not None:
            vectorised(self._graph, X, U)
        else:
            for episode, moves in zip(X, U, strict=True):
                march(self._step, episode, moves)

    @cached_property
    def _kernel(self) -> routines.Kernel | None:
        F, command = self._step.function, routines.compiler()
        if command is None or F.n_instructions() > _LONGEST:
            return None
        try:
            return routines.kernel(F, command, routines.private_cache())
        except (OSError, AttributeError, subprocess.SubprocessError) as error:
            failed = isinstance(error, subprocess.CalledProcessError)
            said = error.stderr.decode(errors="replace")[-500:] if failed else ""
            warnings.warn(
                f"{command[0]} could not compile the step map, batches run slower: {error} {said}",
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


def march(step: routines.Buffered, X: Float[np.ndarray, "rows nx"], U: Float[np.ndarray, "T nu"]) -> None:
    """Write x_1 … x_T after X[0], call by call; NaN from where an implicit method fails."""
    (x, u), (x_next,), evaluate = step.arguments, step.results, step.evaluate
    x[:] = X[0]
    for k in range(len(U)):
        u[:] = U[k]
        try:
            evaluate()
        except RuntimeError as error:
            warn_of(error, x, u)
            X[k + 1 :] = np.nan
            return
        X[k + 1] = x_next
        x[:] = x_next


def vectorised(graph: Graph, X: Float[np.ndarray, "E rows nx"], U: Float[np.ndarray, "E T nu"]) -> None:
    """Write x_1 … x_T after X[:, 0], all episodes of a chunk in one numpy column."""
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


def warn_of(error: RuntimeError, x: np.ndarray, u: np.ndarray) -> None:
    """Warn that an implicit step from (x, u) has no solution; a numerical outcome raises nothing."""
    reason = str(error).strip().splitlines()[-1]
    warnings.warn(
        f"the integrator found no x⁺ from x={x}, u={u}; x⁺ is NaN, try a smaller dt ({reason})",
        RuntimeWarning,
        stacklevel=4,
    )
