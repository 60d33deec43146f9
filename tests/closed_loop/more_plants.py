"""Plants of the ten tasks that were made after causes of failure, with parameters as published or round."""

from dataclasses import dataclass

import casadi as ca

import koopmpc as km
from tests.closed_loop.plants import Tanks


def _sigmoid(x: ca.SX) -> ca.SX:
    return 0.5 * (1 + ca.tanh(x / 2))


@dataclass(frozen=True)
class Funnel(km.Dynamics):
    """Two tanks in a row; the lower one is four times as wide above a ledge, which an engineer sees as a cliff."""

    states = ("upper [m]", "lower [m]")
    inputs = ("pump [m³/min]",)

    ledge: float = 1.0  # height of the ledge [m]
    edge: float = 0.04  # the width changes within some 4 of these [m]
    wider: float = 3.0  # area that the ledge adds [m²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = inflow − Torricelli's outflow, over the area at the level."""
        out = [ca.sqrt(0.5 * (x[i] + ca.sqrt(x[i] ** 2 + 1e-3))) for i in range(2)]
        area = 1 + self.wider * _sigmoid((x[1] - self.ledge) / self.edge)
        return ca.vertcat(u[0] - out[0], (out[0] - out[1]) / area)


@dataclass(frozen=True)
class Heated(km.Dynamics):
    """A stirred tank with a flow through it and a heater, whose element is 8 s late and is not measured."""

    states = ("level [m]", "temperature [°C]", "element [kW]")
    inputs = ("inflow [l/s]", "heater [kW]")

    area: float = 0.05  # [m²]
    outlet: float = 0.5  # [l/s] at a level of 1 m
    feed: float = 15.0  # temperature of the inflow [°C]
    lag: float = 8.0  # [s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ of the volume, of the heat and of the element."""
        level = 0.5 * (x[0] + ca.sqrt(x[0] ** 2 + 1e-4))
        filled = (u[0] - self.outlet * ca.sqrt(level)) * 1e-3 / self.area
        warmed = (u[0] * 4.18 * (self.feed - x[1]) + x[2]) / (4180 * self.area * (level + 0.02))
        return ca.vertcat(filled, warmed, (u[1] - x[2]) / self.lag)

    def measure(self, x: ca.SX) -> ca.SX:
        """Return level and temperature."""
        return x[:2]


@dataclass(frozen=True)
class Coupled(km.Dynamics):
    """Two vessels joined by a wide pipe: logs of ordinary work hold nearly equal levels only."""

    states = ("left [m]", "right [m]")
    inputs = ("pump [m/min]",)

    joint: float = 1.5  # flow through the pipe [1/min]
    out: float = 0.4  # outflow of the right vessel [√m/min]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ of both levels; the flow through the pipe is turbulent."""
        gap = x[0] - x[1]
        across = self.joint * gap / ca.sqrt(ca.sqrt(gap**2 + 0.01))
        leaves = self.out * ca.sqrt(0.5 * (x[1] + ca.sqrt(x[1] ** 2 + 1e-3)))
        return ca.vertcat(u[0] - across, across - leaves)


@dataclass(frozen=True)
class Sled(km.Dynamics):
    """v̇ = u − c v |v|, ẋ = v: a sled on rails that brakes no better than it accelerates."""

    states = ("position [m]", "velocity [m/s]")
    inputs = ("drive [m/s²]",)

    c: float = 0.1  # drag [1/m]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [v, v̇]."""
        return ca.vertcat(x[1], u[0] - self.c * x[1] * ca.sqrt(x[1] ** 2 + 1e-4))


@dataclass(frozen=True)
class LeakyTanks(Tanks):
    """The four tanks with outlets that are 20 % off and a constant leak of each lower tank."""

    leak1: float = 2.0  # [cm³/s]
    leak2: float = 2.0

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ḣ of the tanks, less the leaks."""
        return super().rhs(x, u) - ca.vertcat(self.leak1 / self.A1, self.leak2 / self.A2, 0, 0)


@dataclass(frozen=True)
class Vusse(km.Dynamics):
    """A → B → C, 2 A → D in a cooled tank: Klatt & Engell, Comput. Chem. Eng. 22, 1998.

    More flow gives more of B up to a point, and less beyond it: the gain turns its sign.
    """

    states = ("A [mol/l]", "B [mol/l]", "temperature [K]", "jacket [K]")
    inputs = ("flow [1/h]", "cooling [MJ/h]")

    feed: float = 5.10  # [mol/l]
    warm: float = 378.05  # temperature of the feed [K]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ of the balances of A, of B, of heat, and of the jacket."""
        a, b, T, jacket = (x[i] for i in range(4))
        k1, k3 = 1.287e12 * ca.exp(-9758.3 / T), 9.043e9 * ca.exp(-8560.0 / T)
        r1, r2, r3 = k1 * a, k1 * b, k3 * a**2
        heat = (4.2 * r1 - 11.0 * r2 - 41.85 * r3) / (0.9342 * 3.01)
        exchange = 4032.0 * 0.215
        return ca.vertcat(
            u[0] * (self.feed - a) - r1 - r3,
            -u[0] * b + r1 - r2,
            u[0] * (self.warm - T) - heat + exchange / (0.9342 * 3.01 * 10) * (jacket - T),
            (1e3 * u[1] + exchange * (T - jacket)) / (5.0 * 2.0),
        )


@dataclass(frozen=True)
class LaggedSpring(km.Dynamics):
    """A mass on a hardening spring, pulled by a drive that lags: its position alone is measured."""

    states = ("x [m]", "speed [m/s]", "force [N/kg]")
    inputs = ("set force [N/kg]",)

    lag: float = 0.4  # [s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [speed, acceleration, rate of the force]."""
        return ca.vertcat(x[1], x[2] - x[0] - 0.5 * x[0] ** 3 - 0.3 * x[1], (u[0] - x[2]) / self.lag)

    def measure(self, x: ca.SX) -> ca.SX:
        """Return the position."""
        return x[0]


@dataclass(frozen=True)
class BlindFunnel(Funnel):
    """The funnel whose lower level alone is measured."""

    def measure(self, x: ca.SX) -> ca.SX:
        """Return the lower level."""
        return x[1]
