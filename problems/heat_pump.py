"""Heat pump: it keeps a room at 21 °C through a heated floor, while the weather changes, which is measured.

The colder it is outside, the less heat the compressor makes of a kilowatt: the regression of I. Staffell et al., "A
review of domestic heat pumps", Energy Environ. Sci. 5 (2012), for air and lifts of 15 to 60 K, as PyPSA-Eur quotes it
(scripts/build_cop_profiles.py). The house has two heat capacities, of round sizes. Time in hours; the cost charges the
compressor from zero, and all controllers get the weather of their horizon as a forecast.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class House(km.Dynamics):
    """C₁ Ṫ₁ = G (T₂ − T₁) + H (w − T₁),  C₂ Ṫ₂ = c(T₂ + a − w) u − G (T₂ − T₁),  c(l) = 6.81 − 0.121 l + 0.00063 l²."""

    states = ("room [°C]", "floor [°C]")
    inputs = ("compressor [kW]",)
    disturbances = ("outside [°C]",)

    C1: float = 2.0  # heat capacity of the room [kWh/K]
    C2: float = 8.0  # of the floor and its water [kWh/K]
    G: float = 1.0  # from the floor to the room [kW/K]
    H: float = 0.25  # from the room to the outside [kW/K]
    a: float = 5.0  # the water is warmer than the floor by this [K]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [Ṫ₁, Ṫ₂]; the temperature outside is behind the compressor in u."""
        outside, lift, flow = u[1], x[1] + self.a - u[1], self.G * (x[1] - x[0])
        heat = (6.81 - 0.121 * lift + 0.00063 * lift**2) * u[0]
        return ca.vertcat((flow + self.H * (outside - x[0])) / self.C1, (heat - flow) / self.C2)

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw a house 4 wide, redder where it is warmer, and the power of the compressor as a bar."""
        room, floor = (float(np.clip((value - 15.0) / 15.0, 0.0, 1.0)) for value in x)
        warm, hot = ((round(60 + 180 * v), 90, round(200 - 160 * v)) for v in (room, floor))
        return [
            km.scene.Line("walls", [(-2.0, 0.0), (-2.0, 3.0), (0.0, 4.5), (2.0, 3.0), (2.0, 0.0), (-2.0, 0.0)], 0.1),
            km.scene.Box("room", (0.0, 1.6), (3.4, 2.4), color=warm),
            km.scene.Box("floor", (0.0, 0.2), (3.8, 0.3), color=hot),
            km.scene.Line("power", [(2.6, 0.0), (2.6, 0.5 * float(u[0]) + 0.01)], width=0.4, color=(40, 120, 200)),
        ]


house, night, hours = House(), [17.0, 18.0], 0.5 * np.arange(193)
cold = (-2.0 + 5.0 * np.sin(2 * np.pi * (hours[:192] - 9.0) / 24.0))[:, None]
front = (6.0 - 14.0 / (1.0 + np.exp(24.0 - hours[:192])))[:, None]  # 14 K colder within some hours, after a day
used = np.where((hours % 24 >= 6) & (hours % 24 < 22), 21.0, 18.0)[:, None]
box = km.Limits(u_min=0.0, u_max=4.0, x_max=[np.inf, 30.0])
draughty = replace(house, H=1.2 * house.H, a=6.0)


problem = km.Problem(
    dynamics=house,
    dt=0.5,
    equilibrium=([21.0, 25.75], [1.2331], [2.0]),
    training=km.Training(
        x0=km.Uniform([16.0, 17.0], [24.0, 30.0]),
        excitation=km.Noise(0.0, 4.0, hold=6),
        episodes=40,
        steps=96,
        measured=km.data.Multisine(12.0, period=48.0, harmonics=4, offset=3.0),
    ),
    lifting=km.State() + km.Monomials(2) + km.Constant(),
    cost=km.Cost(Q=1.0, R=0.02, of=km.State("room"), u_target="zero"),
    limits=box,
    horizon=48,
    cases={
        "cold": km.Case(x0=night, reference=[21.0], steps=144, measured=cold[:144]),
        "front": km.Case(x0=[21.0, 24.0], reference=[21.0], steps=144, measured=front[:144]),
        "track": km.Case(x0=night, reference=used, steps=192, measured=cold),
        "beyond": km.Case(x0=night, reference=[26.0], steps=144, measured=cold[:144]),  # the floor would be too hot
        "wrong": km.Case(x0=night, reference=[21.0], steps=144, measured=cold[:144], plant=draughty),
        "noise": km.Case(x0=night, reference=[21.0], steps=144, measured=cold[:144], noise=[0.1, 0.1]),
        "delay": km.Case(
            x0=night, reference=[21.0], steps=144, measured=cold[:144], faults=[km.faults.ActuatorDelay(1)]
        ),
    },
)
