"""`export`: a controller as a folder of C99 that builds anywhere."""

import subprocess
import tempfile
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.disk import path_of, writing
from koopmpc.base.errors import DataError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.codegen.functions import Language
from koopmpc.codegen.programs import make_tables, read_program
from koopmpc.codegen.sources import (
    count_constants,
    count_flops,
    count_iteration_flops,
    read_shipped,
    rename_symbols,
    write_plant_functions,
    write_sources,
)
from koopmpc.codegen.tables import Precision, Tables
from koopmpc.codegen.unit import write_unit
from koopmpc.control.move import Controller
from koopmpc.control.nonlinear.iteration import MOST
from koopmpc.control.nonlinear.staged_program import StagedProgram
from koopmpc.control.plan.condensed_program import CondensedProgram
from koopmpc.control.program import StepProgram
from koopmpc.estimate.filter import FilterProgram
from koopmpc.guarantees.step_effort import IterationBound, ObservedIterations
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.plants.routines import find_compiler
from koopmpc.plants.step_map import StepMap

_BUILT = (".o", ".a", ".su")  # endings of the files of a build
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
    fmu: int | None = None,
    iterations: IterationBound | ObservedIterations | None = None,
) -> Path:
    """Write the controller as C99 into a folder: sources, Makefile, CMakeLists.txt, an example and a README.

    The C has no heap, no file, no clock, no global variable, and no library but math.h. It computes what the controller
    does: lifting, delays, estimator, latency, previews, limits, fallbacks, with the same statuses. Its QP solver is
    DAQP, whose sources come along; a controller with solver="daqp", which "auto" asks first, and its C agree to
    rounding.

    Parameters
    ----------
    controller
        An LQR, a KoopmanMPC, a LinearMPC or a BilinearMPC, without a time_limit.
    folder
        Created if needed. A folder with files that no export wrote is an error.
    name
        Prefix of files and symbols: ``name_step``, ``name.h``. Controllers of different names link together.
    precision
        "double" or "float".
    plant
        The plant of `example.c`; by default the controller's own model, lifted afresh each step.
    x0, reference
        Initial state and reference rows of the example; by default the root mean square of the data, and zero. A model
        with delays starts as if x0 and the smallest allowed input had been held before. The C of a BilinearMPC holds
        the equilibria of these rows, and searches those of other rows when they come.
    steps
        Steps of the example.
    fmu
        2 or 3: also write ``name.fmu``, the controller as a co-simulation unit of this version of the FMI standard,
        with its source and machine code for this platform. Inputs y, reference (one row, held over the horizon) and w;
        outputs u, status, fallback and iterations; a step is one sample.
    iterations
        The most iterations of a step, of `km.guarantees.bound_iterations` or `observe_iterations`, for the README and
        `koopmpc_sizes.h`, which say whether it is proved.

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
    if fmu not in (None, 2, 3):
        raise DataError(f"fmu is {fmu!r}; pass 2 or 3, the version of the FMI standard")
    program = read_program(controller, reference)
    tables = make_tables(program, single=single)
    if iterations is not None:
        _state_iterations(tables, iterations, single=single)
    coarse = float(np.finfo(np.float32).eps) * tables.conditioning
    if single and coarse > _DIGITS:
        warnings.warn(
            f"in single precision rounding may move an input by {100 * coarse:.2g} % of its span (the gain on z "
            f'amplifies it {tables.conditioning:.2g} times); export precision="double", or scale the lifting',
            PrecisionWarning,
            stacklevel=2,
        )
    own = write_sources(tables, single=single)
    texts = dict(own)
    texts |= {name: read_shipped("c", name) for name in ("Makefile", "CMakeLists.txt", "example.c")}
    texts |= _write_plant(tables, plant, x0, checks.count(steps, "steps"), Language(single))
    texts = rename_symbols(texts, name)
    root = path_of(folder)
    _refuse_others(root, {*texts, "README.md", f"{name}.fmu"}, name)
    _write_files(root, texts)
    readme = {"README.md": _write_readme(tables, _measure_objects(root, name), precision)}
    _write_files(root, rename_symbols(readme, name))
    if fmu is not None:
        write_unit(tables, own, root / f"{name}.fmu", name, 2 if fmu == 2 else 3)
    return root


def _state_iterations(tables: Tables, figure: IterationBound | ObservedIterations, *, single: bool) -> None:
    """Put the most iterations of a step among the sizes of the C, and what it is into its header and its README.

    Raises
    ------
    DataError
        A bound is proved for another precision, or for cold steps alone while steps of this C start warm.
    """
    proved = isinstance(figure, IterationBound)
    if proved and single:
        raise DataError('the bound is one of exact arithmetic, which single precision leaves; export "double"')
    if proved and not tables.sizes.get("SETTINGS_COLD_START", 0):
        raise DataError(
            "the bound is for steps that start cold, and steps of this controller start warm; make it with "
            'settings={"cold_start": True}'
        )
    tables.sizes |= {"MOST_ITERATIONS": figure.most, "ITERATIONS_PROVED": int(proved)}
    warm = (
        ""
        if proved or tables.sizes.get("SETTINGS_COLD_START", 0)
        else " Steps of this C start warm: that was not counted."
    )
    tables.effort = f"Iterations of the QP solver: {figure}.{warm}"


def _write_files(root: Path, texts: dict[str, str]) -> None:
    for name, text in texts.items():
        with writing(root / name) as file:
            file.write(text.encode())


def _refuse_others(root: Path, known: set[str], prefix: str) -> None:
    """Raise DataError where the folder holds a file that no export wrote."""
    if root.exists() and not root.is_dir():
        raise DataError(f"{root} is a file; pass a folder")
    for path in sorted(root.rglob("*")) if root.exists() else []:
        name = path.relative_to(root).as_posix()
        ours = name in known or path.suffix in _BUILT or name in _PROGRAMS or name.startswith(f"{prefix}_")
        if path.is_file() and not ours:
            raise DataError(f"{root} holds {name}, which no export wrote; pass an empty folder, or remove that file")


@raise_swallowed()
def _write_plant(
    tables: Tables, plant: StepMap | None, x0: ArrayLike | None, steps: int, language: Language
) -> dict[str, str]:
    """Return plant.c and plant.h, the plant of the example."""
    program, sizes = tables.program, tables.sizes
    model, reference = program.model, program.reference
    if plant is not None:
        checks.kind(plant, "plant", StepMap, "discretize the dynamics")
    F = _model_map(program) if plant is None else plant.F
    nx, nu = F.size1_in(0), F.size1_in(1)
    if nu != sizes["NU"]:
        raise DataError(f"the plant has {nu} inputs, the controller {sizes['NU']}; pass the plant that it controls")
    x = ca.SX.sym("x", nx)
    measured = _express_measurement(program, plant, x, sizes["NY"])
    functions = write_plant_functions(F, ca.Function("measure", [x], [measured]), language)
    past = None if plant is not None or isinstance(model, StepMap) else model.embedding
    size = nx if past is None else len(past.states)
    start = _find_start(model, size) if x0 is None else checks.array(x0, "x0", (size,))
    rest = np.clip(np.zeros(nu), *program.inputs)
    if past is not None:  # the plant is the model of ζ, and was in x0 under this input
        start = past.repeat(start, rest)
    arrays = "".join(
        language.array(name, values).replace("static const", "const") + "\n"
        for name, values in (("plant_x0", start), ("plant_u0", rest), ("plant_reference", reference))
    )
    code = (
        '/** @file plant.c @brief The plant of the example. */\n#include <math.h>\n\n#include "plant.h"\n\n'
        + arrays
        + functions
    )
    header = (
        "/** @file plant.h @brief The plant of the example. */\n#ifndef PLANT_H\n#define PLANT_H\n\n"
        '#include "koopmpc.h"\n\n'
        f"#define PLANT_NX {nx}\n#define PLANT_STEPS {steps}\n#define PLANT_ROWS {len(reference)}\n\n"
        f"extern const koopmpc_real plant_x0[{nx}], plant_u0[{nu}], plant_reference[{reference.size}];\n\n"
        "/** next = F(x, u), one sample later. */\n"
        "void plant_step(const koopmpc_real *x, const koopmpc_real *u, koopmpc_real *next);\n\n"
        "/** y, what the controller measures. */\nvoid plant_measure(const koopmpc_real *x, koopmpc_real *y);\n\n"
        "#endif\n"
    )
    return {"plant.c": code, "plant.h": header}


@raise_swallowed()
def _model_map(program: StepProgram) -> ca.Function:
    """Return the controller's own model as a map of ζ, lifted afresh each step."""
    model = program.model
    x, u = ca.SX.sym("x", program.lifting.n), ca.SX.sym("u", model.nu)
    if isinstance(program, StagedProgram):
        measured = [ca.SX(program.E.shape[1], 1)] if program.scheduled else []  # w is zero
        x_next = program.functions["map"].symbolic(x, u, *measured)
    else:
        assert isinstance(model, LinearPredictor), "all other models are linear"
        z = program.lifting.symbolic(x)
        x_next = ca.DM(model.C @ model.A) @ z + ca.DM(model.C @ model.B) @ u
        if model.embedding is not None:
            x_next = model.embedding.symbolic(x, u, x_next)
    return ca.Function("F", [x, u], [ca.densify(x_next)], {"cse": True})


@raise_swallowed()
def _express_measurement(program: StepProgram, plant: StepMap | None, x: ca.SX, ny: int) -> ca.SX:
    """Return y, the measurement of the controller, of the plant's state x."""
    estimator = program.estimator if isinstance(program, CondensedProgram) else None
    if isinstance(estimator, FilterProgram) and program.lifting.n == x.numel():
        H, kept = np.zeros((ny, program.lifting.m)), estimator.kept
        H[:, kept] = estimator.M[:, : len(kept)]
        return ca.mtimes(ca.DM(H), program.lifting.symbolic(x)) + ca.DM(estimator.h)
    own = program.model.h(x) if isinstance(program.model, StepMap) else x
    y = own if plant is None else plant.h(x)
    if y.shape != (ny, 1):
        y = x[:ny]
    if y.shape != (ny, 1):
        raise DataError(
            f"the plant measures {y.shape[0]} values, the controller takes {ny}; pass the plant it controls"
        )
    return y


def _find_start(model: LinearPredictor | BilinearPredictor | StepMap, nx: int) -> Float[np.ndarray, " n"]:
    """Return the root mean squares of the states in the data, ones where they are not known."""
    if isinstance(model, StepMap) or model.scale is None:
        return np.resize(np.ones(len(model.states)), nx)
    return np.resize(np.linalg.norm(model.scale @ model.C.T, axis=0), nx)


def _measure_objects(root: Path, name: str) -> tuple[int, int, int] | None:
    """Return bytes of code and constants, of the state, and of the stack of all functions; None without a compiler."""
    command = find_compiler()
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


def _list_measures(
    tables: Tables, measured: tuple[int, int, int] | None, precision: Precision
) -> list[tuple[str, str]]:
    """Return what a controller takes, each with its value: memory, operations, digits."""
    sizes, single = tables.sizes, precision == "float"
    numbers_held = count_constants(tables) * (4 if single else 8)
    rows = [("constants", f"{numbers_held} bytes")]
    if measured is not None:
        flash, state, stack = measured
        rows += [
            ("flash: code and constants, this machine's compiler with -Os", f"{flash} bytes"),
            ("RAM: one `koopmpc_state`", f"{state} bytes"),
            ("RAM: stack, at most (the frames of all functions together)", f"{stack} bytes"),
        ]
    rows.append(("floating-point operations of a step without active limits, at most", str(count_flops(tables))))
    if not tables.is_lqr:
        limit, what = MOST if tables.is_staged else int(tables.settings["iter_limit"]), "iteration"
        if sizes.get("LEVELS"):
            limit, what = sizes["NODES"], "node"
        of = "of the search over levels" if sizes.get("LEVELS") else "of the QP solver in one solve"
        rows += [
            (f"{what}s {of}, at most", str(limit)),
            (f"floating-point operations of one {what}, at most", str(count_iteration_flops(tables))),
        ]
    rounding = float(np.finfo(np.float32 if single else np.float64).eps) * tables.conditioning
    rows.append(
        (f"change of an input by rounding in {precision} precision, at most", f"{100 * rounding:.2g} % of its range")
    )
    return rows


def _write_readme(tables: Tables, measured: tuple[int, int, int] | None, precision: Precision) -> str:
    """Return the README of the folder: how to build and call the controller, its memory and its operations."""
    sizes, model = tables.sizes, tables.program.model
    table = "\n".join(f"| {what} | {value} |" for what, value in _list_measures(tables, measured, precision))
    notes = "".join(f"- {note}\n" for note in filter(None, [*tables.notes, tables.effort]))
    solver = (
        "`daqp/` holds sources of DAQP 0.11.0 by Daniel Arnström, unchanged, under the MIT licence in `daqp/LICENSE`.\n"
    )
    solver = "" if tables.is_staged else "\n" + solver
    bound = (
        ""
        if tables.is_lqr or tables.is_staged
        else 'A bound on the worst step comes from the iterations: export a controller with `solver="daqp", '
        'settings={"iter_limit": 100}`. Of a saved controller c (`design.controller`): `saved = c.as_data()`, then '
        '`type(c).from_data(dataclasses.replace(saved, options={**saved.options, "solver": "daqp", "settings": '
        '{"iter_limit": 100}}))`.\n'
    )
    dt, state_names, input_names = model.dt, ", ".join(model.states), ", ".join(model.inputs)
    return f"""# {tables.program.controller} in C99

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
