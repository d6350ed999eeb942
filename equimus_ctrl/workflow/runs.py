"""Scenarios and controllers by name, and runs."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equimus_ctrl import outputs, presets
from equimus_ctrl.controllers.custom import as_controller
from equimus_ctrl.controllers.registry import CONTROLLERS, make_controller
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.engines.predict import robot_as_noted
from equimus_ctrl.errors import ConfigError, EquimusError, SimulationDiverged, unknown_name
from equimus_ctrl.learning.onnx_policy import OnnxPolicy
from equimus_ctrl.learning.policy import Acting, Policy
from equimus_ctrl.learning.policy_controller import PolicyController
from equimus_ctrl.loop import run
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.plants.mujoco_plant import check_nominal
from equimus_ctrl.plants.registry import PLANTS, PlantRequest, make_plant
from equimus_ctrl.recordings import locate, read_commands, read_path, read_set, write
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.robots.elastic.morphology import elastic_of
from equimus_ctrl.scenarios.registry import SCENARIOS, ScenarioEntry, first_paragraph
from equimus_ctrl.scenarios.scenario import Scenario, ScenarioContext
from equimus_ctrl.scenarios.scoring import Score, score_run
from equimus_ctrl.settings import both
from equimus_ctrl.shown import Short, by_name
from equimus_ctrl.types import Controller, Counts, CountsInstants, Ends, KnowsContacts, Plant, Recording, Run

if TYPE_CHECKING:
    from pandas import DataFrame

POLICIES: dict[str, Callable[[bytes, str], Acting]] = {".onnx": OnnxPolicy.from_bytes, ".zip": Policy.from_bytes}
"""How files of policies end."""


def recordings_of(folder: Path | None = None) -> Callable[[str], tuple[Recording, ...]]:
    """What scenarios ask for recordings: file kind → trials, empty where there are none.

    Raises:
        RecordingError: where the folder that is given is none.
    """
    if folder is not None:
        locate.find_recordings(folder)

    def find(kind: str) -> tuple[Recording, ...]:
        path = locate.leg_file(kind, folder)  # type: ignore[arg-type]
        return () if path is None else read_set(path)

    return find


def scenario_names() -> list[str]:
    """Of all scenarios that are known: scripts under ``scenarios/``, and what plugins registered."""
    return list({**presets.names("scenarios", ".py"), **SCENARIOS})


def listed_scenarios() -> list[dict[str, Any]]:
    """Name, summary and options with their defaults of all scenarios that are known.

    Scripts are read, not run: a folder's may be anybody's. Only the one that is asked for by name is run.
    """
    rows = []
    for name, path in presets.names("scenarios", ".py").items():
        summary, options, more = presets.described_function(path, "build")
        joints = {"JOINT": "as in the keyframe"} if more else {}
        rows.append({"name": name, "summary": summary, "options": {**dict(list(options.items())[1:]), **joints}})
    registered = [{"name": n, "summary": e.summary, "options": e.options} for n, e in SCENARIOS.items()]
    return [row for row in rows if row["name"] not in SCENARIOS] + registered


def scenario_entry(name: str) -> ScenarioEntry:
    """What is known by a name, or the script at a path.

    Raises:
        ConfigError: where there is no such scenario.
    """
    return SCENARIOS[name] if name in SCENARIOS else _script(name)


def _script(name: str) -> ScenarioEntry:
    build, where = presets.load_scenario(name, SCENARIOS)
    module = inspect.getmodule(build)
    return ScenarioEntry("" if module is None else first_paragraph(module), build, where, name)


def load_scenario(
    name: str,
    robot: Robot,
    *,
    phase: Any = "swing",
    effects: Sequence[Effect] = (),
    options: Mapping[str, str] | None = None,
    recordings: Path | None = None,
    search: bool = True,
) -> Scenario:
    """A scenario by name or path, built for a robot.

    Args:
        name: see ``scenario_entry``.
        robot: the nominal one.
        phase: base fixed or foot pinned.
        effects: what is known to be attached to it.
        options: the script's options as text.
        recordings: folder to look for recordings in.
        search: whether recordings are looked for at all.

    Raises:
        ConfigError: where there is no such scenario, or an option does not fit.
    """
    for described in robot.scenario_options:
        if described not in (known := scenario_names()):
            raise ConfigError(unknown_name("scenario", described, known, f"{robot.name}: scenarios"))
    find = recordings_of(recordings) if search else (lambda kind: ())
    context = ScenarioContext(robot, phase, find, locate.missing_hint(), tuple(effects), read_path, read_commands)
    return scenario_entry(name).scenario(context, options)


def load_controller(
    name: str, scenario: Scenario, settings: Path | None = None, robot: Robot | None = None
) -> Controller:
    """A controller by name, a policy that ``train`` wrote, or a user's own as ``path/to/file.py:Name``.

    Args:
        name: see ``CONTROLLERS``.
        scenario: whose commands ``open_loop`` plays.
        settings: its settings file; by default ``controllers/<name>_<robot>.toml`` or ``controllers/<name>.toml``.
        robot: to check the settings against.

    Raises:
        ControllerError, ConfigError: where there is no such controller or its settings are wrong.
    """
    reader = None if name in CONTROLLERS else POLICIES.get(Path(name).suffix)
    if reader is not None:
        if settings is not None:
            raise ConfigError(f"controller {name} takes no settings file, but {settings} was given")
        return PolicyController(reader(presets.read_bytes(Path(name)), name), name)
    own = name not in CONTROLLERS and ".py" in name
    takes = None if own else CONTROLLERS.entry(name).settings
    if settings is not None and takes is None:
        raise ConfigError(f"controller {name} takes no settings file, but {settings} was given")
    if own:
        return as_controller(presets.load_object(name), name)
    path = settings
    if settings is None and takes is not None:
        if robot is not None:
            path = settings = presets.find("controllers", own_settings(takes, robot))
        path = path or presets.find("controllers", takes)
    table = presets.read_toml(path) if path is not None else None
    commands = scenario.commands.at if scenario.commands is not None else None
    return make_controller(
        name, table, commands, name if path is None else presets.shown(path), robot, settings is not None
    )


@dataclass(frozen=True, eq=False, repr=False)
class ScenarioRun(Short):
    """One scenario, driven and scored.

    Attributes:
        scenario: what was done.
        controller: name of the controller.
        run: what happened.
        score: how well.
        model: what was simulated.
        plant: name of the plant.
        loop: what the loop saw of itself, of plants that count that.
        recording: file that it was recorded into, if that was asked for.
    """

    scenario: Scenario
    controller: str
    run: Run
    score: Score
    model: Model
    plant: str
    loop: Counts | None = None
    recording: Path | None = None

    def told(self) -> str:
        """What was driven, and its tracking error."""
        spec, score = self.run.spec, self.score
        error = by_name(spec.joints, score.tracking.rmse)
        units = " or ".join(dict.fromkeys(spec.joint_units))
        return (
            f" {self.scenario.name} by {self.controller} on {self.model.name} ({self.plant}), "
            f"{self.run.time[-1]:.4g} s: tracking RMSE {error} {units}, saturated {100 * score.saturated:.3g} %"
        )

    def to_dataframe(self) -> DataFrame:
        """A row for each control instant, see ``Run.to_dataframe``.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        return self.run.to_dataframe()

    def to_dict(self) -> dict[str, Any]:
        """What ``run --json`` prints, but for its files."""
        from equimus_ctrl.report.tables import score_to_dict

        return {
            **score_to_dict(self.score, self.run, self.scenario, self.controller),
            "note": self.run.note,
            "plant": self.plant,
            "model": self.model.name,
        }

    @property
    def kinematics(self) -> Kinematics | None:
        """Geometry and statics of what was simulated, where it has lengths of actuators."""
        robot = self.model.robot
        return Kinematics(elastic_of(robot), self.model.phase) if "lengths" in robot.offers else None


def run_scenario(
    scenario: str | Scenario,
    controller: str | Controller | Callable[..., Any] | None = None,
    *,
    model: Model | None = None,
    effects: Sequence[Effect] = (),
    plant: str | Plant = "mujoco",
    options: Mapping[str, str] | None = None,
    recordings: Path | None = None,
    settings: Path | None = None,
    noise: float = 0.0,
    seed: int = 0,
    nominal: Model | None = None,
    progress: Callable[[float], None] | None = None,
    hardware: HardwareSettings | None = None,
    armed: bool = False,
    record: Path | None = None,
) -> ScenarioRun:
    """Run a scenario and score it.

    Args:
        scenario: name or path of a script, or a scenario; a script builds on what is known.
        controller: name, ``path.py:Name``, controller, class or function; the scenario's own by default.
        model: what is simulated; the nominal leg by default.
        effects: attached to the model on top of its own.
        plant: name of a plant, or a plant.
        options: the script's options as text.
        recordings: folder to look for recordings in.
        settings: the controller's settings file.
        noise: standard deviation of white noise on the measured angles [rad].
        seed: of that noise.
        nominal: what the controller may compute with; the model without ``effects`` by default.
        progress: called with the share done.
        hardware: how a real robot is reached, for the plant of that name.
        armed: whether commands are sent to it.
        record: new file for the run as a recording; of a real robot it is written while that moves, if it is armed.

    Raises:
        EquimusError: for anything a user can get wrong, in one sentence.
        SimulationDiverged: where the simulation did; it has the run until then, and the names of what was done.
        HardwareFault: where a real robot had to be vented.
    """
    model = model or nominal_model()
    known = nominal or model
    check_nominal(known.robot, model.robot)
    if seed < 0:
        raise ConfigError(f"seed is {seed}, expected at least 0")
    if record is not None:
        outputs.check_new(record)
    if isinstance(plant, str):
        PLANTS.entry(plant).check_effects(effects, model.effects)
    if effects:
        model = Model(model.robot, (*model.effects, *effects), model.phase)
    if isinstance(scenario, str):
        scenario = load_scenario(
            scenario, known.robot, phase=model.phase, effects=known.effects, options=options, recordings=recordings
        )
    if scenario.different:
        model, known = (
            replace(own, robot=robot_as_noted(own.robot, scenario.name, scenario.different)) for own in (model, known)
        )
    if controller is None:
        controller = scenario.controller
    if isinstance(controller, str):
        label, driven = controller, load_controller(controller, scenario, settings, known.robot)
    else:
        label = str(getattr(controller, "name", None) or getattr(controller, "__name__", type(controller).__name__))
        driven = as_controller(controller, label)
    real = isinstance(plant, str) and PLANTS.entry(plant).real
    if record is not None and real:
        presets.make_folder(record.parent)
    if isinstance(plant, str):
        request = PlantRequest(
            model, scenario.recorded, noise, known, scenario.events, hardware, armed, record, scenario.different
        )
        plant_name, machine = plant, make_plant(plant, request)
    else:
        plant_name, machine = type(plant).__name__, plant
    duration = scenario.duration
    if isinstance(machine, Ends):
        duration = min(duration, machine.duration)
    notes = {"scenario": scenario.name, "controller": label, "seed": str(seed), **scenario.different}
    try:
        outcome = run(machine, driven, scenario.reference, duration, start=scenario.start, seed=seed, progress=progress)
    except SimulationDiverged as error:
        error.scenario, error.controller = scenario.name, label
        if record is not None and error.run is not None and len(error.run.time) > 1:  # a recording has two rows or more
            with suppress(EquimusError):  # what diverged is told first; what there is of it may still be shown
                error.recording = _recorded(
                    record, error.run.recording(scenario.name, {**notes, "failure": str(error)})
                )
        raise
    finally:
        machine.close()
    if record is not None and not real:
        record = _recorded(record, outcome.recording(scenario.name, notes))
    if isinstance(machine, KnowsContacts) and machine.touched:
        said = f"{machine.touched}, and contacts are in no equations of motion that a controller computes with"
        outcome = replace(outcome, note=both(outcome.note, said))
    counts = machine.counts if isinstance(machine, CountsInstants) else None
    score = score_run(outcome, scenario)
    kept = record if record is not None and record.exists() else None
    return ScenarioRun(scenario, label, outcome, score, model, plant_name, counts, kept)


def _recorded(path: Path, recording: Recording) -> Path:
    """Write a recording; where another process has taken its name in the meantime, by the next free one."""
    with outputs.reserved(path) as own:
        write(own, recording)
    return own


def own_settings(file: str, robot: Robot) -> str:
    """What a settings file is called that is for one robot alone."""
    stem, dot, suffix = file.rpartition(".")
    return f"{stem}_{presets.plain_name(robot.name)}{dot}{suffix}"
