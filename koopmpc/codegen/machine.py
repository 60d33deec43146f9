"""The machine code behind a compiled controller: one source, one pointer a call, and the plant of whole runs."""

import ctypes
import platform
import re
import subprocess
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc.codegen.sources import sources_of, tables_of
from koopmpc.codegen.tables import Exportable
from koopmpc.codegen.text import Language, function, traced
from koopmpc.plants.routines import library, private_cache
from koopmpc.plants.step_map import StepMap

Precision = Literal["double", "float"]


# One call with one pointer: that is what ctypes does fastest.
_DOOR = """
#ifdef _WIN32
#define DOOR __declspec(dllexport)
#else
#define DOOR
#endif
typedef struct {
  koopmpc_state *state;
  koopmpc_real *y;
  koopmpc_rows reference;
  koopmpc_real *applied;
  koopmpc_rows w;
  koopmpc_real *u;
  koopmpc_report report;
} koopmpc_frame;
DOOR void koopmpc_call(koopmpc_frame *f) {
  koopmpc_step(f->state, f->y, &f->reference, f->applied, f->w.count ? &f->w : 0, f->u, &f->report);
}
DOOR long koopmpc_state_size(void) { return (long)sizeof(koopmpc_state); }

/* A whole run: the controller and the plant step by step, with a clock around the controller. */
typedef struct {
  long steps;
  int nx, ny, preview, measured;
  void (*step)(const double *x, const double *u, double *next);
  void (*measure)(const double *x, double *y);
  const koopmpc_real *rows, *W;
  double *X, *Y, *U, *slack, *times;
  int *reports;
} koopmpc_whole;
#ifndef KOOPMPC_FLOAT
static double koopmpc_now(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
DOOR void koopmpc_run(koopmpc_frame *f, const koopmpc_whole *run) {
  for (long k = 0; k < run->steps; k++) {
    const koopmpc_rows reference = {run->rows + k * KOOPMPC_NR, run->preview ? KOOPMPC_HORIZON + 1 : 1};
    const koopmpc_rows w = {run->measured ? run->W + k * KOOPMPC_NW : 0,
                            run->preview && KOOPMPC_HORIZON > 0 ? KOOPMPC_HORIZON : 1};
    double *x = run->X + k * run->nx, *u = run->U + k * KOOPMPC_NU;
    const double start = run->times ? koopmpc_now() : 0;
    koopmpc_step(f->state, run->Y + k * run->ny, &reference, k ? u - KOOPMPC_NU : 0, run->measured ? &w : 0, u,
                 &f->report);
    if (run->times) run->times[k] = koopmpc_now() - start;
    run->reports[3 * k] = (int)f->report.status;
    run->reports[3 * k + 1] = (int)f->report.fallback;
    run->reports[3 * k + 2] = f->report.iterations;
    run->slack[k] = f->report.slack;
    run->step(x, u, x + run->nx);
    run->measure(x + run->nx, run->Y + (k + 1) * run->ny);
  }
}
/* ManyRuns from many states, one after the other, each from the beginning; Y holds one run. */
DOOR void koopmpc_runs(koopmpc_frame *f, koopmpc_whole *run, long runs) {
#if KOOPMPC_IS_STAGED
  const koopmpc_real *targets = f->state->targets;
  const int count = f->state->target_count;
#endif
  for (long e = 0; e < runs; e++) {
    koopmpc_init(f->state, KOOPMPC_NX == run->nx ? run->X : 0, 0);
#if KOOPMPC_IS_STAGED
    koopmpc_use_targets(f->state, targets, count);
#endif
    run->measure(run->X, run->Y);
    koopmpc_run(f, run);
    run->X += (run->steps + 1) * run->nx;
    run->U += run->steps * KOOPMPC_NU;
    run->slack += run->steps;
    run->reports += 3 * run->steps;
  }
}
#endif
"""
_CLOCK = "#define _POSIX_C_SOURCE 199309L\n#include <time.h>\n"


class CRows(ctypes.Structure):
    """Rows of a preview: their address, and how many count."""

    _fields_ = (("values", ctypes.c_void_p), ("count", ctypes.c_int))


_FRAME = (
    ("state", ctypes.c_void_p),
    ("y", ctypes.c_void_p),
    ("reference", CRows),
    ("applied", ctypes.c_void_p),
    ("w", CRows),
    ("u", ctypes.c_void_p),
    ("status", ctypes.c_int),
    ("fallback", ctypes.c_int),
    ("iterations", ctypes.c_int),
)


class Frame(ctypes.Structure):
    """What a call passes; the same fields as in C."""

    _fields_ = (*_FRAME, ("slack", ctypes.c_double))


class SingleFrame(ctypes.Structure):
    """A `Frame` in single precision."""

    _fields_ = (*_FRAME, ("slack", ctypes.c_float))


class WholeCall(ctypes.Structure):
    """What a whole run passes; the same fields as in C."""

    _fields_ = (
        ("steps", ctypes.c_long),
        *((name, ctypes.c_int) for name in ("nx", "ny", "preview", "measured")),
        *((name, ctypes.c_void_p) for name in ("step", "measure", "rows", "W", "X", "Y", "U")),
        *((name, ctypes.c_void_p) for name in ("slack", "times", "reports")),
    )


class Built(NamedTuple):
    """A controller as the compiler built it."""

    code: ctypes.CDLL
    sizes: dict[str, int]
    state_size: int


def first_error(error: Exception) -> str:
    """Return the first error that a compiler printed, or what the system says."""
    printed = getattr(error, "stderr", None) or b""
    text = printed.decode(errors="replace") if isinstance(printed, bytes) else str(printed)
    lines = [line for line in text.splitlines() if "error" in line.lower()]
    return lines[0] if lines else str(error)


def amalgamated(files: dict[str, str]) -> str:
    """Return all sources as one, each local header where it is first included."""
    seen: set[str] = set()

    def inlined(text: str, folder: str) -> str:
        def replaced(match: re.Match[str]) -> str:
            name = match.group(1)
            path = next((p for p in (folder + name, name) if p in files), "")
            if not path:  # what DAQP includes for its own clock
                return match.group()
            if path in seen:
                return ""
            seen.add(path)
            return inlined(files[path], path.rpartition("/")[0] + "/" if "/" in path else "")

        return re.sub(r'^#include "([^"]+)"$', replaced, text, flags=re.MULTILINE)

    own = [name for name in files if name.endswith(".c") and "/" not in name]
    return "\n".join(inlined(files[name], "") for name in own)


def machine() -> list[str]:
    """Return the flags for this very processor, where the compiler takes them."""
    return ["-march=native", "-fvisibility=default"] if platform.machine() in ("x86_64", "AMD64") else []


def _processor() -> str:
    """Return what tells this processor from others whose machine code it may not run."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line for line in lines if line.startswith("flags")), platform.processor())


def built_of(controller: Exportable, precision: Precision, command: list[str]) -> Built:
    """Return the machine code of a controller.

    Raises
    ------
    OSError, subprocess.SubprocessError
        The compiler fails or its output does not load.
    """
    single = precision == "float"
    tables = tables_of(controller, single=single)
    text = _CLOCK + amalgamated(sources_of(tables, single=single)) + _DOOR + f"/* {_processor()} */\n"
    cache = private_cache()
    try:
        code = library(text, [*command, *machine()], cache)
    except subprocess.SubprocessError:
        code = library(text, command, cache)  # it may not know this processor
    code.koopmpc_state_size.restype = ctypes.c_long
    code.koopmpc_init.restype = code.koopmpc_call.restype = None
    return Built(code, tables.sizes, int(code.koopmpc_state_size()))


def whole_call(
    code: ctypes.CDLL,
    steps: int,
    arrays: dict[str, np.ndarray],
    W: Float[np.ndarray, "wrows nw"] | None,
    *,
    preview: bool,
) -> WholeCall:
    """Return what a whole run passes; it holds no reference to the arrays."""
    whole = WholeCall(steps, arrays["X"].shape[-1], arrays["Y"].shape[-1], preview, W is not None)
    for name, routine in (("step", code.plant_step), ("measure", code.plant_measure)):
        setattr(whole, name, ctypes.cast(routine, ctypes.c_void_p))
    for name, array in ({"W": W} | arrays if W is not None else arrays).items():
        assert array.flags.c_contiguous, "machine code reads contiguous arrays"
        setattr(whole, name, array.ctypes.data)
    return whole


def plant_text(plant: StepMap) -> str:
    """Return ``plant_step(x, u, next)`` and ``plant_measure(x, y)`` in double precision.

    Raises
    ------
    DataError
        Its equations cannot be written in C.
    """
    nx, nu = plant.F.size1_in(0), plant.F.size1_in(1)
    step, look = traced(plant.F, "the plant"), traced(plant.h, "what the plant measures")
    head = "#include <math.h>\ntypedef double koopmpc_real;\n#define KOOPMPC_FN(name) name\n"
    return (
        head
        + function(step, "plant_step", {"x": nx, "u": nu}, "next", Language()).text
        + function(look, "plant_measure", {"x": nx}, "y", Language()).text
    )
