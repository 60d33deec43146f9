"""All the C of a controller: files that are the same for every one, and those with its own numbers."""

from collections.abc import Mapping
from importlib.resources import files

import numpy as np

from koopmpc.codegen.tables import CArrays, Tables
from koopmpc.codegen.text import Language, function

OWN = ("koopmpc.h", "koopmpc_common.h", "koopmpc_common.c", "koopmpc_qp.h", "koopmpc_qp.c")
SOLVER = ("daqp.c", "auxiliary.c", "factorization.c", "constants.h", "types.h", "auxiliary.h", "daqp.h")
SOLVER_FILES = (*SOLVER, "factorization.h", "LICENSE")


def sources_of(tables: Tables, *, single: bool) -> dict[str, str]:
    """Return the text of every file by its name: header, controller, lifting, numbers, solver."""
    language = Language(single)
    controller = "koopmpc_lqr.c" if tables.is_lqr else "koopmpc_mpc.c"
    result = {name: shipped("c", name) for name in (*OWN, controller, "koopmpc_daqp.c")}
    result |= {f"daqp/{name}": shipped("daqp", name) for name in SOLVER_FILES}
    result["koopmpc_sizes.h"] = _sizes(tables, single=single)
    result["koopmpc_solver.h"] = _solver(tables, language)
    result["koopmpc_limits.h"] = _header("limits", "Limits of the inputs.", language.arrays(tables.limits))
    result["koopmpc_plan.h"] = _header("plan", "The plan and its limits.", language.arrays(tables.plan))
    result["koopmpc_targets.h"] = _header("targets", "Targets and their limits.", _targets(tables, language))
    assert tables.lifting is not None
    lift = function(tables.lifting, "koopmpc_lift", {"zeta": tables.sizes["NZETA"]}, "z", language)
    result["koopmpc_lift.c"] = (
        "/** @file koopmpc_lift.c @brief z = psi(zeta), the observables. */\n#include <math.h>\n\n"
        '#include "koopmpc.h"\n\n' + lift.text
    )
    return result


def shipped(folder: str, name: str) -> str:
    """Return a file that comes with the package."""
    return files("koopmpc.codegen").joinpath(folder, name).read_text(encoding="utf-8")


def flops(tables: Tables) -> int:
    """Return a bound of the floating-point operations of a step in which no limit is active and the reference rests."""
    sizes = tables.sizes
    assert tables.lifting is not None
    lift = function(tables.lifting, "f", {"zeta": sizes["NZETA"]}, "z", Language()).flops
    if tables.is_lqr:
        return lift + 2 * sizes["NU"] * (sizes["NZ"] + sizes["NW"] + sizes["NR"] + 2 * sizes["NU"])
    nz, known = sizes["NZ"], sizes["KNOWN"]
    model = 2 * nz * (nz + sizes["NU"] + sizes["NW"])
    filtered = {0: 0, 1: model + 8 * nz * sizes["NX"], 2: 4 * sizes["NS"] ** 2 * (1 + sizes.get("DELAY_Y", 0))}
    return lift + 2 * sizes["NT"] * (known + 1) + sizes["LATENCY"] * model + filtered[sizes["ESTIMATOR"]]


def iteration_flops(tables: Tables) -> int:
    """Return a bound of the floating-point operations of one iteration of the QP solver."""
    n, m = tables.sizes["MOVES"], tables.sizes["QP_M"]
    rank = n + tables.sizes["QP_SOFT"] + 1
    return 2 * n * m + 4 * n * rank + 4 * rank * rank


def _header(name: str, what: str, body: str) -> str:
    guard = f"KOOPMPC_{name.upper()}_H"
    return (
        f"/** @file koopmpc_{name}.h @brief {what} Matrices stand column after column. */\n#ifndef {guard}\n"
        f"#define {guard}\n\n{body}\n#endif\n"
    )


def _sizes(tables: Tables, *, single: bool) -> str:
    lines = [f"#define KOOPMPC_{name} {value}" for name, value in sorted(tables.sizes.items())]
    precision = "#define KOOPMPC_FLOAT\n#define DAQP_SINGLE_PRECISION\n" if single else ""
    functions = "#define KOOPMPC_FN(name) name##f\n" if single else "#define KOOPMPC_FN(name) name\n"
    dt = f"#define KOOPMPC_DT {tables.predictor.dt!r}\n"
    body = precision + functions + "#define KOOPMPC_SQRT KOOPMPC_FN(sqrt)\n" + dt + "\n".join(lines) + "\n"
    return _header("sizes", "Sizes of this controller.", body).replace(" Matrices stand column after column.", "")


def _solver(tables: Tables, language: Language) -> str:
    lines = [f"#define KOOPMPC_{name} {language.number(value)}" for name, value in sorted(tables.reals.items())]
    whole = {"cycle_tol", "iter_limit"}
    settings = ", ".join(
        f".{name} = {int(value) if name in whole else language.number(value)}"
        for name, value in tables.settings.items()
    )
    lines.append(f"#define KOOPMPC_SETTINGS {{{settings}}}")
    return _header("solver", "Settings of the QP solver.", "\n".join(lines) + "\n").replace(
        " Matrices stand column after column.", ""
    )


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
    groups: tuple[Mapping[str, np.ndarray] | CArrays, ...] = (tables.limits, tables.plan, tables.targets)
    return sum(max(1, np.size(values)) for group in groups for values in group.values())
