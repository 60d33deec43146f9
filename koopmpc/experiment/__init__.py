"""The next experiment: which data to record so that a controller's model learns most where the controller works."""

from typing import TYPE_CHECKING

from koopmpc.lazy import attach

if TYPE_CHECKING:
    from koopmpc.experiment.plan import ExperimentPlan as ExperimentPlan
    from koopmpc.experiment.planning import next_experiment as next_experiment
else:
    __getattr__, __dir__, __all__ = attach(__name__)
