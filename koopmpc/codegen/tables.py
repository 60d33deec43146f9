"""From a `Program` to the tables of its C code: one loop over its fields, and a form for each type.

A field `a` of the Program is ``koopmpc_a`` in C, the field `b` of its field `a` is ``koopmpc_a_b``:

| type | in C |
|---|---|
| int, bool, float | a macro, ``KOOPMPC_A`` |
| array of numbers | an array; a matrix stands column after column |
| array of integers, of booleans | an array of int, row after row |
| any array | ``KOOPMPC_A_LENGTH`` and ``KOOPMPC_A_WIDTH``, the sizes of its axes |
| Graph | a function, with the arguments in `ARGUMENTS` |
| dataclass, NamedTuple, mapping, tuple | the same of each entry, after `convert` |
| what is not None | ``KOOPMPC_A`` is at least 1 |

What no C file of the controller names is left out; a macro that C names and a Program lacks is 0.
"""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import singledispatch
from numbers import Integral
from typing import Any, Literal, NamedTuple, cast

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.codegen import tolerances
from koopmpc.control.linear.condensed_program import BoundsProgram, CondensedProgram
from koopmpc.control.lqr import FeedbackProgram
from koopmpc.control.nonlinear import motion
from koopmpc.control.nonlinear.iteration import MOST
from koopmpc.control.nonlinear.staged_program import StagedProgram
from koopmpc.control.nonlinear.stagewise import Sides, list_hard_outputs
from koopmpc.control.program import Published, StepProgram, no_export
from koopmpc.control.solvers.daqp import FEW, MOVED, DAQPSetup
from koopmpc.control.stepped.levels import FREE
from koopmpc.control.stepped.search import NODES
from koopmpc.errors import DataError
from koopmpc.estimate.disturbance import EXACT, DisturbanceProgram
from koopmpc.estimate.gate import BEYOND, BRIDGED
from koopmpc.estimate.kalman import FilterProgram
from koopmpc.estimate.observer import EstimatorProgram
from koopmpc.plants.graph import Graph
from koopmpc.plants.step_map import StepMap
from koopmpc.predict.predictors import BilinearPredictor, LinearPredictor

Precision = Literal["double", "float"]

_ZERO_ROW = 1e-11  # DAQP leaves a row as it is if its squared length is below this

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


class CFunction(NamedTuple):
    """A function of C: ``void name(const real *argument, …, real *result)``."""

    graph: Graph
    arguments: Mapping[str, int]
    result: str


@dataclass
class Tables:
    """What the C code of a controller is made of.

    Attributes
    ----------
    program
        The data of a step.
    sizes, reals
        Macros: integers, and numbers.
    arrays, functions
        The arrays and the functions of C, by their names there without the prefix.
    settings
        Those of the QP solver.
    conditioning
        The change of the plan, as a share of an input's span, per relative rounding of the lifted state.
    notes, effort
        Sentences for the README; what is known of the iterations of a step.
    """

    program: StepProgram
    sizes: dict[str, int] = field(default_factory=dict)
    reals: dict[str, float] = field(default_factory=dict)
    arrays: dict[str, np.ndarray] = field(default_factory=dict)
    functions: dict[str, CFunction] = field(default_factory=dict)
    settings: dict[str, float] = field(default_factory=dict)
    conditioning: float = 0.0
    notes: list[str] = field(default_factory=list)
    effort: str = ""

    @property
    def is_lqr(self) -> bool:
        """Whether it is a feedback law."""
        return isinstance(self.program, FeedbackProgram)

    @property
    def is_staged(self) -> bool:
        """Whether its plan is iterated on a nonlinear model, stage by stage."""
        return isinstance(self.program, StagedProgram)


def read_program(controller: object, reference: Any = None) -> StepProgram:
    """Return the Program of a controller.

    Raises
    ------
    DataError
        No C code can be generated; the message is the Program's `obstacle`.
    """
    if not isinstance(controller, Published):
        raise no_export(controller)
    program = controller.program(reference)
    if not isinstance(program, StepProgram):
        raise DataError(program.obstacle)
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
    derive = {FeedbackProgram: None, CondensedProgram: _derive_condensed, StagedProgram: _derive_staged}
    if type(program) not in derive:
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


def write_fields(tables: Tables, path: str, value: Any, *, single: bool) -> None:
    """Write a value under the name that its path through the Program gives it."""
    if value is None or isinstance(value, str):
        return
    name = path.upper()
    if isinstance(value, Integral | np.bool_):
        tables.sizes[name] = int(cast("int", value))
    elif isinstance(value, float):
        tables.reals[name] = value
    elif isinstance(value, np.ndarray):
        array = cast("np.ndarray", value)
        tables.arrays[path] = array.astype(np.intc).ravel() if array.dtype.kind in "biu" else array.T.ravel()
        tables.sizes |= {name: 1, f"{name}_LENGTH": len(array), f"{name}_WIDTH": array.shape[-1]}
    elif isinstance(value, Graph):
        tables.sizes[name] = value.m
        tables.functions[path] = CFunction(_round_gate(value) if single else value, {}, "")
    else:
        tables.sizes[name] = 1
        for key, entry in convert(value, single).items():
            write_fields(tables, f"{path}_{key}" if path else key, entry, single=single)


@singledispatch
def convert(value: object, single: bool) -> Mapping[str, Any]:
    """Return the entries of a value by their names; single precision may need other ones."""
    del single
    if isinstance(value, Mapping):
        return cast("Mapping[str, Any]", value)
    if dataclasses.is_dataclass(value):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if not f.name.startswith("_")}
    entries = cast("tuple[Any, ...]", value)
    return dict(zip(getattr(value, "_fields", map(str, range(len(entries)))), entries, strict=True))


@convert.register
def _(model: LinearPredictor, single: bool) -> Mapping[str, Any]:
    del single
    return {"A": model.A, "B": model.B, "C": model.C, "E": model.E}


@convert.register(StepMap)
@convert.register(BilinearPredictor)
def _(model: Any, single: bool) -> Mapping[str, Any]:
    del model, single
    return {}  # its map is a function of the Program


@convert.register
def _(estimator: FilterProgram, single: bool) -> Mapping[str, Any]:
    """Add S = M P Mᵀ + R in units of its diagonal, and P Mᵀ by these units."""
    S = estimator.M @ estimator.P @ estimator.M.T + estimator.R
    unit = np.sqrt(S.diagonal())
    more = {"S": S / np.outer(unit, unit), "PM": estimator.P @ estimator.M.T / unit, "unit": unit}
    return {**convert.dispatch(object)(estimator, single), **more}


@convert.register
def _(sides: Sides, single: bool) -> Mapping[str, Any]:
    del single
    return {**sides._asdict(), "scale": sides.sign / sides.span}


@convert.register
def _(setup: DAQPSetup, single: bool) -> Mapping[str, Any]:
    """Return the QP as DAQP's least-distance problem: least ½|v|² with rows of length 1, one after the other."""
    soft, H, M, rinv = setup.soft, setup.H, setup.M, np.zeros(0)
    if not (np.array_equal(H, np.eye(len(H))) and (setup.columns == 1).all()):
        least = np.diag(setup.columns**2 * float((H.diagonal() / setup.columns**2).sum()))
        rinv = np.linalg.inv(np.linalg.cholesky(H + single * tolerances.FLAT * least).T)
        M, rinv = M @ rinv, (setup.columns[:, None] * rinv)[np.triu_indices(len(rinv))]
    squares = (M**2).sum(axis=1)
    scaling = np.where(squares < _ZERO_ROW, 1.0, 1 / np.sqrt(np.where(squares > 0, squares, 1.0)))
    arrays: dict[str, Any] = {
        "variables": len(H),
        "count": len(M),
        "M": (M * scaling[:, None]).ravel(),
        "scaling": scaling,
        "rinv": rinv,
        "rows": setup.rows,
        "sense": 8 * soft.astype(np.intc),
        "linear": np.where(soft, setup.linear, 0.0),
        "rho": np.where(soft, 1 / setup.curvature, 0.0),
    }
    if setup.metric is not None:
        values, V = np.linalg.eigh(setup.metric)
        arrays |= {"lambda": np.maximum(values, 0.0), "V": V.ravel(), "MV": (setup.M @ V).ravel()}
    return arrays


def _round_gate(gate: Graph) -> Graph:
    """Return a gate for which differences are rounding that single precision rounds away."""
    fine, coarse = tolerances.IN_C["AT_REST"]
    return replace(gate, constants=np.where(gate.constants == fine, coarse, gate.constants))


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
    inside = {"zeta": program.lifting.n, "y": sizes["NY"], "predicted": sizes["NY"], "memory": sizes["GATE"]}
    inside |= {"x": program.lifting.n, "u": model.nu, "v": model.nu, "w": nw * sizes.get("SCHEDULED", 0)}
    inside |= {"s": sizes.get("NS", 0), "r": sizes.get("Q_LENGTH", 0)}
    functions: dict[str, CFunction] = {}
    for path, (graph, _, _) in tables.functions.items():
        name, result, arguments = ARGUMENTS[path]
        counts = {argument: inside[argument] for argument in arguments if inside[argument]}
        functions[name] = CFunction(graph, counts, result)
    tables.functions = functions
    _add_memory(
        sizes, "TARGET", [(sizes[f"{name}_VARIABLES"], sizes[f"{name}_COUNT"], 0) for name in _target_solvers(sizes)]
    )


def _target_solvers(sizes: Mapping[str, int]) -> list[str]:
    return [name for name in ("TARGET_SOLVERS_0", "TARGET_SOLVERS_1") if name in sizes]


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
        "QP_MIXED": int(soft.any() and not soft.all()),
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
        "RESTS": motion.RESTS,
        "MOST_TERMS": max(motion.ORDERS) + 1,
    }
    tables.arrays |= {"table": p.table.ravel(), "orders": np.array(motion.ORDERS, dtype=np.intc)}
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
