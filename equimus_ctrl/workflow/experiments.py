"""Experiments that tell the explanations of a diagnosis apart: designed, and written for ``run commands``."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from equimus_ctrl import outputs, presets
from equimus_ctrl.diagnosis.budget import Budget
from equimus_ctrl.diagnosis.results import SCHEMA, Diagnosis
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.experiments.conditions import known_conditions
from equimus_ctrl.experiments.design import Progress, designed
from equimus_ctrl.experiments.families import families
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.experiments.results import Designed
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import DesignOptions, with_changes
from equimus_ctrl.recordings.commands import CommandFile, write_commands
from equimus_ctrl.robots.base import Robot

COMMANDS, RECORD = "design.csv", "design.json"
"""Files of a design."""


def design_experiment(
    diagnosed: Path | str | Mapping[str, Any] | Diagnosis | Rivals,
    model: Model | None = None,
    options: DesignOptions | None = None,
    *,
    progress: Progress = lambda stage, share: None,
    asked: Callable[[], bool] = lambda: False,
    **changes: Any,
) -> Designed:
    """Commands within limits under which the explanations that a diagnosis leaves differ most, and what they will show.

    Args:
        diagnosed: a diagnosis, its record as a file, a folder with it or a table, or the rivals themselves.
        model: the nominal one that was diagnosed; the nominal leg by default.
        options: see ``DesignOptions``.
        progress: called with the stage, and its share that is done.
        asked: whether the best so far is to be designed now.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where something given cannot be used, one explanation alone is left, or nothing within the limits
            moves the robot.
    """
    options = with_changes(DesignOptions, options, changes)
    rivals = rivals_in(diagnosed, model)
    budget = Budget.beginning_now(options.budget, asked)
    return designed(
        rivals,
        limits_for(options, rivals.model.robot),
        conditions=known_conditions(options.can, rivals.model),
        over_families=families(options.family),
        seed=options.seed,
        evaluations=options.evaluations,
        over=lambda: budget.over,
        draws=options.draws,
        noises=options.sensor_noise,
        track=options.track,
        simulator=rivals.simulator(options.threads),
        progress=progress,
    )


def limits_for(options: DesignOptions, robot: Robot) -> Limits:
    """What a design must not leave.

    Raises:
        ConfigError: for a file or a limit that cannot be.
    """
    given = dict(options.limit or {})
    if options.duration is not None:
        given["duration"] = repr(options.duration)
    data = None if options.limits is None else presets.read_toml(options.limits)
    return Limits.read(robot, data, given, str(options.limits or "limits"))


def rivals_in(diagnosed: Path | str | Mapping[str, Any] | Diagnosis | Rivals, model: Model | None = None) -> Rivals:
    """The explanations that a diagnosis leaves.

    Args:
        diagnosed: see ``design_experiment``.
        model: the nominal one, of a record.

    Raises:
        ConfigError: for a file that is no record of a diagnosis, or one of another robot.
    """
    if isinstance(diagnosed, Rivals):
        return diagnosed
    if isinstance(diagnosed, Diagnosis):
        return diagnosed.rivals
    where, data = "the record", diagnosed
    if isinstance(data, str | Path):
        path = Path(data)
        path = path / "record.json" if path.is_dir() else path
        where, data = str(path), _record_of(path)
    if data.get("schema") != SCHEMA or not isinstance(data.get("rivals"), Mapping):
        raise ConfigError(
            f"{where}: is no record of a diagnosis that holds the explanations left; expected {SCHEMA} with rivals, as "
            "diagnose --report DIR writes it into DIR/record.json"
        )
    try:
        return Rivals.from_dict(data["rivals"], model or nominal_model())
    except (KeyError, TypeError, IndexError, ValueError) as error:
        raise ConfigError(f"{where}: its rivals cannot be read ({type(error).__name__}: {error})") from None


def _record_of(path: Path) -> Mapping[str, Any]:
    try:
        found = json.loads(presets.read_bytes(path))
    except ValueError as error:
        raise ConfigError(f"{path}: is no JSON ({error}); expected the record of a diagnosis") from None
    if not isinstance(found, Mapping):
        raise ConfigError(f"{path}: is no record of a diagnosis, expected a table")
    return found


@dataclass(frozen=True)
class DesignFiles:
    """Where a design was written.

    Attributes:
        commands: for ``run commands``.
        record: JSON.
        figures: PNG.
    """

    commands: Path
    record: Path
    figures: tuple[Path, ...] = ()

    @property
    def all(self) -> tuple[Path, ...]:
        """Every file."""
        return (self.commands, *self.figures, self.record)


def write_design(
    found: Designed,
    folder: Path | str | None = None,
    *,
    force: bool = False,
    figures: bool = True,
    model_options: Sequence[str] = (),
) -> DesignFiles:
    """Write the commands, ``design.json`` and figures into a new folder.

    Args:
        found: the design.
        folder: where; by default one of the robot's name, with the next free number.
        force: whether what an earlier design wrote there is replaced.
        figures: whether they are drawn.
        model_options: by which the model is chosen on the command line, for the commands in the record.

    Raises:
        ConfigError: where the folder holds earlier results, or cannot be written to.
    """
    default = default_folder(found.rivals.model)
    results = outputs.Results(None if folder is None else Path(folder), force, default)
    drawn: dict[str, bytes] = {}
    if figures:
        from equimus_ctrl.report import style
        from equimus_ctrl.report.experiment_figures import design_drawings

        drawn = {f"{name}.png": style.png(figure) for name, figure in style.drawn(design_drawings(found)).items()}
    own = results.opened(default)
    path = own / COMMANDS
    robot = found.rivals.model.robot
    write_commands(path, robot.actuator_names, command_file(found), robot.joint_names)
    for name, data in drawn.items():
        presets.write_bytes(own / name, data)
    pictures = tuple(own / name for name in drawn)
    record = {**found.to_dict(), "commands": COMMANDS, "run": run_command(path, model_options)}
    written = outputs.write_record(own, RECORD, record, [path, *pictures])
    return DesignFiles(path, written, pictures)


def default_folder(model: Model) -> Path:
    """Where designs for a robot go."""
    return presets.workspace() / "results" / "experiment" / presets.plain_name(model.name)


def command_file(found: Designed) -> CommandFile:
    """The commands of a design as a file holds them, or what is fed forward, the reference and the law."""
    own = found.commands
    return CommandFile(
        own.times, own.commands, own.commands[0], own.start, found.rivals.linear, dict(found.condition.notes),
        own.reference, own.law,
    )  # fmt: skip


def run_command(path: Path, model_options: Sequence[str] = (), record: str = "designed") -> str:
    """The command line that plays a design."""
    words = ["equimus-ctrl", "run", "commands", "--set", f"file={path}", *model_options, "--record", record]
    return shlex.join(words)
