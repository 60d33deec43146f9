"""The text of a controller's C: its numbers, its functions from graphs, and the files that all controllers share."""

import re
from collections.abc import Mapping
from importlib.resources import files

import casadi as ca
import numpy as np

from koopmpc.codegen.functions import Language, count_function_flops, write_functions
from koopmpc.codegen.tables import CFunction, Tables
from koopmpc.control.program import trace_graph
from koopmpc.errors import DataError

_OWN = ("koopmpc.h", "koopmpc_common.h", "koopmpc_common.c")
_RECEDING = ("koopmpc_receding.h", "koopmpc_receding.c", "koopmpc_bounds.h", "koopmpc_levels.h")
_QP = ("koopmpc_qp.h", "koopmpc_qp.c", "koopmpc_daqp.c")
_STAGES = ("koopmpc_stages.h", "koopmpc_stages.c", "koopmpc_staged.c")
_STAGED = (*_STAGES, "koopmpc_rest.c", "koopmpc_rows.c", "koopmpc_finish.c")
_SOLVER = ("daqp.c", "auxiliary.c", "factorization.c", "constants.h", "types.h", "auxiliary.h", "daqp.h")
_SOLVER_FILES = (*_SOLVER, "factorization.h", "LICENSE")
_CLOCK = "#define _POSIX_C_SOURCE 199309L\n#include <time.h>\n"  # for the step times of a whole run


def write_sources(tables: Tables, *, single: bool) -> dict[str, str]:
    """Return the text of every file by its name: header, controller, model, numbers, solver."""
    language = Language(single)
    if tables.is_staged:
        own = (*_OWN, *_RECEDING, *_STAGED, *(["koopmpc_motion.c"] if tables.sizes["BEYOND"] else ()))
        own = (*own, *(_QP if tables.sizes["FINISH_ROWS"] else ()))
        own = (*own, *(["koopmpc_stage_bounds.c"] if tables.sizes["BOUNDS"] else ()))
    else:
        law = ("koopmpc_lqr.c",) if tables.is_lqr else (*_RECEDING, "koopmpc_mpc.c")
        law = (*law, *(["koopmpc_bounds.c"] if tables.sizes["BOUNDS"] else ()))
        law = (*law, *(["koopmpc_levels.c"] if tables.sizes["LEVELED"] else ()))
        own = (*_OWN, *_QP, "koopmpc_target.c", *law)
    result = {name: read_shipped("c", name) for name in own}
    result["koopmpc_sizes.h"] = _write_sizes(tables, single=single)
    result["koopmpc_solver.h"] = _write_solver(tables, language)
    arrays = {
        "limits": ("Limits of the inputs.", language.arrays(tables.limits)),
        "observer": ("The observer's model.", language.arrays(tables.observer)),
        "plan": ("The plan and its limits.", language.arrays(tables.plan)),
    }
    if tables.is_staged:
        arrays["table"] = "Targets of reference rows.", language.arrays(tables.targets)
    else:
        arrays["targets"] = "Targets and their limits.", _write_targets(tables, language)
    for name, (what, body) in arrays.items():
        result[f"koopmpc_{name}.h"] = _write_header(name, f"{what} Matrices stand column after column.", body)
    if "koopmpc_qp.c" in own:
        result |= {f"daqp/{name}": read_shipped("daqp", name) for name in _SOLVER_FILES}
        result["koopmpc_names.h"] = _write_names()
    header = "koopmpc_stages.h" if tables.is_staged else "koopmpc.h"
    result["koopmpc_model.c"] = (
        "/** @file koopmpc_model.c @brief The model, written from CasADi's graph. */\n#include <math.h>\n\n"
        f'#include "{header}"\n\n' + write_functions(tables.functions, language)
    )
    return result


def write_one_source(tables: Tables, *, single: bool) -> str:
    """Return all C of a controller as one file, with the functions by which Python calls it."""
    return "\n".join([_CLOCK + join_sources(write_sources(tables, single=single)), read_shipped("c", "door.c")])


def join_sources(texts: Mapping[str, str]) -> str:
    """Return the C files of a controller as one; each local header stands where it is first included."""
    seen = set[str]()

    def inline(text: str, folder: str) -> str:
        def include(match: re.Match[str]) -> str:
            name = match.group(1)
            path = next((p for p in (folder + name, name) if p in texts), "")
            if not path:  # DAQP includes it for its own clock
                return match.group()
            if path in seen:
                return ""
            seen.add(path)
            return inline(texts[path], path.rpartition("/")[0] + "/" if "/" in path else "")

        return re.sub(r'^#include "([^"]+)"$', include, text, flags=re.MULTILINE)

    return "\n".join(inline(text, "") for name, text in texts.items() if name.endswith(".c") and "/" not in name)


def write_plant_functions(F: ca.Function, h: ca.Function, language: Language) -> str:
    """Return ``plant_step(x, u, next)`` and ``plant_measure(x, y)`` of x⁺ = F(x, u), y = h(x).

    Raises
    ------
    DataError
        The equations cannot be written in C, or F takes measured disturbances.
    """
    if F.n_in() > 2:
        raise DataError("the plant has measured disturbances, and its C would take u alone; pass plant.at(w)")
    nx, nu = F.size1_in(0), F.size1_in(1)
    step, look = trace_graph(F, "the plant"), trace_graph(h, "what the plant measures")
    functions = {
        "plant_step": CFunction(step, {"x": nx, "u": nu}, "next"),
        "plant_measure": CFunction(look, {"x": nx}, "y"),
    }
    return write_functions(functions, language)


def rename_symbols(texts: dict[str, str], name: str) -> dict[str, str]:
    """Return the files with `name` in place of koopmpc in names and symbols, so that several controllers link together.

    Raises
    ------
    DataError
        The name has other characters than lower-case letters, digits and _.
    """
    if not re.fullmatch("[a-z][a-z0-9_]*", name):
        raise DataError(f"name is {name!r}; pass one of lower-case letters, digits and _, a letter first")

    def ours(text: str) -> str:
        return text.replace("koopmpc", name).replace("KOOPMPC", name.upper())

    return {path if "/" in path else ours(path): text if "/" in path else ours(text) for path, text in texts.items()}


def _write_names() -> str:
    """Return the header that renames DAQP's functions, so that one program may hold two controllers."""
    found = [
        re.findall(r"\b(\w*(?:daqp|ldp)_?\w*)\s*\(DAQP", read_shipped("daqp", name))
        for name in _SOLVER
        if name[-1] == "h"
    ]
    found.append(re.findall(r"\b(\w+)\s*\(DAQP", read_shipped("daqp", "factorization.h")))
    lines = [f"#define {name} koopmpc_{name}" for name in sorted({name for names in found for name in names})]
    return _write_header("names", "DAQP's functions in this controller.", "\n".join(lines) + "\n")


def read_shipped(folder: str, name: str) -> str:
    """Return the text of a file of the package."""
    return files("koopmpc.codegen").joinpath(folder, name).read_text(encoding="utf-8")


def count_flops(tables: Tables) -> int:
    """Return a bound of the floating-point operations of a step in which no limit is active and the reference rests."""
    sizes = tables.sizes
    cost = {name: count_function_flops(each.graph) for name, each in tables.functions.items()}
    nz = sizes["NZ"]
    if tables.is_lqr:
        return cost["koopmpc_lift"] + 2 * sizes["NU"] * (nz + sizes["NW"] + sizes["NR"] + 2 * sizes["NU"])
    if tables.is_staged:
        N, ns, nr = sizes["N"], sizes["POINT"], sizes["TRACKED"]
        stage = cost["koopmpc_slopes"] + cost["koopmpc_tracked"] + cost["koopmpc_limited"] + 2 * ns * nr * (nr + ns)
        end = 2 * sizes["END"] * (nr * ns + ns * ns)
        halvings = 10  # of a step, at most
        one = N * (stage + halvings * cost["koopmpc_stage_map"]) + end + _count_sweeps(tables, 1)
        return sizes["ITERATIONS"] * one + (sizes["LATENCY"] + sizes["ESTIMATOR"] + 1) * cost["koopmpc_map"]
    model = 2 * nz * (nz + sizes["NU"] + sizes["NW"])
    filtered = {0: 0, 1: model + 8 * nz * sizes["NX"], 2: 4 * sizes["NS"] ** 2 * (1 + sizes.get("DELAY_Y", 0))}
    return (
        cost["koopmpc_lift"]
        + 2 * sizes["NT"] * (sizes["KNOWN"] + 1)
        + sizes["LATENCY"] * model
        + filtered[sizes["ESTIMATOR"]]
    )


def count_iteration_flops(tables: Tables) -> int:
    """Return a bound of the floating-point operations of one iteration of the QP solver, or of one node of a search."""
    if tables.is_staged:
        return _count_sweeps(tables, 2) + 100 * tables.sizes["N"] * (tables.sizes["SIDES"] + 1)
    if tables.sizes["LEVELED"]:
        return 2 * tables.sizes["FREE_MOVES"] * (tables.sizes["SEARCH_ROWS"] + 4)
    n, m = tables.sizes["MOVES"], tables.sizes["QP_M"]
    rank = n + tables.sizes["QP_SOFT"] + 1
    return 2 * n * m + 4 * n * rank + 4 * rank * rank


def _count_sweeps(tables: Tables, gradients: int) -> int:
    """Return the operations of a Riccati factorisation of all stages, and of the sweeps for so many gradients."""
    sizes = tables.sizes
    n, m, g = sizes["POINT"], sizes["NU"], sizes["LIMITED"]
    factor = 4 * n**3 + 8 * n * n * m + 6 * n * m * m + m**3 + 3 * n * n * (g + 1) + 22 * m
    return sizes["N"] * (factor + gradients * (8 * n * n + 16 * n * m + 4 * m * m + 4 * n * g))


def _write_header(name: str, what: str, body: str) -> str:
    guard = f"KOOPMPC_{name.upper()}_H"
    includes = '#include "koopmpc.h"\n\n' if name not in ("sizes", "names") else ""
    return (
        f"/** @file koopmpc_{name}.h @brief {what} */\n#ifndef {guard}\n#define {guard}\n\n{includes}{body}\n#endif\n"
    )


def _write_sizes(tables: Tables, *, single: bool) -> str:
    lines = [f"#define KOOPMPC_{name} {value}" for name, value in sorted(tables.sizes.items())]
    precision = "#define KOOPMPC_FLOAT\n#define DAQP_SINGLE_PRECISION\n" if single else ""
    functions = "#define KOOPMPC_FN(name) name##f\n" if single else "#define KOOPMPC_FN(name) name\n"
    dt = f"#define KOOPMPC_DT {tables.program.dt!r}\n"
    dt += f"/* {tables.effort} */\n" if tables.effort else ""
    body = precision + functions + "#define KOOPMPC_SQRT KOOPMPC_FN(sqrt)\n" + dt + "\n".join(lines) + "\n"
    return _write_header("sizes", "Sizes of this controller.", body)


def _write_solver(tables: Tables, language: Language) -> str:
    lines = [f"#define KOOPMPC_{name} {language.number(value)}" for name, value in sorted(tables.reals.items())]
    whole = {"cycle_tol", "iter_limit"}
    settings = ", ".join(
        f".{name} = {int(value) if name in whole else language.number(value)}"
        for name, value in tables.settings.items()
    )
    if settings:
        lines.append(f"#define KOOPMPC_SETTINGS {{{settings}}}")
    return _write_header("solver", "Settings of the QP solver.", "\n".join(lines) + "\n")


def _write_targets(tables: Tables, language: Language) -> str:
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


def count_constants(tables: Tables) -> int:
    """Return how many numbers the controller's tables hold."""
    groups = (tables.limits, tables.observer, tables.plan, tables.targets)
    return sum(max(1, np.size(values)) for group in groups for values in group.values())
