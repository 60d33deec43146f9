"""koopmpc: from a CasADi model, or only data, to a constrained controller with a lifted linear predictor.

This file is the table of contents: names of daily work here, the rest one level down in `km.faults`, `km.plot`,
`km.scene`, `km.validate`, `km.spectrum`, `km.moments` and `km.errors`. A name is imported when it is first asked for
(PEP 562). README.md has ten lines that use it.
"""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:  # the one table: type checkers and editors see it as it is, and attach serves its names
    import koopmpc.loop
    import koopmpc.models
    import koopmpc.views.figures
    from koopmpc import control as control
    from koopmpc import data as data
    from koopmpc import estimate as estimate
    from koopmpc import guarantees as guarantees
    from koopmpc import lifting as lifting
    from koopmpc import loop as loop
    from koopmpc import plants as plants
    from koopmpc import synthesis as synthesis
    from koopmpc import validate as validate
    from koopmpc.apps import bench as bench
    from koopmpc.apps import papers as papers
    from koopmpc.apps.bench.problem import Case as Case
    from koopmpc.apps.bench.problem import Problem as Problem
    from koopmpc.apps.bench.problem import Training as Training
    from koopmpc.apps.bench.problem_files import load_problem as load_problem
    from koopmpc.apps.bench.sweep import sweep as sweep
    from koopmpc.base import errors as errors
    from koopmpc.base import scene as scene
    from koopmpc.base.errors import FitWarning as FitWarning
    from koopmpc.base.errors import KoopmpcError as KoopmpcError
    from koopmpc.codegen.compiled import compiled as compiled
    from koopmpc.codegen.export import export as export
    from koopmpc.control.ask.cost import Cost as Cost
    from koopmpc.control.ask.limits import Limits as Limits
    from koopmpc.control.kinds.bilinear_mpc import BilinearMPC as BilinearMPC
    from koopmpc.control.kinds.koopman_mpc import KoopmanMPC as KoopmanMPC
    from koopmpc.control.kinds.koopman_mpc import LinearMPC as LinearMPC
    from koopmpc.control.kinds.lqr import LQR as LQR
    from koopmpc.control.kinds.lqr import dlqr as dlqr
    from koopmpc.control.kinds.lqr import lqr as lqr
    from koopmpc.control.kinds.nonlinear_mpc import NonlinearMPC as NonlinearMPC
    from koopmpc.control.move import Move as Move
    from koopmpc.control.move import Status as Status
    from koopmpc.data.collect import Uniform as Uniform
    from koopmpc.data.collect import collect as collect
    from koopmpc.data.delay import Delay as Delay
    from koopmpc.data.episodes import Episode as Episode
    from koopmpc.data.episodes import Episodes as Episodes
    from koopmpc.data.excitation import Feedback as Feedback
    from koopmpc.data.excitation import Noise as Noise
    from koopmpc.data.files.load import load_episodes as load_episodes
    from koopmpc.estimate.disturbance import LiftedDisturbance as LiftedDisturbance
    from koopmpc.estimate.extended import ExtendedKalman as ExtendedKalman
    from koopmpc.estimate.kalman import LiftedKalman as LiftedKalman
    from koopmpc.guarantees.certify import certify as certify
    from koopmpc.lifting.base import Lifting as Lifting
    from koopmpc.lifting.fourier import Fourier as Fourier
    from koopmpc.lifting.fourier import RandomFourier as RandomFourier
    from koopmpc.lifting.radial import Gaussian as Gaussian
    from koopmpc.lifting.radial import ThinPlate as ThinPlate
    from koopmpc.lifting.state import Constant as Constant
    from koopmpc.lifting.state import Expressions as Expressions
    from koopmpc.lifting.state import Monomials as Monomials
    from koopmpc.lifting.state import State as State
    from koopmpc.loop import faults as faults
    from koopmpc.loop.metrics import metrics as metrics
    from koopmpc.loop.realtime import realtime as realtime
    from koopmpc.loop.run import Run as Run
    from koopmpc.loop.simulate import simulate as simulate
    from koopmpc.models import moments as moments
    from koopmpc.models import spectrum as spectrum
    from koopmpc.models.fits.bilinear import bilinear_edmd as bilinear_edmd
    from koopmpc.models.fits.dmd import dmd as dmd
    from koopmpc.models.fits.dmd import dmdc as dmdc
    from koopmpc.models.fits.edmd import edmd as edmd
    from koopmpc.models.fits.online import OnlineEDMD as OnlineEDMD
    from koopmpc.models.predictors import BilinearPredictor as BilinearPredictor
    from koopmpc.models.predictors import LinearPredictor as LinearPredictor
    from koopmpc.models.predictors import load_model as load_model
    from koopmpc.plants.dynamics import RK4 as RK4
    from koopmpc.plants.dynamics import Dynamics as Dynamics
    from koopmpc.plants.plant import black_box as black_box
    from koopmpc.plants.step_map import StepMap as StepMap
    from koopmpc.plants.step_map import discretize as discretize
    from koopmpc.synthesis.design import design as design
    from koopmpc.synthesis.designed import load_controller as load_controller
    from koopmpc.synthesis.options import DesignOptions as DesignOptions
    from koopmpc.synthesis.options import SearchOptions as SearchOptions
    from koopmpc.synthesis.select import select as select
    from koopmpc.synthesis.stabilise import stabilise as stabilise
    from koopmpc.synthesis.train import train as train
    from koopmpc.validate.report import trust as trust
    from koopmpc.validate.scoring import score as score
    from koopmpc.views import recording as recording
    from koopmpc.views.recording.reader import load_run as load_run
    from koopmpc.views.recording.recorder import Recorder as Recorder
    from koopmpc.views.recording.writer import record as record

    identify = koopmpc.models
    plot = koopmpc.views.figures
    predict = koopmpc.models
    supervise = koopmpc.loop
else:
    _NO_PLANS = (
        "experiments are no longer planned: design.advice says what to record; random steps from many starts serve"
    )
    __getattr__, __dir__, __all__ = attach(
        __name__,
        modules={
            "bench": "apps.bench",
            "errors": "base.errors",
            "faults": "loop.faults",
            "identify": "models",
            "moments": "models.moments",
            "papers": "apps.papers",
            "plot": "views.figures",
            "predict": "models",
            "recording": "views.recording",
            "scene": "base.scene",
            "spectrum": "models.spectrum",
            "supervise": "loop",
        },
        core=(
            "apps.bench.problem",
            "control.kinds.koopman_mpc",
            "control.kinds.lqr",
            "control.kinds.bilinear_mpc",
            "control.kinds.nonlinear_mpc",
            "data.collect",
            "models.fits.bilinear",
            "models.fits.edmd",
            "loop.simulate",
        ),
        joints={
            "files of episodes": ("data.files.load",),
            "log formats": (
                "data.files.npz",
                "data.files.parquet",
                "data.files.plain",
                "data.files.foreign.matlab",
                "data.files.foreign.hdf5",
                "data.files.foreign.mdf",
                "data.files.foreign.ros",
                "views.recording.reader",
            ),
            "controllers": (
                "control.kinds.lqr",
                "control.kinds.eigenfunction_lqr",
                "control.kinds.koopman_mpc",
                "control.kinds.bilinear_mpc",
                "control.kinds.nonlinear_mpc",
                "control.kinds.pid",
                "loop.adaptive",
                "loop.guarded",
                "loop.station",
                "guarantees.certificate",
            ),
            "monitor": ("loop.monitor",),
        },
        hints={
            "next_experiment": _NO_PLANS,
            "experiment": _NO_PLANS,
            "load": "km.load_episodes, load_model, load_controller, load_run and load_problem read files",
            "EDMD": "km.edmd(episodes, lifting) fits a model",
            "EDMDc": "km.edmd(episodes, lifting) fits a model; with inputs where the episodes have them",
            "MPC": "km.KoopmanMPC, LinearMPC, BilinearMPC and NonlinearMPC are the controllers",
            "fit": "km.edmd fits one model, km.select chooses one, and koopmpc fit LOGS does it from the shell",
        },
        moved={
            "Adaptive": "supervise",
            "CVODES": "plants",
            "Chirp": "data",
            "Collocation": "plants",
            "Euler": "plants",
            "Files": "data",
            "Guarded": "supervise",
            "GymPlant": "plants",
            "ImplicitMidpoint": "plants",
            "KoopmanRegressor": "identify",
            "Monitor": "supervise",
            "Multisine": "data",
            "ONNX": "lifting",
            "PRBS": "data",
            "Plant": "plants",
            "Prior": "identify",
            "Standardized": "lifting",
            "Stream": "data",
            "constrained_edmd": "identify",
            "eigenfunctions": "identify",
            "kernel_edmd": "identify",
            "sparse_edmd": "identify",
            "stable_edmd": "identify",
            "view": "recording",
        },
    )
