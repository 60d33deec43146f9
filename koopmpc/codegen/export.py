"""`export`: a controller as a folder of C99 that builds anywhere."""

import subprocess
import tempfile
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc import checks
from koopmpc.codegen.sources import (
    Language,
    constants,
    flops,
    iteration_flops,
    named,
    plant_functions,
    shipped,
    sources_of,
    tables_of,
)
from koopmpc.codegen.tables import Exportable, Precision, Tables, exportable
from koopmpc.control.linear.koopman_mpc import KoopmanMPC
from koopmpc.control.lqr import LQR
from koopmpc.control.move import Controller
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.control.nonlinear.iteration import MOST
from koopmpc.disk import path_of, writing
from koopmpc.errors import DataError
from koopmpc.estimate.kalman import KalmanFilter
from koopmpc.plants.routines import compiler
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor

_BUILT = (".o", ".a", ".su")  # what a build leaves in the folder
_PROGRAMS = ("example", "sanitized")
_DIGITS = 1e-3  # share of an input's span that rounding in single precision may come to


class PrecisionWarning(UserWarning):
    """Single precision is too coarse for this controller."""


def export(
    controller: Controller,
    folder: str | Path,
    *,
    name: str = "koopmpc",
    precision: Precision = "double",
    plant: StepMap | None = None,
    x0: ArrayLike | None = None,
    reference: ArrayLike | None = None,
    steps: int = 200,
) -> Path:
    """Write the controller as C99 into a folder: sources, Makefile, CMakeLists.txt, an example and a README.

    The C has no heap, no file, no clock, no global variable, and no library but math.h. It computes what the controller
    does: lifting, delays, estimator, latency, previews, limits, fallbacks, with the same statuses. Its QP solver is
    DAQP, whose sources come along; a controller with solver="daqp" and its C agree to rounding.

    Parameters
    ----------
    controller
        An LQR, a KoopmanMPC, a LinearMPC or a BilinearMPC, without a time_limit.
    folder
        Is made; one that holds other files than those of an export is refused.
    name
        What files and symbols start with: ``name_step``, ``name.h``. Controllers of different names link together.
    precision
        "double" or "float".
    plant
        What `example.c` controls; by default the controller's own model, lifted afresh each step.
    x0, reference
        Where the example starts, and the row or rows that it follows; by default one root mean square of the data,
        and zero. A model with delays starts as if x0 and the least input had been held.
    steps
        How long the example runs.

    Raises
    ------
    DataError
        A part of the controller, or the plant, cannot be written in C, or the folder holds other files.

    Warns
    -----
    PrecisionWarning
        Rounding in single precision may move an input by more than 0.1 % of its span.
    """
    if precision not in ("double", "float"):
        raise DataError(f'precision is {precision!r}; pass "double" or "float"')
    single = precision == "float"
    known = exportable(controller)
    rows = _reference_of(known, reference)
    tables = tables_of(known, rows, single=single)
    coarse = float(np.finfo(np.float32).eps) * tables.conditioning
    if single and coarse > _DIGITS:
        warnings.warn(
            f"in single precision rounding may move an input by {100 * coarse:.2g} % of its span (the gain on z "
            f'amplifies it {tables.conditioning:.2g} times); export precision="double", or scale the lifting',
            PrecisionWarning,
            stacklevel=2,
        )
    texts = sources_of(tables, single=single)
    texts |= {name: shipped("c", name) for name in ("Makefile", "CMakeLists.txt", "example.c")}
    texts |= _plant(known, tables, plant, x0, rows, checks.count(steps, "steps"), Language(single))
    texts = named(texts, name)
    root = path_of(folder)
    _refuse_others(root, {*texts, "README.md"}, name)
    for path, text in texts.items():
        _write(root / path, text)
    readme = {"README.md": _readme(known, tables, _measure_objects(root, name), precision)}
    _write(root / "README.md", named(readme, name)["README.md"])
    return root


def _write(path: Path, text: str) -> None:
    with writing(path) as file:
        file.write(text.encode())


def _reference_of(controller: Exportable, reference: ArrayLike | None) -> Float[np.ndarray, "rows nr"]:
    """Return the rows of a reference, by default one of zeros."""
    if isinstance(controller, LQR):
        nr = controller._nr
    else:
        nr = len(controller._outputs.Q) if isinstance(controller, BilinearMPC) else len(controller._map.track.Q)
    if reference is None:
        return np.zeros((1, nr))
    rows = np.atleast_2d(checks.array(reference, "reference"))
    return checks.array(rows, "reference", (None, nr))


def _refuse_others(root: Path, known: set[str], prefix: str) -> None:
    """Raise DataError where the folder holds what no export has written."""
    if root.exists() and not root.is_dir():
        raise DataError(f"{root} is a file; pass a folder")
    for path in sorted(root.rglob("*")) if root.exists() else []:
        name = path.relative_to(root).as_posix()
        ours = name in known or path.suffix in _BUILT or name in _PROGRAMS or name.startswith(f"{prefix}_")
        if path.is_file() and not ours:
            raise DataError(f"{root} holds {name}, which no export wrote; pass an empty folder, or remove that file")


def _plant(
    controller: Exportable,
    tables: Tables,
    plant: StepMap | None,
    x0: ArrayLike | None,
    held: Float[np.ndarray, "rows nr"],
    steps: int,
    language: Language,
) -> dict[str, str]:
    """Return plant.c and plant.h: what the example controls."""
    model, sizes = tables.model, tables.sizes
    if plant is not None:
        checks.kind(plant, "plant", StepMap, "discretize the dynamics")
    step_map = plant or (model if isinstance(model, StepMap) else model.step_map())
    nx, nu = step_map.F.size1_in(0), step_map.F.size1_in(1)
    if nu != sizes["NU"]:
        raise DataError(f"the plant has {nu} inputs, the controller {sizes['NU']}; pass the plant that it controls")
    x = ca.SX.sym("x", nx)
    measured = _measured(controller, step_map, x, sizes["NY"])
    functions = plant_functions(step_map.F, ca.Function("measure", [x], [measured]), language)
    past = None if plant is not None or isinstance(model, StepMap) else model.embedding
    size = nx if past is None else len(past.states)
    start = _start(model, size) if x0 is None else checks.array(x0, "x0", (size,))
    rest = np.clip(np.zeros(nu), tables.limits["input_low"], tables.limits["input_high"])
    if past is not None:  # the plant is the model of ζ: it has been in x0 under this input
        start = past.held(start, rest)
    arrays = "".join(
        language.array(name, values).replace("static const", "const") + "\n"
        for name, values in (("plant_x0", start), ("plant_u0", rest), ("plant_reference", held))
    )
    code = (
        '/** @file plant.c @brief What the example controls. */\n#include <math.h>\n\n#include "plant.h"\n\n'
        + arrays
        + functions
    )
    header = (
        "/** @file plant.h @brief What the example controls. */\n#ifndef PLANT_H\n#define PLANT_H\n\n"
        '#include "koopmpc.h"\n\n'
        f"#define PLANT_NX {nx}\n#define PLANT_STEPS {steps}\n#define PLANT_ROWS {len(held)}\n\n"
        f"extern const koopmpc_real plant_x0[{nx}], plant_u0[{nu}], plant_reference[{held.size}];\n\n"
        "/** next = F(x, u), one sample later. */\n"
        "void plant_step(const koopmpc_real *x, const koopmpc_real *u, koopmpc_real *next);\n\n"
        "/** y, what the controller measures. */\nvoid plant_measure(const koopmpc_real *x, koopmpc_real *y);\n\n"
        "#endif\n"
    )
    return {"plant.c": code, "plant.h": header}


def _measured(controller: Exportable, plant: StepMap, x: ca.SX, ny: int) -> ca.SX:
    """Return what the controller takes as y, of the plant's state x."""
    observer = controller._initial.observer if isinstance(controller, KoopmanMPC) else None
    predictor = None if isinstance(controller, BilinearMPC) else controller.predictor
    filtered = isinstance(observer, KalmanFilter)
    if filtered and predictor is not None and len(predictor.lifting.bound_states) == x.numel():
        system = observer._system
        H = np.zeros((ny, predictor.nz))
        H[:, system.kept] = system.M[:, : len(system.kept)]
        return ca.mtimes(ca.DM(H), predictor.lifting.symbolic(x)) + ca.DM(system.h)
    y = plant.h(x)
    if y.shape != (ny, 1):
        y = x[:ny]
    if y.shape != (ny, 1):
        raise DataError(
            f"the plant measures {y.shape[0]} values, the controller takes {ny}; pass the plant it controls"
        )
    return y


def _start(model: LinearPredictor | BilinearPredictor | StepMap, nx: int) -> Float[np.ndarray, " n"]:
    """Return the root mean squares of the states over the data, ones where they are not known."""
    if isinstance(model, StepMap) or model.scale is None:
        return np.resize(np.ones(len(model.states)), nx)
    return np.resize(np.linalg.norm(model.scale @ model.C.T, axis=0), nx)


def _measure_objects(root: Path, name: str) -> tuple[int, int, int] | None:
    """Return bytes of code and constants, of the state, and of the stack of all functions; None without a compiler."""
    command = compiler()
    if command is None:
        return None
    probe = f'#include "{name}.h"\n{name}_state probe;\n'
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        (place / "probe.c").write_text(probe)
        files = [*sorted(root.glob(f"{name}_*.c")), place / "probe.c"]
        try:
            for file in files:
                out = place / (file.stem + ".o")
                flags = ["-std=c99", "-Os", "-ffunction-sections", "-fno-common", "-fstack-usage", f"-I{root}"]
                subprocess.run([*command, *flags, "-c", str(file), "-o", str(out)], check=True, capture_output=True)
            printed = subprocess.run(
                ["size", *(str(place / (file.stem + ".o")) for file in files)],
                check=True,
                capture_output=True,
                text=True,
            ).stdout
        except (OSError, subprocess.SubprocessError):
            return None
        rows = [line.split() for line in printed.splitlines()[1:]]
        stack = sum(
            int(line.split("\t")[1]) for path in place.glob(f"{name}_*.su") for line in path.read_text().splitlines()
        )
    flash = sum(int(row[0]) + int(row[1]) for row in rows if "probe" not in row[-1])
    state = sum(int(row[2]) for row in rows if "probe" in row[-1])
    return flash, state, stack


def _readme(controller: Exportable, tables: Tables, measured: tuple[int, int, int] | None, precision: Precision) -> str:
    """Return the README of the folder: how to build and call the controller, its memory and its operations."""
    sizes, model, single = tables.sizes, tables.model, precision == "float"
    numbers_held = constants(tables) * (4 if single else 8)
    rows = [("constants", f"{numbers_held} bytes")]
    if measured is not None:
        flash, state, stack = measured
        rows += [
            ("flash: code and constants, this machine's compiler with -Os", f"{flash} bytes"),
            ("RAM: one `koopmpc_state`", f"{state} bytes"),
            ("RAM: stack, at most (the frames of all functions together)", f"{stack} bytes"),
        ]
    rows.append(("floating-point operations of a step without active limits, at most", str(flops(tables))))
    if not tables.is_lqr:
        limit = MOST if tables.is_staged else int(tables.settings["iter_limit"])
        rows += [
            ("iterations of the QP solver in one solve, at most", str(limit)),
            ("floating-point operations of one iteration, at most", str(iteration_flops(tables))),
        ]
    rows.append(("rounding of the lifted state, amplified to a share of an input's span", f"{tables.conditioning:.2g}"))
    table = "\n".join(f"| {what} | {value} |" for what, value in rows)
    notes = "".join(f"- {note}\n" for note in tables.notes)
    solver = (
        "`daqp/` holds sources of DAQP 0.11.0 by Daniel Arnström, unchanged, under the MIT licence in `daqp/LICENSE`.\n"
    )
    solver = "" if tables.is_staged else "\n" + solver
    bound = (
        ""
        if tables.is_lqr or tables.is_staged
        else 'A bound on the worst step comes from the iterations: export a controller with `solver="daqp", '
        'settings={"iter_limit": 100}`.\n'
    )
    dt, state_names, input_names = model.dt, ", ".join(model.states), ", ".join(model.inputs)
    return f"""# {type(controller).__name__} in C99

Sampling time {dt} s; states {state_names}; inputs {input_names}. Precision: {precision}.

    make run        # builds the library and the example, prints its closed loop
    make strict     # our own files with every warning an error
    make sanitize   # the example under the sanitizers

```c
#include "koopmpc.h"

static koopmpc_state state;
koopmpc_init(&state, 0, 0);
for (;;) {{ /* every {dt} s */
  koopmpc_rows reference = {{r, 1}}; /* one row, held; or rows of a preview and their count */
  koopmpc_step(&state, y, &reference, 0, 0, u, &report);
}}
```

| size | |
|---|---|
{table}

{bound}
y has {sizes["NY"]} values, u {sizes["NU"]}, a reference row {sizes["NR"]}, a row of w {sizes["NW"]}; up to
{sizes["HORIZON"] + 1} rows of a preview are read. NaN in y is a missed measurement. `koopmpc.h` says what every
argument and every status means.

{notes}{solver}"""
