"""Options of commands from dataclasses: a field is an option, and its line in the docstring is the help."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import MISSING, fields
from functools import wraps
from inspect import Parameter, cleandoc, signature
from types import UnionType
from typing import Annotated, Any, Union, cast, get_args, get_origin, get_type_hints

import typer

from koopmpc.apps.cli.console import friendly
from koopmpc.base.errors import DataError


def take_options(
    kind: type,
    only: Collection[str] | None = None,
    *,
    help: Mapping[str, str] | None = None,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command an option for each field of a dataclass; the command gets them as one object, `options`.

    A sequence is written with commas between its items; an empty text is an empty sequence.
    Fields that are not among `only` keep their defaults. The help is the first sentence of what the docstring says of a
    field in its section Attributes, or what `help` has by its name.
    """
    hints, meanings = get_type_hints(kind), {**read_attributes(kind), **(help or {})}
    chosen = [field for field in fields(kind) if field.init and (only is None or field.name in only)]
    items = {field.name: item for field in chosen if (item := _item_type(hints[field.name])) is not None}
    parameters: list[Parameter] = []
    for field in chosen:
        default = field.default if field.default is not MISSING else cast("Any", field.default_factory)()
        hint = hints[field.name]
        if field.name in items:
            default = None if default is None else ",".join(map(str, default))
            hint = str | None if default is None else str
        option = typer.Option(f"--{field.name.replace('_', '-')}", help=meanings[field.name])
        parameters.append(
            Parameter(field.name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[hint, option])
        )

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = [part for name, part in signature(command, eval_str=True).parameters.items() if name != "options"]

        @wraps(command)
        def run(**given: Any) -> None:
            values = {field.name: given.pop(field.name) for field in chosen}
            with friendly():
                for name, item in items.items():
                    values[name] = None if values[name] is None else _split(values[name], item, name)
                options = kind(**values)
            command(**given, options=options)

        run.__dict__["__signature__"] = signature(command).replace(parameters=[*own, *parameters])
        run.__annotations__ = {part.name: part.annotation for part in (*own, *parameters)}
        return run

    return decorate


def read_attributes(kind: type) -> dict[str, str]:
    """Return name → first sentence of what the section Attributes of a docstring says of it."""
    section = cleandoc(kind.__doc__ or "").partition("Attributes\n----------\n")[2]
    meanings: dict[str, str] = {}
    for names, text in re.findall(r"^(\w[\w, ]*)\n((?: +.*\n?|\n(?= ))+)", section, re.MULTILINE):
        words = re.sub(r"[`]", "", " ".join(text.split()))
        for name in names.split(", "):
            meanings[name] = re.split(r"(?<=\.) |(?<=[^.]); ", words)[0].rstrip(".") + "."
    return meanings


def _item_type(hint: Any) -> type | None:
    """Return the type of the items of a sequence; None for any other type."""
    if get_origin(hint) in (Union, UnionType):
        return next((item for part in get_args(hint) if (item := _item_type(part)) is not None), None)
    origin: Any = get_origin(hint)
    return get_args(hint)[0] if isinstance(origin, type) and issubclass(origin, Sequence) else None


def _split(text: str, item: type, name: str) -> tuple[Any, ...]:
    """Return the items of a text with commas between them."""
    try:
        return tuple(item(part.strip()) for part in text.split(",") if text)
    except ValueError as error:
        raise DataError(
            f"--{name.replace('_', '-')} is {text!r}; pass numbers with commas between them, such as 0,0.01"
        ) from error
