"""The fields of a verb's options as options of the command line."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, TypeVar

import typer

from equimus_ctrl.options import OnCommandLine, offered

T = TypeVar("T")
Verb = Callable[..., None]


def with_options(verb: Verb) -> Verb:
    """Give a verb an option for each field that the class of one of its arguments offers, in that argument's place.

    The verb takes them together, as an instance of the class. What is not given on the command line has the class's
    default.
    """
    own = inspect.signature(verb, eval_str=True)
    kinds = {p.name: p.annotation for p in own.parameters.values() if _offers(p.annotation)}

    @functools.wraps(verb)
    def command(**given: Any) -> None:
        from equimus_ctrl.quiet import quietly

        made = {key: filled(kind, {name: given.pop(name) for name in offered(kind)}) for key, kind in kinds.items()}
        with quietly():  # whatever a model makes MuJoCo warn of is told in a sentence, if it matters
            verb(**made, **given)

    parameters: list[inspect.Parameter] = []
    for parameter in own.parameters.values():
        more = _parameters(parameter.annotation) if parameter.name in kinds else [parameter]
        parameters += [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in more]
    command.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    return command


def _offers(annotation: Any) -> bool:
    return isinstance(annotation, type) and is_dataclass(annotation) and bool(offered(annotation))


def filled(kind: type[T], values: dict[str, Any]) -> T:
    """Options from what was given on the command line.

    Raises:
        ConfigError: for a value that cannot be.
    """
    offers = offered(kind)
    given = {name: value for name, value in values.items() if value is not None and value not in ([], ())}
    readers = {name: offers[name].read or (lambda value: value) for name in given}
    return kind(**{name: readers[name](value) for name, value in given.items()})


def _parameters(kind: type[Any]) -> list[inspect.Parameter]:
    defaults = {f.name: f.default for f in fields(kind)}
    return [_parameter(name, offer, defaults[name]) for name, offer in offered(kind).items()]


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
