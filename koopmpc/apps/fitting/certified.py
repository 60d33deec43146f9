"""describe_certificate: a certificate of stability for the model of a design, from logs that it was not fitted to."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from koopmpc.base import disk
from koopmpc.base.errors import KoopmpcError
from koopmpc.data.episodes import Episodes
from koopmpc.guarantees.certify import CertifyOptions, certify
from koopmpc.lifting.state import State
from koopmpc.synthesis.designed import Design
from koopmpc.synthesis.search.recipe import get_model

PAGE = "certificate.md"


def describe_certificate(
    design: Design, reference: Float[np.ndarray, "..."], unseen: Episodes | None, folder: Path
) -> str:
    """Seek a certificate at the reference, write its file and page, and return what came of it in a sentence."""
    evidence, model = design.evidence, get_model(design.controller)
    why = _explain_unfit(design, reference)
    if why or unseen is None or not len(unseen):
        why = why or "no log is left that the model was not fitted to; record more episodes"
        return f"No certificate: {why}."
    rest = evidence.surrogates[0].holding(evidence.task.cost, evidence.task.limits)(evidence.task.reference[0])
    limits = evidence.task.limits
    try:
        certificate = certify(
            model,
            model.align(unseen),
            limits,
            x=np.asarray(rest.x)[: model.nx],
            u=np.asarray(rest.u),
            options=CertifyOptions(estimated=True),
        )
    except KoopmpcError as error:
        return f"{str(error)[0].upper()}{str(error)[1:]}."
    certificate.save(folder / "certificate.npz")
    with disk.writing(folder / PAGE) as stream:
        stream.write(certificate.page().encode())
    return (
        f"A feedback on the chosen model has a certificate around the reference: {PAGE} states it with its assumptions,"
        " certificate.npz holds it. It is a certificate of that feedback, and not of the predictive controller."
    )


def _explain_unfit(design: Design, reference: Float[np.ndarray, "..."]) -> str:
    """Return why a certificate cannot be sought at all; empty if it can."""
    asked, model = design.evidence.task, get_model(design.controller)
    of = asked.cost.of.bind(model.states)
    if design.best.recipe.feedthrough:
        return "the inputs act on outputs at once, and a certificate is of a state that a controller reads"
    if model.embedding is not None:
        return "the chosen model holds past rows, and a certificate is of a model of the present state"
    if np.ndim(reference) > 1:
        return "the reference moves, and a certificate is of one set point"
    if not isinstance(of, State):
        return "the cost tracks other observables than states, so the set point is not given"
    return ""
