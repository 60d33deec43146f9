"""The registry of controllers: each file of one registers its kind here; files, the bench and `design` look it up."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal

from koopmpc.base import checks
from koopmpc.base.errors import DataError, LogError
from koopmpc.base.lazy import load_joint
from koopmpc.control.ask.limits import Limits
from koopmpc.control.move import Controller
from koopmpc.control.program import Published, SavedController
from koopmpc.models.predictors import BilinearPredictor, LinearPredictor


@dataclass(frozen=True)
class BenchEntry:
    """A controller of the bench.

    Attributes
    ----------
    name
        For tables and ``koopmpc run -c``.
    explanation
        What ``koopmpc explain`` says of it.
    model
        What it plans with: the problem's "equations", or the "linear" or "bilinear" model that was learned from data;
        "designed" where `design` chooses.
    build
        (parts, limits) → controller. `parts` is a `koopmpc.apps.bench.Prepared`: it has `problem`, `step_map`, `model`,
        `local_model`, `bilinear`, `data`, and `monitor_data`, the data for a monitor.
    on_request
        Whether it runs only where it is named.
    """

    name: str
    explanation: str
    model: Literal["equations", "linear", "bilinear", "designed"]
    build: Callable[[Any, Limits], Controller]
    on_request: bool = False


@dataclass(frozen=True)
class ControllerKind:
    """A kind of controller. `as_data`, `from_data` and `program` of its class say how it is saved and exported.

    Attributes
    ----------
    controller
        The class.
    bench
        Under which names the bench runs it.
    designed_for
        The predictor for which `design` builds this kind; None where `design` does not choose it.
    brief
        The class that `design` builds for runs of some hundred steps, where it is another one.
    """

    controller: type[Published]
    bench: tuple[BenchEntry, ...] = ()
    designed_for: type[LinearPredictor | BilinearPredictor] | None = None
    brief: type[Published] | None = None


_KINDS: dict[str, ControllerKind] = {}  # by the name of the class
_BENCH: dict[str, BenchEntry] = {}


def register_controller(kind: ControllerKind) -> None:
    """Register a kind of controller, by the name of its class; a kind of the same name is replaced."""
    checks.kind(kind, "kind", ControllerKind, "see docs/extending.md")
    _KINDS[kind.controller.__name__] = kind
    _BENCH.update({entry.name: entry for entry in kind.bench})


def list_kinds() -> dict[str, ControllerKind]:
    """Return the kinds by the names of their classes, in the order of the table in ``koopmpc/__init__.py``."""
    files = load_joint("controllers")
    place = {file: i for i, file in enumerate(files)}
    return dict(sorted(_KINDS.items(), key=lambda pair: place.get(pair[1].controller.__module__, len(files))))


def list_bench() -> dict[str, BenchEntry]:
    """Return the bench's entries by name; kinds that are registered later appear in the same dict."""
    ordered = {entry.name: entry for kind in list_kinds().values() for entry in kind.bench}
    others = {name: entry for name, entry in _BENCH.items() if name not in ordered}
    _BENCH.clear()
    _BENCH.update(ordered | others)
    return _BENCH


def build_controller(saved: SavedController) -> Any:
    """Return the controller that is made of these data."""
    kinds = list_kinds()
    if saved.name not in kinds:
        raise LogError(f"there is no controller {saved.name!r}; there are {', '.join(kinds)}; register it first")
    parts = {
        name: build_controller(part) if isinstance(part, SavedController) else part
        for name, part in saved.options.items()
    }
    return kinds[saved.name].controller.from_data(replace(saved, options=parts))


def kind_for(model: LinearPredictor | BilinearPredictor) -> ControllerKind:
    """Return the kind that `design` builds for a model."""
    for kind in list_kinds().values():
        if kind.designed_for is not None and isinstance(model, kind.designed_for):
            return kind
    raise DataError(f"no controller is registered for the design on {checks.article(model)}")
