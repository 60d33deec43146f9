"""CSTR: the product of van de Vusse's reactor is set by its feed and its cooling, across the optimum of its yield.

A → B → C and 2 A → D in a cooled, stirred tank: the benchmark of K.-U. Klatt and S. Engell, "Gain-scheduling
trajectory control of a continuous stirred tank reactor", Computers & Chemical Engineering 22 (1998), and of H. Chen,
A. Kremling and F. Allgöwer (ECC 1995), with their parameters. Time in hours: the jacket follows within a minute, the
tank in a quarter of an hour. More feed first lowers the product before it raises it.
"""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

import koopmpc as km


@dataclass(frozen=True)
class Reactor(km.Dynamics):
    """Balances of A, of B, of the tank's heat and of the jacket's; Kᵢ = kᵢ exp(Eᵢ / (T + 273.15))."""

    states = ("A [mol/l]", "B [mol/l]", "tank [degC]", "jacket [degC]")
    inputs = ("feed [1/h]", "cooling [MJ/h]")

    k1: float = 1.287e12  # A → B, and B → C [1/h]
    k3: float = 9.043e9  # 2 A → D [l/(mol h)]
    E1: float = -9758.3  # activation of both [K]
    E3: float = -8560.0  # of the third [K]
    A0: float = 5.10  # A in the feed [mol/l]
    T0: float = 104.9  # the feed's temperature [°C]
    heats: tuple[float, float, float] = (4.2, -11.0, -41.85)  # of the reactions [kJ/mol]
    rho_cp: float = 0.9342 * 3.01  # heat capacity [kJ/(l K)]
    wall: float = 4032.0 * 0.215  # exchange with the jacket [kJ/(h K)]
    volume: float = 10.0  # [l]
    jacket: float = 5.0 * 2.0  # its heat capacity [kJ/K]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ of both concentrations [mol/(l h)] and both temperatures [K/h]."""
        A, B, T, TK = x[0], x[1], x[2], x[3]
        K1, K3 = self.k1 * ca.exp(self.E1 / (T + 273.15)), self.k3 * ca.exp(self.E3 / (T + 273.15))
        heat = -(self.heats[0] * K1 * A + self.heats[1] * K1 * B + self.heats[2] * K3 * A**2) / self.rho_cp
        exchange = self.wall * (TK - T)
        return ca.vertcat(
            u[0] * (self.A0 - A) - K1 * A - K3 * A**2,
            -u[0] * B + K1 * (A - B),
            u[0] * (self.T0 - T) + heat + exchange / (self.rho_cp * self.volume),
            (1000.0 * u[1] - exchange) / self.jacket,
        )

    def scene(self, x: np.ndarray, u: np.ndarray) -> list[km.scene.Shape]:
        """Draw the tank with a layer for A and one for B, redder where hotter, and bars for feed and cooling."""
        A, B = float(np.clip(x[0], 0.01, 6.0)) / 5.0, float(np.clip(x[1], 0.01, 6.0)) / 5.0
        warm = int(np.clip(25.0 * (x[2] - 108.0), 0.0, 255.0))
        feed, cooling = float(u[0]) / 40.0, float(u[1]) / 10.0
        wall = [(-0.5, 1.2), (-0.5, 0.0), (0.5, 0.0), (0.5, 1.2)]
        return [
            km.scene.Box("B", (0.0, B / 2), (0.9, B), color=(warm, 90, 255 - warm)),
            km.scene.Box("A", (0.0, B + A / 2), (0.9, A), color=(170, 180, 190)),
            km.scene.Line("wall", wall, width=0.05),
            km.scene.Line("feed", [(0.8, 0.0), (0.8, feed)], width=0.1, color=(40, 120, 200)),
            km.scene.Line("cooling", [(1.0, 0.0), (1.0, cooling)], width=0.1, color=(40, 120, 200)),
        ]


reactor = Reactor()
nominal = ([2.1403, 1.0903, 114.19, 112.91], [14.19, -1.1135])  # the steady state of the benchmark
start = [2.5, 0.85, 111.0, 109.0]
warm = np.column_stack([np.where(np.arange(201) < 100, 0.95, 1.07), np.where(np.arange(201) < 100, 112.0, 115.0)])
wave = np.column_stack([0.98 + 0.06 * np.sin(np.arange(241) / 20), 113.0 + 1.5 * np.sin(np.arange(241) / 20)])
box = km.Limits(u_min=[3.0, -9.0], u_max=[35.0, 0.0])


problem = km.Problem(
    dynamics=reactor,
    dt=0.005,  # h, 18 s
    integrator=km.RK4(4),
    equilibrium=nominal,
    training=km.Training(
        x0=km.Uniform([1.5, 0.7, 106.0, 104.0], [3.2, 1.2, 120.0, 119.0]),
        excitation=km.Noise([3.0, -4.0], [35.0, 0.0], hold=5),
        episodes=300,
        steps=40,
    ),
    lifting=km.State() + km.Monomials(2) + km.Constant(),
    ridge=1e-9,
    cost=km.Cost(Q=[100.0, 0.5], R=[1e-3, 1e-1], of=km.State(["B", "tank"])),
    limits=box,
    horizon=20,
    cases={
        "reach": km.Case(x0=start, reference=[1.09, 114.19], steps=120),
        "steps": km.Case(x0=start, reference=warm, steps=200),
        "track": km.Case(x0=start, reference=wave, steps=240),
        "beyond": km.Case(  # hotter than the tank may be
            x0=start, reference=[1.0, 116.0], steps=120, limits=replace(box, x_max=np.array([9.0, 9.0, 114.0, 200.0]))
        ),
        "wrong": km.Case(x0=start, reference=[1.05, 114.0], steps=160, plant=replace(reactor, wall=0.8 * reactor.wall)),
        "noise": km.Case(x0=start, reference=[1.09, 114.19], steps=120, noise=[0.01, 0.005, 0.1, 0.1]),
        "delay": km.Case(x0=start, reference=[1.09, 114.19], steps=120, faults=[km.faults.ActuatorDelay(1)]),
    },
)
