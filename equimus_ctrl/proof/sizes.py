"""The tables of sizes that a proof draws from, as the effects' classes hold them; see ``effects.sizes``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from equimus_ctrl.effects.base import REGISTRY, Effect, Robots
from equimus_ctrl.effects.excitation import Excitation
from equimus_ctrl.effects.sizes import Size
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.outside import OUTSIDE

Table = Mapping[str, Sequence[Size]]
"""Name of an effect → what its parameters are drawn from."""


def known() -> dict[str, type[Effect]]:
    """Name → class of all effects, of the catalogue and from outside it."""
    return {**REGISTRY, **OUTSIDE}


def drawn(robots: Robots, among: Mapping[str, type[Effect]] = REGISTRY) -> list[str]:
    """Names of the effects that a proof draws for a kind of robots: for all with elastic actuators those of the leg."""
    sizes = {name: cls.leg_sizes if robots == "elastic" else cls.mjcf_sizes for name, cls in among.items()}
    return sorted(name for name, own in sizes.items() if own)


def leg_table() -> dict[str, tuple[Size, ...]]:
    """The table for the nominal leg: of the catalogue and of what is outside it."""
    return {name: cls.leg_sizes for name, cls in known().items() if cls.leg_sizes}


def mjcf_table(model: Model, excitation: Mapping[str, Excitation]) -> dict[str, tuple[Size, ...]]:
    """The table for an MJCF robot.

    Args:
        model: of the robot.
        excitation: what its recordings show of each place.
    """
    found = {}
    for name, cls in known().items():
        where = cls.places_on(model.robot)
        info = cls.parameter_info()
        found[name] = tuple(
            share.size(info[share.parameter]["unit"], excitation[place], place)
            for place in dict.fromkeys(place for kind in cls.sits_at for place in where[kind])
            for share in cls.mjcf_sizes
        )
    return {name: sizes for name, sizes in found.items() if sizes}


def measured_by(size: Size, effect: type[Effect], true: float) -> tuple[float, float | None]:
    """(what an error is relative to, where the effect does nothing), see ``estimates.measure_of``."""
    info = effect.parameter_info()
    if size.law == "linear" and info[size.parameter]["unit"] in ("rad", "m"):
        return size.high - size.low, None
    zero = (effect.grows_from() if size.parameter == next(iter(info)) else None) or 0.0
    return abs(true - zero), zero


def size_of(table: Table, effect: str, parameter: str, kind: str, location: str) -> Size:
    """What a parameter of an effect is drawn from at a place.

    Raises:
        ConfigError: where the table has nothing for it, or more than one size.
    """
    own = [size for size in table.get(effect, ()) if size.parameter == parameter]
    found = [size for size in own if size.at in ("", kind, location)]
    if len(found) != 1:
        raise ConfigError(
            f"effect {effect} has {len(found)} sizes for {parameter!r} at {location!r}, of which a proof draws it; "
            "expected one"
        )
    return found[0]
