"""Models as files of other programs: MuJoCo's XML (MJCF) of any robot, with its stops, parameters and effects."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl import outputs, presets
from equimus_ctrl.effects.base import Effect, Robots
from equimus_ctrl.effects.bodies import changed_bodies
from equimus_ctrl.effects.native import Draft
from equimus_ctrl.effects.sensors import sensor_settings
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.effects.written import Unwritten, write_effects
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.steps import step_divisor
from equimus_ctrl.errors import ConfigError, ModelError, unknown_name
from equimus_ctrl.models.mjcf import SolverSettings
from equimus_ctrl.models.mjcf_file import add_keyframes, closed_spec
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import ExportOptions, with_changes
from equimus_ctrl.robots.elastic.morphology import Morphology, Phase
from equimus_ctrl.robots.mjcf.export import copy_numbers, exported, fill_keyframes, finish, with_comment
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array

STEPS = (2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5)
"""Physics steps of files of robots with elastic actuators, of few digits: the longest that follows a robot's motion and
its stops [s]."""
INTEGRATOR = "RK4"
"""Its integrator, which follows the exact equations several hundred times as closely as MuJoCo's others."""
FORMATS = ("mjcf",)
KEY = "rest"
"""What the keyframe is called in which such a robot rests under its lowest commands."""


@dataclass(frozen=True, repr=False)
class Written(Short):
    """A model as MuJoCo's XML.

    Attributes:
        xml: the text.
        unwritten: effects that it cannot hold.
        ignored: actuators and loose objects that the model leaves out.
    """

    xml: str
    unwritten: tuple[Unwritten, ...] = ()
    ignored: tuple[str, ...] = ()

    @property
    def missing(self) -> tuple[str, ...]:
        """What is not in it, a phrase each."""
        return (*_ignored(self.ignored), *(own.label for own in self.unwritten))


@dataclass(frozen=True, repr=False)
class Export(Short):
    """A model that was written as a file.

    Attributes:
        path: of the file.
        model: with the effects that are in it.
        left_out: effects that were left out of it, as asked for.
        ignored: actuators and loose objects that the model leaves out.
    """

    path: Path
    model: Model
    left_out: tuple[Effect, ...]
    ignored: tuple[str, ...]

    def told(self) -> str:
        """Of what, and where."""
        out = f", without {', '.join(_label(own) for own in self.left_out)}" if self.left_out else ""
        return f" of {self.model.name} to {self.path}{out}"

    def to_dict(self) -> dict[str, Any]:
        """What ``export --json`` prints."""
        return {
            "model": self.model.name,
            "format": "mjcf",
            "path": str(self.path),
            "effects": [{**_named(e), "written_as": e.mjcf_form} for e in self.model.effects],
            "left_out": [_named(e) for e in self.left_out],
            "ignored": list(self.ignored),
        }


def export_model(
    path: Path | str,
    model: Model | None = None,
    options: ExportOptions | None = None,
    *,
    format: str = "mjcf",
    near: Path | None = None,
    **changes: Any,
) -> Export:
    """Write a model as one file of plain MuJoCo, with all that it has: parameters, joint stops, effects.

    Args:
        path: of the file, ``.xml``.
        model: the nominal leg by default.
        options: see ``ExportOptions``.
        format: ``"mjcf"``, MuJoCo's XML; there is no other yet.
        near: file that the model was read from, beside which the meshes are that an MJCF robot's XML names.
        **changes: of the options, one by one.

    Raises:
        ConfigError: where the file is there already or cannot be written, the model differs between groups of trials,
            or MuJoCo cannot hold an effect that was not to be left out.
    """
    path, model = Path(path), model or nominal_model()
    options = with_changes(ExportOptions, options, changes)
    if format not in FORMATS:
        raise ConfigError(unknown_name("format", format, FORMATS, "export"))
    presets.check_xml(path)
    outputs.check_new(path, options.force)
    if near is not None and (own := _overwritten(path, near, model)):
        raise ConfigError(
            f"{path}: the model is read from {own}, which would be lost; expected another name (--output), with "
            "--force too"
        )
    if model.by_group:
        groups = [group for group, _ in model.by_group]
        raise ConfigError(
            f"{model.name}: has other parameters in {', '.join(groups)}, expected one of these models, such as "
            f"model.in_group({groups[0]!r})"
        )
    kept, out = _without(model, options.leave_out)
    folder = "" if near is None else presets.relative(_read_from(near, model).parent, path.parent)
    written = mjcf_of_model(kept, folder, options.timestep, [_label(e) for e in out])
    if written.unwritten:
        raise ConfigError(_refusal(model, written.unwritten))
    presets.write_text(path, written.xml)
    return Export(path, kept, out, written.ignored)


def mjcf_of_model(model: Model, folder: str = "", timestep: float | None = None, left: Sequence[str] = ()) -> Written:
    """A model as MuJoCo's XML.

    Args:
        model: of any robot.
        folder: where the files are that it names, as seen from where the XML is to be.
        timestep: its physics step; the XML's own by default, of a robot with elastic actuators one of ``STEPS`` [s].
        left: what was left out, for a comment that also names what the XML cannot hold.
    """
    return WRITERS[model.robot.traits.catalogue](model, folder, timestep, left)


def write_corrected(path: Path, model: Model, source: Path | None = None) -> tuple[str, ...]:
    """Write the XML of a model with all that it has fields for; what it does not hold, a phrase each.

    Args:
        path: of the file.
        model: of any robot.
        source: folder of the XML that an MJCF robot was made from, where its meshes are.
    """
    written = mjcf_of_model(model, "" if source is None else presets.relative(source, path.parent))
    presets.write_text(path, written.xml)
    return written.missing


def _of_mjcf(model: Model, folder: str, timestep: float | None, left: Sequence[str]) -> Written:
    own = realise(model, dt=timestep)
    draft, ignored = Draft(own.mujoco), own.robot.edits.ignore
    drives = {drive.name: drive.index for drive in own.robot.actuators}
    # What acts between commands and drives is by the XML and by effects together.
    given = own.robot.mujoco_model(timestep).actuator_delay[list(drives.values())]
    unwritten, measured = write_effects(
        draft, model.effects, drives, own.robot.joint_names, own.valve, own.sensor, given
    )
    told = [*left, *_ignored(ignored), *(effect.label for effect in unwritten)]
    return Written(exported(own.robot, draft, told, folder, measured), tuple(unwritten), ignored)


def _of_elastic(model: Model, folder: str, timestep: float | None, left: Sequence[str]) -> Written:
    robot = changed_bodies(model.effects, model.morphology)
    begins = _begins(model)
    settings = SolverSettings(timestep=timestep or _step(robot, model.phase, begins), integrator=INTEGRATOR)
    spec = closed_spec(robot, model.phase, settings, begins)
    before = spec.compile()
    draft = Draft(spec.compile())
    drives = {name: int(before.actuator(name).id) for name in robot.actuator_names}
    unwritten, measured = write_effects(
        draft, model.effects, drives, robot.joint_names, valve_settings(model.effects, robot.actuator_names),
        sensor_settings(model.effects, robot.joint_names), np.zeros(len(drives)),
    )  # fmt: skip
    copy_numbers(spec, draft.model)
    finish(spec, draft, measured)
    add_keyframes(spec, before, robot, model.phase, {KEY: begins, **robot.keyframes})
    fill_keyframes(spec, before)
    told = [*left, *(effect.label for effect in unwritten)]
    return Written(with_comment(spec.to_xml(), told), tuple(unwritten))


WRITERS: Mapping[Robots, Callable[[Model, str, float | None, Sequence[str]], Written]] = {
    "elastic": _of_elastic,
    "mjcf": _of_mjcf,
}
"""Kind of robots (``RobotTraits.catalogue``) → how one is written: model, folder, step, what was left out."""


def _step(robot: Morphology, phase: Phase, begins: Array) -> float:
    """The longest step that follows a robot [s]."""
    longest = STEPS[0] / step_divisor(robot, phase, [begins], STEPS[0])
    return next((step for step in STEPS if step <= longest), STEPS[-1])


def _begins(model: Model) -> Array:
    """(nj,) where a robot with elastic actuators rests under its lowest commands, or the middle of its ranges [rad]."""
    try:
        return rest_pose(model, model.robot.command_limits[0])
    except ModelError:
        low, high = (np.clip(side, -np.pi, np.pi) for side in model.robot.joint_range)
        return np.asarray((low + high) / 2)


def _without(model: Model, names: Sequence[str]) -> tuple[Model, tuple[Effect, ...]]:
    """A model without some effects, named with or without their places, and these."""
    known = [*dict.fromkeys(e.name for e in model.effects), *map(_placed, model.effects)]
    for name in names:
        if name not in known:
            raise ConfigError(unknown_name("effect", name, known, f"{model.name}: what is to be left out"))
    out = tuple(e for e in model.effects if {e.name, _placed(e)} & set(names))
    return replace(model, effects=tuple(e for e in model.effects if e not in out)), out


def _refusal(model: Model, unwritten: Sequence[Unwritten]) -> str:
    told = "; ".join(f"{own.label} ({own.reason})" for own in unwritten)
    flags = " ".join(f"--leave-out {own.name}@{own.place}" for own in unwritten)
    return f"{model.name}: MJCF cannot hold {told}; {flags} writes the rest, with a comment that says so"


def _placed(effect: Effect) -> str:
    return f"{effect.name}@{effect.location}"


def _label(effect: Effect) -> str:
    return f"{effect.name} at {effect.location}"


def _named(effect: Effect) -> dict[str, Any]:
    return {"effect": effect.name, "location": effect.location, **effect.parameters()}


def _ignored(names: Sequence[str]) -> list[str]:
    return [f"{name}, which is ignored" for name in names]


def _read_from(near: Path, model: Model) -> Path:
    """The file that a robot is read from by way of a file: itself, or the XML that it names."""
    data = model.robot.to_dict()
    named = near.suffix.lower() in presets.MJCF or "mjcf" not in data
    return near if named else near.parent / data["mjcf"]


def _overwritten(path: Path, near: Path, model: Model) -> Path | None:
    """Which of the files that a model is read from a file would be written over, by whichever name or link."""
    both = (near, _read_from(near, model))
    return next((own for own in both if path.exists() and own.exists() and path.samefile(own)), None)
