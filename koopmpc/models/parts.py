"""What predictors are made of: checks of their fields, the re-lifted map, and systems of scipy.signal and control."""

from collections.abc import Mapping, Sequence
from typing import Any, TypedDict

import casadi as ca
import numpy as np
from jaxtyping import Complex, Float
from numpy.typing import ArrayLike

from koopmpc.base import checks
from koopmpc.base.errors import DataError, ShapeError
from koopmpc.base.interrupts import raise_swallowed
from koopmpc.base.values import freeze
from koopmpc.data.delay import Delay
from koopmpc.lifting.base import Lifting, bind_lifting
from koopmpc.models.base import FitReport, Predictor
from koopmpc.plants.step_map import StepMap

_MATRICES = ("A", "B", "C", "D")


class _Fields(TypedDict, total=False):
    """Further fields of a predictor, which most models leave out.

    Attributes
    ----------
    embedding
        Makes the point ζ of x and its past.
    scale
        (nz, nz) upper triangular factor of the lifted data's covariance.
    E, disturbances
        (nz, nw) effects of measured disturbances w, and their names.
    """

    embedding: Delay | None
    scale: ArrayLike | None
    E: ArrayLike | None
    disturbances: Sequence[str] | None


class BilinearFields(_Fields, total=False):
    """Those of bilinear predictors too: S, (nw, nz, nz), and M, (nw, nz, nu), how w changes A and B."""

    S: ArrayLike | None
    M: ArrayLike | None


class LinearFields(_Fields, total=False):
    """Those of linear predictors too."""

    exact_modes: Complex[np.ndarray, "nl nz"] | None


def refuse_unknown(parts: Mapping[str, object], kind: type) -> None:
    """Raise TypeError, as Python does, where the predictor has no such keyword."""
    unknown = parts.keys() - kind.__annotations__.keys()
    if unknown:
        raise TypeError(f"a predictor has no {', '.join(sorted(unknown))}; it has {', '.join(kind.__annotations__)}")


def check_drift(nz: int, parts: BilinearFields | LinearFields) -> dict[str, Any]:
    """Return E, the names of the disturbances, and how many there are."""
    E, given = parts.get("E"), parts.get("disturbances")
    drift = np.zeros((nz, 0)) if E is None else checks.bounded(E, "E", (nz, None))
    nw = drift.shape[1]
    names = tuple(f"w{i}" for i in range(nw)) if given is None else tuple(given)
    if len(names) != nw:
        raise ShapeError(f"disturbances has {len(names)} names and E {nw} columns; give one name each")
    return {"E": drift, "disturbances": names, "nw": nw}


def store_fields(
    predictor: Predictor,
    matrices: tuple[ArrayLike, ArrayLike, ArrayLike],
    lifting: Lifting,
    dt: float,
    names: tuple[Sequence[str], Sequence[str]],
    report: FitReport | None,
    parts: BilinearFields | LinearFields,
) -> None:
    """Check the fields that all predictors share and store them."""
    (A, B, C), embedding, scale = matrices, parts.get("embedding"), parts.get("scale")
    states, inputs = checks.texts(names[0], "states"), checks.texts(names[1], "inputs")
    if embedding is not None:
        checks.kind(embedding, "embedding", Delay, "pass km.Delay(steps)")
    bound_embedding = None if embedding is None else embedding.bind(states, inputs)
    bound = bind_lifting(lifting, states if bound_embedding is None else bound_embedding.names)
    nz, nx, nu = bound.nz, len(states), len(inputs)
    transition = checks.array(A, "A")
    largest = float(np.abs(transition).max(initial=0.0))
    if largest > 1e300:  # sums of entries would overflow
        raise DataError(f"A holds {largest:.3g}, so products with A overflow; scale the states, or fit again")
    if transition.shape != (nz, nz):
        raise ShapeError(
            f"A has shape {transition.shape}, but the lifting returns {nz} observables; "
            "pass the lifting used in the fit"
        )
    freeze(
        predictor,
        A=transition,
        B=checks.bounded(B, "B", (nz, nu)),
        C=checks.bounded(C, "C", (nx, nz)),
        lifting=bound,
        dt=checks.positive(dt, "dt", "s"),
        states=states,
        inputs=inputs,
        report=report,
        embedding=bound_embedding,
        scale=None if scale is None else _check_scale(scale, nz),
        nx=nx,
        nu=nu,
        nz=nz,
    )


def _check_scale(scale: ArrayLike, nz: int) -> Float[np.ndarray, "nz nz"]:
    """Return the scale as an array; raise if it is not upper triangular or has a zero on its diagonal."""
    R = checks.array(scale, "scale", (nz, nz))
    if np.tril(R, -1).any() or not R.diagonal().all():
        raise DataError(
            "scale is not upper triangular with a nonzero diagonal; pass the triangular factor of the lifted "
            "data, np.linalg.qr(Z, mode='r') / sqrt(len(Z)), or leave it out"
        )
    return R


@raise_swallowed()
def build_step_map(
    predictor: Predictor,
    E: Float[np.ndarray, "nz nw"],
    disturbances: tuple[str, ...],
    N: Sequence[Float[np.ndarray, "nz nz"]] | np.ndarray = (),
    S: Sequence[Float[np.ndarray, "nz nz"]] | np.ndarray = (),
    M: Sequence[Float[np.ndarray, "nz nu"]] | np.ndarray = (),
) -> StepMap:
    """Return x⁺ = C ((A + Σ uᵢ Nᵢ + Σ wⱼ Sⱼ) ψ(x) + (B + Σ wⱼ Mⱼ) u + E w) as a StepMap of x, or of ζ."""
    x, u, w = (ca.SX.sym(*each) for each in (("x", len(predictor.point_names)), ("u", predictor.nu), ("w", E.shape[1])))
    C, z = predictor.C, predictor.lifting.symbolic(x)
    x_next = ca.DM(C @ predictor.A) @ z + ca.DM(C @ predictor.B) @ u
    for factor, products, of in ((u, N, z), (w, S, z), (w, M, u)):
        for i, each in enumerate(products):
            x_next += factor[i] * (ca.DM(C @ each) @ of)
    if disturbances:
        x_next += ca.DM(C @ E) @ w
    point_next = x_next if predictor.embedding is None else predictor.embedding.symbolic(x, u, x_next)
    arguments, names = ([x, u, w], ["x", "u", "w"]) if disturbances else ([x, u], ["x", "u"])
    F = ca.Function("F", arguments, [ca.densify(point_next)], names, ["x_next"], {"cse": True})
    return StepMap(F, predictor.dt, states=predictor.point_names, inputs=predictor.inputs, disturbances=disturbances)


def _is_state_space(given: object) -> bool:
    """Return whether an object has the four matrices of a state-space system."""
    return all(hasattr(given, name) for name in _MATRICES) and not hasattr(given, "lifting")


def read_state_space(
    system: Any,
    dt: float | None = None,
    states: Sequence[str] | None = None,
    inputs: Sequence[str] | None = None,
) -> tuple[np.ndarray, np.ndarray, float, tuple[str, ...], tuple[str, ...]]:
    """Return A, B, the sample time and the names of a system of scipy.signal or python-control (``ss``).

    A continuous system is discretised by a zero-order hold of `dt` seconds.
    """
    if not _is_state_space(system) and hasattr(system, "to_ss"):
        system = system.to_ss()
    if not _is_state_space(system):
        raise DataError(f"system is {checks.article(system)}; pass scipy.signal.StateSpace or control.ss")
    A, B, C, D = (checks.array(getattr(system, name), name, (None, None)) for name in _MATRICES)
    if D.any():
        raise DataError("D is not zero: the input acts on the output of its own step, and a predictor has none of that")
    step, continuous = _find_step(system, dt)
    if continuous:
        from scipy.signal import cont2discrete  # slow to import

        A, B, *_ = cont2discrete((A, B, C, D), step)
    state_names = getattr(system, "state_labels", None) if states is None else states
    input_names = getattr(system, "input_labels", None) if inputs is None else inputs
    return (
        np.asarray(A, dtype=np.float64),
        np.asarray(B, dtype=np.float64),
        step,
        checks.names(state_names, "states", "x", len(A)),
        checks.names(input_names, "inputs", "u", B.shape[1]),
    )


def _find_step(system: Any, dt: float | None) -> tuple[float, bool]:
    """Return the sample time [s], and whether the system is continuous."""
    own = getattr(system, "dt", None)
    if own is None and not hasattr(system, "to_discrete"):
        raise DataError("the system does not say whether it is continuous; give it dt=0, or its sample time")
    if own is None or own == 0:
        if dt is None:
            raise DataError("the system is continuous; pass dt=, the sample time in seconds")
        return checks.positive(dt, "dt", "s"), True
    if own is True:
        return checks.positive(1.0 if dt is None else dt, "dt", "s"), False
    if dt is not None and not np.isclose(dt, float(own)):
        raise DataError(f"the system has dt = {float(own):g} s, but dt= is {dt:g} s; leave dt out")
    return float(own), False
