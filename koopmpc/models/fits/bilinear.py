"""Bilinear extended dynamic mode decomposition: z⁺ = A z + (B + Σ wⱼ Mⱼ) u + E w + Σ uᵢ Nᵢ z + Σ wⱼ Sⱼ z, z = ψ(x)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Unpack

import numpy as np
from jaxtyping import Float, Int

from koopmpc.base.errors import DataError, ObservableError
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episodes
from koopmpc.data.source import Source, source_of
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.composed import Projected
from koopmpc.models.fits.rank import Rank, leading_directions, truncation_loss
from koopmpc.models.moments.doubts import find_doubts
from koopmpc.models.moments.moments import Moments
from koopmpc.models.moments.read import ReadOptions, second_moments
from koopmpc.models.moments.solve import (
    BilinearColumns,
    RegressionRows,
    Ridge,
    check_ridge,
    describe_solve,
    solve,
)
from koopmpc.models.predictors import BilinearPredictor
from koopmpc.models.shared.regression import build_bilinear, build_regression


def bilinear_edmd(
    episodes: Episodes | Source,
    lifting: Lifting,
    *,
    embedding: Delay | None = None,
    ridge: Ridge = 0.0,
    rank: Rank = None,
    products: Sequence[str] | None = None,
    difference: bool = False,
    scheduled_inputs: bool = False,
    **options: Unpack[ReadOptions],
) -> BilinearPredictor:
    """Fit ψ(x⁺) = A ψ(x) + B u + E w + Σ uᵢ Nᵢ ψ(x) + Σ wⱼ Sⱼ ψ(x) by least squares on M snapshot pairs.

    Nothing is added to the lifting. If it holds a Constant, the columns of Nᵢ and Sⱼ for it are zero, because B
    multiplies uᵢ and E wⱼ. Where the episodes hold measured disturbances W, these act as inputs do; with wⱼ ψ(x) the
    model is linear parameter-varying, and wⱼ a scheduling signal.

    Parameters
    ----------
    episodes
        Episodes with inputs, or a Source of them; no pair spans two episodes.
    lifting
        ψ: R^nx → R^nz. C selects by name the states that ψ holds, and is fitted for the others.
    embedding
        ψ acts on the state and its past, as in `edmd`.
    ridge
        Tikhonov weight on unit-norm columns of [ψ(x) u u⊗ψ(x)]; with a `Constant` on those of the deviations from
        their means, [ψ − ψ̄, u − ū, (u − ū)⊗(ψ − ψ̄)]. With 0, singular values below eps · max(M, n) of
        the largest are cut. "gcv" chooses it by generalised cross-validation.
    rank
        As in `edmd`: z = U_rᵀ ψ(x) on unscaled columns, and u⊗z for the products.
    products
        Names of the observables that inputs and measured disturbances multiply, for an input-affine model
        ψ(x⁺) = A ψ(x) + G(x) u whose G is spanned by 1 and these; all by default.
    difference
        Regress ψ(x⁺) − ψ(x) and add I to A. Without a ridge and on independent columns the model is the same. With a
        ridge, or a cut of singular values, the model is drawn towards z⁺ = z instead of z⁺ = 0. For a short dt this is
        closer to the plant.
    scheduled_inputs
        Also fit Σ wⱼ Mⱼ u: measured disturbances change what inputs do, as the cold does to a heat pump.
    **options
        ``weights``, ``workers``, ``scheduler`` and ``progress``, as in `km.moments.second_moments`.

    Raises
    ------
    DataError
        The data have no inputs, ridge is negative, products and a rank are both given, an observable is not finite on
        the data, or scheduled_inputs go with a rank or with data without W.
    ObservableError
        The lifting does not hold one of the products.

    Warns
    -----
    FitWarning
        Rank-deficient, ill-conditioned, or inputs that are functions of ψ(x); each is also in the report.

    References
    ----------
    Bruder, Fu & Vasudevan, "Advantages of bilinear Koopman realizations for the modeling and control of systems
    with unknown dynamics", IEEE Robot. Autom. Lett. 6, 2021.

    Examples
    --------
    >>> import koopmpc as km
    >>> plant = km.discretize(km.load_problem("pendulum").dynamics, dt=0.05)
    >>> data = km.collect(plant, km.Uniform([-1, -1], [1, 1]), km.Noise(-5, 5), episodes=60, steps=30)
    >>> model = km.bilinear_edmd(data, km.State() + km.Fourier(1, states="theta"), difference=True)
    >>> cost, limits = km.Cost(Q=[10, 1], R=0.1), km.Limits(u_min=-25, u_max=25)
    >>> km.BilinearMPC(model, cost, limits, horizon=20)([0.5, 0.0], [0.0, 0.0]).status.name
    'UNCONSTRAINED'
    """
    ridge, source = check_ridge(ridge), source_of(episodes)
    if source.nu == 0:
        raise DataError("the episodes have no inputs; pass them to edmd, or give each Episode its U")
    if rank is not None and products is not None:
        raise DataError("a rank mixes all observables, so inputs cannot multiply some of them; pass one of the two")
    if scheduled_inputs and (rank is not None or not source.nw):
        raise DataError(
            "scheduled_inputs multiply inputs by measured disturbances, without a rank: give each Episode its W, and "
            "leave rank out"
        )
    delays = embedding if embedding is None or not source.nw else embedding.match(source.states, source.inputs)
    signals = source.driven(products=scheduled_inputs)
    total = second_moments(signals, lifting, bilinear=True, embedding=delays, **options)
    regression = build_regression(total, "bilinear_edmd", disturbances=source.disturbances)
    assert regression.C is not None, "an extended regression has its C"
    bound, nz, nu = regression.lifting, total.nz, source.nu + source.nw
    columns = BilinearColumns(nz, source.nu, source.nw, crossed=scheduled_inputs)
    which = total.products if products is None else _find_products(total, products)
    rows = columns.arrange(regression.rows, total.products, which)
    regular = ridge != 0 or rank is not None
    sentences, condition = find_doubts(
        rows, bound.names, columns.name(total.inputs, bound.names, which), regular=regular
    )
    P, C, basis, state_residual, words = rows.P, regression.C, np.eye(nz), regression.state_residual, ""
    if rank is not None:
        basis, words = leading_directions(rows, nz, rank, sentences)
        P, C, bound = _project_rows(P, basis, nu, which), C @ basis, Projected(bound, basis).bind(bound.bound_states)
        state_residual = np.hypot(state_residual, truncation_loss(rows.P[:, :nz], basis, regression.C, rows.samples))
        which = np.arange(len(basis.T))
    r = len(basis.T)
    columns = replace(columns, nz=r)
    start = np.eye(P.shape[1], r) @ basis.T * difference  # K of the model z⁺ = z, or zero
    constant = rows.constant if rank is None else None
    change = RegressionRows(P, rows.T[:, :nz] - P @ start, rows.rest[:nz], rows.samples, constant)
    shifted, back = columns.centre(change, which)
    solution = solve(shifted, ridge=ridge)
    K = (back @ solution.K + start) @ basis
    regression = replace(
        regression,
        rows=replace(rows, P=P, constant=constant),
        lifting=bound,
        C=C,
        inputs=(*source.inputs, *source.disturbances),
        state_residual=state_residual,
    )
    solved = describe_solve(regression.rows, ridge, solution.ridge)
    return build_bilinear(
        regression,
        K,
        columns.split(K, which),
        rule=f"{words}, {solved}" if words else solved,
        rank=solution.rank,
        condition=condition,
        ridge=solution.ridge,
        doubts=sentences,
    )


def _find_products(total: Moments, products: Sequence[str]) -> Int[np.ndarray, " np"]:
    """Return the indices of the observables with these names, without the Constant, because u · 1 is u."""
    place = {name: i for i, name in enumerate(total.lifting.names)}
    for name in products:
        if name not in place:
            raise ObservableError(
                f"products names {name!r}, which the lifting lacks; it holds {', '.join(total.lifting.names)}"
            )
    return np.intersect1d([place[name] for name in products], total.products).astype(np.intp)


def _project_rows(
    P: Float[np.ndarray, "m n"], basis: Float[np.ndarray, "nz r"], nu: int, which: Int[np.ndarray, " np"]
) -> Float[np.ndarray, "m _"]:
    """Return [z u u⊗z], z = basisᵀ ψ, from [ψ u u⊗ψ]; for the Constant, which u⊗ψ leaves out, it uses u · 1 = u."""
    nz = len(basis)
    U = P[:, nz : nz + nu]
    constant = np.delete(basis, which, axis=0).sum(axis=0)
    parts = P[:, nz + nu :].reshape(len(P), nu, -1)
    mixed = [parts[:, i] @ basis[which] + U[:, i : i + 1] * constant for i in range(nu)]
    return np.hstack([P[:, :nz] @ basis, U, *mixed])
