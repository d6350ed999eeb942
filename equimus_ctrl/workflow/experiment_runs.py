"""Experiments in a loop: designed, made on any plant, recorded and diagnosed, until one explanation is left.

    <folder>/request.json                      what it began with
    <folder>/trials/designed_01.csv …          recordings of the trials that were made
    <folder>/step_01/design.csv, design.json   what was to be made, why, and what it was expected to distinguish
    <folder>/step_01/corrected.toml            the model with what was found
    <folder>/step_01/belief.json               explanations after it, and how the prediction turned out
    <folder>/step_01/diagnosis.json            record of the diagnosis of all trials so far
    <folder>/attempts/                         recordings of trials that did not go through
    <folder>/log.jsonl, log.md                 all of it, for programs and for people

Each file appears whole or not at all, the last two of a step at its end, and what is there is not done again. Step 0 is
the diagnosis of what there was before, or where there was nothing a first trial that moves everything.
"""

from __future__ import annotations

import itertools
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from equimus_ctrl import outputs, presets
from equimus_ctrl.diagnosis.diagnose import Progress
from equimus_ctrl.diagnosis.rivals import Rivals, identity
from equimus_ctrl.effects.base import Effect
from equimus_ctrl.errors import ConfigError, NothingFeasible
from equimus_ctrl.experiments.conditions import known_conditions
from equimus_ctrl.experiments.families import families
from equimus_ctrl.experiments.first import first_trial
from equimus_ctrl.experiments.loop import (
    End,
    Predicted,
    belief_of,
    fitted_share,
    held_out,
    hopeless,
    known_from,
    label_of,
    no_longer_left,
    realised,
    why,
    why_not,
    with_better,
    worth_making,
)
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import DiagnoseOptions, RunExperimentsOptions, with_changes
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.plants.registry import PLANTS
from equimus_ctrl.proof.seal import digest
from equimus_ctrl.recordings import CommandFile, write_commands
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.diagnoses import diagnose
from equimus_ctrl.workflow.experiment_steps import SCHEMA, ExperimentRun, Plan, Step, read_json, write_log
from equimus_ctrl.workflow.experiments import design_experiment, limits_for
from equimus_ctrl.workflow.models import save_model
from equimus_ctrl.workflow.runs import run_scenario
from equimus_ctrl.workflow.scores import gather

if TYPE_CHECKING:
    from equimus_ctrl.options import Some

FIRST, NAMED = "first", "designed_"
"""Names of the trials that are made: the first one where nothing was recorded before, and designed ones by number."""
Ask = Callable[[str], None]
"""Called before a trial with what has to be set first, as a sentence; raises where it is not."""
Say = Callable[[str], None]
"""Called with a sentence for people."""
MAY_CHANGE = ("limits", "trials", "seconds", "threads", "budget", "evaluations", "sensor_noise")
"""Options with which experiments may go on that began with others; the file of limits counts by what it says."""
ENDS: Mapping[End, str] = {
    "resolved": "one explanation is left",
    "inseparable": "within the limits nothing more can be distinguished",
    "trials": "as many trials were made as were asked for",
    "seconds": "another trial would take longer than was asked for",
}
NOTHING_BESIDE = "beside it nothing more can be seen within the limits"


@dataclass(frozen=True, eq=False)
class _Bench:
    """What trials are made with, and what they are diagnosed by.

    Attributes:
        folder: of everything.
        model: the nominal one.
        options: of the loop.
        given: recordings from before.
        plant: name of the plant.
        effects: hidden in a simulation.
        noise: of its sensors.
        hardware: how a real robot is reached.
        armed: whether that is commanded.
        source: file of the model.
        ask: see ``Ask``; None where nobody can be asked.
        progress: see ``diagnosis.diagnose``.
        say: see ``Say``.
    """

    folder: Path
    model: Model
    options: RunExperimentsOptions
    given: tuple[Recording, ...]
    plant: str
    effects: tuple[Effect, ...]
    noise: float
    hardware: HardwareSettings | None
    armed: bool
    source: Path | None
    ask: Ask | None
    progress: Progress
    say: Say
    made: list[Recording] = field(default_factory=list)

    def place(self, number: int) -> Path:
        """The folder of a step."""
        return self.folder / f"step_{number:02d}"

    def planned(self, number: int, before: Rivals | None) -> Plan:
        """The trial of a step: as it was planned before, or designed now."""
        here = self.place(number)
        if (known := Plan.read(here)) is not None:
            return known
        begun = time.perf_counter()
        limits, seed = limits_for(self.options, self.model.robot), self.options.seed + number

        def progress(stage: str, share: float) -> None:
            self.progress(f"step {number}: {stage}", share, "")

        if before is None:
            progress("first trial", 0.0)
            commands, amplitude, excess = first_trial(self.model, limits, seed, self.options.draws, self.options.track)
            record = {"family": "multisine", "amplitude": amplitude, "nearest_to_a_limit": str(excess)}
            trial, reason, linear = FIRST, "nothing was recorded before: it moves everything", False
            pairs: tuple[Predicted, ...] = ()
        else:
            options = replace(self.options, seed=seed)
            left = replace(before, fitted=fitted_share(options.validation))
            found = design_experiment(left, options=options, progress=progress)
            commands, linear = found.commands, before.linear
            pairs = Predicted.of(before, found.pairs)
            record = found.to_dict()
            trial, reason = f"{NAMED}{number:02d}", why(pairs) if pairs else "the recordings have settled all pairs"
        record["seconds"] = time.perf_counter() - begun
        presets.make_folder(here)
        actuators, joints = self.model.robot.actuator_names, self.model.robot.joint_names
        write_commands(here / "design.csv", actuators, command_file(commands, linear), joints)
        plan = Plan(trial, here / "design.csv", commands.duration, commands.notes, reason, pairs, record)
        presets.write_text(here / "design.json", presets.json_text(plan.to_dict()))
        return plan

    def recorded(self, number: int, plan: Plan, noted: Mapping[str, str]) -> Recording:
        """The recording of a planned trial: as it was made before, or made now.

        Args:
            number: of the step.
            plan: of it.
            noted: what was known to be different in the trial before it.
        """
        path = self.folder / "trials" / f"{plan.trial}.csv"
        if not path.exists():
            if dict(plan.notes) != dict(noted):
                self._require(plan, noted)
            attempt = outputs.free_name(self.folder / "attempts" / f"{plan.trial}.csv")
            presets.make_folder(attempt.parent)
            self.say(f"step {number}: {plan.trial}, {plan.duration:g} s: {plan.why}")
            done = run_scenario(
                "commands",
                model=self.model,
                effects=self.effects,
                plant=self.plant,
                options={"file": str(plan.file)},
                noise=self.noise,
                seed=self.options.seed + number,
                nominal=self.model,
                hardware=self.hardware,
                armed=self.armed,
                record=attempt,
                progress=lambda share: self.progress(f"step {number}: {plan.trial}", share, ""),
            )
            if done.recording is None:
                raise ConfigError(f"--plant {self.plant} records nothing, expected one that makes recordings")
            outputs.named_at_last(done.recording, path)
        (found,) = gather([path], self.model)
        return found

    def _require(self, plan: Plan, noted: Mapping[str, str]) -> None:
        """Have somebody set what is to be different in the next trial, where the plant does not do that by itself."""
        lines = [f"{key} = {text}" for key, text in plan.notes.items()]
        wanted = f"expects of the robot: {', '.join(lines)}" if lines else "expects the robot as it usually is"
        back = ", ".join(f"{key} = {text}" for key, text in noted.items() if plan.notes.get(key) != text)
        said = f"{plan.trial} {wanted}" + (f" (no longer {back})" if back else "")
        if self.ask is not None:
            self.ask(said)
        elif PLANTS.entry(self.plant).real:
            raise ConfigError(f"{said}; nobody can be asked to set that, expected a terminal, or ask=… in a program")

    def diagnosed(self, number: int, plan: Plan | None, before: Rivals | None) -> Step:
        """The explanations after a step: as it was found before, or diagnosed now."""
        here = self.place(number)
        if (known := Step.read(here, number, plan, self.model)) is not None:
            return known
        o = self.options
        options = DiagnoseOptions(
            free=o.free, fix=o.fix, exclude=o.exclude, also=o.also, validation=o.validation, threads=o.threads
        )

        def progress(stage: str, share: float, best: str) -> None:
            self.progress(f"step {number}: {stage}", share, best)

        trials = [*self.given, *self.made]
        from_before = trials[: max(len(self.given), 1)]
        heldout = held_out(from_before, len(trials) - len(from_before), options.validation)
        found = diagnose(trials, self.model, options, heldout=heldout, known=known_from(before), progress=progress)
        progress("belief", 0.0, "")
        now, gone = with_better(found.rivals, no_longer_left(before, found, found.rivals))
        became = () if plan is None or before is None else realised(before, plan.predicted, now, gone)
        belief = belief_of(now, gone)
        presets.make_folder(here)
        if not found.corrected.by_group:
            save_model(here / "corrected.toml", found.corrected, self.source)
        said = {"belief": belief.to_dict(), "realised": [own.to_dict() for own in became]}
        presets.write_text(here / "belief.json", presets.json_text(said))
        presets.write_text(here / "diagnosis.json", presets.json_text({**found.to_dict(), "rivals": now.to_dict()}))
        step = Step.read(here, number, plan, self.model)
        assert step is not None
        return step

    def spent(self, steps: Sequence[Step]) -> End | None:
        """What of the budget is spent."""
        made = [own.plan for own in steps if own.plan is not None]
        if sum(own.trial != FIRST for own in made) >= self.options.trials:
            return "trials"
        lasts = limits_for(self.options, self.model.robot).duration
        if self.options.seconds is not None and sum(own.duration for own in made) + lasts > self.options.seconds:
            return "seconds"
        return None


def run_experiments(
    folder: Path | str,
    recordings: Some = (),
    model: Model | None = None,
    options: RunExperimentsOptions | None = None,
    *,
    plant: str = "mujoco",
    effects: Sequence[Effect] = (),
    noise: float = 0.0,
    hardware: HardwareSettings | None = None,
    armed: bool = False,
    source: Path | None = None,
    ask: Ask | None = None,
    progress: Progress = lambda stage, share, best: None,
    say: Say = lambda sentence: None,
    **changes: Any,
) -> ExperimentRun:
    """Make experiments until one explanation is left, nothing more can be distinguished, or the budget is spent.

    All trials so far are diagnosed, a trial that distinguishes what that leaves is designed within the limits and made;
    and again. What is in the folder already is not done again.

    Args:
        folder: for everything that is made.
        recordings: from before; where there are none the first trial moves everything.
        model: of the robot; the nominal leg by default.
        options: see ``RunExperimentsOptions``.
        plant: by name: a simulation, or ``hardware``.
        effects: attached to a simulated robot; neither designs nor diagnoses know of them.
        noise: standard deviation of white noise on its measured positions [rad or m].
        hardware: how a real robot is reached, see ``load_hardware``.
        armed: whether commands are sent to it.
        source: the file that the model was read from, beside which corrected models name its XML.
        ask: called with what has to be set before a trial, such as a payload; raises where it is not. A simulation sets
            it by itself where nobody is asked; a real robot does not.
        progress: called with the stage, the share done and the best hypothesis so far.
        say: called with sentences for people.
        **changes: of the options, one by one.

    Raises:
        ConfigError: for options that cannot be, or others than those that the folder's experiments began with.
        EquimusError: where something given cannot be used, or no design stays within the limits.
        HardwareFault: where a real robot had to be stopped; the same call goes on with that trial.
    """
    model, folder = model or nominal_model(), Path(folder)
    options = with_changes(RunExperimentsOptions, options, changes)
    entry = PLANTS.entry(plant)
    if entry.real and not armed:
        raise ConfigError(f"experiments with --plant {plant} command a real robot, expected --arm")
    entry.check_effects(effects, model.effects)
    replace(model, effects=(*model.effects, *effects))  # places that there are not are told before anything is done
    if prescribed := model.robot.prescribed_names:
        raise ConfigError(
            f"{model.name}: the motion of {', '.join(prescribed)} is an input from recordings, which trials that are "
            "still to be made do not have; expected a robot whose joints all move by themselves"
        )
    given = tuple(gather(recordings, model)) if not _none(recordings) else ()
    if taken := [trial.name for trial in given if trial.name == FIRST or trial.name.startswith(NAMED)]:
        raise ConfigError(
            f"recording {taken[0]} has a name that trials of experiments get; expected another, for both are diagnosed"
        )
    known_conditions(options.can, model)  # what cannot be is told before anything is done
    families(options.family)
    limits_for(options, model.robot)
    presets.check_folder(folder)
    wanted = _wanted(model, options, given, plant, effects, noise)
    _claim(folder, wanted)
    bench = _Bench(
        folder, model, options, given, plant, tuple(effects), noise, hardware, armed, source, ask, progress, say
    )
    steps, files = list[Step](), tuple[Path, ...]()
    for step in _steps(bench, steps):
        steps.append(step)
        say(f"step {step.number}: {step.belief}")
        if step.doubt:
            say(f"step {step.number}: {step.doubt}")
        files = write_log(folder, model, steps, None)
    end, said = _ended(bench, steps)
    files = write_log(folder, model, steps, said)
    return ExperimentRun(model, folder, tuple(steps), end, said, tuple(bench.made), files)


def command_file(commands: Commands, linear: bool = False) -> CommandFile:
    """Commands of a design as a file has them: its last row says when they end."""
    times, values = np.asarray(commands.times), np.asarray(commands.commands)
    if times[-1] < times[0] + commands.duration:
        times = np.append(times, times[0] + commands.duration)
        values = np.vstack([values, values[-1]])
    reference = commands.reference
    if reference is not None:
        reference = np.vstack([reference, np.tile(reference[-1], (len(times) - len(reference), 1))])
    return CommandFile(
        times - times[0], values, values[0], commands.start, linear, dict(commands.notes), reference, commands.law
    )


def _steps(bench: _Bench, steps: Sequence[Step]) -> Iterator[Step]:
    """Steps one after the other, until there is a reason to end; see ``_ended`` for which."""
    for number in itertools.count():
        before, plan = steps[-1].rivals if steps else None, None
        if before is not None or not bench.given:
            if before is not None and (len(before.rivals) == 1 or bench.spent(steps)):
                return
            try:
                plan = bench.planned(number, before)
            except NothingFeasible:
                if not steps:
                    raise
                return
            made = sum(own.plan is not None and own.plan.trial != FIRST for own in steps)
            if before is not None and not worth_making(plan.predicted, bench.options.trials - made):
                return
            noted = steps[-1].plan.notes if steps and steps[-1].plan is not None else {}
            bench.made.append(bench.recorded(number, plan, noted))
        yield bench.diagnosed(number, plan, before)


def _ended(bench: _Bench, steps: Sequence[Step]) -> tuple[End, str]:
    """Why there was no further trial, and the same as a sentence."""
    last = steps[-1]
    if len(last.rivals.named) == 1:
        whole = last.verdict not in ("partly_explained", "unexplained")
        said = ENDS["resolved"] + ("" if whole else ", which does not explain all that was measured")
        if len(last.rivals.rivals) > 1:
            spent = bench.spent(steps)
            said += f"; {NOTHING_BESIDE if spent is None else ENDS[spent]}"
        return "resolved", said + (f"; but {last.doubt}" if last.doubt else "")
    spent = bench.spent(steps)
    plan, before = Plan.read(bench.place(last.number + 1)), last.rivals
    if plan is None and spent is not None and len(steps) > 1:
        plan, before = last.plan, steps[-2].rivals
    if plan is None:
        return ("inseparable", why_not(())) if spent is None else (spent, ENDS[spent])
    remedies = plan.record.get("remedies", ())
    if own := hopeless([label_of(rival) for rival in last.rivals.named], plan.predicted):
        pairs = {frozenset({pair.true, pair.other}) for pair in own}
        labels = [label_of(rival) for rival in before.rivals]
        remedies = [one for one in remedies if frozenset(labels[k] for k in one["pair"]) in pairs]
    elif spent is not None:
        return spent, ENDS[spent]
    return "inseparable", why_not(own or plan.predicted) + _remedy(remedies)


def _remedy(remedies: Sequence[Mapping[str, Any]]) -> str:
    """What would distinguish a pair that nothing else does, as a clause; none where nothing would."""
    best = max((own for own in remedies if own["settles"]), key=lambda own: own["gap"], default=None)
    if best is None:
        return ""
    what = "measuring" if best["kind"] == "sensor" else "knowing"
    return f"; {what} {best['name']} would (an expected gap of {best['gap']:.3g} in place of {best['without']:.3g})"


def _none(recordings: Some) -> bool:
    return not isinstance(recordings, Path | str) and not list(recordings)


def _wanted(
    model: Model,
    options: RunExperimentsOptions,
    given: Sequence[Recording],
    plant: str,
    effects: Sequence[Effect],
    noise: float,
) -> dict[str, Any]:
    """What the experiments in a folder have to be of; budgets may grow."""
    return {
        "schema": SCHEMA,
        "robot": model.name,
        "model_sha256": identity(model),
        "recordings_sha256": digest(given) if given else None,
        "plant": plant,
        "effects": [{"effect": e.name, "location": e.location, **e.parameters()} for e in effects],
        "noise": noise,
        "limits": None if options.limits is None else presets.read_toml(options.limits),
        **{key: value for key, value in vars(options).items() if key not in MAY_CHANGE},
    }


def _claim(folder: Path, wanted: Mapping[str, Any]) -> None:
    """Note in the folder what its experiments are of, or raise ConfigError where they are of something else."""
    text = presets.json_text(wanted)
    if (known := read_json(folder / "request.json")) is None:
        presets.write_text(folder / "request.json", text)
        return
    for key, value in json.loads(text).items():
        if known.get(key) != value:
            what = {"model_sha256": "another model", "recordings_sha256": "other recordings"}.get(
                key, f"{key} {known.get(key)}, not {value}"
            )
            raise ConfigError(f"{folder}: holds experiments that began with {what}; choose another folder")
