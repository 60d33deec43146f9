"""From a `Program` to the numbers of its C code: sizes, arrays and functions by the names that they have in C."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from koopmpc import checks
from koopmpc.codegen import tolerances
from koopmpc.control.limits import Interval
from koopmpc.control.linear.condensed_program import BoundsProgram, CondensedProgram
from koopmpc.control.lqr import FeedbackProgram
from koopmpc.control.nonlinear import motion
from koopmpc.control.nonlinear.iteration import MOST
from koopmpc.control.nonlinear.staged_program import StagedProgram
from koopmpc.control.nonlinear.stagewise import list_hard_outputs
from koopmpc.control.program import LinearProgram, Published, StepProgram, no_export
from koopmpc.control.solvers.daqp import FEW, MOVED
from koopmpc.control.stepped.levels import FREE
from koopmpc.control.stepped.search import NODES
from koopmpc.control.stepped.sequences import LevelsProgram
from koopmpc.errors import DataError
from koopmpc.estimate.disturbance import EXACT, DisturbanceProgram
from koopmpc.estimate.gate import BEYOND, BRIDGED
from koopmpc.estimate.kalman import FilterProgram
from koopmpc.plants.graph import Graph
from koopmpc.plants.step_map import StepMap

CArrays = dict[str, np.ndarray]
Precision = Literal["double", "float"]

_ZERO_ROW = 1e-11  # DAQP leaves a row as it is if its squared length is below this

_LONG = 2**11  # numbers in the reference's share of a plan from which on a step first asks for its first input alone
_TABLE_NOTE = (
    "`koopmpc_table.h` holds the equilibria of the reference rows that `export` was given, and what the end of the "
    "horizon costs there. Any other row may come at run time: the step that meets it finds its equilibrium from that "
    "of the nearest row, by up to 40 times 20 Gauss-Newton steps, and keeps it. To bound the time of a step, pass all "
    "rows to `export`."
)


_OF_MODEL = ("map", "stage_map", "slopes", "local")  # the functions that w enters where it multiplies x or u

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


class CFunction(NamedTuple):
    """A function of C: ``void name(const real *argument, …, real *result)``."""

    graph: Graph
    arguments: Mapping[str, int]
    result: str


@dataclass
class Tables:
    """The numbers of a controller's C code: `sizes` are integers, `settings` those of the QP solver, the others arrays.

    `conditioning` is the change of the plan, as a share of an input's span, per relative rounding of the lifted state.
    `effort` says what is known of the iterations of a step.
    """

    program: StepProgram
    sizes: dict[str, int]
    functions: dict[str, CFunction]
    limits: CArrays = field(default_factory=dict)
    plan: CArrays = field(default_factory=dict)
    observer: CArrays = field(default_factory=dict)
    targets: CArrays = field(default_factory=dict)
    target_qps: list[tuple[int, int]] = field(default_factory=list)
    settings: dict[str, float] = field(default_factory=dict)
    reals: dict[str, float] = field(default_factory=dict)
    conditioning: float = 0.0
    notes: list[str] = field(default_factory=list)
    effort: str = ""

    def define(self, reals: Mapping[str, float]) -> None:
        """Add constants of the C code, each under a name that nothing else has: the later one would be used by both."""
        _refuse_twins(self.reals, reals)
        self.reals |= reals

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
    """Return the numbers of a Program's C code.

    `room` is how many numbers a table of what given input targets share in the plan may have; it may always have as
    many as the matrix that it replaces.

    Raises
    ------
    DataError
        A setting of the solver has no counterpart in C, or C code for this kind of Program is not known.
    """
    sizes = {
        "IS_LQR": 0,
        "IS_STAGED": 0,
        "BOUNDS": 0,
        "LEVELED": 0,
        "FIRST_ALONE": 0,
        "SCHEDULED": 0,
        "NU": program.model.nu,
        "NR": program.nr,
    }
    embedding = None if isinstance(program.model, StepMap) else program.model.embedding
    steps, inputs_too = (0, 0) if embedding is None else (embedding.steps, int(embedding.inputs))
    sizes |= {"DELAYS": steps, "DELAYED_INPUTS": inputs_too, "NZETA": program.lifting.n, "NZ": program.lifting.m}
    sizes["GIVEN"] = 0 if program.given is None else len(program.given)
    lift = CFunction(program.lifting, {"zeta": program.lifting.n}, "z")
    tables = Tables(program, sizes, {"koopmpc_lift": lift}, notes=list(program.notes))
    tables.limits = {"input_low": program.inputs.low, "input_high": program.inputs.high}
    tables.plan["given"] = np.zeros(0) if program.given is None else program.given
    _add_limits(tables, rate=program.rates)
    _add_settings(tables, single=single)
    tables.conditioning = _amplify(program)
    match program:
        case FeedbackProgram():
            _add_feedback(tables, program, single=single)
        case CondensedProgram():
            _add_condensed(tables, program, single=single, room=room)
        case StagedProgram():
            _add_staged(tables, program, single=single)
        case _:
            raise DataError(
                f"there is no C code for {checks.article(program)}; make a FeedbackProgram or a CondensedProgram"
            )
    _refuse_twins(tables.sizes, tables.reals)
    return tables


def _refuse_twins(one: Mapping[str, float], other: Mapping[str, float]) -> None:
    twice = sorted(one.keys() & other.keys())
    if twice:
        raise ValueError(f"the C code has two constants of the name {twice[0]}; give one of them another name")


def stack(matrix: np.ndarray) -> np.ndarray:
    """Return a matrix as one column after the other."""
    return np.ascontiguousarray(np.asarray(matrix).T).ravel()


def _add_limits(tables: Tables, **limits: Interval | None) -> None:
    """Write both ends of further limits of the inputs, zeros where there is none."""
    none = np.zeros(tables.sizes["NU"])
    for name, limit in limits.items():
        low, high = (none, none) if limit is None else limit
        tables.limits |= {f"{name}_low": low, f"{name}_high": high}
        if name.endswith("rate"):
            tables.sizes[f"{name.upper()}D"] = int(limit is not None)


def _amplify(program: StepProgram) -> float:
    """Return Σ |gain| size over an input's span, for the most sensitive input of the plan; `size` is that of z."""
    span = program.inputs.high - program.inputs.low
    reach = np.abs(program.gain) @ program.sizes
    known = np.where(np.isfinite(span) & (span > 0), span, reach[: len(span)] + 1e-300)
    return float((reach / np.tile(known, len(reach) // len(known))).max())


def _add_settings(tables: Tables, *, single: bool) -> None:
    """Write DAQP's settings and the tolerances beside them."""
    known = tables.program.settings
    if known["time_limit"] > 0:
        raise DataError(
            'a time_limit cannot be exported, C has no clock; bound the iterations: settings={"iter_limit": 100}'
        )
    settings = {name: float(value) for name, value in known.items() if name in tolerances.SETTINGS}
    if single:
        settings |= {name: max(settings[name], least) for name, least in tolerances.SINGLE.items()}
    tables.settings = settings
    tables.define({"PRIMAL_TOL": settings["primal_tol"], "ZERO_TOL": settings["zero_tol"]})
    tables.define({name: values[single] for name, values in tolerances.OF_ALL.items()})


def _add_gate(tables: Tables, gate: Graph | None, ny: int, *, single: bool) -> None:
    """Write which readings are refused; what counts as rounding depends on the precision."""
    tables.sizes["GATE"] = 0 if gate is None else gate.m - 2
    tables.sizes["BRIDGED"] = BRIDGED
    if gate is not None:
        tables.define({"AGREES": BEYOND})
        rounding = tolerances.OF_ALL["AT_REST"]
        gate = replace(gate, constants=np.where(gate.constants == rounding[0], rounding[single], gate.constants))
        arguments = {"y": ny, "predicted": ny, "memory": gate.m - 2}
        tables.functions["koopmpc_gate"] = CFunction(gate, arguments, "result")


def _add_estimator(tables: Tables, program: CondensedProgram | StagedProgram, *, single: bool) -> None:
    """Write how z and d follow from y, and the linear model where it is advanced."""
    plan, sizes, estimator = tables.observer, tables.sizes, program.estimator
    sizes["ESTIMATOR"] = 0
    if isinstance(estimator, FilterProgram):
        F, M, P = estimator.F, estimator.M, estimator.P
        S = M @ P @ M.T + estimator.R
        unit = np.sqrt(S.diagonal())
        sizes |= {
            "ESTIMATOR": 2,
            "NY": len(M),
            "NS": len(F),
            "DELAY_Y": estimator.delay,
            "PATIENCE": estimator.patience,
            "KEPT": len(estimator.kept),
            "HELD": estimator.held,
            "RESTS": int(estimator.rests),
            "SHOWS": int(estimator.shows),
        }
        plan |= {
            "filter_F": stack(F),
            "filter_G": stack(estimator.G),
            "filter_f": estimator.f,
            "filter_M": M,
            "filter_h": estimator.h,
            "filter_S": S / np.outer(unit, unit),
            "filter_PM": stack(P @ M.T / unit),
            "filter_unit": unit,
            "filter_z": stack(estimator.to_z),
            "filter_one": estimator.one,
            "filter_d": stack(estimator.to_d),
            "kept": np.asarray(estimator.kept, dtype=np.intc),
        }
    elif isinstance(estimator, DisturbanceProgram):
        sizes["ESTIMATOR"] = 1
        tables.define({"GAIN": estimator.gain, "STEADY": estimator.reach, "EXACT": EXACT})
    _add_gate(tables, estimator.gate, sizes["NY"], single=single)
    if isinstance(program, StagedProgram):
        plan |= {"C": stack(np.eye(program.ny, program.nx)), "E": stack(program.E)}
    elif sizes["ESTIMATOR"] == 1 or program.latency or estimator.gate is not None:
        model = program.model
        plan |= {
            "C": stack(model.C),
            "A": stack(model.A),
            "B": stack(model.B),
            "E": stack(model.E),
        }


def _add_linear(tables: Tables, program: LinearProgram, *, single: bool) -> None:
    """Write the sizes of a linear model, its targets, and the two QPs that move one inside its limits.

    Without equilibria C has one coordinate, which is not used.
    """
    model, targets = program.model, program.targets
    na, nl = targets.Z.shape[1], len(targets.rows)
    tables.sizes |= {"NX": model.nx, "NY": model.nx, "LEARNED": model.nz, "NW": model.nw, "NW1": max(1, model.nw)}
    tables.sizes |= {"NA": max(1, na), "NL": max(1, nl)}

    def pad(rows: np.ndarray) -> np.ndarray:
        return rows if na else np.zeros((1, *rows.shape[1:]))

    def wide(matrix: np.ndarray) -> np.ndarray:
        return matrix if na else np.zeros((len(matrix), 1))

    tables.targets = {
        "target_offset": pad(targets.offset),
        "target_reference": stack(pad(targets.from_reference)),
        "target_disturbance": stack(pad(targets.from_disturbance)),
        "target_rows": stack(wide(targets.rows)),
        "target_rows_disturbance": stack(targets.rows_disturbance),
        "target_low": targets.low,
        "target_high": targets.high,
        "target_size": targets.size,
    }
    for which, count in enumerate((nl, targets.hard)):
        M, unit, rinv = np.zeros((count, 1)), np.ones(count), np.eye(1)
        if na:
            solver = program.target_solvers[which]
            least = np.diag(solver.columns**2 * float((solver.H.diagonal() / solver.columns**2).sum()))
            H = solver.H + single * tolerances.FLAT * least  # what moves no tracked output has next to no weight
            rinv = np.linalg.inv(np.linalg.cholesky(H).T)
            M, unit = solver.M @ rinv, solver.rows
            rinv = solver.columns[:, None] * rinv
        M, scaling = _normalise(M)
        arrays = {
            "M": M,
            "scaling": scaling,
            "rinv": rinv[np.triu_indices(len(rinv))],
            "sense": np.zeros(count, dtype=np.intc),
            "unit": unit,
        }
        tables.targets |= {f"target_{name}_{which}": values for name, values in arrays.items()}
        tables.target_qps.append((max(1, na), count))


def _normalise(rows: Float[np.ndarray, "m n"]) -> tuple[Float[np.ndarray, "m n"], Float[np.ndarray, " m"]]:
    """Return rows of length 1, and by what they were multiplied, as DAQP does it."""
    squares = (rows**2).sum(axis=1)
    scaling = np.where(squares < _ZERO_ROW, 1.0, 1 / np.sqrt(np.where(squares > 0, squares, 1.0)))
    return rows * scaling[:, None], scaling


def _memory_shares(n: int, m: int, soft: int) -> tuple[int, int]:
    """Return how many numbers and integers a problem of n variables and m rows, some of them soft, takes."""
    rank = n + soft + 1
    return 6 * m + 2 * n + 5 * rank + rank * (rank + 1) // 2, m + rank + 3


def _add_memory(tables: Tables, n: int, m: int, soft: int) -> None:
    """Set the sizes of the solver's memory: that of the plan's problem, and that of the targets'."""
    reals, ints = zip(*(_memory_shares(n, m, 0) for n, m in tables.target_qps), strict=True)
    sizes = _memory_shares(n, m, soft)
    tables.sizes |= {
        "QP_M": m,
        "QP_M1": max(1, m),
        "QP_SOFT": soft,
        "QP_REALS": sizes[0],
        "QP_INTS": sizes[1],
        "TARGET_REALS": max(reals),
        "TARGET_INTS": max(ints),
    }


def _add_feedback(tables: Tables, program: FeedbackProgram, *, single: bool) -> None:
    """Write a feedback law."""
    _add_linear(tables, program, single=single)
    model, targets = program.model, program.targets
    tables.sizes |= {"IS_LQR": 1, "HORIZON": 0, "LATENCY": 0, "N": 1, "WITH_RATES": int(program.K_rate.size > 0)}
    tables.plan |= {
        "E": stack(model.E),
        "gain": stack(-program.K),
        "gain_rate": stack(-program.K_rate),
        "feedforward": stack(program.feedforward),
        "target_input": targets.u0,
        "target_span": stack(targets.W if targets.Z.shape[1] else np.zeros((model.nu, 1))),
        "target_push": stack(targets.u_disturbance),
    }
    _add_gate(tables, program.gate, model.nx, single=single)
    if program.gate is not None:
        tables.plan |= {"A": stack(model.A), "B": stack(model.B), "C": stack(model.C)}
    _add_memory(tables, 1, 0, 0)


def _add_condensed(tables: Tables, program: CondensedProgram, *, single: bool, room: int) -> None:
    """Write a plan by one matrix, and its condensed QP."""
    _add_linear(tables, program, single=single)
    model, qp, solver, targets = program.model, program.qp, program.solver, program.targets
    moves, m = program.deviation.shape[0], len(qp.source)
    checked, constant = int(program.checked.sum()), model.lifting.constant_index
    soft, any_soft = solver.soft, bool(solver.soft.any())
    if not np.array_equal(solver.H, np.eye(moves)):
        raise AssertionError("the Hessian of Riccati coordinates is the identity")
    tables.sizes |= {
        "N": program.N,
        "LATENCY": program.latency,
        "HORIZON": program.N + program.latency,
        "WITH_RATES": int(program.with_rates),
        "KNOWN": program.M.shape[1],
        "NT": len(program.M),
        "MOVES": moves,
        "PLANNED": len(program.offset),
        "AIMED": int(program.aimed),
        "CHECKED": checked,
        "CHECKED_LIMITS": int(program.disturbance.shape[1] > 0),
        "CONSTANT": -1 if constant is None else constant,
        "NS": model.nz,
        "QP_MIXED": int(any_soft and not soft.all()),
        "STEEP": int(solver.metric is not None and program.levels is None),
        "FEW": FEW,
        "MOVED": MOVED,
        "COLD_START": int(solver.settings["cold_start"]),
    }
    if program.levels is None and not program.disturbance.shape[1] and program.from_reference.size >= _LONG:
        tables.sizes["FIRST_ALONE"] = 1
        tables.plan["shares"] = np.abs(program.from_reference[:, program.nr :]).sum(axis=1)
        tables.plan["first_shares"] = program.from_reference[: program.model.nu, program.nr :]
    given, tabled = np.zeros(0) if program.given is None else stack(program.from_given), False
    if program.given is not None:
        tabled = len(program.given) * len(program.offset) <= max(room, given.size)
        given = _tabulate(program) if tabled else given
    tables.sizes["GIVEN_TABLED"] = int(tabled)
    tables.define({"UNPUSHED": program.unpushed})
    _add_limits(tables, hard_rate=program.hard_rates)
    tables.limits["move_of"] = np.asarray(program.move_of, dtype=np.intc)
    M, scaling = _normalise(solver.M)
    rate_input = np.full(m, -1, dtype=np.intc)
    rate_input[qp.rate_rows] = qp.rate_inputs
    tables.plan |= {
        "map": stack(program.M),
        "low": program.low,
        "high": program.high,
        "offset": program.offset,
        "from_reference": stack(program.from_reference),
        "from_held": stack(program.from_reference.reshape(len(program.offset), -1, program.nr).sum(axis=1)),
        "from_target": stack(program.from_target) if program.aimed else np.zeros(0),
        "from_given": given,
        "checked": targets.rows[program.checked] if checked else np.zeros(0),
        "disturbance": stack(program.disturbance) if checked else np.zeros(0),
        "M": M,
        "scaling": scaling,
        "unit": solver.rows,
        "sense": 8 * soft.astype(np.intc),
        "linear": np.where(soft, solver.linear, 0.0),
        "rho": np.where(soft, 1 / solver.curvature, 0.0),
        "source": np.asarray(qp.source, dtype=np.intc),
        "scale": qp.scale,
        "qp_low": np.maximum(qp.low, -1e30),
        "qp_high": np.minimum(qp.high, 1e30),
        "allowance": qp.softness.allowance,
        "rate_input": rate_input,
        "shift": np.asarray(qp.shift_dual, dtype=np.intc),
        "deviation": stack(program.deviation),
    }
    if program.bounds is not None:
        _add_bounds(tables, program.bounds, rated=program.rates is not None)
        tables.targets["target_gain"] = np.abs(targets.rows @ targets.from_reference).sum(axis=1)
        tables.targets["target_shift"] = targets.rows @ targets.offset
    if program.levels is not None:
        _add_levels(tables, program.levels, single=single)
    elif solver.metric is not None:
        values, V = np.linalg.eigh(solver.metric)
        tables.plan |= {"lambda": np.maximum(values, 0.0), "V": V, "MV": solver.M @ V}
    _add_estimator(tables, program, single=single)
    _add_memory(tables, moves, m, int(soft.sum()))


def _tabulate(program: CondensedProgram) -> Float[np.ndarray, " entries"]:
    """Return, for each step at which the given input targets move on, their share of the plan and its offset."""
    assert program.given is not None, "there are some"
    ahead = np.arange(len(program.given))[:, None] + program.latency + np.arange(program.N + 1)
    rows = program.given[np.minimum(ahead, len(program.given) - 1)]
    return (program.offset + rows.reshape(len(rows), -1) @ program.from_given.T).ravel()


def _add_levels(tables: Tables, program: LevelsProgram, *, single: bool) -> None:
    """Write the levels of the inputs, and the search for the best sequence of them."""
    levels, soft = program.levels, np.isfinite(program.linear)
    tables.sizes |= {
        "LEVELED": 1,
        "FREE_MOVES": len(program.free),
        "SEARCH_ROWS": len(program.rows),
        "NODES": NODES,
        "FREE": FREE,
    }
    tables.define({name: values[single] for name, values in tolerances.OF_LEVELS.items()})
    whole = {
        "level_count": levels.count,
        "dwell": levels.dwell,
        "block": program.blocks,
        "free_move": program.free,
        "free_steps": program.steps,
        "group": program.group,
        "row_start": program.first,
        "search_row": program.rows,
        "row_soft": soft,
    }
    tables.plan |= {name: values.astype(np.intc).ravel() for name, values in whole.items()}
    tables.plan |= {
        "level_first": levels.first,
        "level_spacing": levels.spacing,
        "move_of_s": program.L,
        "row_of": program.T,
        "row_linear": np.where(soft, program.linear, 0.0),
        "row_quadratic": program.quadratic,
    }
    tables.notes.append(_LEVELS_NOTE)


def _add_bounds(tables: Tables, bounds: BoundsProgram, *, rated: bool) -> None:
    """Write how rows of limits become those of the plan."""
    once = (bounds.count == 1).all() and (np.arange(len(bounds.first)) == bounds.first.T).all()
    tables.sizes |= {"BOUNDS": 1, "OUTPUTS": bounds.margin.shape[1], "CHANGES": int(rated), "HELD_ONCE": int(once)}
    whole = {
        "hold_first": bounds.first,
        "hold_count": bounds.count,
        "move_start": bounds.start,
        "held": bounds.held,
        "tied": bounds.tied,
        "checked_limit": bounds.checked,
        "hard": bounds.hard,
    }
    tables.plan |= {name: values.astype(np.intc).ravel() for name, values in whole.items()}
    tables.plan |= {"inwards": bounds.margin.ravel(), "rate_allowance": bounds.allowance}
    tables.targets["target_values"] = bounds.values
    tables.notes.append(_BOUNDS_NOTE)


def _add_staged(tables: Tables, program: StagedProgram, *, single: bool) -> None:
    """Write stages, their functions, weights and limits, and the targets of the reference rows."""
    p, side, softness = program, program.sides, program.softness
    N, nx, nu, nr, ng = p.N, p.nx, p.model.nu, p.nr, len(p.box.low)
    goal = nx + nr + nu * (p.weighs_changes and p.end != "given")
    box = len(p.rest.low) - nu
    target = nr + nx + nu + (nu + box) + nu + nu * nx
    tables.sizes |= {
        "IS_STAGED": 1,
        "SCHEDULED": int(p.scheduled),
        "NX": p.ny,
        "NY": p.ny,
        "NS": nx,
        "LEARNED": p.ny,
        "CONSTANT": -1,
        "NW": p.E.shape[1],
        "NW1": max(1, p.E.shape[1]),
        "N": N,
        "LATENCY": p.latency,
        "HORIZON": N + p.latency,
        "MOVES": N * nu,
        "WITH_RATES": int(p.with_rates),
        "KNOWN": nx + nu * p.with_rates + N * p.E.shape[1] + nx * isinstance(p.estimator, DisturbanceProgram),
        "POINT": p.ns,
        "TRACKED": len(p.Q),
        "LIMITED": ng,
        "LIMITED1": max(1, ng),
        "BOX": box,
        "SIDES": len(side.row),
        "SOFT": side.soft,
        "PAIRS": max(1, N * len(side.row)),
        "EASED": max(1, N * side.soft),
        "SOFT_RATES": len(p.soft_rates),
        "INTERIOR": MOST,
        "DISTURBED": int(p.disturbed),
        "PUSHES": N * nx if p.disturbed else 1,
        "GIVEN_MAP": int(isinstance(p.model, StepMap)),
        "AFFINE": int(p.affine),
        "ITERATIONS": p.iterations,
        "HOLDS": int(p.holds),
        "GIVEN_END": int(p.end == "given"),
        "STAGE_END": {"given": 0, "tail": 1, "stage": 2}[p.end],
        "GOAL": goal,
        "END": goal + nu * p.with_rates,
        "TARGETS": len(p.table),
        "TARGET": target + goal * (nr + nx + nu + 1) + 1,
        "MADE": N + 1 if p.holds else 1,
        "MADE_SIZE": target + 1,
        "TAIL": p.tail.steps,
        "BEYOND": p.beyond,
        "RESTS": motion.RESTS,
        "MOST_TERMS": max(motion.ORDERS) + 1,
    }
    arguments = {
        "map": {"x": nx, "u": nu},
        "stage_map": {"s": p.ns, "v": nu},
        "slopes": {"s": p.ns, "v": nu},
        "tracked": {"s": p.ns},
        "limited": {"s": p.ns},
        "stage": {"s": p.ns, "r": len(p.Q)},
        "local": {"x": nx, "u": nu},
    }
    for name, graph in p.functions.items():
        result = "next" if name.endswith("map") else "out"
        measured = {"w": p.E.shape[1]} if p.scheduled and name in _OF_MODEL else {}
        tables.functions[f"koopmpc_{name}"] = CFunction(graph, arguments[name] | measured, result)
    _add_limits(tables, hard_rate=p.hard_rates, change=p.v_limits)
    tables.limits["move_of"] = np.arange(N, dtype=np.intc)
    same = all((end == end[0]).all() for end in p.stage_limits)
    low, high = (end[:1] if same else end for end in p.stage_limits)  # the last row is that of all stages after it
    tables.sizes["BOX_ROWS"] = len(low)
    soft = np.isfinite(softness.linear)
    hard = list_hard_outputs(softness, nu * p.with_rates)
    tables.sizes["HARD_OUTPUTS"] = len(hard)
    tables.plan |= {
        "hard_output": hard.astype(np.intc),
        "hard_allowance": softness.allowance[hard],
        "Q": p.Q,
        "R": p.R,
        "R_held": p.R_held,
        "Q_root": p.Q_root,
        "R_root": p.R_root,
        "free": p.free.astype(np.intc),
        "held_from": p.held_from.astype(np.intc),
        "soft_rates": p.soft_rates.astype(np.intc),
        "low": low,
        "high": high,
        "side_row": side.row.astype(np.intc),
        "side_scale": side.sign / side.span,
        "side_span": side.span,
        "soft_linear": side.linear,
        "soft_quadratic": side.quadratic,
        "allowance": softness.allowance[side.row[len(side.row) - side.soft :] - nu],
        "cost_linear": np.where(soft, softness.linear, 0.0),
        "cost_quadratic": np.where(soft, softness.quadratic, 0.0),
        "sizes": p.stage_sizes,
        "input_sizes": p.input_sizes,
        "orders": np.array(motion.ORDERS, dtype=np.intc),
    }
    tables.plan |= {
        "rest_weight": p.rest.weight,
        "rest_size": p.rest.size,
        "rest_limit": p.rest.limit_size,
        "rest_low": p.rest.low,
        "rest_high": p.rest.high,
        "tail_rows": p.tail.row_size,
        "tail_Q": p.tail.Q,
        "tail_R": p.tail.R,
        "tail_D": p.tail.R_delta,
        "tail_end": p.tail.end,
    }
    if p.bounds is not None:
        bounds = p.bounds
        tables.sizes |= {"BOUNDS": 1, "OUTPUTS": bounds.margin.shape[1], "CHANGES": 0}
        tables.plan |= {"inwards": bounds.margin, "far_inputs": bounds.far_inputs, "far_outputs": bounds.far_outputs}
        tables.notes.append(_BOUNDS_NOTE)
    tables.define({"TAIL_SCALE": p.tail.scale})
    tables.define({name: values[single] for name, values in tolerances.OF_STAGES.items()})
    _add_finish(tables, p, low, high)
    _add_estimator(tables, p, single=single)
    tables.targets = {"table": p.table}
    tables.notes += [_TABLE_NOTE, *([_SCHEDULE_NOTE] if p.scheduled else [])]


def _add_finish(
    tables: Tables, program: StagedProgram, low: Float[np.ndarray, "b nq"], high: Float[np.ndarray, "b nq"]
) -> None:
    """Write which rows DAQP gets where interior points end early, their prices, and the sizes of its memory."""
    free, nu, none = program.free, program.model.nu, np.zeros(program.model.nu)
    linear = np.concatenate([np.full(nu, np.inf), 0.5 * program.softness.linear])  # half of the prices, as of the cost
    quadratic = np.concatenate([none, 0.5 * program.softness.quadratic])
    kept = np.tile((np.isfinite(low) | np.isfinite(high))[:1], (program.N, 1))
    kept[~free, :nu] = False
    place, soft = np.flatnonzero(kept), np.isfinite(linear)
    sense = 8 * soft[place % kept.shape[1]]
    n = nu * int(free.sum())
    reals, ints = _memory_shares(n, len(place), int((sense > 0).sum()))
    tables.sizes |= {
        "FINISH_ROWS": len(place),
        "FINISH_WIDTH": n,
        "FINISH_SOFT": int((sense > 0).sum()),
        "FINISH_REALS": reals,
        "FINISH_INTS": ints,
    }
    tables.plan |= {
        "finish_row": place.astype(np.intc),
        "finish_at": (np.cumsum(free) - free).astype(np.intc),
        "finish_sense": sense.astype(np.intc),
        "finish_linear": np.where(soft, linear, 0.0),
        "finish_quadratic": quadratic,
    }
