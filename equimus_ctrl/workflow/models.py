"""Model files and MuJoCo's XML as models, and models as files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from equimus_ctrl import presets
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict, nominal_model
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.workflow.exports import write_corrected
from equimus_ctrl.workflow.mjcf import load_mjcf, suited


def load_model(
    path: Path | str | None = None,
    *,
    lock: Mapping[str, float] | None = None,
    ignore: Sequence[str] = (),
    motors: bool = False,
    prescribe: Sequence[str] = (),
    unmeasured: Sequence[str] = (),
    recordings: Sequence[Path | str] = (),
) -> Model:
    """The model in a model file, an MJCF file or a URDF; the nominal leg where ``path`` is None.

    Args:
        path: of the file.
        lock: joint → where it is held [rad or m], of an MJCF robot: what was not measured.
        ignore: actuators that are left out, for they were not recorded, and loose objects: bodies with a free joint.
        motors: whether each joint without an actuator gets a motor, see ``robots.mjcf.editing.Edits``.
        prescribe: names or patterns of joints whose motion was measured and is taken as it is.
        unmeasured: names or patterns of joints that no column tells of and that move by themselves.
        recordings: files or folders that it is to be compared with, by which the axes are chosen about which a free
            base that is prescribed turns.

    Raises:
        ConfigError, ModelError: where the file cannot be read or describes no model.
    """
    edits = Edits(dict(lock or {}), tuple(ignore), motors, tuple(prescribe), unmeasured=tuple(unmeasured))
    if path is None:
        if edits:
            raise ConfigError(
                "joints are held, prescribed or not measured, and actuators left out, of MJCF robots alone; name one "
                "by --model"
            )
        return nominal_model()
    files = [Path(own) for own in recordings]
    if Path(path).suffix.lower() in presets.MJCF:
        return suited(Model(load_mjcf(Path(path), edits=edits)), files)
    folder, data = Path(path).parent, presets.read_toml(Path(path))
    if not data:
        raise ConfigError(f"{path}: is empty; a model file has a morphology, parameters or effects, or names an mjcf")

    def read(name: str, own: Edits) -> MjcfRobot:
        both = Edits(
            {**own.lock, **edits.lock}, (*own.ignore, *edits.ignore), own.motors or edits.motors,
            (*own.prescribe, *edits.prescribe), unmeasured=(*own.unmeasured, *edits.unmeasured),
        )  # fmt: skip
        return load_mjcf(folder / name, name, both)

    return suited(model_from_dict(data, str(path), read), files)


def load_elastic(path: Path | str | None = None) -> Model:
    """The model in a model file, of a robot with elastic actuators alone; the nominal leg where ``path`` is None.

    Raises:
        ConfigError, ModelError: see ``load_model``; also for a robot whose actuators have no lengths of their own.
    """
    model = load_model(path)
    if "lengths" not in model.robot.offers:
        raise ConfigError(
            f"{path}: has no elastic actuators, which this is for; identify, diagnose, prove, score, "
            "sensitivity, list parameters and recordings check take it"
        )
    return model


def renamed(model: Model, name: str) -> Model:
    """The model under another name, such as its file's, so that a table shows which one it is of."""
    return replace(model, robot=replace(model.robot, name=name))


def by_group(path: Path, model: Model, groups: Sequence[str]) -> list[tuple[Path, Model]]:
    """A model's file; where it differs between groups of trials a file for each, with the group's name: ``arm_B.toml``.

    Args:
        path: of the file.
        model: to be written.
        groups: of trials.
    """
    if not model.by_group:
        return [(path, model)]
    names = {group: f"{path.stem}_{group.replace('/', '_')}{path.suffix}" for group in groups}
    return [(path.with_name(name), model.in_group(group)) for group, name in names.items()]


def save_model(path: Path | str, model: Model, near: Path | None = None) -> list[Path]:
    """Write a model file, whole or not at all; of an MJCF robot also the XML with all that it has fields for.

    Args:
        path: of the model file.
        model: what is written.
        near: file that the model was read from, by which its XML is found again.

    Returns:
        The files written.
    """
    path, data = Path(path), model_to_dict(model)
    if "mjcf" not in data:
        presets.write_text(path, presets.toml_text(data))
        return [path]
    if near is not None:
        found = near if near.suffix.lower() in presets.MJCF else near.parent / data["mjcf"]
        data["mjcf"] = presets.relative(found, path.parent)
    whole = path.with_suffix(".xml")
    if (near is not None and whole.resolve() == found.resolve()) or (whole.exists() and not path.exists()):
        # The robot's own XML, or one that was not written together with this model file.
        whole = path.with_name(f"{path.stem}_whole.xml")
    left = write_corrected(whole, model, None if near is None else found.parent)
    shown_text = f"{whole.name} has all of this in one MuJoCo model"
    shown_text += f", but for {', '.join(left)}." if left else "."
    presets.write_text(path, presets.toml_text(data, shown_text))
    return [path, whole]
