"""What can be named: scenarios, controllers, plants, effects, models, parameters and thresholds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.frames import dataframe
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.shown import Short, listed

if TYPE_CHECKING:
    from pandas import DataFrame

Kind = Literal["scenarios", "controllers", "plants", "effects", "models", "parameters", "thresholds"]
KINDS: tuple[str, ...] = get_args(Kind)
GROUPS = {
    ("command", "actuator"): "Between command and actuator: valves and drives",
    ("command", "base"): "Supply of all actuators",
    ("force", "actuator"): "Forces of actuators",
    ("force", "joint"): "Joints: friction, damping, springs, stops, transmission",
    ("force", "link"): "Links: payloads, tethers, contacts",
    ("force", "base"): "The whole robot",
    ("measurement", "joint"): "Sensors",
}
"""Side and place of effects → heading, in the order of lists; a foot is a link's end."""


@dataclass(frozen=True, eq=False, repr=False)
class Listing(Short):
    """What can be named, of one kind.

    Attributes:
        kind: one of ``KINDS``.
        rows: ``name``, ``summary`` and what else there is to say of each.
    """

    kind: str
    rows: tuple[Mapping[str, Any], ...]

    def told(self) -> str:
        """How many."""
        return f" of {listed(self.names, self.kind.removesuffix('s'))}"

    @property
    def names(self) -> tuple[str, ...]:
        """Of all."""
        return tuple(row["name"] for row in self.rows)

    def to_dict(self) -> dict[str, Any]:
        """What ``list --json`` prints."""
        return {self.kind: [dict(row) for row in self.rows]}

    def to_dataframe(self) -> DataFrame:
        """A row for each.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        return dataframe(self.rows, "name")


def list_names(kind: str, model: Model | None = None) -> Listing:
    """What can be named: on the command line, in model files, in a program.

    Args:
        kind: ``"scenarios"``, ``"controllers"``, ``"plants"``, ``"effects"`` (grouped by where they act), ``"models"``,
            ``"parameters"`` or ``"thresholds"``.
        model: whose parameters; the nominal leg by default.

    Raises:
        ConfigError: for another kind, or a model where it has no part.
    """
    if kind not in KINDS:
        raise ConfigError(unknown_name("kind of names", kind, KINDS))
    if kind == "parameters":
        return Listing(kind, tuple(_parameters(model or nominal_model())))
    if model is not None:
        raise ConfigError(f"a model is for parameters, not for {kind}")
    return Listing(kind, tuple(ROWS[kind]()))


def _parameters(model: Model) -> list[dict[str, Any]]:
    from equimus_ctrl.workflow.mjcf import parameter_rows

    rows = parameter_rows(model)
    for row in rows:
        free = f", free by default from {row['low']:g} to {row['high']:g}" if row["free"] else ""
        row["summary"] = f"{row['value']:g} {'' if row['unit'] == '1' else row['unit']}".rstrip() + free
    return rows


def _scenarios() -> list[dict[str, Any]]:
    from equimus_ctrl.workflow.runs import listed_scenarios

    return listed_scenarios()


def _controllers() -> list[dict[str, Any]]:
    from equimus_ctrl.controllers.registry import CONTROLLERS

    rows: list[dict[str, Any]] = [
        {"name": name, "summary": entry.summary, "settings": entry.settings, "compared": entry.compared}
        for name, entry in CONTROLLERS.items()
    ]
    own = {"summary": "your own, a class or a function", "settings": None, "compared": False}
    return [*rows, {"name": "path/to/file.py:Name", **own}]


def _plants() -> list[dict[str, Any]]:
    from equimus_ctrl.plants.registry import PLANTS

    return [
        {"name": name, "summary": entry.summary, "real": entry.real, "effects": entry.effects}
        for name, entry in PLANTS.items()
    ]


def _models() -> list[dict[str, Any]]:
    from equimus_ctrl.robots.elastic.leg import MORPHOLOGIES

    return [{"name": name, "summary": (make.__doc__ or "").strip()} for name, make in MORPHOLOGIES.items()]


def _effects() -> list[dict[str, Any]]:
    from equimus_ctrl.effects import REGISTRY

    rows: list[dict[str, Any]] = [
        {
            "name": name,
            "summary": f"{cls.summary} (at {' or '.join(cls.sits_at)}, {cls.side} side{_whose(cls.robots)})",
            "group": _group(cls.side, cls.sits_at),
            "robots": list(cls.robots),
            "sits_at": list(cls.sits_at),
            "side": cls.side,
            "parameters": {
                key: f"{key} [{info['unit']}] {info['low']:g} to {info['high']:g}: {info['doc']}"
                for key, info in cls.parameter_info().items()
            },
        }
        for name, cls in sorted(REGISTRY.items())
    ]
    order = list(dict.fromkeys([*GROUPS.values(), *(row["group"] for row in rows)]))
    return sorted(rows, key=lambda row: order.index(row["group"]))


def _group(side: str, places: Sequence[str]) -> str:
    """The heading under which an effect is listed, one of somebody's own at a place where none of ours is too."""
    place = "link" if {"link", "foot"} & set(places) else places[0]
    return GROUPS.get((side, place), f"Other effects on the {side} side")


def _thresholds() -> list[dict[str, Any]]:
    from equimus_ctrl.diagnosis.thresholds import Thresholds
    from equimus_ctrl.preflight.limits import CheckLimits

    asked = [("diagnosis", t.name, t) for t in Thresholds.listed()]
    asked += [("preflight", f"check.{t.name}", t) for t in CheckLimits.listed()]
    return [
        {
            "name": name,
            "summary": f"{t.value:g} {t.unit}".rstrip() + f": {t.meaning}",
            "parameters": {"origin": f"{t.origin.basis}: {t.origin.why}", "asked by": _asked_by(folder, t.where)},
            "value": t.value,
            "unit": t.unit,
        }
        for folder, name, t in asked
    ]


ROWS: Mapping[str, Callable[[], list[dict[str, Any]]]] = {
    "scenarios": _scenarios,
    "controllers": _controllers,
    "plants": _plants,
    "effects": _effects,
    "models": _models,
    "thresholds": _thresholds,
}
"""Kind → its rows."""


def _asked_by(folder: str, modules: Sequence[str]) -> str:
    return "asked by " + ", ".join(f"{folder}/{module}.py" for module in modules)


def _whose(robots: tuple[str, ...]) -> str:
    if "mjcf" not in robots:
        return ""
    return ", also MuJoCo's XML" if "elastic" in robots else ", MuJoCo's XML alone"
