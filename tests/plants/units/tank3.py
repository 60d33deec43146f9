"""The tank of tank.py as an FMI 3 co-simulation unit."""

from math import sqrt

from pythonfmu3 import Float64, Fmi3Causality, Fmi3Initial, Fmi3Slave, Fmi3Variability


class Tank3(Fmi3Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.time, self.level, self.inflow, self.drain, self.area = 0.0, 1.0, 0.0, 0.5, 2.0
        time = Float64("time", causality=Fmi3Causality.independent, variability=Fmi3Variability.continuous)
        self.register_variable(time)
        self.register_variable(Float64("level", causality=Fmi3Causality.output, initial=Fmi3Initial.exact, start=1.0))
        self.register_variable(Float64("inflow", causality=Fmi3Causality.input, start=0.0))
        for name in ("drain", "area"):
            causality, variability = Fmi3Causality.parameter, Fmi3Variability.tunable
            self.register_variable(Float64(name, causality=causality, variability=variability))

    def do_step(self, current_time, step_size):
        for _ in range(20):
            self.level += step_size / 20 * (self.inflow - self.drain * sqrt(max(self.level, 0.0))) / self.area
        return True
