"""Checks of a model on held-out episodes, and of the data that it was fitted to: `km.validate`."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.validate.bands import ConformalBand as ConformalBand
    from koopmpc.validate.bands import Forecast as Forecast
    from koopmpc.validate.bands import conformal as conformal
    from koopmpc.validate.bands import forecast as forecast
    from koopmpc.validate.binomial import bound_failure_rate as bound_failure_rate
    from koopmpc.validate.binomial import count_runs_needed as count_runs_needed
    from koopmpc.validate.closed_loop import feedback_share as feedback_share
    from koopmpc.validate.drift import DriftReport as DriftReport
    from koopmpc.validate.drift import find_drift as find_drift
    from koopmpc.validate.logs.audit import AuditReport as AuditReport
    from koopmpc.validate.logs.audit import audit as audit
    from koopmpc.validate.memory import Memory as Memory
    from koopmpc.validate.memory import find_hidden_state as find_hidden_state
    from koopmpc.validate.report import TrustReport as TrustReport
    from koopmpc.validate.report import trust as trust
    from koopmpc.validate.residuals import Invariance as Invariance
    from koopmpc.validate.residuals import ResidualDMD as ResidualDMD
    from koopmpc.validate.residuals import invariance as invariance
    from koopmpc.validate.residuals import residual_dmd as residual_dmd
    from koopmpc.validate.scoring import Score as Score
    from koopmpc.validate.scoring import score as score
    from koopmpc.validate.sufficiency import Coverage as Coverage
    from koopmpc.validate.sufficiency import Persistency as Persistency
    from koopmpc.validate.sufficiency import coverage as coverage
    from koopmpc.validate.sufficiency import persistency as persistency
else:
    __getattr__, __dir__, __all__ = attach(__name__)
