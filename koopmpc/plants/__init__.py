"""Plants: dynamics, integrators, step maps."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.plants.dynamics import CVODES as CVODES
    from koopmpc.plants.dynamics import Collocation as Collocation
    from koopmpc.plants.dynamics import Euler as Euler
    from koopmpc.plants.dynamics import ImplicitMidpoint as ImplicitMidpoint
    from koopmpc.plants.dynamics import Integrator as Integrator
    from koopmpc.plants.fmu_equations import FMUStepMap as FMUStepMap
    from koopmpc.plants.fmu_plant import FMUPlant as FMUPlant
    from koopmpc.plants.fmu_plant import fmu as fmu
    from koopmpc.plants.gym_plant import GymPlant as GymPlant
    from koopmpc.plants.plant import Plant as Plant
    from koopmpc.plants.plant import SimulatedPlant as SimulatedPlant
    from koopmpc.plants.step_map import Affine as Affine
else:
    __getattr__, __dir__, __all__ = attach(__name__)
