"""MJCF robots: reading and writing them, their recordings, and their parameters to estimate."""

from __future__ import annotations

from collections.abc import Mapping as Table
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl import presets
from equimus_ctrl.engines.predict import check_notes
from equimus_ctrl.engines.supposed import with_supposed
from equimus_ctrl.errors import ConfigError, ModelError, unknown_name
from equimus_ctrl.identification.parameters import default_bounds, default_names, matching, unit_of
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import LEG, Limits, Mapping, Wanted, read_mapping
from equimus_ctrl.recordings.sets import read_with_files
from equimus_ctrl.recordings.smoothing import smoothed
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.mjcf.editing import Edits, edited
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

FORMAT = "equimus-ctrl/parameters/1"
UNRECORDED = (
    "a joint that was not measured is held by --lock, or moves by itself with --unmeasured; an actuator that was not "
    "recorded is left out by --ignore"
)


def load_mjcf(path: Path, source: str | None = None, edits: Edits | None = None) -> MjcfRobot:
    """The MJCF robot of a file.

    Args:
        path: of the file.
        source: how a model file names it; by the file's name by default.
        edits: what is made of it, see there.

    Raises:
        ConfigError, ModelError: where it cannot be read, or is no robot of hinges and slides.
    """
    edits = edits or Edits()
    name, xml, assets = presets.read_mjcf(path)
    if edits:
        xml, edits = edited(path.name, xml, assets, edits)
    try:
        return MjcfRobot(name, xml, assets, source or path.name, edits)
    except ModelError as error:
        raise ModelError(f"{path}: {str(error).removeprefix(f'{name}: ')}") from None


def read_trials(
    files: Sequence[Path],
    robot: Robot,
    mapping: Mapping | Path | str | None = None,
    rotating: Sequence[str] = (),
) -> tuple[Recording, ...]:
    """Trials of a robot, see ``read_trials_with_files``."""
    return tuple(trial for _, trial in read_trials_with_files(files, robot, mapping, rotating))


def read_trials_with_files(
    files: Sequence[Path],
    robot: Robot,
    mapping: Mapping | Path | str | None = None,
    rotating: Sequence[str] = (),
) -> tuple[tuple[Path, Recording], ...]:
    """Trials of a robot, each with the file that it was read from, of any format that is known.

    These are pressures within a leg's limits, or any commands of its joints and actuators in its order.

    Args:
        files: they, or folders.
        robot: by whose names columns are found.
        mapping: what the columns of other formats than the project's are, or its file.
        rotating: hinges that turn without end, so that no angle of theirs is odd.

    Raises:
        EquimusError: where a file cannot be read or lacks one of them, or what rotates is no hinge of the robot.
    """
    read = _read(files, robot, mapping_of(mapping), rotating=rotating)
    return tuple((path, as_modelled(trial, robot)) for path, trial in read)


def mapping_of(given: Mapping | Path | str | None) -> Mapping | None:
    """A mapping, or the one in a file.

    Raises:
        ConfigError: where the file cannot be read.
    """
    return read_mapping(given) if isinstance(given, Path | str) else given


def wanted_of(robot: Robot) -> Wanted:
    """What the columns of a robot's recordings are called, and their units."""
    given, driven = robot.prescribed_columns, [robot.driven_joints(name) for name in robot.actuator_names]
    return Wanted(
        (*robot.joint_names, *given),
        robot.actuator_names,
        (*robot.joint_units, *("" for _ in given)),
        robot.command_units,
        robot.goals,
        tuple(next(iter(joints)) if len(joints) == 1 else "" for joints in driven),
    )


def suited(model: Model, files: Sequence[Path]) -> Model:
    """A model of a robot whose prescribed joints suit the motion in some files, see ``Robot.suited``."""
    if not files:
        return model

    def read() -> list[tuple[str, Array]]:
        columns = model.robot.prescribed_columns
        trials = [trial for _, trial in _read(files, model.robot)]
        return [(t.name, t.position[:, [t.joints.index(name) for name in columns]]) for t in trials]

    return replace(model, robot=model.robot.suited(read))


def read_recorded(
    files: Sequence[Path], robot: Robot, mapping: Mapping | Path | str | None = None, pressures: Limits = LEG
) -> tuple[Recording, ...]:
    """Trials of a robot as they were recorded, the columns of joints whose motion is prescribed among them.

    Args:
        files: they, or folders.
        robot: by whose names columns are found.
        mapping: what the columns of other formats than the project's are, or its file.
        pressures: what may stand in recordings of a robot whose commands are pressures.

    Raises:
        EquimusError: where a file cannot be read or lacks one of them.
    """
    return tuple(trial for _, trial in _read(files, robot, mapping_of(mapping), pressures))


def _read(
    files: Sequence[Path],
    robot: Robot,
    mapping: Mapping | None = None,
    pressures: Limits = LEG,
    rotating: Sequence[str] = (),
) -> tuple[tuple[Path, Recording], ...]:
    """Trials as they were recorded, each with its file."""
    wanted = wanted_of(robot)
    if robot.traits.commands_are_pressures:
        return read_with_files(
            files, wanted=wanted, mapping=mapping, limits=replace(pressures, rotating=(*pressures.rotating, *rotating))
        )
    joints, actuators, given = robot.joint_names, robot.actuator_names, robot.prescribed_columns
    columns = [*joints, *(name for name in robot.prescribed_names if name in given)]
    every = [name for name in columns if not robot.slides(name)]
    for name in rotating:
        if name not in every:
            raise ConfigError(unknown_name("hinge", name, every, "--rotating"))
    hinges = [name for name in every if name not in rotating]
    limits = Limits.of_mjcf(joints, actuators, hinges, UNRECORDED, given)
    return read_with_files(
        files, joints=(*joints, *given), actuators=actuators, limits=limits, wanted=wanted, mapping=mapping
    )


def as_modelled(trial: Recording, robot: Robot) -> Recording:
    """A trial with how prescribed joints moved, and unmeasured ones may have moved.

    Raises:
        ConfigError: where that cannot be made of it.
    """
    check_notes(robot, trial)
    return with_supposed(with_prescribed(trial, robot), robot)


def with_prescribed(trial: Recording, robot: Robot) -> Recording:
    """A trial in which the positions of joints whose motion is prescribed are that motion, and no measurements.

    Raises:
        ConfigError: where it cannot be made of them.
    """
    columns = robot.prescribed_columns
    if not columns or trial.prescribed is not None or not set(columns) <= set(trial.joints):
        return trial
    given = trial.position[:, [trial.joints.index(name) for name in columns]]
    kept = [j for j, name in enumerate(trial.joints) if name not in columns]
    inputs = {f"pos.{name}": trial.position[:, trial.joints.index(name)] for name in columns}
    if trial.velocity is not None:
        rates = ((name, trial.velocity[:, trial.joints.index(name)]) for name in columns)
        inputs |= {f"vel.{name}": rate for name, rate in rates if not np.isnan(rate).all()}
    velocity = None if trial.velocity is None else trial.velocity[:, kept]
    if velocity is not None and np.isnan(velocity).all():
        velocity = None  # that of prescribed joints alone was measured
    return replace(
        trial,
        position=trial.position[:, kept],
        joints=tuple(trial.joints[j] for j in kept),
        velocity=velocity,
        inputs=inputs,
        prescribed=smoothed(
            trial.name, robot.prescribed_names, trial.time, robot.prescribed_positions(trial.name, given)
        ),
    )


@dataclass(frozen=True)
class FreeParameterFile:
    """What a file of free parameters says.

    Attributes:
        names: names or patterns of what is free; None where nothing is said.
        bounds: (low, high) of some.
    """

    names: tuple[str, ...] | None = None
    bounds: Table[str, tuple[float, float]] = field(default_factory=dict)

    def with_more(
        self, free: Sequence[str] | None, bounds: Table[str, tuple[float, float]] | None
    ) -> tuple[list[str] | None, dict[str, tuple[float, float]]]:
        """These names and more; of bounds those that are given here win."""
        names = None if self.names is None and free is None else [*(self.names or ()), *(free or ())]
        return names, {**self.bounds, **(bounds or {})}


def read_free(path: Path, model: Model) -> FreeParameterFile:
    """The parameters to estimate, from a file such as ``offer`` writes.

    Raises:
        ConfigError: where the file says nothing that can be.
    """
    data = presets.read_toml(path)
    for key in data:
        if key not in ("format", "free"):
            raise ConfigError(unknown_name("key", key, ("format", "free"), str(path)))
    if data.get("format", FORMAT) != FORMAT:
        raise ConfigError(f"{path}: format is {data['format']!r}, expected {FORMAT!r}")
    table = data.get("free")
    if not isinstance(table, Table) or not table:
        raise ConfigError(f'{path}: there is no [free] table of names, such as "arm.mass" = [0.4, 0.8]')
    names: list[str] = []
    bounds: dict[str, tuple[float, float]] = {}
    kept: set[str] = set()
    for name, value in table.items():
        if isinstance(value, Table):
            raise ConfigError(f'{path}: free: put a dotted name in quotes, such as "{name}.…" = true')
        try:
            found = matching(model, [name])
        except ConfigError as error:
            raise ConfigError(f"{path}: free: {error}") from None
        if value is False:
            kept.update(found)
            continue
        names += found
        if value is not True:
            bounds.update(dict.fromkeys(found, _bounds(value, f"{path}: free: {name}")))
    free = [name for name in dict.fromkeys(names) if name not in kept]
    if not free:
        raise ConfigError(f"{path}: free: everything is false, so nothing is free")
    return FreeParameterFile(tuple(free), {name: own for name, own in bounds.items() if name in free})


def _bounds(value: Any, where: str) -> tuple[float, float]:
    pair = isinstance(value, list) and len(value) == 2
    if not pair or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
        raise ConfigError(f"{where} is {value!r}, expected true, false or [low, high]")
    return float(value[0]), float(value[1])


def parameter_rows(model: Model) -> list[dict[str, Any]]:
    """Every parameter of a model: name, value, unit, bounds, and whether it is free by default."""
    free = set(default_names(model))
    rows = []
    for name, value in model.parameters().items():
        low, high = default_bounds(model, name)
        rows.append(
            {"name": name, "value": value, "unit": unit_of(model, name), "low": low, "high": high, "free": name in free}
        )
    return rows


def offer(path: Path, model: Model) -> None:
    """Write a file of free parameters: those that are by default with their bounds, all others as false."""
    rows = parameter_rows(model)
    table = {row["name"]: [row["low"], row["high"]] if row["free"] else False for row in rows}
    comment = (
        f"Parameters of {model.name} to estimate: [low, high], true for the bounds of their kind, false for fixed.\n"
        "In SI units; for --parameters of equimus-ctrl identify and diagnose."
    )
    presets.write_text(path, presets.toml_text({"format": FORMAT, "free": table}, comment))
