"""Plants of the ten tasks that problems/ does not have: small textbook models with parameters as published or round."""

from dataclasses import dataclass

import casadi as ca

import koopmpc as km


@dataclass(frozen=True)
class Crane(km.Dynamics):
    """v̇ = u − f tanh(v / w) − c v,  l φ̈ = −g sin φ − v̇ cos φ − b l φ̇: a trolley and the load that swings below it."""

    states = ("position [m]", "velocity [m/s]", "swing [rad]", "rate [rad/s]")
    inputs = ("drive [m/s²]",)

    f: float = 0.3  # dry friction [m/s²]
    w: float = 0.1  # the speed at which it slips [m/s]
    c: float = 0.1  # rolling drag [1/s]
    b: float = 0.1  # damping of the swing [1/s]
    length: float = 1.5  # rope [m]
    g: float = 9.81  # [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [v, v̇, φ̇, φ̈]."""
        v, swing, rate = x[1], x[2], x[3]
        push = u[0] - self.f * ca.tanh(v / self.w) - self.c * v
        turn = -(self.g * ca.sin(swing) + push * ca.cos(swing)) / self.length - self.b * rate
        return ca.vertcat(v, push, rate, turn)


@dataclass(frozen=True)
class Rotor(km.Dynamics):
    """J ω̇ = u − c ω − m g l sin θ: an unbalanced disk on a motor; θ = 0 hangs."""

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    J: float = 0.5  # inertia [kg m²]
    c: float = 0.3  # friction [N m s]
    mgl: float = 1.5  # moment of the unbalance [N m]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [ω, ω̇]."""
        return ca.vertcat(x[1], (u[0] - self.c * x[1] - self.mgl * ca.sin(x[0])) / self.J)


@dataclass(frozen=True)
class Bellows(km.Dynamics):
    """ṗ = (u √(p_s (p_s − p)) − L p) / τ,  m ẍ = A p − k x (1 + (x / x_k)²) − c ẋ: an air spring fed by a valve."""

    states = ("pressure [Pa]", "stroke [m]", "speed [m/s]")
    inputs = ("opening [1]",)

    supply: float = 5e4  # supply pressure above ambient [Pa]
    tau: float = 0.2  # filling time [s]
    leak: float = 0.4  # share that leaks
    area: float = 1e-3  # [m²]
    mass: float = 20.0  # [kg]
    k: float = 8e4  # stiffness [N/m]
    stiffens: float = 5e-4  # stroke at which the stiffness has doubled [m]
    c: float = 1e3  # damping [N s/m]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [ṗ, speed, acceleration]."""
        p, s, v = x[0], x[1], x[2]
        force = self.area * p - self.k * s * (1 + (s / self.stiffens) ** 2) - self.c * v
        flow = u[0] * ca.sqrt(self.supply * (self.supply - p)) - self.leak * p
        return ca.vertcat(flow / self.tau, v, force / self.mass)


@dataclass(frozen=True)
class Reactor(km.Dynamics):
    """An exothermic reaction A → B in a cooled tank: Seborg, Edgar & Mellichamp, "Process Dynamics and Control", 2.

    Its cooling jacket has a wall of small heat capacity, whose temperature follows within seconds: a stiff plant.
    """

    states = ("concentration [mol/l]", "temperature [K]", "wall [K]")
    inputs = ("coolant [K]",)

    flow: float = 1.0  # q / V [1/min]
    feed: float = 1.0  # concentration of the feed [mol/l]
    feed_temperature: float = 350.0  # [K]
    k0: float = 7.2e10  # [1/min]
    activation: float = 8750.0  # E / R [K]
    heat: float = 209.2  # −ΔH / (ρ c) [K l/mol]
    exchange: float = 2.092  # U A / (V ρ c) [1/min]
    wall: float = 0.02  # time constant of the wall [min]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ of the balances of A and of heat, and of the wall."""
        c, T, wall = x[0], x[1], x[2]
        rate = self.k0 * ca.exp(-self.activation / T) * c
        balance = self.flow * (self.feed_temperature - T) + self.heat * rate + self.exchange * (wall - T)
        return ca.vertcat(self.flow * (self.feed - c) - rate, balance, (u[0] - wall) / self.wall)


@dataclass(frozen=True)
class Spring(km.Dynamics):
    """ẍ = −k x − k₃ x³ − c ẋ + u, of which x alone is measured: a Duffing oscillator."""

    states = ("x [m]", "speed [m/s]")
    inputs = ("force [N/kg]",)

    k: float = 1.0  # [1/s²]
    k3: float = 1.0  # [1/(m² s²)]
    c: float = 0.3  # [1/s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [speed, acceleration]."""
        return ca.vertcat(x[1], u[0] - self.k * x[0] - self.k3 * x[0] ** 3 - self.c * x[1])

    def measure(self, x: ca.SX) -> ca.SX:
        """Return the position."""
        return x[0]


@dataclass(frozen=True)
class Wells(km.Dynamics):
    """ẍ = x − x³ − c ẋ + u: a beam between two magnets, unstable in the middle (Moon & Holmes 1979)."""

    states = ("x [mm]", "speed [mm/s]")
    inputs = ("force [mm/s²]",)

    c: float = 0.3  # [1/s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [speed, acceleration]."""
        return ca.vertcat(x[1], x[0] - x[0] ** 3 - self.c * x[1] + u[0])


@dataclass(frozen=True)
class VanDerPol(km.Dynamics):
    """ẍ = μ (1 − x²) ẋ − x + u: unstable at rest, with a limit cycle of amplitude 2."""

    states = ("x [V]", "rate [V/s]")
    inputs = ("drive [V/s²]",)

    mu: float = 1.0  # [1/s]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [rate, its derivative]."""
        return ca.vertcat(x[1], self.mu * (1 - x[0] ** 2) * x[1] - x[0] + u[0])


@dataclass(frozen=True)
class Tanks(km.Dynamics):
    """Four tanks and two pumps in the minimum-phase setting: Johansson, IEEE Trans. Control Syst. Tech. 8, 2000."""

    states = ("h1 [cm]", "h2 [cm]", "h3 [cm]", "h4 [cm]")
    inputs = ("pump 1 [V]", "pump 2 [V]")

    A1: float = 28.0  # cross-sections of the tanks [cm²]; tank 3 as tank 1, tank 4 as tank 2
    A2: float = 32.0
    a1: float = 0.071  # of the outlets [cm²], likewise
    a2: float = 0.057
    g: float = 981.0  # [cm/s²]
    k1: float = 3.33  # pump constants [cm³/(V s)]
    k2: float = 3.35
    share1: float = 0.70  # of pump 1 into tank 1, the rest into tank 4
    share2: float = 0.60  # of pump 2 into tank 2, the rest into tank 3

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ḣ = inflow − Torricelli's outflow, smooth at the bottom."""
        out = [ca.sqrt(2 * self.g * 0.5 * (x[i] + ca.sqrt(x[i] ** 2 + 0.01))) for i in range(4)]
        q1, q2 = self.k1 * u[0], self.k2 * u[1]
        return ca.vertcat(
            (self.a1 * (out[2] - out[0]) + self.share1 * q1) / self.A1,
            (self.a2 * (out[3] - out[1]) + self.share2 * q2) / self.A2,
            ((1 - self.share2) * q2 - self.a1 * out[2]) / self.A1,
            ((1 - self.share1) * q1 - self.a2 * out[3]) / self.A2,
        )


@dataclass(frozen=True)
class Arm(km.Dynamics):
    """J ω̇ = u − c ω − m g l sin θ: one link that hangs at θ = 0."""

    states = ("theta [rad]", "omega [rad/s]")
    inputs = ("torque [N m]",)

    m: float = 1.0  # payload [kg]
    l: float = 0.5  # length [m]  # noqa: E741
    c: float = 0.2  # friction [N m s]
    g: float = 9.81  # [m/s²]

    def rhs(self, x: ca.SX, u: ca.SX) -> ca.SX:
        """ẋ = [ω, ω̇]."""
        turn = u[0] - self.c * x[1] - self.m * self.g * self.l * ca.sin(x[0])
        return ca.vertcat(x[1], turn / (self.m * self.l**2))
