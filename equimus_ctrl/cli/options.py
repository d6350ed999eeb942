"""The fields of a verb's options as options of the command line."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields
from typing import Annotated, Any, TypeVar

import typer

from equimus_ctrl.options import OnCommandLine, offered

T = TypeVar("T")
Verb = Callable[..., None]


def with_options(kind: type[Any]) -> Callable[[Verb], Verb]:
    """Give a verb an option for each field that a class offers; it takes them together, as its argument ``options``.

    What is not given on the command line has the class's default.
    """

    def decorated(verb: Verb) -> Verb:
        offers = offered(kind)

        @functools.wraps(verb)
        def command(**given: Any) -> None:
            values = {name: given.pop(name) for name in offers}
            verb(options=filled(kind, values), **given)

        own = inspect.signature(verb, eval_str=True)
        parameters: list[inspect.Parameter] = []
        for parameter in own.parameters.values():
            more = _parameters(kind, offers) if parameter.name == "options" else [parameter]
            parameters += [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in more]
        command.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
        return command

    return decorated


def filled(kind: type[T], values: dict[str, Any]) -> T:
    """Options from what was given on the command line.

    Raises:
        ConfigError: for a value that cannot be.
    """
    offers = offered(kind)
    given = {name: value for name, value in values.items() if value is not None and value not in ([], ())}
    readers = {name: offers[name].read or (lambda value: value) for name in given}
    return kind(**{name: readers[name](value) for name, value in given.items()})


def _parameters(kind: type[Any], offers: dict[str, OnCommandLine]) -> list[inspect.Parameter]:
    defaults = {f.name: f.default for f in fields(kind)}
    return [_parameter(name, offer, defaults[name]) for name, offer in offers.items()]


def _parameter(name: str, offer: OnCommandLine, default: Any) -> inspect.Parameter:
    info = typer.Option(*offer.flags, help=offer.help, metavar=offer.metavar, show_default=offer.shown)
    plain = isinstance(default, bool | int | float | str) and default is not MISSING
    # Of a list or a table nothing given is None, and then the class says what that is.
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=default if plain else None,
        annotation=Annotated[offer.takes, info],
    )
