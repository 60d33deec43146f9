"""All the C of a controller: files that are the same for every one, and those with its own numbers."""

import re
from importlib.resources import files

import numpy as np
from jaxtyping import Float

from koopmpc.codegen.linear import koopman_tables, lqr_tables
from koopmpc.codegen.staged import bilinear_tables
from koopmpc.codegen.tables import Exportable, Tables, refusal
from koopmpc.codegen.text import Language, function
from koopmpc.control.lqr import LQR
from koopmpc.control.nonlinear.bilinear_mpc import BilinearMPC
from koopmpc.errors import DataError

OWN = ("koopmpc.h", "koopmpc_common.h", "koopmpc_common.c")
_RECEDING = ("koopmpc_receding.h", "koopmpc_receding.c")
_QP = ("koopmpc_qp.h", "koopmpc_qp.c", "koopmpc_daqp.c")
_STAGED = ("koopmpc_stages.h", "koopmpc_stages.c", "koopmpc_staged.c", "koopmpc_rest.c", "koopmpc_finish.c")
SOLVER = ("daqp.c", "auxiliary.c", "factorization.c", "constants.h", "types.h", "auxiliary.h", "daqp.h")
_COLUMNS = " Matrices stand column after column."
SOLVER_FILES = (*SOLVER, "factorization.h", "LICENSE")


def tables_of(
    controller: Exportable, references: Float[np.ndarray, "rows nr"] | None = None, *, single: bool
) -> Tables:
    """Return the tables of a controller; a BilinearMPC's hold the targets of these reference rows.

    Raises
    ------
    DataError
        It cannot be written in C; the message says which part of it, and what would do.
    """
    error = refusal(controller)
    if error is not None:
        raise error
    if isinstance(controller, BilinearMPC):
        return bilinear_tables(controller, references, single=single)
    if isinstance(controller, LQR):
        return lqr_tables(controller, single=single)
    return koopman_tables(controller, single=single)


def sources_of(tables: Tables, *, single: bool) -> dict[str, str]:
    """Return the text of every file by its name: header, controller, model, numbers, solver."""
    language = Language(single)
    if tables.is_staged:
        own = (*OWN, *_RECEDING, *_STAGED, *(_QP if tables.sizes["FINISH_ROWS"] else ()))
    else:
        law = ("koopmpc_lqr.c",) if tables.is_lqr else (*_RECEDING, "koopmpc_mpc.c")
        own = (*OWN, *_QP, "koopmpc_target.c", *law)
    result = {name: shipped("c", name) for name in own}
    result["koopmpc_sizes.h"] = _sizes(tables, single=single)
    result["koopmpc_solver.h"] = _solver(tables, language)
    result["koopmpc_limits.h"] = _header("limits", "Limits of the inputs.", language.arrays(tables.limits))
    result["koopmpc_observer.h"] = _header("observer", "The observer's model.", language.arrays(tables.observer))
    result["koopmpc_plan.h"] = _header("plan", "The plan and its limits.", language.arrays(tables.plan))
    if "koopmpc_qp.c" in own:
        result |= {f"daqp/{name}": shipped("daqp", name) for name in SOLVER_FILES}
        result["koopmpc_names.h"] = _names()
    if tables.is_staged:
        result["koopmpc_table.h"] = _header("table", "Targets of reference rows.", language.arrays(tables.targets))
    else:
        result["koopmpc_targets.h"] = _header("targets", "Targets and their limits.", _targets(tables, language))
    header = "koopmpc_stages.h" if tables.is_staged else "koopmpc.h"
    result["koopmpc_model.c"] = (
        "/** @file koopmpc_model.c @brief The model, written from CasADi's graph. */\n#include <math.h>\n\n"
        f'#include "{header}"\n\n'
        + "\n".join(
            function(each.graph, name, each.arguments, each.result, language).text
            for name, each in tables.functions.items()
        )
    )
    return result


def named(texts: dict[str, str], name: str) -> dict[str, str]:
    """Return files whose names and symbols start with another name than `koopmpc`, so that several link together.

    Raises
    ------
    DataError
        The name is none that C takes in lower case.
    """
    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise DataError(f"name is {name!r}; pass one of lower-case letters, digits and _, a letter first")

    def ours(text: str) -> str:
        return text.replace("koopmpc", name).replace("KOOPMPC", name.upper())

    return {path if "/" in path else ours(path): text if "/" in path else ours(text) for path, text in texts.items()}


def _names() -> str:
    """Return the header that gives DAQP's functions names of this controller, for two may be in one program."""
    found = [
        re.findall(r"\b(\w*(?:daqp|ldp)_?\w*)\s*\(DAQP", shipped("daqp", name)) for name in SOLVER if name[-1] == "h"
    ]
    found.append(re.findall(r"\b(\w+)\s*\(DAQP", shipped("daqp", "factorization.h")))
    lines = [f"#define {name} koopmpc_{name}" for name in sorted({name for names in found for name in names})]
    return _header("names", "DAQP's functions in this controller.", "\n".join(lines) + "\n").replace(_COLUMNS, "")


def shipped(folder: str, name: str) -> str:
    """Return a file that comes with the package."""
    return files("koopmpc.codegen").joinpath(folder, name).read_text(encoding="utf-8")


def flops(tables: Tables) -> int:
    """Return a bound of the floating-point operations of a step in which no limit is active and the reference rests."""
    sizes = tables.sizes
    cost = {
        name: function(each.graph, name, each.arguments, each.result, Language()).flops
        for name, each in tables.functions.items()
    }
    nz = sizes["NZ"]
    if tables.is_lqr:
        return cost["koopmpc_lift"] + 2 * sizes["NU"] * (nz + sizes["NW"] + sizes["NR"] + 2 * sizes["NU"])
    if tables.is_staged:
        N, ns, nr = sizes["N"], sizes["POINT"], sizes["TRACKED"]
        stage = cost["koopmpc_slopes"] + cost["koopmpc_tracked"] + cost["koopmpc_limited"] + 2 * ns * nr * (nr + ns)
        end = 2 * sizes["END"] * (nr * ns + ns * ns)
        halvings = 10  # of a step, at most
        one = N * (stage + halvings * cost["koopmpc_stage_map"]) + end + _sweeps(tables, 1)
        return sizes["ITERATIONS"] * one + (sizes["LATENCY"] + sizes["ESTIMATOR"] + 1) * cost["koopmpc_map"]
    model = 2 * nz * (nz + sizes["NU"] + sizes["NW"])
    filtered = {0: 0, 1: model + 8 * nz * sizes["NX"], 2: 4 * sizes["NS"] ** 2 * (1 + sizes.get("DELAY_Y", 0))}
    return (
        cost["koopmpc_lift"]
        + 2 * sizes["NT"] * (sizes["KNOWN"] + 1)
        + sizes["LATENCY"] * model
        + filtered[sizes["ESTIMATOR"]]
    )


def iteration_flops(tables: Tables) -> int:
    """Return a bound of the floating-point operations of one iteration of the QP solver."""
    if tables.is_staged:
        return _sweeps(tables, 2) + 100 * tables.sizes["N"] * (tables.sizes["SIDES"] + 1)
    n, m = tables.sizes["MOVES"], tables.sizes["QP_M"]
    rank = n + tables.sizes["QP_SOFT"] + 1
    return 2 * n * m + 4 * n * rank + 4 * rank * rank


def _sweeps(tables: Tables, gradients: int) -> int:
    """Return the operations of a Riccati factorisation of all stages, and of the sweeps for so many gradients."""
    sizes = tables.sizes
    n, m, g = sizes["POINT"], sizes["NU"], sizes["LIMITED"]
    factor = 4 * n**3 + 8 * n * n * m + 6 * n * m * m + m**3 + 3 * n * n * (g + 1) + 22 * m
    return sizes["N"] * (factor + gradients * (8 * n * n + 16 * n * m + 4 * m * m + 4 * n * g))


def _header(name: str, what: str, body: str) -> str:
    guard = f"KOOPMPC_{name.upper()}_H"
    includes = '#include "koopmpc.h"\n\n' if name not in ("sizes", "names") else ""
    return (
        f"/** @file koopmpc_{name}.h @brief {what}{_COLUMNS} */\n#ifndef {guard}\n"
        f"#define {guard}\n\n{includes}{body}\n#endif\n"
    )


def _sizes(tables: Tables, *, single: bool) -> str:
    lines = [f"#define KOOPMPC_{name} {value}" for name, value in sorted(tables.sizes.items())]
    precision = "#define KOOPMPC_FLOAT\n#define DAQP_SINGLE_PRECISION\n" if single else ""
    functions = "#define KOOPMPC_FN(name) name##f\n" if single else "#define KOOPMPC_FN(name) name\n"
    dt = f"#define KOOPMPC_DT {tables.model.dt!r}\n"
    body = precision + functions + "#define KOOPMPC_SQRT KOOPMPC_FN(sqrt)\n" + dt + "\n".join(lines) + "\n"
    return _header("sizes", "Sizes of this controller.", body).replace(_COLUMNS, "")


def _solver(tables: Tables, language: Language) -> str:
    lines = [f"#define KOOPMPC_{name} {language.number(value)}" for name, value in sorted(tables.reals.items())]
    whole = {"cycle_tol", "iter_limit"}
    settings = ", ".join(
        f".{name} = {int(value) if name in whole else language.number(value)}"
        for name, value in tables.settings.items()
    )
    if settings:
        lines.append(f"#define KOOPMPC_SETTINGS {{{settings}}}")
    return _header("solver", "Settings of the QP solver.", "\n".join(lines) + "\n").replace(_COLUMNS, "")


def _targets(tables: Tables, language: Language) -> str:
    body = language.arrays(tables.targets)
    none = "static const koopmpc_real koopmpc_target_free[1] = {0};\n"
    entries: list[str] = []
    for which, (n, m) in enumerate(tables.target_qps):
        arrays = ", ".join(f"koopmpc_target_{name}_{which}" for name in ("M", "scaling", "rinv", "sense"))
        entries.append(f"  {{{n}, {m}, 0, {arrays}, koopmpc_target_free, koopmpc_target_free}},")
    units = ", ".join(f"koopmpc_target_unit_{which}" for which in range(len(tables.target_qps)))
    return (
        f"{body}{none}static const koopmpc_qp koopmpc_target_qps[2] = {{\n"
        + "\n".join(entries)
        + f"\n}};\nstatic const koopmpc_real *const koopmpc_target_unit[2] = {{{units}}};\n"
    )


def constants(tables: Tables) -> int:
    """Return how many numbers the controller's tables hold."""
    groups = (tables.limits, tables.observer, tables.plan, tables.targets)
    return sum(max(1, np.size(values)) for group in groups for values in group.values())
