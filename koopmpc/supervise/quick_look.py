"""QuickLook: what a Watch asks of a linear model at each step, as machine code, where a compiler is there."""

import ctypes
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float, Int

INSIDE = 1  # bit of the answer: state and input are inside the data
FITS = 2  # bit of the answer: the prediction fits
CODE = """
typedef struct {
  long long nz, nu, nd, nx, *begun;
  const double *reach, *ahead, *back, *z, *d, *u;
  double *last, *sums;
} Watch;

/* sums += the columns of G, each times its v */
static void add_columns(const double* G, const double* v, long long columns, long long rows, double* sums) {
  for (long long j = 0; j < columns; ++j) {
    const double by = v[j];
    for (long long i = 0; i < rows; ++i) sums[i] += by * G[j * rows + i];
  }
}

static double square(const double* sums, long long rows) {
  double found = 0.0;
  for (long long i = 0; i < rows; ++i) found += sums[i] * sums[i];
  return found;
}

#ifdef _WIN32
__declspec(dllexport)
#endif
int koopmpc_look(Watch* w) {
  const long long n = w->nz + w->nu;
  double* sums = w->sums;
  for (long long i = 0; i < w->nx; ++i) sums[i] = 0.0;
  add_columns(w->ahead, w->last, n + w->nd, w->nx, sums);
  add_columns(w->back, w->z, w->nz, w->nx, sums);
  const int fits = !*w->begun || square(sums, w->nx) <= 1.0;
  for (long long i = 0; i < n; ++i) sums[i] = 0.0;
  add_columns(w->reach, w->z, w->nz, n, sums);
  add_columns(w->reach + w->nz * n, w->u, w->nu, n, sums);
  const int inside = square(sums, n) <= 1.0;
  for (long long i = 0; i < w->nz; ++i) w->last[i] = w->z[i];
  for (long long i = 0; i < w->nu; ++i) w->last[w->nz + i] = w->u[i];
  for (long long i = 0; i < w->nd; ++i) w->last[n + i] = w->d[i];
  *w->begun = 1;
  return inside | fits << 1;
}
"""


class _Memory(ctypes.Structure):
    """The struct of the C code."""

    _fields_ = (
        *((name, ctypes.c_longlong) for name in ("nz", "nu", "nd", "nx")),
        *((name, ctypes.c_void_p) for name in ("begun", "reach", "ahead", "back", "z", "d", "u", "last", "sums")),
    )


class QuickLook:
    """‖L [z; u]‖² ≤ 1 and ‖P [z; u; d]_{k−1} − W C z_k‖² ≤ 1 with P = W C [A B I], in one call that copies the step.

    Parameters
    ----------
    code
        The machine code, see `load_look` of koopmpc.supervise.monitor.
    reach
        (n, n) L.
    ahead
        (nx, n + nd) P.
    back
        (nx, nz) W C.
    z, d
        (nz,), (nd,) arrays that hold z and d at each call.
    last
        (n + nd,) array of [z; u; d] of the step before.
    begun
        (1,) array: 0 where there was no step before.

    Attributes
    ----------
    u
        (nu,) to be filled before a call.
    acted
        (nu,) the input of the step before, to be overwritten where another one acted.
    look
        Returns the bits INSIDE and FITS of the step.
    """

    def __init__(
        self,
        code: Callable[[ctypes.c_void_p], int],
        reach: Float[np.ndarray, "n n"],
        ahead: Float[np.ndarray, "nx width"],
        back: Float[np.ndarray, "nx nz"],
        z: Float[np.ndarray, " nz"],
        d: Float[np.ndarray, " nd"],
        last: Float[np.ndarray, " width"],
        begun: Int[np.ndarray, "1"],
    ) -> None:
        (nx, nz), n = back.shape, len(reach)
        self.u = np.zeros(n - nz)
        self.acted = last[nz:n]
        self._ahead, self._back = np.zeros((n + len(d), nx)), np.zeros((nz, nx))  # columns of the matrices as rows
        columns, sums = np.ascontiguousarray(reach.T), np.zeros(max(n, nx))
        arrays = [begun, columns, self._ahead, self._back, z, d, self.u, last, sums]
        self._memory = _Memory(nz, n - nz, len(d), nx, *(each.ctypes.data for each in arrays))
        self._kept: list[Any] = arrays  # the memory holds pointers only
        self.look: Callable[[], int] = partial(code, ctypes.c_void_p(ctypes.addressof(self._memory)))
        self.update(ahead, back)

    def update(self, ahead: Float[np.ndarray, "nx width"], back: Float[np.ndarray, "nx nz"]) -> None:
        """Go on with the P and W C of another model."""
        self._ahead[:], self._back[:] = ahead.T, -back.T
