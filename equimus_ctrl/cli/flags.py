"""Help in which a flag looks like a flag: it takes no value, so none is named."""

from __future__ import annotations

from typing import TYPE_CHECKING

from typer.core import TyperCommand, TyperGroup

if TYPE_CHECKING:
    from typing import Any


def _bare(parameters: list[Any]) -> list[Any]:
    for own in parameters:
        if getattr(own, "is_flag", False) and own.metavar is None:
            own.metavar = ""
    return parameters


class Command(TyperCommand):
    """A verb."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Its parameters, ``--help`` among them."""
        return _bare(super().get_params(ctx))


class Group(TyperGroup):
    """Verbs under one name."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Its parameters, ``--help`` among them."""
        return _bare(super().get_params(ctx))
