"""From a `Program` to the tables of its C code: one loop over its fields, and a form for each type.

A field `a` of the Program is ``koopmpc_a`` in C, the field `b` of its field `a` is ``koopmpc_a_b``.

| type | in C |
|---|---|
| int, bool, float | a macro, ``KOOPMPC_A`` |
| array of numbers | an array; a matrix stands column after column |
| array of integers, of booleans | an array of int; a matrix stands row after row |
| any array | ``KOOPMPC_A_LENGTH`` and ``KOOPMPC_A_WIDTH``, the sizes of its axes |
| Graph | a function; its arguments are in `ARGUMENTS` |
| dataclass, NamedTuple, mapping, tuple | these forms for each entry; `convert` comes first |
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

from koopmpc.codegen import tolerances
from koopmpc.control.nonlinear.staged_program import StagedProgram
from koopmpc.control.nonlinear.stagewise import Sides
from koopmpc.control.program import LinearProgram, StepProgram
from koopmpc.control.solvers.scaled_qp import DAQPSetup
from koopmpc.control.step.feedback import FeedbackProgram
from koopmpc.estimate.filter import FilterProgram
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor
from koopmpc.plants.graph import Graph
from koopmpc.plants.step_map import StepMap

Precision = Literal["double", "float"]

_ZERO_ROW = 1e-11  # DAQP leaves a row as it is if its squared length is below this


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
def _(program: LinearProgram, single: bool) -> Mapping[str, Any]:
    """Leave out what Python's step alone needs, and add what is computed."""
    fields = convert.dispatch(object)(program, single)
    kept = {name: value for name, value in fields.items() if name not in program.IN_PYTHON}
    return kept | {name: getattr(program, name) for name in program.COMPUTED}


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
    return {**convert.dispatch(object)(sides, single), "scale": sides.sign / sides.span}


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
