"""The settings of Snyder & Song (2021): plants, weights, starts, observables, what its figures show, and our tasks."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from koopmpc.control.cost import Cost
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.fourier import Fourier
from koopmpc.lifting.state import Constant, Monomials, State
from koopmpc.papers.plants import CartPole, Pendulum, gain, printed_gain
from koopmpc.papers.snyder.reconstruction import Setting
from koopmpc.plants.dynamics import Dynamics

PENDULUM_WEIGHTS: tuple[list[float], float] = ([0.0, 10.0], 1.0)  # Q and R of the paper
CART_POLE_WEIGHTS: tuple[list[float], float] = ([5.0, 10.0, 0.0, 0.0], 1.0)
DATABOOK_WEIGHTS: tuple[list[float], float] = ([1.0, 1.0, 1.0, 1.0], 1e-4)  # Brunton & Kutz 2019, section 8.7
UP = (0.0, 0.0, np.pi, 0.0)
TARGET = (1.0, 0.0, np.pi, 0.0)

OBSERVABLES: dict[str, Lifting] = {
    "DMD": State(),
    "EDMD monomials 2": State() + Monomials(2) + Constant(),
    "EDMD monomials 3": State() + Monomials(3) + Constant(),
    "EDMD Fourier 1": State() + Fourier(1),
    "EDMD Fourier 2": State() + Fourier(2),
}


@dataclass(frozen=True)
class Shown:
    """One figure of the paper: its name, the observables, the settings side by side, and what the paper says of each.

    `says` is in our words and has one entry for each setting.
    """

    name: str
    method: str
    settings: tuple[str, ...]
    says: tuple[str, ...]
    appendix: bool = False


_BOTH = ("pendulum", "pendulum-lqr")
FIGURES = (
    Shown("pendulum-dmd", "DMD", _BOTH, ("small error",) * 2),
    Shown("pendulum-monomials-2", "EDMD monomials 2", _BOTH, ("no change against DMD", "a marginal gain on DMD")),
    Shown("pendulum-monomials-3", "EDMD monomials 3", _BOTH, ("better, without truncation",) * 2),
    Shown("pendulum-fourier-1", "EDMD Fourier 1", _BOTH, ("better",) * 2),
    Shown("pendulum-fourier-2", "EDMD Fourier 2", _BOTH, ("no gain on Fourier 1",) * 2),
    Shown("cart-pole-dmd", "DMD", ("cart-pole", "cart-pole-lqr"), ("fails", "partly captured")),
    Shown("cart-pole-monomials-2", "EDMD monomials 2", ("cart-pole-lqr",), ("no gain on DMD",)),
    Shown("cart-pole-fourier-1", "EDMD Fourier 1", ("cart-pole-lqr",), ("no gain on DMD",)),
    Shown("appendix-cart-pole-monomials-2", "EDMD monomials 2", ("cart-pole",), ("no gain on DMD",), appendix=True),
    Shown("appendix-cart-pole-fourier-1", "EDMD Fourier 1", ("cart-pole",), ("no gain on DMD",), appendix=True),
)
VARIANTS = ("upright", "upright-lqr", "cart-pole-g10", "databook", "databook-legacy")


def all_settings(others: int = 10) -> dict[str, Setting]:
    """Return every trajectory that is fitted, by name, with `others` held-out trajectories beside each."""
    pendulum, upright = Pendulum(), Pendulum(upright=True)
    cart_pole, databook = CartPole(), CartPole(g=10.0, d=1.0)
    start, swing = (np.pi / 4, 0.0), (np.pi / 6, 0.5)
    off, tilt = (-1.0, 0.0, np.pi + 0.1, 0.0), (0.5, 0.2, 0.1, 0.1)
    shift, near = (-1.0, 0.0, np.pi, 0.0), (1.0, 0.2, 0.02, 0.02)
    K = gains()
    found = {
        "pendulum": Setting("Pendulum, hanging, uncontrolled", pendulum, start, swing),
        "pendulum-lqr": Setting("Pendulum, hanging, LQR", pendulum, start, swing, K["pendulum"]),
        "upright": Setting("Pendulum, upright, uncontrolled", upright, start, swing),
        "upright-lqr": Setting("Pendulum, upright, LQR", upright, start, swing, K["upright"]),
        "cart-pole": Setting("Cart-pole, uncontrolled", cart_pole, off, tilt),
        "cart-pole-lqr": Setting("Cart-pole, LQR", cart_pole, shift, near, K["cart-pole"], TARGET),
        "cart-pole-g10": Setting("Cart-pole, LQR, g = 10", CartPole(g=10.0), shift, near, K["cart-pole-g10"], TARGET),
        "databook": Setting("Databook's cart-pole, LQR", databook, off, tilt, K["databook"], TARGET),
        "databook-legacy": Setting(
            "Databook's cart-pole, LQR as printed (legacy)", databook, off, tilt, K["databook-legacy"], TARGET
        ),
    }
    return {name: replace(setting, others=others) for name, setting in found.items()}


def gains() -> dict[str, np.ndarray]:
    """Return K of each feedback by the name of its setting without "-lqr"."""
    databook = CartPole(g=10.0, d=1.0)
    return {
        "pendulum": gain(Pendulum(), [0.0, 0.0], *PENDULUM_WEIGHTS).K,
        "upright": gain(Pendulum(upright=True), [0.0, 0.0], *PENDULUM_WEIGHTS).K,
        "cart-pole": gain(CartPole(), UP, *CART_POLE_WEIGHTS).K,
        "cart-pole-g10": gain(CartPole(g=10.0), UP, *CART_POLE_WEIGHTS).K,
        "databook": gain(databook, UP, *DATABOOK_WEIGHTS).K,
        "databook-legacy": printed_gain(databook, *DATABOOK_WEIGHTS).K,
    }


@dataclass(frozen=True)
class Shaking:
    """Excitation of a plant for data: episodes start in x ± spread, and uniform noise of ± `noise` is added to u."""

    spread: Sequence[float]
    noise: float


SHAKINGS: Mapping[str, Shaking] = {
    "pendulum": Shaking((1.0, 1.0), 4.0),
    "cart-pole": Shaking((1.0, 0.5, 0.1, 0.1), 10.0),
}


@dataclass(frozen=True)
class ControlTask:
    """The task of a controller, and the excitation of the plant for the data of its model.

    Attributes
    ----------
    dynamics, x_eq
        The plant and its equilibrium.
    K
        Name of the feedback that holds the plant while data are collected; None where it needs none.
    shaking
        Excitation of the data about x_eq.
    cost, limit
        The paper's weights, and the bound on |u| in the runs with limits, which is below what LQR would take.
    x0, reference
        Where the run starts, and where it has to go.
    """

    dynamics: Dynamics
    x_eq: Sequence[float]
    K: str | None
    shaking: Shaking
    cost: Cost
    limit: float
    x0: Sequence[float]
    reference: Sequence[float]


_DRIVEN, _CARRIED = Cost(*PENDULUM_WEIGHTS), Cost(*CART_POLE_WEIGHTS)
_REST, _START = (0.0, 0.0), (np.pi / 4, 0.0)
_SHIFTED, _LEANING = (-1.0, 0.0, np.pi, 0.0), (0.0, 0.0, np.pi + 0.3, 0.0)
TASKS: Mapping[str, ControlTask] = {
    "pendulum, hanging, π/4": ControlTask(
        Pendulum(), _REST, None, Shaking((1.2, 2.0), 4.0), _DRIVEN, 2.0, _START, _REST
    ),
    "pendulum, upright, π/4": ControlTask(
        Pendulum(upright=True), _REST, "upright", Shaking((1.0, 1.0), 10.0), _DRIVEN, 20.0, _START, _REST
    ),
    "cart-pole, 2 m shift": ControlTask(
        CartPole(), UP, "cart-pole", Shaking((2.0, 1.0, 0.1, 0.1), 5.0), _CARRIED, 3.0, _SHIFTED, TARGET
    ),
    "cart-pole, 0.3 rad off": ControlTask(
        CartPole(), UP, "cart-pole", Shaking((2.0, 1.0, 0.4, 0.4), 10.0), _CARRIED, 40.0, _LEANING, UP
    ),
}
