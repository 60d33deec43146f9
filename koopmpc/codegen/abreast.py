"""Copies of a controller in machine code that step side by side, one call for all of them."""

import ctypes
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, Int

from koopmpc.codegen.door import AbreastStep, point_to


class ControllersAbreast:
    """E copies of one controller in double precision, each with a state of its own; see `Compiled.start_abreast`.

    `U` (E, nu) and `reports` (E, 2) hold the last input of each, and the numbers of its Status and Fallback.

    Parameters
    ----------
    code, sizes
        The machine code of the controller, and the sizes of its program.
    rows
        (E, R, nr) reference of each; step k gets the rows k … k + N, so that R is at least the steps + N.
    x0
        (E, nx) states in which the estimators begin; None where they begin without one.
    W
        (w, nw) measured disturbances, the same at every step, at least N rows; None where there are none.
    targets
        Table of the targets of all reference rows; None for a controller without one.
    """

    def __init__(
        self,
        code: ctypes.CDLL,
        sizes: Mapping[str, int],
        rows: Float[np.ndarray, "E R nr"],
        x0: Float[np.ndarray, "E nx"] | None,
        W: Float[np.ndarray, "w nw"] | None,
        targets: Float[np.ndarray, "found size"] | None,
    ) -> None:
        self._code, self._rows = code, np.ascontiguousarray(rows)
        self._kept = targets  # every state holds the address of this table
        self.U = np.zeros((len(rows), sizes["NU"]))
        self.reports = np.zeros((len(rows), 2), dtype=np.intc)
        self._nr, self._ny = sizes["NR"], sizes["NY"]
        self._W = None if W is None else np.ascontiguousarray(W)
        words = -(-int(code.koopmpc_state_size()) // 8)
        self._states = np.zeros((len(rows), words))
        for e, state in enumerate(self._states):
            start = None if x0 is None else np.ascontiguousarray(x0[e])
            code.koopmpc_init(point_to(state), point_to(start), None)
            if targets is not None:
                code.koopmpc_use_targets(point_to(state), point_to(targets), len(targets))

    def step(self, k: int, Y: Float[np.ndarray, "E ny"], which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "E nu"]:
        """Return the inputs after step k of the controllers `which`; rows of the others are those of before."""
        Y, places = np.ascontiguousarray(Y, dtype=np.float64), np.ascontiguousarray(which, dtype=np.dtype("long"))
        assert Y.shape == (len(self.U), self._ny), "a row of measurements for each controller"
        rows = self._rows
        assert k + 1 <= rows.shape[1], "the reference has a row for this step"
        arguments = AbreastStep(
            len(places),
            self._states.strides[0],
            rows.shape[1] * rows.shape[2],
            int(k == 0),
            int(self._W is not None),
            places.ctypes.data,
            self._states.ctypes.data,
            Y.ctypes.data,
            rows.ctypes.data + 8 * k * self._nr,
            0 if self._W is None else self._W.ctypes.data,
            self.U.ctypes.data,
            self.reports.ctypes.data,
        )
        self._code.koopmpc_step_abreast(ctypes.byref(arguments))
        return self.U
