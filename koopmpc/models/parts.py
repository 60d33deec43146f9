"""What predictors are made of: checks of their fields, and the re-lifted map."""

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
