"""Each parameter of a docstring has its own type in the reference, also where several are described in one line.

Griffe gives `cost, limits` the type of the first name; this extension of Griffe reads each from the signature.
"""

from typing import Any

import griffe


class OwnAnnotations(griffe.Extension):
    """Sets the annotation of each documented parameter to that of the signature."""

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Mend the docstring of a function."""
        _mend(func)

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Mend the docstrings of classes, whose parameters are known once the package is loaded."""
        stack: list[Any] = [pkg]
        while stack:
            found = stack.pop()
            if found.is_class:
                _mend(found)
            stack += [member for member in found.members.values() if not member.is_alias and hasattr(member, "members")]


def _mend(found: Any) -> None:
    if found.docstring is None:
        return
    for section in found.docstring.parsed:
        if section.kind is griffe.DocstringSectionKind.parameters:
            for each in section.value:
                if each.name in found.parameters:
                    each.annotation = found.parameters[each.name].annotation
