"""A user's own controller: a class with ``init`` and ``step``, or one function."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from numpy.typing import ArrayLike

from equimus_ctrl.errors import FAILURES, ControllerError, EquimusError
from equimus_ctrl.types import Controller, Observation, PlantSpec, Reference


@dataclass(frozen=True)
class FunctionController:
    """A stateless controller made of a function.

    Attributes:
        function: (observation, reference) or (observation, reference, spec) → pressures (na,) [Pa].
        name: shown in tables.
    """

    function: Callable[..., ArrayLike]
    name: str = "function"

    @property
    def senses(self) -> Any:
        """What the function says that it needs beside positions, by an attribute of this name."""
        return getattr(self.function, "senses", ())

    def init(self, spec: PlantSpec, observation: Observation) -> PlantSpec:
        """The state is the plant's spec."""
        return spec

    def step(self, observation: Observation, reference: Reference, state: PlantSpec) -> tuple[ArrayLike, PlantSpec]:
        """The function's command."""
        if _wants_spec(self.function):
            return self.function(observation, reference, state), state
        return self.function(observation, reference), state


def _accepts(function: Callable[..., Any], count: int) -> bool:
    """Whether a function can be called with ``count`` positional arguments."""
    try:
        inspect.signature(function).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # a built-in without a signature
        return count == 2
    return True


def _wants_spec(function: Callable[..., Any]) -> bool:
    """Whether a function needs the spec, rather than having a default in the third place."""
    return not _accepts(function, 2)


def as_controller(thing: Any, name: str) -> Controller:
    """A controller from a class, an instance or a function.

    Raises:
        ControllerError: where it is none of these, or a class that cannot be made without arguments.
    """
    if inspect.isclass(thing):
        try:
            inspect.signature(thing).bind()
        except TypeError as error:
            raise ControllerError(f"{name}: the class cannot be made without arguments ({error})") from None
        except ValueError:  # a built-in without a signature
            pass
        try:
            thing = thing()
        except EquimusError:
            raise
        except FAILURES as error:
            raise ControllerError(f"{name}: fails when it is made: {type(error).__name__}: {error}") from error
    if callable(getattr(thing, "init", None)) and callable(getattr(thing, "step", None)):
        controller: Controller = thing
        return controller
    if callable(thing):
        if _accepts(thing, 2) or _accepts(thing, 3):
            return FunctionController(thing, name)
        count = len(inspect.signature(thing).parameters)
        raise ControllerError(
            f"{name}: a controller function takes (observation, reference) or (observation, reference, spec), "
            f"this one takes {count} parameters"
        )
    raise ControllerError(f"{name}: {type(thing).__name__} is neither a class with init and step nor a function")
