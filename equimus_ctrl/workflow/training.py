"""Training of policies into a folder, from where it was stopped."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from equimus_ctrl import outputs, presets
from equimus_ctrl.errors import ConfigError, needs, unknown_name
from equimus_ctrl.executors.versions import versions
from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.evaluation import Judged, judge
from equimus_ctrl.learning.onnx_policy import check_onnx as check_onnx
from equimus_ctrl.learning.onnx_policy import to_onnx
from equimus_ctrl.learning.policy import Policy, Suited, training_state
from equimus_ctrl.learning.settings import KickSettings
from equimus_ctrl.models.model import Model, model_to_dict, nominal_model
from equimus_ctrl.options import UNSEEN_SEED, TrainOptions, with_changes
from equimus_ctrl.shown import Short
from equimus_ctrl.workflow.learning import KICK, make_episodes
from equimus_ctrl.workflow.models import load_model

POLICY, CHECKPOINT, BOARD, ONNX = "policy.zip", "checkpoint.zip", "tensorboard", "policy.onnx"
SCHEMA = "equimus-ctrl/training/1"
MEANWHILE = ("steps", "budget", "threads")
"""Options that may be others when a training goes on."""
LIBRARIES = ("gymnasium", "stable-baselines3", "torch")
Progress = Callable[..., None]


@dataclass(frozen=True, eq=False, repr=False)
class Trained(Short):
    """What a training has come to.

    Attributes:
        policy: the best of its rounds.
        folder: with ``policy.zip``, that one, and ``checkpoint.zip``, the latest.
        curve: a row for each round: ``steps``, ``seconds``, ``cpu_seconds``, ``explored``, and what unseen robots did.
        best: the row of the best.
        settings: how it was trained, as JSON data.
        reason: why it ended: ``"steps"``, ``"budget"`` or ``"stopped"``.
        files: what was written.
    """

    policy: Policy
    folder: Path
    curve: tuple[Mapping[str, Any], ...]
    best: Mapping[str, Any]
    settings: Mapping[str, Any]
    reason: str
    files: tuple[Path, ...]

    def told(self) -> str:
        """How well it does."""
        suited = self.policy.suited
        return (
            f" to {suited.task} with {suited.robot}: return {self.best['return']:.4g} at {self.best['steps']:,} steps"
        )

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        libraries = {name: _version(name) for name in LIBRARIES}
        return {
            "schema": SCHEMA, "task": self.policy.suited.task, "model": self.policy.suited.robot,
            "joints": self.policy.suited.joints, "actuators": self.policy.suited.actuators, "reason": self.reason,
            "best": dict(self.best), "settings": dict(self.settings), "versions": {**versions(), **libraries},
            "curve": [dict(row) for row in self.curve],
        }  # fmt: skip


def train(
    folder: Path | str,
    task: str,
    model: Model | Path | str | None = None,
    options: TrainOptions | None = None,
    *,
    force: bool = False,
    progress: Progress | None = None,
    stopped: Callable[[], bool] = lambda: False,
    **changes: Any,
) -> Trained:
    """Train a policy, or go on where the same was stopped.

    After each round of a few episodes of every robot, the policy is judged on robots that nobody trains on, and what is
    to be kept is written: ``policy.zip``, the best so far, which is a controller for ``run`` and ``compare``, and
    ``checkpoint.zip``, from which the same call goes on.

    Args:
        folder: for these.
        task: see ``make_env``.
        model: see ``make_env``.
        options: see ``TrainOptions``.
        force: begin anew.
        progress: called with the stage, the share done and the best so far.
        stopped: asked all the time; what it stops has cost a round.
        **changes: fields of the options.

    Raises:
        NotAvailable: where Stable-Baselines3 is not installed.
        EquimusError: for anything that cannot be, in one sentence.
    """
    options = with_changes(TrainOptions, options, changes)
    _require()
    from equimus_ctrl.learning.training import Trainer

    folder = Path(folder)
    nominal = model if isinstance(model, Model) else nominal_model() if model is None else load_model(model)
    kept, unseen = episodes_of(task, options.envs, nominal, options, options.seed), unseen_of(task, nominal, options)
    suited, settings = _suited(kept, nominal), _settings(task, nominal, options)
    trainer = Trainer(options.algorithm, kept, options.seed, options.hyper or {}, folder / BOARD)
    checkpoint, rows, best = folder / CHECKPOINT, [], None
    if checkpoint.exists() and not force:
        rows = _resumed(trainer, checkpoint, settings)
        best = Policy.from_bytes(presets.read_bytes(folder / POLICY), str(folder / POLICY)) if rows else None
    else:
        outputs.Results(folder, force, folder).opened(folder)
    begun, worked = time.monotonic(), time.process_time()
    before = {key: rows[-1][key] if rows else 0.0 for key in ("seconds", "cpu_seconds")}
    reason = ""
    while not reason:
        passed = time.monotonic() - begun
        if trainer.steps >= options.steps:
            reason = "steps"
        elif options.budget is not None and passed >= options.budget:
            reason = "budget"
        elif stopped() or not trainer.round(len(rows), stopped):
            reason = "stopped"
        else:
            policy = trainer.policy(suited)
            row = {
                "steps": trainer.steps, "seconds": before["seconds"] + time.monotonic() - begun,
                "cpu_seconds": before["cpu_seconds"] + time.process_time() - worked, "explored": trainer.said(),
                **judged(unseen, policy).to_dict(),
            }  # fmt: skip
            better = not rows or row["return"] > _best(rows)["return"]
            rows.append(row)
            record = {"settings": settings, "curve": rows}
            if better:
                best = policy.recorded({"settings": settings, "judged": row})
                presets.write_bytes(folder / POLICY, best.to_bytes())
            presets.write_bytes(checkpoint, policy.recorded(record).to_bytes(*trainer.state()))
            if progress is not None:
                progress("training", _share(trainer.steps, options, time.monotonic() - begun), _words(_best(rows)))
    if best is None:
        raise ConfigError("the training was stopped before its first round was over, and nothing was learned")
    return Trained(best, folder, tuple(rows), _best(rows), settings, reason, (folder / POLICY, checkpoint))


def write_training(found: Trained, files: Iterable[Path] = ()) -> Path:
    """Write ``record.json`` into the folder of a training, in the place of an earlier one."""
    return outputs.write_record(found.folder, "record.json", found.to_dict(), files or found.files)


def write_onnx(found: Trained) -> Path:
    """Write the best policy as ``policy.onnx`` into the folder of a training, in the place of an earlier one.

    Raises:
        NotAvailable: where the library ``onnx`` is not installed.
    """
    path = found.folder / ONNX
    presets.write_bytes(path, to_onnx(found.policy))
    return path


def export_policy(path: Path | str, policy: Policy | Path | str, *, force: bool = False) -> Path:
    """Write a policy as an ONNX file, see ``learning.onnx_policy``: for other programs, and a controller as well.

    Args:
        path: where.
        policy: which, or the file that ``train`` wrote of it.
        force: replace what is there.

    Raises:
        NotAvailable: where the library ``onnx`` is not installed.
        EquimusError: for anything that cannot be, in one sentence.
    """
    path = Path(path)
    outputs.check_new(path, force)
    if not isinstance(policy, Policy):
        policy = Policy.from_bytes(presets.read_bytes(Path(policy)), str(policy))
    presets.write_bytes(path, to_onnx(policy))
    return path


def film_of_training(found: Trained, model: Model, options: TrainOptions) -> tuple[list[Any], float]:
    """Pictures of what the best policy does on the unseen robot on which it does best, and how many a second."""
    from equimus_ctrl.learning.rendering import film_of

    episodes = unseen_of(found.policy.suited.task, model, options)
    best = int(judged(episodes, found.policy).returns.argmax()) % episodes.count
    return film_of(episodes, lambda observed, period: found.policy.act(observed), best, UNSEEN_SEED)


def episodes_of(task: str, n: int, model: Model, options: TrainOptions, robot_seed: int) -> Episodes:
    """Episodes as options have them, on robots of a seed."""
    told = options.task_options or {}
    scenario = None if task == KICK else told
    own = kick_settings(told) if task == KICK else {}
    return make_episodes(
        task, n, model, control=options.control, noise=options.noise, history=options.history,
        randomise=options.randomise, robots=options.robots, robot_seed=robot_seed, diagnosis=options.diagnosis,
        scenario=scenario, threads=options.threads, **own,
    )  # fmt: skip


def unseen_of(task: str, model: Model, options: TrainOptions, seed: int = UNSEEN_SEED) -> Episodes:
    """Episodes on robots that nobody trains on."""
    changed = with_changes(TrainOptions, options, {"robots": options.unseen})
    return episodes_of(task, options.unseen, model, changed, seed)


def judged(episodes: Episodes, policy: Policy) -> Judged:
    """How well a policy does its task; the same episodes for all policies."""
    return judge(episodes, lambda observed, period: policy.act(observed), UNSEEN_SEED)


def kick_settings(told: Mapping[str, str]) -> dict[str, Any]:
    """Fields of ``KickSettings`` from text.

    Raises:
        ConfigError: for an unknown name, or text that does not fit.
    """
    known = {own.name: own for own in fields(KickSettings) if own.name != "ball"}
    read: dict[str, Callable[[str], Any]] = {"kicker": str, "place": _place, "seen": _yes}
    found = {}
    for name, text in told.items():
        if name not in known:
            raise ConfigError(unknown_name("option", name, known, KICK))
        try:
            found[name] = read.get(name, float)(text)
        except ValueError:
            raise ConfigError(f"--set {name}={text}: expected {_EXPECTED.get(name, 'a number')}") from None
    return found


_EXPECTED = {"place": "three numbers of metres, such as 0.3,0,0.1", "seen": "yes or no"}


def _place(text: str) -> tuple[float, ...]:
    numbers = tuple(float(part) for part in text.split(","))
    if len(numbers) != 3:
        raise ValueError
    return numbers


def _yes(text: str) -> bool:
    if text not in ("yes", "no", "true", "false"):
        raise ValueError
    return text in ("yes", "true")


def _resumed(trainer: Any, path: Path, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The curve so far, the trainer having what it learned."""
    data, where = presets.read_bytes(path), str(path)
    record = Policy.from_bytes(data, where).record
    before = record.get("settings", {})
    for name in settings:
        if before.get(name) != settings[name]:
            raise ConfigError(
                f"{where}: is a training with {name} {before.get(name)!r}, not {settings[name]!r}; expected another "
                "--output, or --force to begin anew"
            )
    trainer.restore(*training_state(data, where))
    return [dict(row) for row in record.get("curve", [])]


def _settings(task: str, model: Model, options: TrainOptions) -> dict[str, Any]:
    """What has to be the same for a training to go on."""
    own = {key: value for key, value in asdict(options).items() if key not in MEANWHILE}
    own["diagnosis"] = None if options.diagnosis is None else str(options.diagnosis)
    whole = json.dumps(model_to_dict(model), sort_keys=True, default=str)
    settings = {"task": task, "model": model.name, **own, "model_sha256": hashlib.sha256(whole.encode()).hexdigest()}
    plain: dict[str, Any] = json.loads(json.dumps(settings))
    return plain


def _suited(episodes: Episodes, model: Model) -> Suited:
    task, settings = episodes.task, episodes.settings
    return Suited.to(
        episodes.plant.spec, robot=model.name, history=settings.history, privileged=settings.privileged,
        task=task.name, sight=task.sight, blind=task.blind,
    )  # fmt: skip


def _best(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The first of the greatest returns."""
    return max(rows, key=lambda row: row["return"])


def _share(steps: int, options: TrainOptions, passed: float) -> float:
    return min(max(steps / options.steps, passed / (options.budget or math.inf)), 1.0)


def _words(row: Mapping[str, Any]) -> str:
    success = "" if row["success"] is None else f", success {100 * row['success']:.0f} %"
    return f"return {row['return']:.4g}{success}"


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "none"


def _require() -> None:
    for library in ("gymnasium", "stable_baselines3"):
        try:
            __import__(library)
        except ImportError:
            raise needs(library, "rl", "training") from None
