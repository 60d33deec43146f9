"""From a `Program` to the `Tables` of its C code: its fields, what they lead to, and the sizes of memory."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from koopmpc.base import checks
from koopmpc.base.errors import DataError
from koopmpc.codegen import tolerances
from koopmpc.codegen.tables import CFunction, Tables, write_fields
from koopmpc.control.ask.levels import FREE
from koopmpc.control.nonlinear.iteration import MOST
from koopmpc.control.nonlinear.staged_program import StagedProgram
from koopmpc.control.nonlinear.stagewise import list_hard_outputs
from koopmpc.control.plan.condensed_program import BoundsProgram, CondensedProgram
from koopmpc.control.program import Published, StepProgram, no_export
from koopmpc.control.solvers.daqp import FEW, MOVED
from koopmpc.control.solvers.levels import NODES
from koopmpc.control.step import aim
from koopmpc.control.step.feedback import FeedbackProgram
from koopmpc.estimate.disturbance import EXACT, DisturbanceProgram
from koopmpc.estimate.filter import FilterProgram
from koopmpc.estimate.gate import BEYOND, BRIDGED
from koopmpc.estimate.observer import EstimatorProgram
from koopmpc.models.predictors import LinearPredictor
from koopmpc.plants.step_map import StepMap

_LONG = 2**11  # numbers in the reference's share of a plan from which on a step first asks for its first input alone
_TABLE_NOTE = (
    "`koopmpc_table` holds the equilibria of the reference rows that `export` was given, and what the end of the "
    "horizon costs there. Any other row may come at run time: the step that meets it finds its equilibrium from that "
    "of the nearest row, by up to 40 times 20 Gauss-Newton steps, and keeps it. To bound the time of a step, pass all "
    "rows to `export`."
)

_SCHEDULE_NOTE = (
    "Measured disturbances multiply the state or the inputs: the last row of their preview holds at the end of the "
    "horizon, and each step at which it changes searches the equilibria of the reference again."
)

_BOUNDS_NOTE = (
    "Limits that move in time are arguments: call `koopmpc_set_bounds` before a step, with rows from that step on. "
    "Until then, and after `koopmpc_init`, the widest bounds of the controller hold."
)

_LEVELS_NOTE = (
    "A step searches sequences of levels, and looks at no more than `most_nodes` of the state; `koopmpc_init` sets it "
    "to KOOPMPC_NODES. If the search ends there, the status is KOOPMPC_TIME_LIMIT, and `gap` bounds by which share of "
    "its cost a better plan could be cheaper."
)

# The name of each function in C, its result, and its arguments: of a model, w comes last where it multiplies x or u.
ARGUMENTS = {
    "lifting": ("lift", "z", ("zeta",)),
    "estimator_gate": ("gate", "result", ("y", "predicted", "memory")),
    "functions_map": ("map", "next", ("x", "u", "w")),
    "functions_stage_map": ("stage_map", "next", ("s", "v", "w")),
    "functions_slopes": ("slopes", "out", ("s", "v", "w")),
    "functions_local": ("local", "out", ("x", "u", "w")),
    "functions_tracked": ("tracked", "out", ("s",)),
    "functions_limited": ("limited", "out", ("s",)),
    "functions_stage": ("stage", "out", ("s", "r")),
}


def read_program(controller: object, reference: Any = None) -> StepProgram:
    """Return the Program of a controller.

    Raises
    ------
    DataError
        No C code can be generated; the message says why.
    """
    if not isinstance(controller, Published):
        raise no_export(controller)
    program = controller.build_program(reference)
    if not isinstance(program, StepProgram):
        raise no_export(controller)
    return program


def make_tables(program: StepProgram, *, single: bool, room: int = 0) -> Tables:
    """Return the tables of a Program's C code.

    `room` is how many numbers a table of what given input targets share in the plan may have; it may always have as
    many as the matrix that it replaces.

    Raises
    ------
    DataError
        A setting of the solver has no counterpart in C, or C code for this kind of Program is not known.
    """
    if not isinstance(program, FeedbackProgram | CondensedProgram | StagedProgram):
        raise DataError(
            f"there is no C code for {checks.article(program)}; make a FeedbackProgram or a CondensedProgram"
        )
    program = _adapt(program, single=single)
    tables = Tables(program, notes=list(program.notes), conditioning=_amplify(program))
    tables.settings = {name: float(program.settings[name]) for name in tolerances.SETTINGS}
    tables.reals = {name: values[single] for name, values in tolerances.IN_C.items()}
    write_fields(tables, "", program, single=single)
    _add_sizes(tables, program)
    if isinstance(program, CondensedProgram):
        _derive_condensed(tables, program, room)
    elif isinstance(program, StagedProgram):
        _derive_staged(tables, program)
    twice = sorted(tables.sizes.keys() & tables.reals.keys())
    if twice:
        raise ValueError(f"the C code has two constants of the name {twice[0]}; give one of them another name")
    return tables


def _adapt(program: StepProgram, *, single: bool) -> StepProgram:
    """Return the Program with settings that C has, and in single precision with tolerances above its rounding."""
    if program.settings["time_limit"] > 0:
        raise DataError(
            'a time_limit cannot be exported, C has no clock; bound the iterations: settings={"iter_limit": 100}'
        )
    if not single:
        return program
    coarse = {name: max(float(program.settings[name]), least) for name, least in tolerances.SINGLE.items()}
    return replace(program, settings={**program.settings, **coarse})


def _amplify(program: StepProgram) -> float:
    """Return Σ |gain| size over an input's span, for the most sensitive input of the plan; `size` is that of z."""
    span = program.inputs.high - program.inputs.low
    reach = np.abs(program.gain) @ program.sizes
    known = np.where(np.isfinite(span) & (span > 0), span, reach[: len(span)] + 1e-300)
    return float((reach / np.tile(known, len(reach) // len(known))).max())


def _add_sizes(tables: Tables, program: StepProgram) -> None:
    """Add the sizes that `koopmpc.h` names, and give each function its name in C and its arguments."""
    model, estimator, sizes = program.model, program.estimator, tables.sizes
    embedding = None if isinstance(model, StepMap) else model.embedding
    steps, inputs_too = (0, 0) if embedding is None else (embedding.steps, int(embedding.inputs))
    rates: np.ndarray = getattr(program, "K_rate", np.zeros(0))
    nx, nw = model.nx, 0
    if isinstance(program, StagedProgram):
        nx, nw = program.ny, program.E.shape[1]
    elif isinstance(model, LinearPredictor):
        nw = model.nw
    N, latency = (1, 0) if tables.is_lqr else (sizes["N"], sizes["LATENCY"])
    bounds: BoundsProgram | None = getattr(program, "bounds", None)
    sizes |= {
        "IS_LQR": int(tables.is_lqr),
        "IS_STAGED": int(tables.is_staged),
        "ESTIMATOR": {EstimatorProgram: 0, DisturbanceProgram: 1, FilterProgram: 2}[type(estimator)],
        "GATE": 0 if estimator.gate is None else estimator.gate.m - 2,
        "NU": model.nu,
        "NR": program.nr,
        "NX": nx,
        "NY": len(estimator.M) if isinstance(estimator, FilterProgram) else nx,
        "NW": nw,
        "NW1": max(1, nw),
        "NZ": program.lifting.m,
        "NZETA": program.lifting.n,
        "N": N,
        "LATENCY": latency,
        "HORIZON": 0 if tables.is_lqr else N + latency,
        "WITH_RATES": sizes.get("WITH_RATES", int(rates.size > 0)),
        "DELAYS": steps,
        "DELAYED_INPUTS": inputs_too,
        "OUTPUTS": 0 if bounds is None else bounds.margin.shape[1],
        "NA": sizes.get("TARGETS_OFFSET_LENGTH", 0),
        "NL": sizes.get("TARGETS_ROWS_LENGTH", 0),
        "MOVES": model.nu,  # of a feedback law
        "KNOWN": program.lifting.m + nw,
        "CHANGES": int(bounds is not None and not tables.is_staged and program.rates is not None),
        "BRIDGED": BRIDGED,
        "NODES": NODES,
        "FREE": FREE,
        "FEW": FEW,
        "MOVED": MOVED,
        "INTERIOR": MOST,
    }
    tables.reals |= {"AGREES": BEYOND, "EXACT": EXACT}
    for name in ("rates", "hard_rates"):
        for end in ("low", "high"):
            tables.arrays.setdefault(f"{name}_{end}", np.zeros(model.nu))
    if bounds is not None:
        tables.notes.append(_BOUNDS_NOTE)
    _name_functions(tables, program)
    solvers = [name for name in ("TARGET_SOLVERS_0", "TARGET_SOLVERS_1") if name in sizes]
    _add_memory(sizes, "TARGET", [(sizes[f"{name}_VARIABLES"], sizes[f"{name}_COUNT"], 0) for name in solvers])


def _name_functions(tables: Tables, program: StepProgram) -> None:
    """Give each function its name in C and its arguments."""
    sizes, n, nu = tables.sizes, program.lifting.n, program.model.nu
    inside = {"zeta": n, "y": sizes["NY"], "predicted": sizes["NY"], "memory": sizes["GATE"], "x": n, "u": nu, "v": nu}
    inside |= {"w": sizes["NW"] * sizes.get("SCHEDULED", 0), "s": sizes.get("NS", 0), "r": sizes.get("Q_LENGTH", 0)}
    functions: dict[str, CFunction] = {}
    for path, (graph, _, _) in tables.functions.items():
        name, result, arguments = ARGUMENTS[path]
        counts = {argument: inside[argument] for argument in arguments if inside[argument]}
        functions[name] = CFunction(graph, counts, result)
    tables.functions = functions


def _add_memory(sizes: dict[str, int], name: str, problems: list[tuple[int, int, int]]) -> None:
    """Set how many numbers and integers DAQP takes for the largest of some problems: variables, rows, soft ones."""
    reals, ints = [1], [1]
    for n, m, soft in problems:
        rank = n + soft + 1
        reals.append(6 * m + 2 * n + 5 * rank + rank * (rank + 1) // 2)
        ints.append(m + rank + 3)
    sizes |= {f"{name}_REALS": max(reals), f"{name}_INTS": max(ints)}


def _derive_condensed(tables: Tables, program: CondensedProgram, room: int) -> None:
    """Add what C takes from a plan by one matrix besides its fields: sums, shares and sizes."""
    sizes, arrays, planned = tables.sizes, tables.arrays, len(program.offset)
    targets, soft, by_row = program.targets, program.solver.soft, program.from_reference
    moves, m, bounds = len(program.deviation), len(program.qp.source), program.bounds
    if not np.array_equal(program.solver.H, np.eye(moves)):
        raise AssertionError("the Hessian of Riccati coordinates is the identity")
    sizes |= {
        "NT": len(program.M),
        "KNOWN": program.M.shape[1],
        "MOVES": moves,
        "PLANNED": planned,
        "CHECKED_COUNT": int(program.checked.sum()),
        "QP_M": m,
        "QP_M1": max(1, m),
        "QP_SOFT": int(soft.sum()),
        "STEEP": int(program.solver.metric is not None and program.levels is None),
    }
    _add_memory(sizes, "QP", [(moves, m, sizes["QP_SOFT"])])
    arrays["from_held"] = by_row.reshape(planned, -1, program.nr).sum(axis=1).T.ravel()
    if not program.aimed:
        arrays["from_target"] = np.zeros(0)
    if program.levels is None and not program.disturbance.shape[1] and by_row.size >= _LONG:
        sizes["FIRST_ALONE"] = 1
        arrays["shares"] = np.abs(by_row[:, program.nr :]).sum(axis=1)
        arrays["first_shares"] = by_row[: program.model.nu, program.nr :].ravel()
    if program.given is None:
        arrays["from_given"] = np.zeros(0)
    elif len(program.given) * planned <= max(room, program.from_given.size):
        sizes["GIVEN_TABLED"] = 1
        arrays["from_given"] = _tabulate(program)
    if bounds is not None:
        sizes["HELD_ONCE"] = int((bounds.count == 1).all() and (np.arange(len(bounds.first)) == bounds.first.T).all())
        arrays["targets_gain"] = np.abs(targets.rows @ targets.from_reference).sum(axis=1)
        arrays["targets_shift"] = targets.rows @ targets.offset
    if program.levels is not None:
        tables.notes.append(_LEVELS_NOTE)


def _tabulate(program: CondensedProgram) -> Float[np.ndarray, " entries"]:
    """Return, for each step at which the given input targets move on, their share of the plan and its offset."""
    assert program.given is not None, "there are some"
    ahead = np.arange(len(program.given))[:, None] + program.latency + np.arange(program.N + 1)
    rows = program.given[np.minimum(ahead, len(program.given) - 1)]
    return (program.offset + rows.reshape(len(rows), -1) @ program.from_given.T).ravel()


def _derive_staged(tables: Tables, p: StagedProgram) -> None:
    """Add what C takes from stages besides their fields: sizes of targets, and the rows that an active set gets."""
    N, nx, nu, nr = p.N, p.nx, p.model.nu, p.nr
    goal = nx + nr + nu * (p.weighs_changes and p.end != "given")
    head = nr + nx + nu + len(p.rest.low) + nu + nu * nx
    sides = len(p.sides.row)
    tables.sizes |= {
        "MOVES": N * nu,
        "KNOWN": nx + nu * p.with_rates + N * p.E.shape[1] + nx * isinstance(p.estimator, DisturbanceProgram),
        "TRACKED": len(p.Q),
        "LIMITED": len(p.box.low),
        "LIMITED1": max(1, len(p.box.low)),
        "BOX": len(p.rest.low) - nu,
        "SIDES": sides,
        "SOFT": p.sides.soft,
        "PAIRS": max(1, N * sides),
        "EASED": max(1, N * p.sides.soft),
        "HARD_OUTPUTS": len(list_hard_outputs(p.softness, nu * p.with_rates)),
        "PUSHES": N * nx if p.disturbed else 1,
        "GIVEN_MAP": int(isinstance(p.model, StepMap)),
        "STAGE_END": ("given", "tail", "stage").index(p.end),
        "GOAL": goal,
        "END": goal + nu * p.with_rates,
        "TARGETS": len(p.table),
        "TARGET": head + goal * (nr + nx + nu + 1) + 1,
        "MADE": N + 1 if p.holds else 1,
        "MADE_SIZE": head + 1,
        "RESTS": aim.RESTS,
        "REST_STEPS": aim.REST_STEPS,
        "MOST_TERMS": max(aim.ORDERS) + 1,
    }
    tables.arrays |= {"table": p.table.ravel(), "orders": np.array(aim.ORDERS, dtype=np.intc)}
    for name in {"rest_weight", "Q_root", "R_root", "tail_end"} & tables.arrays.keys():  # C has these row after row
        tables.arrays[name] = tables.arrays[name].reshape(tables.sizes[f"{name.upper()}_WIDTH"], -1).T.ravel()
    tables.notes += [_TABLE_NOTE, *([_SCHEDULE_NOTE] if p.scheduled else [])]
    low, high = (end[0] for end in p.stage_limits)
    limited = np.tile(np.isfinite(low) | np.isfinite(high), (N, 1))
    limited[~p.free, :nu] = False
    rows = np.flatnonzero(limited)
    soft = np.concatenate([np.zeros(nu, bool), np.isfinite(p.softness.linear)])[rows % limited.shape[1]]
    width = nu * int(p.free.sum())
    tables.sizes |= {"FINISH_ROWS": len(rows), "FINISH_WIDTH": width, "FINISH_SOFT": int(soft.sum())}
    _add_memory(tables.sizes, "FINISH", [(width, len(rows), int(soft.sum()))])
    tables.arrays |= {"finish_row": rows.astype(np.intc), "finish_sense": 8 * soft.astype(np.intc)}
    tables.arrays["finish_at"] = (np.cumsum(p.free) - p.free).astype(np.intc)
