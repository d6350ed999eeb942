"""An extension of griffe: in signatures stands what a field's default is, not the call that makes the field."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Iterator
from typing import Any

import griffe

PACKAGE = "equimus_ctrl"


class RealDefaults(griffe.Extension):  # type: ignore[misc]
    """Before griffe makes signatures of dataclasses from their fields."""

    def on_package(self, *, pkg: griffe.Module, **kwargs: Any) -> None:
        """Of a package that was read."""
        if pkg.name != PACKAGE:
            return
        for cls in _classes(pkg):
            made = {name: member for name, member in cls.members.items() if _is_made(member)}
            if not made:
                continue
            own = getattr(importlib.import_module(cls.module.path), cls.name)
            for field in dataclasses.fields(own) if dataclasses.is_dataclass(own) else ():
                if field.name in made:
                    made[field.name].value = _default(field)


def _classes(module: griffe.Module) -> Iterator[griffe.Class]:
    for member in module.members.values():
        if member.is_alias:
            continue
        if member.is_module:
            yield from _classes(member)
        elif member.is_class:
            yield member


def _is_made(member: Any) -> bool:
    """Whether a function of this package makes the field, such as ``option`` and ``parameter``."""
    if member.is_alias or not member.is_attribute or not isinstance(member.value, griffe.ExprCall):
        return False
    path = member.value.canonical_path
    return path.startswith(f"{PACKAGE}.") and path.rpartition(".")[2].islower()


def _default(field: dataclasses.Field[Any]) -> str | None:
    """As source; None for a field that has to be given."""
    if field.default_factory is not dataclasses.MISSING:
        return f"{field.default_factory.__name__}()"
    return None if field.default is dataclasses.MISSING else repr(field.default)
