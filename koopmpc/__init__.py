"""koopmpc: from a CasADi model, or only data, to a constrained controller with a lifted linear predictor.

This file is the table of contents; see README.md for ten lines that use it.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from koopmpc.bench.library import list_problems, load_problem
from koopmpc.bench.problem import Case, Problem, Training
from koopmpc.bench.sweep import sweep
from koopmpc.control.bilinear_mpc import BilinearMPC
from koopmpc.control.cost import Cost
from koopmpc.control.koopman_mpc import KoopmanMPC
from koopmpc.control.limits import Limits
from koopmpc.control.linear_mpc import LinearMPC
from koopmpc.control.lqr import LQR
from koopmpc.control.move import Controller, Fallback, Move, Plan, Status
from koopmpc.control.nonlinear_mpc import NonlinearMPC
from koopmpc.control.riccati import Gain, dlqr, lqr
from koopmpc.data.collect import Uniform, collect
from koopmpc.data.delay import Delay
from koopmpc.data.episodes import Episode, Episodes, Snapshots
from koopmpc.data.excitation import PRBS, Chirp, Feedback, Multisine, Noise
from koopmpc.data.folder import Files
from koopmpc.data.source import Source
from koopmpc.data.storage import load_episodes
from koopmpc.data.stream import Stream
from koopmpc.errors import (
    DataError,
    DefinitenessError,
    FitWarning,
    KoopmpcError,
    LogError,
    ObservableError,
    ProblemError,
    ShapeError,
)
from koopmpc.estimate.disturbance import LiftedDisturbance
from koopmpc.estimate.kalman import LiftedKalman
from koopmpc.estimate.observer import Estimator
from koopmpc.identify.bilinear import bilinear_edmd
from koopmpc.identify.candidates import Candidate
from koopmpc.identify.constrained import constrained_edmd
from koopmpc.identify.coverage import Coverage, coverage
from koopmpc.identify.dmd import dmd, dmdc
from koopmpc.identify.edmd import edmd
from koopmpc.identify.excitation import Persistency, feedback_share, persistency
from koopmpc.identify.gather import moments
from koopmpc.identify.invariance import Invariance, invariance
from koopmpc.identify.moments import Moments
from koopmpc.identify.online import OnlineEDMD
from koopmpc.identify.prior import Combination, Prior, Storage
from koopmpc.identify.residual_dmd import ResidualDMD, residual_dmd
from koopmpc.identify.select import select
from koopmpc.identify.selection import Selection
from koopmpc.identify.sparse import sparse_edmd
from koopmpc.identify.stable import stable_edmd
from koopmpc.identify.trust import TrustReport, trust
from koopmpc.lifting.base import Lifting
from koopmpc.lifting.constant import Constant
from koopmpc.lifting.expressions import Expressions
from koopmpc.lifting.fourier import Fourier
from koopmpc.lifting.gaussian import Gaussian
from koopmpc.lifting.monomials import Monomials
from koopmpc.lifting.random_fourier import RandomFourier
from koopmpc.lifting.standardized import Standardized
from koopmpc.lifting.state import State
from koopmpc.lifting.thin_plate import ThinPlate
from koopmpc.loop.faults import (
    ActuatorDelay,
    ActuatorLoss,
    DroppedSamples,
    FrozenSensor,
    NaNSensor,
    SensorDelay,
    SolverFailure,
)
from koopmpc.loop.injection import Fault, Injection
from koopmpc.loop.metrics import Metrics, metrics
from koopmpc.loop.run import Plans, Run
from koopmpc.loop.simulate import Step, simulate
from koopmpc.plant.dynamics import Dynamics
from koopmpc.plant.integrators import CVODES, RK4, Collocation, Euler, ImplicitMidpoint
from koopmpc.plant.simulated import Plant, SimulatedPlant
from koopmpc.plant.step_map import Affine, StepMap, discretize
from koopmpc.predict.bilinear import BilinearPredictor, load_bilinear_predictor
from koopmpc.predict.conformal import ConformalBand, conformal
from koopmpc.predict.evolution import evolution_error
from koopmpc.predict.linear import LinearPredictor, load_predictor
from koopmpc.predict.report import FitReport
from koopmpc.predict.score import Score, score
from koopmpc.predict.spectrum import amplitudes, continuous_eigenvalues, linearity_error, reconstruct
from koopmpc.recording.episodes import run_episodes
from koopmpc.recording.reader import load_run
from koopmpc.recording.recorder import Recorder, record
from koopmpc.recording.scene import Box, Disk, Line
from koopmpc.recording.viewer import view

if TYPE_CHECKING:
    from koopmpc.figures.eigenfunctions import plot_eigenfunctions
    from koopmpc.figures.error import plot_error
    from koopmpc.figures.reconstruction import plot_reconstruction
    from koopmpc.figures.runs import plot_runs
    from koopmpc.figures.series import plot_rollout, plot_run
    from koopmpc.figures.spectrum import plot_spectrum
    from koopmpc.figures.style import save as save_figure
    from koopmpc.identify.regressor import KoopmanRegressor as KoopmanRegressor
    from koopmpc.recording.model import record_model

_LATER = {  # imported when they are asked for: what draws, and what needs an extra
    "KoopmanRegressor": ("koopmpc.identify.regressor", "KoopmanRegressor"),
    "plot_eigenfunctions": ("koopmpc.figures.eigenfunctions", "plot_eigenfunctions"),
    "plot_error": ("koopmpc.figures.error", "plot_error"),
    "plot_reconstruction": ("koopmpc.figures.reconstruction", "plot_reconstruction"),
    "plot_rollout": ("koopmpc.figures.series", "plot_rollout"),
    "plot_run": ("koopmpc.figures.series", "plot_run"),
    "plot_runs": ("koopmpc.figures.runs", "plot_runs"),
    "plot_spectrum": ("koopmpc.figures.spectrum", "plot_spectrum"),
    "record_model": ("koopmpc.recording.model", "record_model"),
    "save_figure": ("koopmpc.figures.style", "save"),
}

__all__ = [
    "CVODES",
    "LQR",
    "PRBS",
    "RK4",
    "ActuatorDelay",
    "ActuatorLoss",
    "Affine",
    "BilinearMPC",
    "BilinearPredictor",
    "Box",
    "Candidate",
    "Case",
    "Chirp",
    "Collocation",
    "Combination",
    "ConformalBand",
    "Constant",
    "Controller",
    "Cost",
    "Coverage",
    "DataError",
    "DefinitenessError",
    "Delay",
    "Disk",
    "DroppedSamples",
    "Dynamics",
    "Episode",
    "Episodes",
    "Estimator",
    "Euler",
    "Expressions",
    "Fallback",
    "Fault",
    "Feedback",
    "Files",
    "FitReport",
    "FitWarning",
    "Fourier",
    "FrozenSensor",
    "Gain",
    "Gaussian",
    "ImplicitMidpoint",
    "Injection",
    "Invariance",
    "KoopmanMPC",
    "KoopmpcError",
    "LiftedDisturbance",
    "LiftedKalman",
    "Lifting",
    "Limits",
    "Line",
    "LinearMPC",
    "LinearPredictor",
    "LogError",
    "Metrics",
    "Moments",
    "Monomials",
    "Move",
    "Multisine",
    "NaNSensor",
    "Noise",
    "NonlinearMPC",
    "ObservableError",
    "OnlineEDMD",
    "Persistency",
    "Plan",
    "Plans",
    "Plant",
    "Prior",
    "Problem",
    "ProblemError",
    "RandomFourier",
    "Recorder",
    "ResidualDMD",
    "Run",
    "Score",
    "Selection",
    "SensorDelay",
    "ShapeError",
    "SimulatedPlant",
    "Snapshots",
    "SolverFailure",
    "Source",
    "Standardized",
    "State",
    "Status",
    "Step",
    "StepMap",
    "Storage",
    "Stream",
    "ThinPlate",
    "Training",
    "TrustReport",
    "Uniform",
    "amplitudes",
    "bilinear_edmd",
    "collect",
    "conformal",
    "constrained_edmd",
    "continuous_eigenvalues",
    "coverage",
    "discretize",
    "dlqr",
    "dmd",
    "dmdc",
    "edmd",
    "evolution_error",
    "feedback_share",
    "invariance",
    "linearity_error",
    "list_problems",
    "load_bilinear_predictor",
    "load_episodes",
    "load_predictor",
    "load_problem",
    "load_run",
    "lqr",
    "metrics",
    "moments",
    "persistency",
    "plot_eigenfunctions",
    "plot_error",
    "plot_reconstruction",
    "plot_rollout",
    "plot_run",
    "plot_runs",
    "plot_spectrum",
    "reconstruct",
    "record",
    "record_model",
    "residual_dmd",
    "run_episodes",
    "save_figure",
    "score",
    "select",
    "simulate",
    "sparse_edmd",
    "stable_edmd",
    "sweep",
    "trust",
    "view",
]


def __getattr__(name: str) -> Any:
    """Return what is imported only when it is asked for."""
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, attribute = _LATER[name]
    found = globals()[name] = getattr(import_module(module), attribute)
    return found
