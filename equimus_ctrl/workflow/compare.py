"""Controllers × scenarios × conditions: each driven the same way, with the same noise, and scored alike."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from equimus_ctrl.controllers.custom import as_controller
from equimus_ctrl.controllers.horizon import FALLBACKS
from equimus_ctrl.controllers.registry import compared_controllers
from equimus_ctrl.effects import FirstOrderLag, TransportDelay
from equimus_ctrl.effects.bodies import BodyEffect
from equimus_ctrl.effects.valves import ValveEffect
from equimus_ctrl.errors import ConfigError, ControllerError, SimulationDiverged, unknown_name
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.scenarios.comparison import Comparison, Condition, Entry
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import ErrorFigures, score_run
from equimus_ctrl.simulate import run
from equimus_ctrl.tuning.ensemble import make_ensemble
from equimus_ctrl.tuning.study import EnsembleSettings
from equimus_ctrl.types import Controller
from equimus_ctrl.workflow.runs import load_controller, load_scenario

NOISE = 2e-3
"""Standard deviation of measured angles where there is noise [rad]."""
LAG, DELAY = 0.1, 0.1
"""Time constant of the lag and dead time of the delayed valves [s]."""
SPREAD = EnsembleSettings(stiffness=0.15, area=0.15, damping=0.4, rest_length=0.02, mass=0.15)
"""Relative perturbation of the parameters of perturbed robots, at most."""


CONDITIONS = {
    "nominal": "the model, and the controller knows it",
    "noisy": f"the same with {1e3 * NOISE:g} mrad of noise on each angle",
    "delayed": f"noisy, valves with a lag of {LAG:g} s and a dead time of {DELAY:g} s, which the controller knows",
    "unmodelled_delay": "the same, which the controller does not know",
    "perturbed": "noisy, stiffness, area and mass ±15 %, damping ±40 %, rest lengths ±2 %, which it does not know",
    "corrected": "noisy, the augmented model of a diagnosis, and the controller knows it",
    "uncorrected": "the same, but the controller knows the model as it was",
}
"""Name → one line. The last two need a corrected model."""


def conditions(
    names: Sequence[str], model: Model, corrected: Model | None = None, draws: int = 3, seed: int = 0
) -> list[Condition]:
    """The conditions of these names.

    Args:
        names: of ``CONDITIONS``.
        model: the nominal model.
        corrected: the augmented model of a diagnosis.
        draws: how many perturbed robots.
        seed: of what these are.

    Raises:
        ConfigError: for a name that there is not, fewer than one draw, or a corrected model that is not there.
    """
    if draws < 1:
        raise ConfigError(f"draws is {draws}, expected at least 1")
    found: list[Condition] = []
    for name in names:
        if name not in CONDITIONS:
            raise ConfigError(unknown_name("condition", name, CONDITIONS))
        summary = CONDITIONS[name]
        if name in ("corrected", "uncorrected"):
            if corrected is None:
                raise ConfigError(f"condition {name} needs a corrected model; give it with --corrected FILE")
            found.append(Condition(name, summary, corrected, corrected if name == "corrected" else model, NOISE))
        elif name == "perturbed":
            own = tuple(effect for effect in model.effects if not isinstance(effect, BodyEffect))
            for k, member in enumerate(make_ensemble(model, SPREAD, draws, seed, fixed=False)):
                other = Model(member.morphology, own, model.phase)
                found.append(Condition(f"{name} {k + 1}" if draws > 1 else name, summary, other, model, NOISE))
        else:
            delayed = _delayed(model) if name in ("delayed", "unmodelled_delay") else model
            noise = 0.0 if name == "nominal" else NOISE
            found.append(Condition(name, summary, delayed, model if name == "unmodelled_delay" else delayed, noise))
    return found


def _delayed(model: Model) -> Model:
    """The model with delayed valves in place of its own."""
    effects = [effect for effect in model.effects if not isinstance(effect, ValveEffect)]
    for actuator in model.morphology.actuator_names:
        effects += [FirstOrderLag(actuator, time_constant=LAG), TransportDelay(actuator, delay=DELAY)]
    return replace(model, effects=tuple(effects))


def compare(
    scenarios: Sequence[str | Scenario],
    controllers: Sequence[str | Controller | Callable[..., Any]] | None = None,
    under: Sequence[str | Condition] = ("nominal", "noisy", "delayed", "perturbed"),
    *,
    model: Model | None = None,
    corrected: Model | None = None,
    draws: int = 3,
    options: Mapping[str, str] | None = None,
    settings: Mapping[str, Path] | None = None,
    recordings: Path | None = None,
    seed: int = 0,
    notify: Callable[[float, str], None] = lambda share, what: None,
) -> Comparison:
    """Drive every controller through every scenario under every condition, one after the other.

    Every run of a scenario under a condition has the same noise. Errors are of the true angles, over what the scenario
    scores.

    Args:
        scenarios: names, paths or scenarios.
        controllers: names, ``path.py:Name``, controllers, classes or functions; all that are made for it by default.
        under: names of ``CONDITIONS``, or conditions.
        model: the robot as it is known; the nominal leg by default.
        corrected: the augmented model of a diagnosis.
        draws: how many perturbed robots.
        options: of the scenarios, as text.
        settings: controller → its settings file.
        recordings: folder to look for recordings in.
        seed: of noise and perturbed robots.
        notify: called with the share done and what is done now.

    Raises:
        EquimusError: for anything that is wrong before the first run begins; what fails in a run stands in its entry.
    """
    model = model or nominal_model()
    controllers = compared_controllers() if controllers is None else controllers
    if seed < 0:
        raise ConfigError(f"seed is {seed}, expected at least 0")
    if not scenarios or not controllers or not under:
        raise ConfigError("a comparison needs at least one scenario, one controller and one condition")
    robots = conditions([c for c in under if isinstance(c, str)], model, corrected, draws, seed)
    robots += [c for c in under if isinstance(c, Condition)]
    built = [
        s
        if isinstance(s, Scenario)
        else load_scenario(s, model.morphology, phase=model.phase, options=options, recordings=recordings)
        for s in scenarios
    ]
    strange = sorted(set(settings or {}) - {c for c in controllers if isinstance(c, str)})
    if strange:
        raise ConfigError(f"settings are given for {strange[0]}, which is not compared")
    entries: list[Entry] = []
    total = len(built) * len(robots) * len(controllers)
    made = {}
    for scenario in built:
        for controller in controllers:
            if isinstance(controller, str):
                driven = load_controller(controller, scenario, (settings or {}).get(controller), model.morphology)
                made[scenario.name, _label(controller)] = driven
            else:
                made[scenario.name, _label(controller)] = as_controller(controller, _label(controller))
    for scenario in built:
        for robot in robots:
            for controller in controllers:
                label = _label(controller)
                notify(len(entries) / total, f"{label}, {scenario.name}, {robot.name}")
                entries.append(_driven(label, made[scenario.name, label], scenario, robot, seed))
    notify(1.0, "")
    return Comparison(model, {s.name: s for s in built}, tuple(robots), tuple(entries), seed)


def _label(controller: Any) -> str:
    if isinstance(controller, str):
        return controller.rpartition(":")[2] or controller
    return str(getattr(controller, "name", None) or getattr(controller, "__name__", type(controller).__name__))


def _driven(label: str, controller: Controller, scenario: Scenario, robot: Condition, seed: int) -> Entry:
    plant = MujocoPlant(robot.model, nominal=robot.known, noise=robot.noise, events=scenario.events)
    try:
        done = run(plant, controller, scenario.reference, scenario.duration, start=scenario.start, seed=seed)
    except (ControllerError, SimulationDiverged) as error:
        return Entry(label, scenario.name, robot.name, None, None, None, 0.0, 0.0, str(error))
    finally:
        plant.close()
    score = score_run(done, scenario)
    inside = (done.time >= score.window[0] - 1e-9) & (done.time <= score.window[1] + 1e-9)
    assert done.truth is not None  # a simulated plant knows it
    figures = ErrorFigures.of((done.truth - done.reference)[inside])
    missed = float((done.solve_time > done.spec.control_dt).mean())
    fallbacks = float(np.mean([status in FALLBACKS for status in done.status]))
    return Entry(label, scenario.name, robot.name, done, score, figures, missed, fallbacks)
