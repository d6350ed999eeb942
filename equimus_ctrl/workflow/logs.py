"""Logs in and out: recordings of any format read, and written with what models predict of them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from collections.abc import Mapping as Table
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equimus_ctrl import outputs, presets
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.predict import check_columns, predict
from equimus_ctrl.errors import ConfigError, RecordingError
from equimus_ctrl.models.model import Model, model_from_dict, nominal_model
from equimus_ctrl.recordings import (
    Exported,
    Limits,
    Mapping,
    Prediction,
    Summary,
    fetch,
    formats,
    read_set,
    summarise,
    write_set,
)
from equimus_ctrl.recordings.bags import write_bag
from equimus_ctrl.recordings.csvfile import notes_of
from equimus_ctrl.recordings.layouts import foxglove, plotjuggler
from equimus_ctrl.recordings.mapping import si_unit
from equimus_ctrl.recordings.mcapfile import mcap_library, write_mcap
from equimus_ctrl.recordings.rerunfile import rerun_library, write_rerun
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.mjcf import load_mjcf, mapping_of, read_recorded, wanted_of
from equimus_ctrl.workflow.scores import gather

if TYPE_CHECKING:
    from equimus_ctrl.options import Some

NOMINAL, REFITTED, AUGMENTED = "nominal", "refitted", "augmented"
LAYOUTS = (".foxglove.json", ".plotjuggler.xml")
"""What layouts beside an MCAP file end with."""
SUFFIXES = (".mcap", ".rrd")
"""Of files that hold trials and predictions."""


def read_recording(
    path: Path | str,
    model: Model | None = None,
    mapping: Mapping | Path | str | None = None,
    *,
    trial: str | None = None,
) -> Recording:
    """The trial in a file of any format that is known: CSV, npz, parquet, MCAP, rosbag2, LeRobot, PACE, BAM.

    It is as it was recorded: what a model takes as its input, such as the motion of prescribed joints, whoever compares
    the two makes of it.

    Args:
        path: the file, or the folder of a bag or a dataset.
        model: of the robot, by whose names columns are found and whose limits hold; without one the file has to name
            its columns as a recording does, or a mapping has to.
        mapping: what the file's columns are, or the TOML file that says it, see ``recordings.mapping``.
        trial: name of the one wanted, of a file that has several.

    Raises:
        EquimusError: where the file cannot be read, has no such trial, or several and none is named.
    """
    if model is None:
        limits = Limits(-float("inf"), float("inf"), float("inf"), joints=(), actuators=(), max_interval=float("inf"))
        trials = list(read_set(Path(path), limits=limits, wanted=None, mapping=mapping_of(mapping)))
    else:
        trials = list(read_recorded([Path(path)], model.robot, mapping))
    names = [own.name for own in trials]
    if trial is None and len(trials) == 1:
        return trials[0]
    if trial is None or trial not in names:
        shown = ", ".join(names[:12]) + ", …" * (len(names) > 12)
        raise RecordingError(f"{path}: there is no trial {trial!r} (known: {shown}); expected one of them as trial")
    return trials[names.index(trial)]


def read_recordings(
    recordings: Some, model: Model | None = None, mapping: Mapping | Path | str | None = None
) -> tuple[Recording, ...]:
    """The trials of files and folders, of any format that is known.

    Args:
        recordings: files, folders or trials.
        model: of the robot, by whose names columns are found and whose limits hold; the leg's formats without one.
        mapping: what the columns of files of other formats are, or its file, see ``recordings.mapping``.

    Raises:
        EquimusError: where one cannot be read.
    """
    return tuple(gather(recordings, model, mapping))


def check_recordings(
    recordings: Some,
    model: Model | None = None,
    mapping: Mapping | Path | str | None = None,
    *,
    rotating: Sequence[str] = (),
) -> tuple[Summary, ...]:
    """What recordings hold: duration, rate, jitter and ranges of each trial; what is odd is warned of.

    ``check`` says what they could show of a model.

    Args:
        recordings: files, folders or trials.
        model: see ``read_recordings``.
        mapping: see ``read_recordings``.
        rotating: joints that turn without end, so that no angle of theirs is odd.

    Raises:
        EquimusError: where one cannot be read.
    """
    return tuple(summarise(trial) for trial in gather(recordings, model, mapping, rotating))


def write_recording(
    path: Path | str, recording: Recording, units: Table[str, str] | None = None, *, force: bool = False
) -> Path:
    """Write a trial in the format that the name ends in: ``.csv``, ``.npz``, ``.parquet``, ``.mcap`` or ``.rrd``.

    All but the last are read back with every bit.

    Args:
        path: of the file.
        recording: the trial.
        units: column → SI unit, for those who look at it.
        force: whether a file that is there is replaced.

    Returns:
        The file written.

    Raises:
        NotAvailable: where the library of the format is not installed.
        RecordingError: where the recording is none that could be read back, or the format is not known.
        ConfigError: where the file is there already, or cannot be written.
    """
    path = Path(path)
    outputs.check_new(path, force)
    formats.write_recording(path, recording, units)
    return path


def write_recordings(recordings: Some, folder: Path | str, *, force: bool = False) -> tuple[Path, ...]:
    """Write each trial into a folder, as a CSV file of its name: all of them or none.

    Args:
        recordings: files, folders or trials, each with a name of its own.
        folder: made where it does not exist.
        force: whether files that are there are replaced.

    Returns:
        The files written.

    Raises:
        RecordingError: where a file is there already, or the folder cannot be written.
    """
    return write_set(gather(recordings), folder, force=force)


def fetch_recordings(folder: Path | str | None = None) -> tuple[Path, ...]:
    """Download the recordings of the real leg; files that are there already are left as they are.

    Args:
        folder: for the files; the user's data folder by default, where scenarios find them.

    Returns:
        The files.

    Raises:
        EquimusError: where they cannot be had, or are not what they should be.
    """
    return tuple(own.path for own in fetch(folder))


def recorded_models(path: Path | str, model: Model, source: Path | None = None) -> dict[str, Model]:
    """The refitted and the augmented model of a diagnosis.

    Args:
        path: its ``record.json``, or the folder that has one.
        model: the nominal one.
        source: file that this was read from; None for the nominal leg.

    Raises:
        ConfigError: where it cannot be read, or is of another robot.
    """
    path = Path(path)
    file = path / "record.json" if path.is_dir() else path
    try:
        record = json.loads(presets.read_bytes(file))
    except ValueError as error:
        raise ConfigError(f"{file}: is no JSON ({error})") from None
    held = record.get("models") if isinstance(record, dict) else None
    if not isinstance(held, dict):
        raise ConfigError(
            f"{file}: has no models in it, expected the record of a diagnosis; give the files of models instead "
            "(--refitted, --augmented)"
        )

    def read(name: str, edits: Edits) -> MjcfRobot:
        if source is None:
            raise ConfigError(f"{file}: is of {name}; expected its model")
        return load_mjcf(source if source.suffix.lower() in presets.MJCF else source.parent / name, name, edits)

    found = {}
    for key, state in ((REFITTED, "refitted"), (AUGMENTED, "corrected")):
        if not isinstance(held.get(state), dict):
            raise ConfigError(f"{file}: has no one {state} model; where folders differ give a model's file instead")
        found[key] = model_from_dict(held[state], f"{file}: models: {state}", read)
        check_same(found[key], model, f"{file}: {state}")
    return found


def check_same(other: Model, model: Model, where: str) -> None:
    """Raise ConfigError where a model has other joints or actuators than the nominal one."""
    for kind, own, wanted in (
        ("joints", other.robot.joint_names, model.robot.joint_names),
        ("actuators", other.robot.actuator_names, model.robot.actuator_names),
    ):
        if own != wanted:
            raise ConfigError(f"{where}: its {kind} are {', '.join(own)}, expected {', '.join(wanted)}")


def exported(trials: Sequence[Recording], models: dict[str, Model]) -> list[Exported]:
    """Trials with what models predict of each from its own measured start.

    Args:
        trials: gathered for these models.
        models: name → model; the first tells the units.

    Raises:
        EquimusError: where a trial cannot be simulated.
    """
    wanted = wanted_of(next(iter(models.values())).robot)
    columns = [f"{p}.{j}" for p in ("pos", "vel") for j in wanted.joints] + [f"cmd.{a}" for a in wanted.actuators]
    units = {column: unit for column in columns if (unit := si_unit(column, wanted)) is not None}
    found = []
    for trial in trials:
        predictions = []
        for name, model in models.items():
            check_columns(model, trial)
            engine = engine_for(model, positions=[trial.poses]).name
            predictions.append(Prediction(name, predict(model, trial, engine=engine)))
        found.append(Exported(trial, tuple(predictions), units))
    return found


def export_recordings(
    recordings: Path | str | Iterable[Path | str | Recording],
    path: Path | str,
    model: Model | None = None,
    *,
    refitted: Model | None = None,
    augmented: Model | None = None,
    mapping: Mapping | Path | str | None = None,
    ros2: bool = False,
    force: bool = False,
) -> list[Path]:
    """Write trials, predictions of models and residuals for Foxglove and PlotJuggler (``.mcap``) or rerun (``.rrd``).

    Beside an MCAP file a layout for each of the two is written. Residuals are measured − predicted, each trial
    predicted from its own measured start.

    Args:
        recordings: files, folders or trials.
        path: of the file.
        model: the nominal one; that of the leg by default.
        refitted: its parameters re-identified.
        augmented: with the effects found.
        mapping: what the columns of files of other formats are, or its file.
        ros2: whether a folder of bags is written in their place, one a trial, for those who work with ROS 2.
        force: whether files that are there are replaced.

    Returns:
        The files written.

    Raises:
        EquimusError: where something cannot be read, simulated or written, or is there already.
    """
    path = Path(path)
    if not ros2 and path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path}: expected a name that ends in {' or '.join(SUFFIXES)}")
    layouts = [path.with_suffix(suffix) for suffix in LAYOUTS] if path.suffix.lower() == ".mcap" and not ros2 else []
    if ros2 and force and os.path.lexists(path):
        raise ConfigError(
            f"{path}: is there already, and --force replaces no folder of bags; expected another name, or take it away"
        )
    if ros2:
        outputs.check_free(path)
        presets.check_folder(path)
    else:
        for file in (path, *layouts):
            outputs.check_new(file, force)
        presets.check_folder(path.parent)
    if not ros2:  # what is missing is told before the work
        (mcap_library if layouts else rerun_library)()
    model = model or nominal_model()
    models = {NOMINAL: model}
    for name, own in ((REFITTED, refitted), (AUGMENTED, augmented)):
        if own is not None:
            check_same(own, model, name)
            models[name] = own
    trials = exported(gather(recordings, model, mapping), models)
    folders = [trial.folder for trial in trials]
    for trial in trials:
        if folders.count(trial.folder) > 1:
            raise ConfigError(
                f"{trial.recording.name}: another trial would have the same topics, {trial.folder}/…; expected names "
                "that differ in letters and digits"
            )
    if ros2:
        names = [presets.plain_name(trial.recording.name) for trial in trials]
        with outputs.new_folder_whole(path) as folder:
            for name, trial in zip(names, trials, strict=True):
                write_bag(folder / name, trial)
        return [path / name for name in names]
    if not layouts:
        write_rerun(path, trials)
        return [path]
    write_mcap(path, trials, [notes_of(trial.recording) for trial in trials])
    texts: list[Any] = [presets.json_text(foxglove(trials)), plotjuggler(trials)]
    for file, text in zip(layouts, texts, strict=True):
        presets.write_text(file, text)
    return [path, *layouts]
