"""The proof: blinded synthetic ground truths with SHA-256 seals, diagnosed by other processes, then scored."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from equimus_ctrl import presets
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.executors.base import Executor
from equimus_ctrl.executors.calls import Ended
from equimus_ctrl.frames import dataframe
from equimus_ctrl.models.model import Model
from equimus_ctrl.options import ProveOptions, Shard, with_changes
from equimus_ctrl.proof import blind, chirps
from equimus_ctrl.proof.designs import DURATION, TRIALS
from equimus_ctrl.proof.drawing import Kind
from equimus_ctrl.proof.mjcf import Experiment, require_bare_mjcf
from equimus_ctrl.proof.resolved import Resolved
from equimus_ctrl.proof.scoring import Goal, Score, score
from equimus_ctrl.proof.seal import seal_of_all
from equimus_ctrl.proof.store import Request, make_cases, open_truth, recorded
from equimus_ctrl.recordings.folders import read_text, write_text
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow.plugins import load_plugins
from equimus_ctrl.workflow.proof_experiments import Further, further_limits, poor_recordings_of
from equimus_ctrl.workflow.proof_files import check_claim, claim, claimed, parsed, read_answer, require_all, wanted_of
from equimus_ctrl.workflow.proof_shards import merge_shards, note_shard, shard_name
from equimus_ctrl.workflow.scores import gather
from equimus_ctrl.workflow.where import where_of

if TYPE_CHECKING:
    from pandas import DataFrame

    from equimus_ctrl.options import Some

Progress = Callable[[str, int, int], None]
"""Called with the stage, how many cases are done, and how many there are."""
Say = Callable[[str], None]
"""Called with a sentence for people."""
FAR, SOME = 3.0, 0.1
"""Robots that cover so many times what the recorded one does ran away; a note says so from this share of them on."""
STAGES = ("simulating robots", "diagnosing", "scoring")


@dataclass(frozen=True, eq=False, repr=False)
class Proof(Short):
    """A proof that was carried through.

    Attributes:
        request: what was asked for.
        seal: of all seals.
        score: what it came to.
        notes: what else a person ought to know.
        seconds: how long all of it took.
        shard: the part of the cases that it is of; None of all.
        experiments: what designed trials came to; None where none were asked for.
    """

    request: Request
    seal: str
    score: Score
    notes: tuple[str, ...]
    seconds: float
    shard: Shard | None = None
    experiments: Resolved | None = None

    @property
    def goals(self) -> tuple[Goal, ...]:
        """By which it is judged: where trials are designed, those of these, for the first recordings are poor."""
        return self.experiments.goals if self.experiments else self.score.goals

    @property
    def accurate(self) -> bool:
        """Whether no goal of accuracy is missed."""
        return self.experiments.accurate if self.experiments else self.score.accurate

    def told(self) -> str:
        """The robot, and the score."""
        told = f" of the diagnosis on {self.request.model.name}, seed {self.request.seed}:{self.score.told()}"
        return told + (f"; {self.experiments.told()}" if self.experiments else "")

    def to_dataframe(self) -> DataFrame:
        """A row for each case: its ground truth, what was said of it, whether that is right.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        keys = ("case", "kind", "strength", "right", "verdict", "seconds")
        rows = [
            {key: line[key] for key in keys} | {key: _phrase(line[key]) for key in ("truth", "named")}
            for line in self.score.lines
        ]
        return dataframe(rows, "case")

    def to_dict(self) -> dict[str, Any]:
        """What ``prove --json`` prints."""
        r = self.request
        found = self.score.to_dict()
        head = {
            "schema": found.pop("schema"),
            "robot": r.model.name,
            "seed": r.seed,
            "kind": r.kind,
            "trials": r.trials,
            **({"shard": str(self.shard)} if self.shard else {}),
        }
        rest = {"duration_s": r.duration, "seal": self.seal, "notes": list(self.notes), "seconds": self.seconds}
        whole = {**head, **rest, **found, "accurate": self.accurate}
        return whole | ({"experiments": self.experiments.to_dict()} if self.experiments else {})


def prove(
    folder: Path | str,
    options: ProveOptions | None = None,
    *,
    recordings: Some = (),
    model: Model | None = None,
    experiment: Experiment | None = None,
    plugins: Sequence[Path] = (),
    progress: Progress = lambda stage, done, total: None,
    say: Say = lambda sentence: None,
    **changes: Any,
) -> Proof:
    """Put the diagnosis to the proof. What is in the folder already is not done again.

    Args:
        folder: for everything that is made.
        options: see ``ProveOptions``.
        recordings: of an MJCF robot, whose commands drive those that are like it; with ``experiments`` there need be
            none: small chirps of the nominal robot take their place.
        model: of that robot; legs and trials that are drawn by default.
        experiment: a robot and its recordings as one, in the place of ``model`` and ``recordings``.
        plugins: files that register effects, see ``load_plugins``: those with sizes are drawn too, and looked for.
        progress: see ``Progress``.
        say: see ``Say``; the seal of all seals is said before the first diagnosis begins.
        **changes: of the options, one by one.

    Raises:
        ConfigError: for settings that make no proof, a folder that holds another one, or truths that were changed.
        EquimusError: where a diagnosis' process ended without an answer.
    """
    begun = time.perf_counter()
    options, folder = with_changes(ProveOptions, options, changes), Path(folder)
    experiment = experiment or experiment_of(recordings, model, options)
    request = _request(folder, options, experiment)
    cases = range(options.cases) if options.shard is None else options.shard.cases(options.cases)
    baselines = experiment is None if options.baselines is None else options.baselines
    limits = further_limits(options, request.model)
    presets.check_folder(folder)
    load_plugins(plugins)
    wanted = wanted_of(request, plugins)
    if options.merge:
        for other in options.merge:
            check_claim(other, wanted, claimed(other))
        merge_shards(request, options, baselines)
    claim(folder, wanted)
    prepare = partial(load_plugins, [path.resolve() for path in plugins]) if plugins else None
    done = 0

    def count_made(made: object) -> None:
        nonlocal done
        done += 1
        progress(STAGES[0], done, len(cases))

    progress(STAGES[0], 0, len(cases))
    with where_of(options.workers, options.scheduler, options.slurm).opened(len(cases), prepare) as executor:
        seals = {made.case: made.seal for made in make_cases(request, cases, executor, count_made)}
        whole = seal_of_all(list(seals.values()))
        lines = "".join(f"{one}  case_{case:04d}\n" for case, one in seals.items())
        presets.write_text(folder / f"{shard_name('seals', options.shard)}.txt", f"{whole}  all\n{lines}")
        say(f"{len(cases)} ground truths are sealed; SHA-256 of the seals: {whole}")
        notes = far_beyond(request, cases)
        for note in notes:
            say(note)
        notes += _diagnose(request, seals, executor, baselines, limits is not None, progress, say)
        more = None if limits is None else Further(request, seals, options, limits, progress, say)
        if more is not None:
            more.carry_out(executor)
    # Before any truth is opened.
    answers = "" if more is None else more.seal_answers(shard_name("answers", options.shard))
    if options.shard is not None:
        note_shard(request, options, baselines, whole)
    progress(STAGES[2], 0, len(cases))
    truths = []
    for case in cases:
        truths.append(open_truth(request, case))
        progress(STAGES[2], len(truths), len(cases))
    reports = [read_answer(request.report(case)) for case in cases]
    others = [read_answer(request.baselines(case))["answers"] if baselines else {} for case in cases]
    found = score(truths, reports, others, request.model.robot)
    resolved = None if more is None else more.resolved(truths, answers)
    return Proof(request, whole, found, tuple(notes), time.perf_counter() - begun, options.shard, resolved)


def experiment_of(recordings: Some, model: Model | None, options: ProveOptions) -> Experiment | None:
    """An MJCF robot and what is done with it; None where legs are put to the proof.

    Args:
        recordings: of the robot.
        model: of it; None of legs.
        options: of the proof.

    Raises:
        EquimusError: where one is given without the other, or cannot be used.
    """
    given = [recordings] if isinstance(recordings, Path | str) else list(recordings)
    if model is None:
        if given:
            first = given[0].name if isinstance(given[0], Recording) else given[0]
            raise ConfigError(f"{first}: recordings are for --model, an MJCF robot; a leg's trials are drawn")
        return None
    require_bare_mjcf(model)  # before its recordings are taken for a leg's
    if not given and options.excites == "poor":
        return Experiment(model, poor_recordings_of(model, options), options.track)
    if not given:
        raise ConfigError(
            f"{model.name}: an MJCF robot is driven as in recordings of it; give their folder or files too, or "
            "--excitation poor for small chirps"
        )
    if options.trials is not None or options.duration is not None:
        raise ConfigError("--trials and --duration are for legs; an MJCF robot is driven as in its recordings")
    if options.excitation is not None:
        raise ConfigError("--excitation is for legs; an MJCF robot is driven as in its recordings")
    return Experiment(model, tuple(gather(given, model)), options.track)


def far_beyond(request: Request, cases: Sequence[int]) -> list[str]:
    """A sentence where many robots moved much farther than the one of the recordings; none where they did not.

    Where nothing tracks, torques that a controller gave are played as they were: what it held then runs away.
    """
    if request.experiment is None:
        return []
    tracked = request.experiment.track is not None
    model = request.experiment.model
    usual = _covered(request.experiment.recordings)
    far = [bool(np.any(_covered(recorded(request.recordings(k), model)) > FAR * usual)) for k in cases]
    if sum(far) <= SOME * len(cases):
        return []
    return [
        f"{sum(far)} of {len(cases)} robots moved more than {FAR:g} times as far as the recorded one, so the score "
        "says little of this experiment; "
        + ("track at another frequency" if tracked else "where a controller gave these commands, add --track HZ")
    ]


def _covered(recordings: Sequence[Recording]) -> Array:
    """(nj,) the most that each joint covers in one of some recordings [rad or m]."""
    return np.asarray(np.max([np.ptp(r.position, axis=0) for r in recordings], axis=0))


def _request(folder: Path, options: ProveOptions, experiment: Experiment | None) -> Request:
    kind = cast("Kind | None", options.kind)
    if experiment is None:
        if options.track is not None:
            raise ConfigError("--track is for an MJCF robot; the valves of a leg hold it")
        usual = (chirps.TRIALS, chirps.DURATION) if options.excites == "poor" else (TRIALS, DURATION)
        given = options.trials, options.duration
        trials, duration = (own if own is not None else default for own, default in zip(given, usual, strict=True))
        return Request(folder, options.seed, kind, int(trials), duration, excitation=options.excites)
    if options.baselines:
        raise ConfigError("the simpler methods are for legs; an MJCF robot is put to the proof without them")
    return Request.of_mjcf(folder, options.seed, kind, experiment)


def _phrase(found: Sequence[Mapping[str, Any]]) -> str:
    """Effects and where they are, in one line."""
    return "; ".join(f"{own['effect']} at {', '.join(own['locations'])}" for own in found)


@dataclass(frozen=True, eq=False)
class _Current:
    """What makes an answer one of this version of the program, to this case.

    Attributes:
        seals: of all cases, by their numbers.
        report: fingerprint that a report must have.
        baselines: fingerprint that baselines' answers must have.
    """

    seals: Mapping[int, str]
    report: str
    baselines: str

    @classmethod
    def of(cls, seals: Mapping[int, str], further: bool) -> _Current:
        """Now; ``further`` where designed trials may follow."""
        return cls(seals, blind.report_fingerprint(further), blind.baselines_fingerprint(further))

    def holds(self, path: Path, case: int, what: str) -> bool | None:
        """Whether a file is of this version; None where there is none."""
        text = read_text(path)
        if text is None:
            return None
        found = parsed(text)
        own = found.get("proof", {}) if what == "report" else found
        return bool(own.get("seal") == self.seals[case] and own.get("fingerprint") == getattr(self, what))


def _diagnose(
    request: Request,
    seals: Mapping[int, str],
    executor: Executor,
    baselines: bool,
    further: bool,
    progress: Progress,
    say: Say,
) -> list[str]:
    current = _Current.of(seals, further)
    tasks: list[tuple[int, dict[str, Path]]] = []
    stale = {"report": 0, "baselines": 0}
    for case in seals:
        paths = {"report": request.report(case), **({"baselines": request.baselines(case)} if baselines else {})}
        states = {what: current.holds(path, case, what) for what, path in paths.items()}
        for what, state in states.items():
            stale[what] += state is False
        needed = {what: paths[what] for what, state in states.items() if not state}
        if needed:
            tasks.append((case, needed))
    for what, count in stale.items():
        if count:
            kind = "reports" if what == "report" else "answers of the baselines"
            say(f"{count} {kind} were made by another version of the program, or of other recordings: made again")
    if len(tasks) < len(seals):
        say(f"{len(seals) - len(tasks)} of {len(seals)} cases were diagnosed before")
    finished, ended = len(seals) - len(tasks), dict[str, Ended]()
    progress(STAGES[1], finished, len(seals))
    # Recordings are read when they are needed. Who diagnoses them is told of nothing else.
    given = (
        (recorded(request.recordings(case), request.model), request.model, "report" in needed, "baselines" in needed,
         further, seals[case])
        for case, needed in tasks
    )  # fmt: skip
    for index, found in executor.each_apart(blind.answer, given):
        case, needed = tasks[index]
        finished += 1
        if isinstance(found, Ended):
            ended[request.report(case).stem] = found
        else:
            for what, text in zip(("report", "baselines"), found, strict=True):
                if text is not None:
                    write_text(needed[what], text)
        progress(STAGES[1], finished, len(seals))
    require_all(ended, "diagnosed")
    changed = _Current.of(seals, further)
    mixed = sum(not changed.holds(request.report(case), case, "report") for case in seals)
    return [f"the program changed while it ran: {mixed} reports are of another version"] if mixed else []
