"""Closed loops side by side: controllers in machine code and surrogates in numpy step all loops at once."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.errors import KoopmpcError
from koopmpc.codegen.compiled import Compiled, NoCompilerWarning, compiled
from koopmpc.codegen.programs import make_tables, read_program
from koopmpc.control.move import Fallback, Status
from koopmpc.loop.run import Run
from koopmpc.plants.routines import find_compiler
from koopmpc.synthesis.loops.neighbours import NeighbourMap
from koopmpc.synthesis.loops.surrogates import Surrogate
from koopmpc.synthesis.task import DesignTask


@dataclass(frozen=True, eq=False)
class Acting:
    """v_k = u_0 + gain ((1 − late) u_k + late u_{k−1} − u_0), with a gain and a delay for each of E loops.

    An input that comes a share `late` of a step late has this mean over the step, with that of the step before.
    """

    middle: Float[np.ndarray, " nu"]  # (nu,) u_0, the mean of the data's inputs
    # gain, late: (E,) factors on the inputs, and delays as shares of a step
    gain: Float[np.ndarray, " E"]
    late: Float[np.ndarray, " E"]

    def take(self, place: int) -> "Acting":
        """Return that of one loop."""
        return Acting(self.middle, self.gain[[place]], self.late[[place]])

    def change(
        self, U: Float[np.ndarray, "n nu"], before: Float[np.ndarray, "n nu"], which: Int[np.ndarray, " n"]
    ) -> Float[np.ndarray, "n nu"]:
        """Return what acts in the loops `which`; at the first step `before` is U itself."""
        late, gain = self.late[which, None], self.gain[which, None]
        return self.middle + gain * ((1 - late) * U + late * before - self.middle)


# ζ⁺ of the loops `which` from their ζ (n, nzeta) and u (n, nu)
CrowdStep = Callable[
    [Float[np.ndarray, "n nzeta"], Float[np.ndarray, "n nu"], Int[np.ndarray, " n"]], Float[np.ndarray, "n nzeta"]
]
_STATUS = list(Status)
_FALLBACK = list(Fallback)


def speed_up(controller: Any) -> Any:
    """Return the controller in machine code; itself without a compiler, and where no C code can be generated."""
    if find_compiler() is None:
        return controller
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NoCompilerWarning)
            return compiled(controller)
    except KoopmpcError:
        return controller


def explain_python(controller: Any) -> str:
    """Return why the loops of a controller that `speed_up` did not change run in Python."""
    try:
        make_tables(read_program(controller, ()), single=False)
    except KoopmpcError as error:
        return f"this controller has no C code ({error})"
    if find_compiler() is None:
        return "no C compiler was found ($CC, cc, gcc, clang): install one"
    return "the C compiler failed"


def run_abreast(
    task: DesignTask,
    controller: Compiled,
    stand_in: Surrogate | NeighbourMap,
    step: CrowdStep,
    acting: Acting,
    starts: Sequence[Float[np.ndarray, " n"]],
    seeds: Sequence[int],
    reference: Float[np.ndarray, "E rows nr"],
    u_reference: Float[np.ndarray, "E T nu"],
    box: tuple[Float[np.ndarray, " nx"], Float[np.ndarray, " nx"]],
) -> list[Run | None]:
    """Return the same loops as `run_on_surrogate` one by one, with its draws; None for one that left the box.

    Of the T + 1 + N rows of each reference the last N are only seen ahead.
    """
    N, nx = controller.horizon, len(stand_in.states)
    E, T1 = len(reference), u_reference.shape[1] + 1
    Z = np.array([stand_in.start(x0) for x0 in starts])
    draws = [np.random.default_rng(seed).standard_normal((T1, nx)) for seed in seeds]  # as `simulate` draws them
    noise, V = np.array(draws) * stand_in.noise, np.tile(stand_in.middle, (E, 1))
    W = np.tile(stand_in.w, (N + 1, 1)) if len(stand_in.w) else None
    known = Z.shape[1] == nx and not stand_in.feedthrough
    fleet = controller.start_abreast(reference, Z if known else None, W)
    X, U = np.full((E, T1, nx), np.nan), np.zeros((E, T1 - 1, controller.nu))
    reports = np.zeros((E, T1 - 1, 2), dtype=np.int64)
    X[:, 0] = Z[:, :nx]
    Y, alive = np.full(X.shape, np.nan), np.ones(E, dtype=bool)
    for k in range(T1 - 1):
        which = np.flatnonzero(alive)
        if not which.size:
            break
        read = step(Z[which], V[which], which) if stand_in.feedthrough else Z[which]
        Y[which, k] = read[:, :nx] + noise[which, k]
        U[which, k] = fleet.step(k, Y[:, k], which)[which]
        reports[which, k] = fleet.reports[which]
        V[which] = acting.change(U[which, k], U[which, max(k - 1, 0)], which)
        Z[which] = step(Z[which], V[which], which)
        X[which, k + 1] = Z[which, :nx]
        alive[which] = ((X[which, k + 1] >= box[0]) & (X[which, k + 1] <= box[1])).all(axis=1)
    which = np.flatnonzero(alive)
    last = step(Z[which], V[which], which) if stand_in.feedthrough and which.size else Z[which]
    Y[which, -1] = last[:, :nx] + noise[which, -1]
    nothing = np.zeros(T1 - 1)
    return [
        Run(
            X=X[e],
            Y=Y[e],
            U=U[e],
            reference=reference[e, :T1],
            status=tuple([_STATUS[int(i)] for i in reports[e, :, 0]]),
            fallback=tuple([_FALLBACK[int(i)] for i in reports[e, :, 1]]),
            solve_time=nothing,
            iterations=nothing.astype(np.int64),
            slack=nothing,
            cost=task.cost,
            limits=task.limits,
            u_reference=u_reference[e],
            dt=controller.dt,
            states=stand_in.states,
            inputs=stand_in.inputs,
            outputs=stand_in.states,
            angles=task.angles,
        )
        if alive[e]
        else None
        for e in range(E)
    ]
