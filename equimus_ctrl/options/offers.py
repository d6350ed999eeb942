"""What makes a field of a frozen class an option of the command line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, TypeVar

from equimus_ctrl.errors import ConfigError, unknown_name

T = TypeVar("T")


@dataclass(frozen=True)
class OnCommandLine:
    """How the command line offers a field.

    Attributes:
        takes: type of what is given there.
        help: the line of help.
        flags: names of the option; by default the field's own with two dashes.
        metavar: what stands for its value in the help.
        read: makes the field's value of what is given.
        shown: whether the help shows the default.
    """

    takes: Any
    help: str
    flags: tuple[str, ...] = ()
    metavar: str | None = None
    read: Callable[[Any], Any] | None = None
    shown: bool = True


def option(
    default: Any,
    takes: Any,
    help: str,
    *flags: str,
    metavar: str | None = None,
    read: Callable[[Any], Any] | None = None,
    shown: bool = True,
) -> Any:
    """A field that the command line offers; see ``OnCommandLine``."""
    return field(default=default, metadata={"offer": OnCommandLine(takes, help, flags, metavar, read, shown)})


def offered(options: type[Any]) -> dict[str, OnCommandLine]:
    """Fields of a class that the command line offers, in their order."""
    return {f.name: f.metadata["offer"] for f in fields(options) if "offer" in f.metadata}


def with_changes(kind: type[T], options: T | None, changes: Mapping[str, Any]) -> T:
    """Options, by default those of the class, with other values of some fields.

    Raises:
        ConfigError: for options of another verb, a name that is no field, or a value that cannot be.
    """
    if options is not None and not isinstance(options, kind):
        raise ConfigError(f"options are {type(options).__name__}, expected {kind.__name__}")
    known = [f.name for f in fields(kind)]  # type: ignore[arg-type]
    for name in changes:
        if name not in known:
            raise ConfigError(unknown_name("option", name, known))
    return replace(options if options is not None else kind(), **changes)  # type: ignore[type-var]
