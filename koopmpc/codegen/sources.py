"""The text of a controller's C: its numbers, its functions from graphs, and the files that all controllers share."""

import re
from collections.abc import Mapping
from importlib.resources import files

import casadi as ca
import numpy as np

from koopmpc.base.errors import DataError
from koopmpc.codegen.functions import Language, count_function_flops, write_functions
from koopmpc.codegen.tables import CFunction, Tables
from koopmpc.control.program import trace_graph

_OWN = ("koopmpc.h", "koopmpc_step.h", "koopmpc_step.c", "koopmpc_observe.c")
_QP = ("koopmpc_qp.c", "koopmpc_daqp.c")
_STAGED = ("stages.h", "stages.c", "staged.c", "rest.c", "rows.c", "finish.c")
_SOLVER = ("daqp.c", "auxiliary.c", "factorization.c", "constants.h", "types.h", "auxiliary.h", "daqp.h")
_SOLVER_FILES = (*_SOLVER, "factorization.h", "LICENSE")
_PUBLIC = {"NX", "NY", "NU", "NR", "NW", "N", "LATENCY", "HORIZON", "MOST_ITERATIONS", "ITERATIONS_PROVED", "TARGET"}
_CLOCK = "#define _POSIX_C_SOURCE 199309L\n#include <time.h>\n"  # for the step times of a whole run


def list_sources(tables: Tables) -> tuple[str, ...]:
    """Return the names of the shipped files that a controller takes."""
    sizes = tables.sizes
    if tables.is_staged:
        parts = {"motion.c": sizes["BEYOND"], "stage_bounds.c": sizes.get("BOUNDS")}
        names = (*_STAGED, *(name for name, needed in parts.items() if needed))
        return (*_OWN, *(f"koopmpc_{name}" for name in names), *(_QP if sizes["FINISH_ROWS"] else ()))
    law = ("koopmpc_feedback.c",) if tables.is_lqr else ("koopmpc_condensed.c",)
    parts = (f"koopmpc_{name}.c" for name in ("bounds", "levels") if sizes.get(name.upper()))
    return (*_OWN, *_QP, "koopmpc_target.c", *law, *parts)


def write_sources(tables: Tables, *, single: bool) -> dict[str, str]:
    """Return the text of every file by its name: header, controller, model, tables, solver.

    The arrays that one file alone names stand in a header of its own, so that each is compiled once.
    """
    language, own = Language(single), list_sources(tables)
    result = {name: read_shipped("c", name) for name in own}
    result["koopmpc_sizes.h"] = _write_sizes(tables, "\n".join(result.values()), single=single)
    shared, alone = _share_arrays(tables)
    what = "Matrices stand column after column, tables of integers row after row."
    for name, arrays in alone.items():
        header = f"{name.removeprefix('koopmpc_')}_tables"
        result[f"koopmpc_{header}.h"] = _write_header(header, f"Tables of {name}.c. {what}", language.arrays(arrays))
    body = _write_reals(tables, language) + language.arrays(shared)
    result["koopmpc_tables.h"] = _write_header("tables", f"Tables of several files. {what}", body)
    if "koopmpc_qp.c" in own:
        result |= {f"daqp/{name}": read_shipped("daqp", name) for name in _SOLVER_FILES}
        result["koopmpc_names.h"] = _write_names()
    header = "koopmpc_stages.h" if tables.is_staged else "koopmpc_step.h"
    result["koopmpc_model.c"] = (
        "/** @file koopmpc_model.c @brief The model, written from CasADi's graph. */\n#include <math.h>\n\n"
        f'#include "{header}"\n\n'
        + write_functions({f"koopmpc_{name}": each for name, each in tables.functions.items()}, language)
    )
    return result


def _share_arrays(tables: Tables) -> tuple[dict[str, np.ndarray], dict[str, dict[str, np.ndarray]]]:
    """Return the arrays that several files of a controller name, and of each other file those that it names alone."""
    texts = {name: read_shipped("c", name) for name in list_sources(tables)}
    named = {name: set(re.findall(r"\bkoopmpc_(\w+)", text)) for name, text in texts.items()}
    alone = {name[:-2]: dict[str, np.ndarray]() for name, text in texts.items() if f'"{name[:-2]}_tables.h"' in text}
    shared = dict[str, np.ndarray]()
    for path, values in tables.arrays.items():
        users = [name for name, words in named.items() if path in words]
        if users:
            only = users[0][:-2] if len(users) == 1 and users[0].endswith(".c") else ""
            alone.get(only, shared)[path] = values
    return shared, alone


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
        return cost["lift"] + 2 * sizes["NU"] * (nz + sizes["NW"] + sizes["NR"] + 2 * sizes["NU"])
    if tables.is_staged:
        N, ns, nr = sizes["N"], sizes["NS"], sizes["TRACKED"]
        stage = cost["slopes"] + cost["tracked"] + cost["limited"] + 2 * ns * nr * (nr + ns)
        end = 2 * sizes["END"] * (nr * ns + ns * ns)
        halvings = 10  # of a step, at most
        one = N * (stage + halvings * cost["stage_map"]) + end + _count_sweeps(tables, 1)
        return sizes["ITERATIONS"] * one + (sizes["LATENCY"] + sizes["ESTIMATOR"] + 1) * cost["map"]
    model = 2 * nz * (nz + sizes["NU"] + sizes["NW"])
    filtered = {
        0: 0,
        1: model + 8 * nz * sizes["NX"],
        2: 4 * sizes.get("ESTIMATOR_F_LENGTH", 0) ** 2 * (1 + sizes.get("ESTIMATOR_DELAY", 0)),
    }
    return (
        cost["lift"] + 2 * sizes["NT"] * (sizes["KNOWN"] + 1) + sizes["LATENCY"] * model + filtered[sizes["ESTIMATOR"]]
    )


def count_iteration_flops(tables: Tables) -> int:
    """Return a bound of the floating-point operations of one iteration of the QP solver, or of one node of a search."""
    if tables.is_staged:
        return _count_sweeps(tables, 2) + 100 * tables.sizes["N"] * (tables.sizes["SIDES"] + 1)
    if tables.sizes.get("LEVELS"):
        return 2 * tables.sizes["LEVELS_FREE_LENGTH"] * (tables.sizes["LEVELS_ROWS_LENGTH"] + 4)
    n, m = tables.sizes["MOVES"], tables.sizes["QP_M"]
    rank = n + tables.sizes["QP_SOFT"] + 1
    return 2 * n * m + 4 * n * rank + 4 * rank * rank


def _count_sweeps(tables: Tables, gradients: int) -> int:
    """Return the operations of a Riccati factorisation of all stages, and of the sweeps for so many gradients."""
    sizes = tables.sizes
    n, m, g = sizes["NS"], sizes["NU"], sizes["LIMITED"]
    factor = 4 * n**3 + 8 * n * n * m + 6 * n * m * m + m**3 + 3 * n * n * (g + 1) + 22 * m
    return sizes["N"] * (factor + gradients * (8 * n * n + 16 * n * m + 4 * m * m + 4 * n * g))


def _write_header(name: str, what: str, body: str) -> str:
    guard = f"KOOPMPC_{name.upper()}_H"
    includes = '#include "koopmpc.h"\n\n' if name not in ("sizes", "names") else ""
    return (
        f"/** @file koopmpc_{name}.h @brief {what} */\n#ifndef {guard}\n#define {guard}\n\n{includes}{body}\n#endif\n"
    )


def _write_sizes(tables: Tables, text: str, *, single: bool) -> str:
    """Return the header of the sizes that a text names; one that the Program lacks is 0."""
    named = set(re.findall(r"\bKOOPMPC_([A-Z][A-Z0-9_]*[A-Z0-9])\b", text)) - {"FLOAT", "FN", "SQRT", "DT", "SETTINGS"}
    named -= set(re.findall(r"(?:#define KOOPMPC_(?=\w)|KOOPMPC_(?=\w+ = ))(\w+)", text)) | tables.reals.keys()
    sizes = dict.fromkeys(named, 0) | {name: size for name, size in tables.sizes.items() if name in named | _PUBLIC}
    lines = [f"#define KOOPMPC_{name} {value}" for name, value in sorted(sizes.items())]
    precision = "#define KOOPMPC_FLOAT\n#define DAQP_SINGLE_PRECISION\n" if single else ""
    functions = "#define KOOPMPC_FN(name) name##f\n" if single else "#define KOOPMPC_FN(name) name\n"
    dt = f"#define KOOPMPC_DT {tables.program.model.dt!r}\n"
    dt += f"/* {tables.effort} */\n" if tables.effort else ""
    body = precision + functions + "#define KOOPMPC_SQRT KOOPMPC_FN(sqrt)\n" + dt + "\n".join(lines) + "\n"
    return _write_header("sizes", "Sizes of this controller.", body)


def _write_reals(tables: Tables, language: Language) -> str:
    lines = [f"#define KOOPMPC_{name} {language.number(value)}" for name, value in sorted(tables.reals.items())]
    whole = {"cycle_tol", "iter_limit"}
    settings = ", ".join(
        f".{name} = {int(value) if name in whole else language.number(value)}"
        for name, value in tables.settings.items()
    )
    lines.append(f"#define KOOPMPC_SETTINGS {{{settings}}}")
    return "\n".join(lines) + "\n\n"


def count_constants(tables: Tables) -> int:
    """Return how many numbers the controller's tables hold."""
    shared, alone = _share_arrays(tables)
    return sum(max(1, values.size) for group in (shared, *alone.values()) for values in group.values())
