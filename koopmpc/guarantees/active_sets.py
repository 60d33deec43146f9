"""`list_ways`: every way that DAQP can take through a parametric QP from a cold start, with its iterations.

Of ½‖u‖² → min, low(θ) ≤ A u ≤ high(θ) with unit rows and affine limits, the dual of a working set has the gradient
σ(θ) c at each of DAQP's iterates, σ affine and c constant: a row that is added makes it so, and a step along G⁻¹c, a
row that leaves and a slack that is freed keep it so. Multipliers are therefore affine in θ, and so is all that DAQP
compares: its ways part a box of θ into polytopes.

Arnström & Axehill, "A unifying complexity certification framework for active-set methods for convex quadratic
programming", IEEE Trans. Automat. Contr. 67(6), 2022.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from koopmpc.base.errors import CertificateError
from koopmpc.control.move import Status
from koopmpc.control.solvers.base import QP
from koopmpc.control.solvers.daqp import DAQP

THIN = 1e-7  # a part of the box of ±1 without a ball of this radius is left out: rounding decides there
_SAMPLES = 2000  # points of the box that show at once which ways are taken
_STILL = 1e-12  # entry of a direction below which a multiplier does not move
_LONGEST = 1000  # iterations of one way

AffineRows = Float[np.ndarray, "k p1"]  # rows of [θ; 1]
AffineRow = Float[np.ndarray, " p1"]


class ParametricQP(NamedTuple):
    """½‖u‖² → min, low θ₁ ≤ A u ≤ high θ₁ with θ₁ = [θ; 1], −1 ≤ θ ≤ 1, unit rows of A.

    `limited` says which of the 2 m limits exist, the upper ones first. A soft row has a finite price `linear`, and
    `rho`, the inverse of twice its quadratic price.
    """

    A: Float[np.ndarray, "m n"]
    low: AffineRows
    high: AffineRows
    limited: Bool[np.ndarray, " m2"]
    linear: Float[np.ndarray, " m"]
    rho: Float[np.ndarray, " m"]


class Way(NamedTuple):
    """One way to an end: its iterations, a θ that takes it, and whether the QP has no solution there."""

    iterations: int
    theta: Float[np.ndarray, " p"]
    infeasible: bool


@dataclass(frozen=True, eq=False)
class _Part:
    """Rows g of g θ₁ ≤ 0, samples in it, and one point of its inside."""

    region: AffineRows
    points: Float[np.ndarray, "s p1"]
    inside: AffineRow


@dataclass(frozen=True, eq=False)
class _Node:
    """An iterate on a part: the working set with sides ±1, free slacks, pushing multipliers ≥ 0, and σ c.

    `switched` are the rows whose slacks were freed or fixed since the last full step.
    """

    part: _Part
    W: tuple[int, ...]
    side: tuple[float, ...]
    free: frozenset[int]
    multipliers: AffineRows
    sigma: AffineRow
    c: Float[np.ndarray, " k"]
    iterations: int = 0
    switched: frozenset[int] = frozenset()


def list_ways(problem: ParametricQP, most: int, rng: np.random.Generator) -> list[Way]:
    """Return all ways of the box."""
    p1 = problem.low.shape[1]
    points = np.ones((_SAMPLES, p1))
    points[:, :-1] = rng.uniform(-1, 1, (_SAMPLES, p1 - 1))
    none, zero = np.zeros((0, p1)), np.zeros(p1)
    search = _Search(problem)
    stack = [_Node(_Part(none, points, points[0]), (), (), frozenset(), none, zero, np.zeros(0))]
    ways: list[Way] = []
    while stack:
        node = stack.pop()
        if node.iterations > _LONGEST:
            raise CertificateError(f"a way of the solver takes more than {_LONGEST} iterations; take a shorter horizon")
        nodes, ends = search.step(replace(node, iterations=node.iterations + 1))
        stack += nodes
        ways += ends
        if len(ways) > most:
            raise CertificateError(
                f"the solver has more than {most} ways through the box; take a smaller box, a shorter horizon or "
                "blocked moves, or km.guarantees.observe_iterations"
            )
    return ways


class _Search:
    def __init__(self, problem: ParametricQP) -> None:
        self.problem = problem
        m, p1 = problem.low.shape
        self.gram = problem.A @ problem.A.T
        self.soft = problem.linear < 1e20  # a linear price from here is that of a hard row
        self.sides = np.repeat([1.0, -1.0], m)
        self.limits = np.concatenate([problem.high, problem.low])
        self.one = np.eye(p1)[-1]

    def step(self, node: _Node) -> tuple[list[_Node], list[Way]]:
        """Return what one pass of DAQP makes of a node: nodes on the parts of its part, and ends."""
        if not node.W:
            return self.add(node, node.part, node.multipliers)
        G = self.curvature(node.W, node.side, node.free)
        values, vectors = np.linalg.eigh(G)
        singular = bool(values[0] < 1e-10)  # least eigenvalue of G of dependent rows
        # least eigenvalue of G below which DAQP refines its factors
        if not singular and values[0] < 1e-6:
            raise CertificateError(
                "active rows are so near to dependent that rounding decides how many iterations a step takes; use "
                "km.guarantees.observe_iterations, or blocked moves"
            )
        if singular:
            direction = vectors[:, 0] * (1.0 if vectors[:, 0] @ node.c > 0 else -1.0)
            direction[np.abs(direction) < 1e-9] = 0.0
        else:
            direction = np.linalg.solve(G, node.c)
        nodes: list[_Node] = []
        blocks = self.find_blocks(node, direction, singular)
        for i, target, length in blocks:
            rows = [length - other for j, _, other in blocks if j != i] + ([] if singular else [length - node.sigma])
            part = self.cut(node.part, rows)
            if part is not None:
                nodes.append(self.stop(node, part, i, target, direction, length, singular))
        if singular:
            ends = [] if blocks else [Way(node.iterations, node.part.inside[:-1], infeasible=True)]
            return nodes, ends
        whole = self.cut(node.part, [node.sigma - length for *_, length in blocks])
        if whole is None:
            return nodes, []
        more, ends = self.add(node, whole, node.multipliers + np.outer(direction, node.sigma))
        return nodes + more, ends

    def curvature(self, W: Sequence[int], side: Sequence[float], free: frozenset[int]) -> Float[np.ndarray, "k k"]:
        """Return the Hessian of the dual of a working set."""
        rho = [self.problem.rho[i] if i in free else 0.0 for i in W]
        return self.gram[np.ix_(W, W)] * np.outer(side, side) + np.diag(rho)

    def find_blocks(
        self, node: _Node, direction: Float[np.ndarray, " k"], singular: bool
    ) -> list[tuple[int, float, AffineRow]]:
        """Return places whose multiplier meets the end of its range, that end, and the length of the step to it."""
        blocks: list[tuple[int, float, AffineRow]] = []
        for i, (row, d) in enumerate(zip(node.W, direction, strict=True)):
            price = float(self.problem.linear[row])
            if d < -_STILL:
                target = price if row in node.free else 0.0
            elif d > _STILL and self.soft[row] and row not in node.free:
                target = price
            else:
                continue
            if (
                target
                and not singular
                and row in node.switched
                and np.abs(node.multipliers[i] - price * self.one).max() < _STILL
            ):
                continue  # it would switch back by rounding
            blocks.append((i, target, (target * self.one - node.multipliers[i]) / d))
        return blocks

    def stop(
        self,
        node: _Node,
        part: _Part,
        i: int,
        target: float,
        direction: Float[np.ndarray, " k"],
        length: AffineRow,
        singular: bool,
    ) -> _Node:
        """Return the node after a step that the multiplier of place i ends: its row leaves, or its slack switches."""
        multipliers, row = node.multipliers + np.outer(direction, length), node.W[i]
        sigma = node.sigma if singular else node.sigma - length
        node = replace(node, part=part, sigma=sigma, multipliers=multipliers)
        if target:
            multipliers[i] = target * self.one
            return replace(node, free=node.free ^ {row}, switched=node.switched | {row})
        keep = [k for k in range(len(node.W)) if k != i]
        return replace(
            node,
            W=tuple(node.W[k] for k in keep),
            side=tuple(node.side[k] for k in keep),
            free=node.free - {row},
            multipliers=multipliers[keep],
            c=node.c[keep],
            switched=frozenset(),
        )

    def add(self, node: _Node, part: _Part, end: AffineRows) -> tuple[list[_Node], list[Way]]:
        """Return the nodes after a full step, one for each row that may be broken most, and the end if none is."""
        A, m = self.problem.A, len(self.problem.A)
        W, side = list(node.W), np.array(node.side)
        u = -A[W].T @ (side[:, None] * end)
        broken = self.sides[:, None] * (np.tile(A @ u, (2, 1)) - self.limits)
        able = self.problem.limited & ~np.isin(np.arange(2 * m) % m, W)
        able &= np.abs(broken[:, :-1]).sum(axis=1) + broken[:, -1] > 1e-9  # somewhere in the box
        rows = np.flatnonzero(able)
        nodes: list[_Node] = []
        for k in rows:
            own = self.cut(part, [-broken[k], *(broken[j] - broken[k] for j in rows if j != k)])
            if own is not None:
                nodes.append(self.put(node, own, end, int(k % m), float(self.sides[k]), broken[k]))
        rest = self.cut(part, list(broken[rows]))
        return nodes, [] if rest is None else [Way(node.iterations, rest.inside[:-1], infeasible=False)]

    def put(self, node: _Node, part: _Part, end: AffineRows, row: int, side: float, violation: AffineRow) -> _Node:
        """Return the node with one more row, which is broken by `violation`.

        DAQP gives a hard row that multiplier, and a soft one zero.
        """
        W, sides = (*node.W, row), (*node.side, side)
        c = np.eye(len(W))[-1]
        first = violation
        if self.soft[row]:
            price = float(self.problem.linear[row])
            if self.cut(part, [price * self.one - violation]) is not None:
                raise CertificateError(
                    "a soft limit is broken by so much that its slack is free at once, and the solver's iterates are "
                    "not affine; take a smaller box, a larger slack weight, or km.guarantees.observe_iterations"
                )
            first = np.zeros_like(violation)
        else:
            c = c - self.curvature(W, sides, node.free)[:, -1]
        return replace(
            node,
            part=part,
            W=W,
            side=sides,
            multipliers=np.vstack([end, first]),
            sigma=violation,
            c=c,
            switched=frozenset(),
        )

    def cut(self, part: _Part, rows: Sequence[AffineRow]) -> _Part | None:
        """Return the part in which rows g θ₁ ≤ 0 hold, too; None where it is empty or thin."""
        if not len(rows):
            return part
        new = np.array(rows)
        norms = np.linalg.norm(new[:, :-1], axis=1)
        flat = norms < 1e-11
        if (new[flat, -1] > 1e-11).any():
            return None
        new = new[~flat] / norms[~flat, None]
        if not len(new):
            return part
        if (new[:, -1] - np.abs(new[:, :-1]).sum(axis=1) > -THIN).any():  # nowhere in the box
            return None
        region = np.concatenate([part.region, new])
        points = part.points[(part.points @ new.T <= -THIN).all(axis=1)]
        if len(points):
            return _Part(region, points, points[0])
        inside = self.find_point(region)
        return None if inside is None else _Part(region, points, inside)

    def find_point(self, region: AffineRows) -> AffineRow | None:
        """Return a point of the box that is THIN inside all rows; None where there is none."""
        p = int(region.shape[1]) - 1
        box, zero = np.eye(p), np.zeros(p, dtype=np.float64)
        A = np.concatenate([box, region[:, :-1]])
        high = np.concatenate([np.ones(p), -region[:, -1] - THIN])
        low = np.concatenate([-np.ones(p), np.full(len(region), -np.inf)])
        solver = DAQP(QP(box, zero, A, low, high))
        found = solver.solve(zero, np.zeros(len(A)))
        return np.append(found.v, 1.0) if found.status is Status.OPTIMAL else None
