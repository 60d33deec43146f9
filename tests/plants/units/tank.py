"""A tank as a co-simulation unit in Python: level' = (inflow - drain √level) / area, 20 Euler steps a step."""

from math import sqrt

from pythonfmu import Fmi2Causality, Fmi2Initial, Fmi2Slave, Fmi2Variability, Integer, Real


class Tank(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.level, self.inflow, self.drain, self.area, self.count = 1.0, 0.0, 0.5, 2.0, 0
        self.register_variable(Real("level", causality=Fmi2Causality.output, initial=Fmi2Initial.exact))
        self.register_variable(Real("inflow", causality=Fmi2Causality.input))
        for name in ("drain", "area"):
            causality, variability = Fmi2Causality.parameter, Fmi2Variability.tunable
            self.register_variable(Real(name, causality=causality, variability=variability))
        self.register_variable(Integer("count", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        for _ in range(20):
            self.level += step_size / 20 * (self.inflow - self.drain * sqrt(max(self.level, 0.0))) / self.area
        self.count += 1
        return True
