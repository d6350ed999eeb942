"""Controllers × scenarios × conditions: each driven the same way, with the same noise, and scored alike."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from equimus_ctrl.controllers.custom import as_controller
from equimus_ctrl.controllers.horizon import FALLBACKS
from equimus_ctrl.controllers.registry import compared_controllers
from equimus_ctrl.effects import FirstOrderLag, TransportDelay
from equimus_ctrl.effects.bodies import BodyEffect, changed_bodies
from equimus_ctrl.effects.valves import ValveEffect
from equimus_ctrl.errors import ConfigError, ControllerError, SimulationDiverged, unknown_name
from equimus_ctrl.executors.calls import cannot_be_sent
from equimus_ctrl.executors.where import Where
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.models.spread import groups, latin_hypercube, perturbed
from equimus_ctrl.options import CompareOptions, with_changes
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.base import Robot
from equimus_ctrl.scenarios.comparison import Comparison, Condition, Entry
from equimus_ctrl.scenarios.scenario import Scenario
from equimus_ctrl.scenarios.scoring import ErrorFigures, off_reference, score_run
from equimus_ctrl.tuning.ensemble import make_ensemble
from equimus_ctrl.tuning.study import EnsembleSettings
from equimus_ctrl.types import Controller
from equimus_ctrl.workflow.plugins import load_plugins, loaded
from equimus_ctrl.workflow.runs import load_controller, load_scenario
from equimus_ctrl.workflow.where import where_of

NOISE = 2e-3
"""Standard deviation of measured positions where there is noise [rad or m]."""
SPREAD = EnsembleSettings(stiffness=0.15, area=0.15, damping=0.4, rest_length=0.02, mass=0.15)
"""Relative perturbation of the parameters of perturbed robots, at most."""
REHEARSED = 3
"""Control instants before a run that are not counted."""


CONDITIONS = {
    "nominal": "the model, and the controller knows it",
    "noisy": f"the same with {1e3 * NOISE:g} mrad (slides mm) of noise on each position",
    "delayed": "noisy, {late} between a command and what it does, which the controller knows",
    "unmodelled_delay": "the same, which the controller does not know",
    "perturbed": "noisy, {spread}, which it does not know",
    "corrected": "noisy, the augmented model of a diagnosis, and the controller knows it",
    "uncorrected": "the same, but the controller knows the model as it was",
}
"""Name → one line. The last two need a corrected model."""
WORDS = {
    "mass": "masses and inertias", "damping": "damping and friction", "stiffness": "stiffness", "area": "areas",
    "rest_length": "rest lengths",
}  # fmt: skip
"""Of what varies, see ``Robot.varying``."""
USUAL, CORRECTED = ("nominal", "noisy", "delayed", "perturbed"), ("corrected", "uncorrected")
"""Conditions that are compared by default; the latter with a corrected model."""


def conditions(
    names: Sequence[str],
    model: Model,
    corrected: Model | None = None,
    draws: int = CompareOptions.draws,
    seed: int = CompareOptions.seed,
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
        summary = CONDITIONS[name].format(late=_lateness(model.robot), spread=_spread(model.robot))
        if name in CORRECTED:
            if corrected is None:
                raise ConfigError(f"condition {name} needs a corrected model; give it with --corrected FILE")
            found.append(Condition(name, summary, corrected, corrected if name == "corrected" else model, NOISE))
        elif name == "perturbed":
            for k, other in enumerate(_perturbed(model, draws, seed)):
                found.append(Condition(f"{name} {k + 1}" if draws > 1 else name, summary, other, model, NOISE))
        else:
            delayed = _delayed(model) if name in ("delayed", "unmodelled_delay") else model
            noise = 0.0 if name == "nominal" else NOISE
            found.append(Condition(name, summary, delayed, model if name == "unmodelled_delay" else delayed, noise))
    return found


def _lateness(robot: Robot) -> str:
    lag, delay = robot.traits.usual_lag, robot.traits.usual_delay
    return f"a lag of {lag:g} s and a dead time of {delay:g} s" if lag else f"a dead time of {delay:g} s"


def _spread(robot: Robot) -> str:
    kinds = dict.fromkeys(kind for kind, _ in robot.varying())
    return ", ".join(f"{WORDS[kind]} ±{100 * getattr(SPREAD, kind):g} %" for kind in kinds)


def _perturbed(model: Model, draws: int, seed: int) -> list[Model]:
    own = tuple(effect for effect in model.effects if not isinstance(effect, BodyEffect))
    if "lengths" in model.robot.offers:
        legs = make_ensemble(model, SPREAD, draws, seed, fixed=False)
        return [Model(leg.morphology, own, model.phase) for leg in legs]
    robot = changed_bodies(model.effects, model.robot)
    spreads = groups(robot, {key: getattr(SPREAD, key) for key in WORDS})
    rows = latin_hypercube(draws, len(spreads), np.random.default_rng(seed))
    return [Model(perturbed(robot, spreads, row), own, model.phase) for row in rows]


def _delayed(model: Model) -> Model:
    """The model with late drives in place of its own."""
    effects = [effect for effect in model.effects if not isinstance(effect, ValveEffect)]
    traits = model.robot.traits
    for actuator in model.robot.actuator_names:
        effects += [FirstOrderLag(actuator, time_constant=traits.usual_lag)] if traits.usual_lag else []
        effects.append(TransportDelay(actuator, delay=traits.usual_delay))
    return replace(model, effects=tuple(effects))


def compare(
    scenarios: Sequence[str | Scenario],
    controllers: Sequence[str | Controller | Callable[..., Any]] | None = None,
    under: Sequence[str | Condition] | None = None,
    options: CompareOptions | None = None,
    *,
    model: Model | None = None,
    corrected: Model | None = None,
    notify: Callable[[float, str], None] = lambda share, what: None,
    **changes: Any,
) -> Comparison:
    """Drive every controller through every scenario under every condition.

    Every run of a scenario under a condition has the same noise. Errors are of the true angles, over what the scenario
    scores. Runs are done beside each other by processes, or by a cluster, see ``CompareOptions``; but for times of
    steps they come to the same wherever they are done. Where what is compared cannot be given to another process, this
    one does them one after the other.

    Args:
        scenarios: names, paths or scenarios.
        controllers: in place of the options'.
        under: in place of the options'.
        options: see ``CompareOptions``.
        model: the robot as it is known; the nominal leg by default.
        corrected: the augmented model of a diagnosis.
        notify: called with the share done and what is done now.
        **changes: of the options, one by one.

    Raises:
        EquimusError: for anything that is wrong before the first run begins; what fails in a run stands in its entry.
    """
    model = model or nominal_model()
    named = {"controllers": controllers, "under": under}
    options = with_changes(CompareOptions, options, {**changes, **{k: v for k, v in named.items() if v is not None}})
    controllers = compared_controllers(model.robot) if options.controllers is None else options.controllers
    under = (USUAL if corrected is None else (*USUAL, *CORRECTED)) if options.under is None else options.under
    seed, settings = options.seed, options.settings or {}
    if not scenarios or not controllers or not under:
        raise ConfigError("a comparison needs at least one scenario, one controller and one condition")
    robots = conditions([c for c in under if isinstance(c, str)], model, corrected, options.draws, seed)
    robots += [c for c in under if isinstance(c, Condition)]
    built = [
        s
        if isinstance(s, Scenario)
        else load_scenario(
            s,
            model.robot,
            phase=model.phase,
            effects=model.effects,
            options=options.scenario_options,
            recordings=options.recordings,
        )
        for s in scenarios
    ]
    strange = sorted(set(settings) - {c for c in controllers if isinstance(c, str)})
    if strange:
        raise ConfigError(f"settings are given for {strange[0]}, which is not compared")
    made = {}
    for scenario in built:
        for controller in controllers:
            if isinstance(controller, str):
                driven = load_controller(controller, scenario, settings.get(controller), model.robot)
                made[scenario.name, _label(controller)] = driven
            else:
                made[scenario.name, _label(controller)] = as_controller(controller, _label(controller))
    runs = [
        (label, made[scenario.name, label], scenario, robot, seed)
        for scenario in built
        for robot in robots
        for label in map(_label, controllers)
    ]
    names = [f"{label}, {scenario.name}, {robot.name}" for label, _, scenario, robot, _ in runs]
    where = _where(options, [(f"controller {label}", own) for (_, label), own in made.items()], built, robots)
    prepare = partial(load_plugins, loaded()) if loaded() else None
    entries: dict[int, Entry] = {}
    notify(0.0, names[0])
    with where.opened(len(runs), prepare) as executor:
        for index, entry in executor.each(_driven, runs):
            entries[index] = entry
            # Runs begin in their order, so the first that is left is one of those under way.
            notify(len(entries) / len(runs), next((name for k, name in enumerate(names) if k not in entries), ""))
    ordered = tuple(entries[k] for k in range(len(runs)))
    return Comparison(model, {s.name: s for s in built}, tuple(robots), ordered, seed)


def _where(
    options: CompareOptions,
    controllers: Sequence[tuple[str, Controller]],
    scenarios: Sequence[Scenario],
    robots: Sequence[Condition],
) -> Where:
    """Where runs are done: in this process where nothing is said and something cannot be given to another.

    Raises:
        ConfigError: for what cannot be given to another process that is asked for.
    """
    if options.workers == 1:
        return Where(1)
    named = [
        *controllers,
        *((f"scenario {own.name}", own) for own in scenarios),
        *((f"condition {own.name}", own) for own in robots),
    ]
    for what, own in named:
        if (why := cannot_be_sent(own)) is not None:
            if (options.workers, options.scheduler, options.slurm) == (None, None, None):
                return Where(1)
            raise ConfigError(f"{what} cannot be given to another process ({why}); expected --workers 1")
    return where_of(options.workers, options.scheduler, options.slurm)


def _label(controller: Any) -> str:
    if isinstance(controller, str):
        return controller.rpartition(":")[2] or controller
    return str(getattr(controller, "name", None) or getattr(controller, "__name__", type(controller).__name__))


def _driven(label: str, controller: Controller, scenario: Scenario, robot: Condition, seed: int) -> Entry:
    plant = MujocoPlant(robot.model, nominal=robot.known, noise=robot.noise, events=scenario.events)
    try:
        # What is compiled for a robot is compiled here, so that the times of steps are those of steps.
        few = min(REHEARSED * plant.spec.control_dt, scenario.duration)
        run(plant, controller, scenario.reference, few, start=scenario.start, seed=seed)
        done = run(plant, controller, scenario.reference, scenario.duration, start=scenario.start, seed=seed)
    except (ControllerError, SimulationDiverged) as error:
        return Entry(label, scenario.name, robot.name, None, None, None, 0.0, 0.0, str(error))
    finally:
        plant.close()
    score = score_run(done, scenario)
    inside = (done.time >= score.window[0] - 1e-9) & (done.time <= score.window[1] + 1e-9)
    assert done.truth is not None  # a simulated plant knows it
    figures = ErrorFigures.of(off_reference(done.truth, done.reference, done.spec, scenario)[inside])
    missed = float((done.solve_time > done.spec.control_dt).mean())
    fallbacks = float(np.mean([status in FALLBACKS for status in done.status]))
    return Entry(label, scenario.name, robot.name, done, score, figures, missed, fallbacks)
