"""What is proved, and what is promised with its probability: certificates, invariant sets, tubes, worst cases."""

from typing import TYPE_CHECKING

from koopmpc.base.lazy import attach

if TYPE_CHECKING:
    from koopmpc.control.ask.terminal import TerminalFeedback as TerminalFeedback
    from koopmpc.control.ask.terminal import TerminalSet as TerminalSet
    from koopmpc.guarantees.certificate import Certificate as Certificate
    from koopmpc.guarantees.certificate import CertifiedFeedback as CertifiedFeedback
    from koopmpc.guarantees.certificate import load_certificate as load_certificate
    from koopmpc.guarantees.certify import CertifyOptions as CertifyOptions
    from koopmpc.guarantees.certify import certify as certify
    from koopmpc.guarantees.invariant_set import InvariantPolytope as InvariantPolytope
    from koopmpc.guarantees.invariant_set import find_invariant_set as find_invariant_set
    from koopmpc.guarantees.step_effort import IterationBound as IterationBound
    from koopmpc.guarantees.step_effort import ObservedIterations as ObservedIterations
    from koopmpc.guarantees.step_effort import bound_iterations as bound_iterations
    from koopmpc.guarantees.step_effort import observe_iterations as observe_iterations
    from koopmpc.guarantees.terminal_set import find_terminal_set as find_terminal_set
else:
    __getattr__, __dir__, __all__ = attach(__name__)
