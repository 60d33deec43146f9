"""The settings of Snyder & Song (2021): plants, weights, starts, observables, and what its figures show."""

from dataclasses import dataclass

import numpy as np

from koopmpc.lifting.base import Lifting
from koopmpc.lifting.fourier import Fourier
from koopmpc.lifting.monomials import Monomials
from koopmpc.lifting.state import Constant, State
from koopmpc.papers.plants import CartPole, Pendulum, gain, printed_gain
from koopmpc.papers.reconstruction import Scene
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
    """One figure of the paper: its name, the observables, the scenes side by side, and what the paper says of each.

    `says` is in our words; one entry for each scene.
    """

    name: str
    method: str
    scenes: tuple[str, ...]
    says: tuple[str, ...]
    appendix: bool = False


FIGURES = (
    Shown("pendulum-dmd", "DMD", ("pendulum", "pendulum-lqr"), ("small error", "small error")),
    Shown(
        "pendulum-monomials-2",
        "EDMD monomials 2",
        ("pendulum", "pendulum-lqr"),
        ("no change against DMD", "a marginal gain on DMD"),
    ),
    Shown(
        "pendulum-monomials-3",
        "EDMD monomials 3",
        ("pendulum", "pendulum-lqr"),
        ("better, without truncation", "better, without truncation"),
    ),
    Shown("pendulum-fourier-1", "EDMD Fourier 1", ("pendulum", "pendulum-lqr"), ("better", "better")),
    Shown(
        "pendulum-fourier-2",
        "EDMD Fourier 2",
        ("pendulum", "pendulum-lqr"),
        ("no gain on Fourier 1", "no gain on Fourier 1"),
    ),
    Shown("cart-pole-dmd", "DMD", ("cart-pole", "cart-pole-lqr"), ("fails", "partly captured")),
    Shown("cart-pole-monomials-2", "EDMD monomials 2", ("cart-pole-lqr",), ("no gain on DMD",)),
    Shown("cart-pole-fourier-1", "EDMD Fourier 1", ("cart-pole-lqr",), ("no gain on DMD",)),
    Shown(
        "appendix-cart-pole-monomials-2",
        "EDMD monomials 2",
        ("cart-pole",),
        ("no gain on DMD",),
        appendix=True,
    ),
    Shown("appendix-cart-pole-fourier-1", "EDMD Fourier 1", ("cart-pole",), ("no gain on DMD",), appendix=True),
)
VARIANTS = ("upright", "upright-lqr", "cart-pole-g10", "databook", "databook-legacy")


def scenes(others: int = 10) -> dict[str, Scene]:
    """Return every trajectory that is fitted, with so many held-out ones beside each."""
    pendulum, upright = Pendulum(), Pendulum(upright=True)
    cart_pole, databook = CartPole(), CartPole(g=10.0, d=1.0)
    swing, tilt, near = (np.pi / 6, 0.5), (0.5, 0.2, 0.1, 0.1), (1.0, 0.2, 0.02, 0.02)
    off = (-1.0, 0.0, np.pi + 0.1, 0.0)
    start = (np.pi / 4, 0.0)

    def scene(
        title: str,
        dynamics: Dynamics,
        x0: tuple[float, ...],
        spread: tuple[float, ...],
        K: np.ndarray | None = None,
        x_ref: tuple[float, ...] | float = 0.0,
    ) -> Scene:
        return Scene(title, dynamics, x0, spread, K, x_ref, others=others)

    shift = (-1.0, 0.0, np.pi, 0.0)
    return {
        "pendulum": scene("Pendulum, hanging, uncontrolled", pendulum, start, swing),
        "pendulum-lqr": scene("Pendulum, hanging, LQR", pendulum, start, swing, gains()["pendulum"]),
        "upright": scene("Pendulum, upright, uncontrolled", upright, start, swing),
        "upright-lqr": scene("Pendulum, upright, LQR", upright, start, swing, gains()["upright"]),
        "cart-pole": scene("Cart-pole, uncontrolled", cart_pole, off, tilt),
        "cart-pole-lqr": scene("Cart-pole, LQR", cart_pole, shift, near, gains()["cart-pole"], TARGET),
        "cart-pole-g10": scene(
            "Cart-pole, LQR, g = 10", CartPole(g=10.0), shift, near, gains()["cart-pole-g10"], TARGET
        ),
        "databook": scene("Databook's cart-pole, LQR", databook, off, tilt, gains()["databook"], TARGET),
        "databook-legacy": scene(
            "Databook's cart-pole, LQR as printed (legacy)",
            databook,
            off,
            tilt,
            gains()["databook-legacy"],
            TARGET,
        ),
    }


def gains() -> dict[str, np.ndarray]:
    """Return K of each feedback by the name of its scene, without "-lqr"."""
    databook = CartPole(g=10.0, d=1.0)
    return {
        "pendulum": gain(Pendulum(), [0.0, 0.0], *PENDULUM_WEIGHTS).K,
        "upright": gain(Pendulum(upright=True), [0.0, 0.0], *PENDULUM_WEIGHTS).K,
        "cart-pole": gain(CartPole(), UP, *CART_POLE_WEIGHTS).K,
        "cart-pole-g10": gain(CartPole(g=10.0), UP, *CART_POLE_WEIGHTS).K,
        "databook": gain(databook, UP, *DATABOOK_WEIGHTS).K,
        "databook-legacy": printed_gain(databook, *DATABOOK_WEIGHTS).K,
    }
