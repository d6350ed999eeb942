"""Help for people: a flag takes no value, so none is named, and the value of an option is not a type of Python."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from typer.core import TyperCommand, TyperGroup

if TYPE_CHECKING:
    from typing import Any


VALUES = {"str": "TEXT", "int": "INTEGER", "float": "NUMBER", "path": "PATH"}
"""Type of an option's value, or of each of several → its name in help."""


def _bare(parameters: list[Any], ctx: Any) -> list[Any]:
    for own in parameters:
        if own.param_type_name == "argument":
            named = _named(own, ctx) or own.display_type(ctx).strip("<>")
            own.display_type_rich = partial(_always, named)  # a metavar would stand in the place of its name
        elif own.metavar is None:
            own.metavar = "" if getattr(own, "is_flag", False) else _named(own, ctx)
    return parameters


def _named(own: Any, ctx: Any) -> str | None:
    return VALUES.get(own.display_type(ctx).strip("<>").lower().removeprefix("list[").removesuffix("]"))


def _always(named: str, ctx: Any) -> str:
    return named


def _flowing(text: str) -> str:
    r"""Paragraphs without the ends of lines that they have in the source; those of examples, after a \b, stay."""
    parts = text.split("\n\n")
    return "\n\n".join(part if part.lstrip().startswith("\b") else " ".join(part.split()) for part in parts)


class Command(TyperCommand):
    """A verb."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.help = _flowing(self.help) if self.help else self.help

    def get_params(self, ctx: Any) -> list[Any]:
        """Its parameters, ``--help`` among them."""
        return _bare(super().get_params(ctx), ctx)


class Group(TyperGroup):
    """Verbs under one name."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Its parameters, ``--help`` among them."""
        return _bare(super().get_params(ctx), ctx)
