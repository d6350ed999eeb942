"""Environments to learn in, for users of the library and for Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import ConfigError, needs, unknown_name
from equimus_ctrl.identification.noise import JointNoise, Noise
from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.kick import Kick
from equimus_ctrl.learning.randomisation import Diagnosed, Draws, Same, Spread
from equimus_ctrl.learning.settings import DIAGNOSIS, EnvSettings, KickSettings
from equimus_ctrl.learning.tasks import Follow, Task
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.workflow.experiments import rivals_in
from equimus_ctrl.workflow.models import load_model
from equimus_ctrl.workflow.runs import load_scenario, scenario_names

if TYPE_CHECKING:
    from equimus_ctrl.learning.environments import RobotEnv, RobotVectorEnv
    from equimus_ctrl.learning.sb3 import RobotVecEnv

KICK = "kick"


def make_env(
    task: str,
    model: Model | Path | str | None = None,
    *,
    render_mode: str | None = None,
    **changes: Any,
) -> RobotEnv:
    """A ``gymnasium.Env`` of one robot at a task.

    Args:
        task: ``"kick"``, or the name of any scenario: its reference is followed.
        model: the nominal one, or its file; the nominal leg by default.
        render_mode: ``"rgb_array"``, ``"human"`` or None.
        **changes: fields of ``EnvSettings``; of ``KickSettings`` for a kick; ``scenario``, options of a scenario as
            text; ``diagnosis``, its record, the folder with it or the ``Diagnosis``, for ``randomise="diagnosis"``.

    Raises:
        NotAvailable: where Gymnasium is not installed.
        EquimusError: for anything that cannot be, in one sentence.
    """
    _require("gymnasium")
    from equimus_ctrl.learning.environments import RobotEnv, check_render_mode

    check_render_mode(render_mode)
    return RobotEnv(make_episodes(task, 1, model, threads=1, **changes), render_mode)


def make_vec_env(
    task: str,
    num_envs: int = 64,
    model: Model | Path | str | None = None,
    *,
    autoreset_mode: Any = "NextStep",
    render_mode: str | None = None,
    threads: int | None = None,
    **changes: Any,
) -> RobotVectorEnv:
    """A ``gymnasium.vector.VectorEnv`` of many robots at a task, in one process.

    Args:
        task: see ``make_env``.
        num_envs: how many.
        model: see ``make_env``.
        autoreset_mode: Gymnasium's ``AutoresetMode`` or its value.
        render_mode: ``"rgb_array"`` or None.
        threads: to use; all usable processors by default. Nothing depends on it.
        **changes: see ``make_env``.

    Raises:
        NotAvailable: where Gymnasium is not installed.
        EquimusError: for anything that cannot be, in one sentence.
    """
    _require("gymnasium")
    from equimus_ctrl.learning.environments import RobotVectorEnv

    return RobotVectorEnv(make_episodes(task, num_envs, model, threads=threads, **changes), autoreset_mode, render_mode)


def make_sb3_env(
    task: str,
    num_envs: int = 64,
    model: Model | Path | str | None = None,
    *,
    render_mode: str | None = None,
    threads: int | None = None,
    **changes: Any,
) -> RobotVecEnv:
    """The same as a ``VecEnv`` of Stable-Baselines3.

    Args:
        task: see ``make_env``.
        num_envs: how many.
        model: see ``make_env``.
        render_mode: ``"rgb_array"`` or None.
        threads: see ``make_vec_env``.
        **changes: see ``make_env``.

    Raises:
        NotAvailable: where Stable-Baselines3 is not installed.
        EquimusError: for anything that cannot be, in one sentence.
    """
    _require("gymnasium")
    _require("stable_baselines3")
    from equimus_ctrl.learning.sb3 import RobotVecEnv

    return RobotVecEnv(make_episodes(task, num_envs, model, threads=threads, **changes), render_mode)


def make_episodes(
    task: str,
    n: int,
    model: Model | Path | str | None = None,
    *,
    settings: EnvSettings | None = None,
    diagnosis: Path | str | Mapping[str, Any] | Diagnosis | Rivals | None = None,
    scenario: Mapping[str, str] | None = None,
    threads: int | None = None,
    **changes: Any,
) -> Episodes:
    """What environments are made of, see ``make_env``."""
    nominal = _model(model)
    own, rest = _split(EnvSettings, changes)
    settings = replace(settings or EnvSettings(), **own)
    done = _task(task, nominal, rest, scenario)
    draws, noise = _draws(nominal, settings, diagnosis)
    return Episodes(n, nominal, done, draws, settings, noise, threads)


def _model(given: Model | Path | str | None) -> Model:
    if isinstance(given, Model):
        return given
    return nominal_model() if given is None else load_model(given)


def _split(kind: type, changes: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    names = [field.name for field in fields(kind)]
    return {k: v for k, v in changes.items() if k in names}, {k: v for k, v in changes.items() if k not in names}


def _task(task: str, model: Model, changes: Mapping[str, Any], scenario: Mapping[str, str] | None) -> Task:
    known = [field.name for field in fields(EnvSettings)] + ["diagnosis", "scenario", "threads"]
    if task == KICK:
        own, rest = _split(KickSettings, changes)
        if rest or scenario:
            names = [*known, *(field.name for field in fields(KickSettings))]
            raise ConfigError(unknown_name("setting", next(iter(rest or {"scenario": 0})), names, task))
        return Kick(model, KickSettings(**own))
    if changes:
        raise ConfigError(unknown_name("setting", next(iter(changes)), known, task))
    if task not in scenario_names() and not task.endswith(".py"):
        raise ConfigError(unknown_name("task", task, [KICK, *scenario_names()]))
    robot = model.robot
    return Follow(load_scenario(task, robot, phase=model.phase, effects=model.effects, options=scenario, search=False))


def _draws(
    model: Model, settings: EnvSettings, diagnosis: Path | str | Mapping[str, Any] | Diagnosis | Rivals | None
) -> tuple[Draws, Noise]:
    """The robots, and the noise of measured positions."""
    noise = (JointNoise(settings.noise or 0.0),) * len(model.robot.joint_names)
    if settings.randomise != DIAGNOSIS:
        if diagnosis is not None:
            raise ConfigError("a diagnosis is given but robots are not drawn from it, expected randomise='diagnosis'")
        share = settings.randomise
        if not isinstance(share, float | int):
            return Same(model), noise
        return Spread(model, float(share), settings.robots, settings.robot_seed), noise
    if diagnosis is None:
        raise ConfigError(
            "randomise is 'diagnosis' without a diagnosis, expected its record, its folder, or the result of diagnose"
        )
    rivals = rivals_in(diagnosis, model)
    if settings.noise is None:
        noise = rivals.noise[: len(noise)]
    return Diagnosed(rivals, settings.robots, settings.robot_seed), noise


def _require(library: str) -> None:
    try:
        __import__(library)
    except ImportError:
        raise needs(library, "rl", "learning") from None
