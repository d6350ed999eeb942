"""Designed trials in a proof: designed blindly, made with the sealed robot, diagnosed blindly, one after the other.

Three processes do one trial. One knows the explanations that the last diagnosis leaves and designs it. One draws the
robot again from its seed and plays the commands; only its recording goes on. One diagnoses all recordings so far. Each
answer says of what it was made (SHA-256), so what is there is not done again, and what follows from something that
changed is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from equimus_ctrl import presets
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.executors.base import Executor
from equimus_ctrl.executors.calls import Ended
from equimus_ctrl.experiments.conditions import known_conditions
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.models.model import Model
from equimus_ctrl.options import DesignOptions, ProveOptions
from equimus_ctrl.proof import blind, chirps
from equimus_ctrl.proof.designing import Design, Designing, End, next_trial
from equimus_ctrl.proof.further import make_trial
from equimus_ctrl.proof.poor import poor_recordings
from equimus_ctrl.proof.resolved import Resolved, followed
from equimus_ctrl.proof.seal import digest, opened
from equimus_ctrl.proof.store import Request, recorded
from equimus_ctrl.recordings.folders import read_text, write_folder, write_text
from equimus_ctrl.types import Recording
from equimus_ctrl.workflow.experiments import limits_for
from equimus_ctrl.workflow.proof_files import parsed, require_all

T = TypeVar("T")


def further_limits(options: ProveOptions, model: Model) -> Limits | None:
    """What designed trials must not leave; None where there are none.

    Raises:
        ConfigError: where commands have no limits, or a limit cannot be.
    """
    if not options.experiments:
        given = [n for n in ("limits", "limit", "can", "evaluations") if getattr(options, n)]
        if given and (options.excites == "rich" or given[-1] in ("can", "evaluations")):
            raise ConfigError(f"--{given[-1]} is for designed trials; expected --experiments with it")
        return None
    found = limits_for(DesignOptions(limits=options.limits, limit=options.limit), model.robot)
    known_conditions(options.can, model)
    found.bounds(np.zeros(len(model.robot.actuator_names)))  # commands without limits are told before anything is done
    return found


def poor_recordings_of(model: Model, options: ProveOptions) -> tuple[Recording, ...]:
    """Small chirps of an MJCF robot, in the place of recordings."""
    given = DesignOptions(limits=options.limits, limit=options.limit)
    duration = chirps.DURATION if options.duration is None else options.duration
    limits = replace(limits_for(given, model.robot), duration=duration)
    return poor_recordings(model, limits, options.trials or chirps.TRIALS, options.seed)


@dataclass(frozen=True, eq=False)
class _Answer:
    """A file that is of this version of the program and of what came before.

    Attributes:
        data: in it.
        sha256: of it.
    """

    data: dict[str, Any]
    sha256: str


@dataclass(frozen=True, eq=False)
class _Chain:
    """A case as far as it was followed.

    Attributes:
        reports: without and with each designed trial more.
        designs: of the trials, and one more where that is why there is none.
        driven: what is known of the trials that were made.
        end: why there is no further one; None where as many were made as were asked for, or where it goes on.
    """

    reports: tuple[_Answer, ...]
    designs: tuple[_Answer, ...]
    driven: tuple[_Answer, ...]
    end: End | None


@dataclass(frozen=True, eq=False)
class Further:
    """Designed trials of the cases of a proof.

    Attributes:
        request: that the cases were made from.
        seals: of them, by their numbers.
        options: of the proof.
        limits: that the trials keep.
        progress: called with the stage, how many cases are done, and how many there are.
        say: called with sentences for people.
    """

    request: Request
    seals: Mapping[int, str]
    options: ProveOptions
    limits: Limits
    progress: Callable[[str, int, int], None]
    say: Callable[[str], None]

    @property
    def designing(self) -> Designing:
        """How trials are designed."""
        conditions = known_conditions(self.options.can, self.request.model)
        return Designing(self.limits, self.options.evaluations, conditions=conditions)

    def carry_out(self, executor: Executor) -> None:
        """Design, make and diagnose trials that are not there yet.

        Raises:
            EquimusError: where a process ended without an answer.
        """
        for number in range(1, self.options.experiments + 1):
            going = {case: chain for case in self.seals if (chain := self._chain(case, number - 1)).end is None}
            self._stage(executor, number, "designs", going, self._to_design, next_trial)
            going = {case: chain for case in going if (chain := self._chain(case, number, "designs")).end is None}
            self._make(executor, number, going)
            going = {case: chain for case in going if (chain := self._chain(case, number, "driven")).end is None}
            self._stage(executor, number, "answers", going, self._to_diagnose, blind.answer_with)

    def seal_answers(self, name: str) -> str:
        """Write SHA-256 of all answers into a file, and say theirs: from then on none can be changed unseen."""
        lines = [
            f"{own.sha256}  case_{case:04d} after {number}\n"
            for case in self.seals
            for number, own in enumerate(self._chain(case, self.options.experiments).reports)
        ]
        whole = hashlib.sha256("".join(lines).encode()).hexdigest()
        presets.write_text(self.request.root / f"{name}.txt", f"{whole}  all\n{''.join(lines)}")
        self.say(f"all answers after 0 to {self.options.experiments} designed trials are there; SHA-256: {whole}")
        return whole

    def resolved(self, truths: Sequence[Mapping[str, Any]], answers: str) -> Resolved:
        """What the trials came to.

        Args:
            truths: of all cases.
            answers: SHA-256 of all answers, see ``seal_answers``.

        Raises:
            ConfigError: where the recording of a designed trial was changed.
        """
        found, most = [], self.options.experiments
        for truth in truths:
            case = truth["case"]
            chain = self._chain(case, most)
            for number, own in enumerate(chain.driven, start=1):
                made = self.request.made(case, number)
                if own.data["failed"]:
                    continue
                if digest(recorded(made, self.request.model)) != own.data["recording_sha256"]:
                    raise ConfigError(f"{made}: the recording was changed after it was made")
            reports, designs, driven = (
                [own.data for own in several] for several in (chain.reports, chain.designs, chain.driven)
            )
            found.append(followed(truth, reports, designs, driven, chain.end, self.request.model.robot))
        margin = 1.0 / (self.designing.draws + 1)
        return Resolved(most, tuple(found), margin, answers)

    # --- what is there

    def _chain(self, case: int, most: int, until: str = "answers") -> _Chain:
        """What there is of a case, up to so many designed trials, the last one up to a stage.

        Raises:
            ConfigError: where something is missing that is not at its end.
        """
        request, designing = self.request, self.designing.fingerprint
        first = read_text(request.report(case)) or ""
        reports, designs, driven = [_Answer(parsed(first), _sha256(first))], list[_Answer](), list[_Answer]()

        def chain(end: End | None) -> _Chain:
            return _Chain(tuple(reports), tuple(designs), tuple(driven), end)

        for number in range(1, most + 1):
            if reports[-1].data["proof"].get("failed"):
                return chain("failed")
            designs.append(self._there(request.design(case, number), case, designing, reports[-1].sha256))
            left = self.options.experiments - number + 1
            if (end := Design.from_dict(designs[-1].data).ends(left)) is not None:
                return chain(end)
            if number == most and until == "designs":
                break
            driven.append(self._there(request.driven(case, number), case, None, designs[-1].sha256))
            if driven[-1].data["failed"]:
                return chain("failed")
            if number == most and until == "driven":
                break
            report = request.report(case, number)
            reports.append(self._there(report, case, blind.further_fingerprint(), driven[-1].sha256))
        return chain("failed" if reports[-1].data["proof"].get("failed") else None)

    def _there(self, path: Path, case: int, fingerprint: str | None, of: str) -> _Answer:
        found = self._current(path, case, fingerprint, of)
        if found is None:
            raise ConfigError(f"{path}: is missing, or was changed while the proof ran; run it again")
        return found

    def _current(self, path: Path, case: int, fingerprint: str | None, of: str) -> _Answer | None:
        """What a file holds; None where there is none, or one of something else."""
        text = read_text(path)
        found = parsed(text or "")
        own = found.get("proof", {})
        same = own.get("seal") == self.seals[case] and own.get("of") == of
        if not (same and (fingerprint is None or own.get("fingerprint") == fingerprint)):
            return None
        return _Answer(found, _sha256(text or ""))

    # --- what is done

    def _to_design(self, number: int, case: int, chain: _Chain) -> tuple[Path, str, str, Callable[[], tuple[Any, ...]]]:
        """The file, its fingerprint, of what it is, and what its process is given."""
        last = chain.reports[-1]
        made = {"seal": self.seals[case], "of": last.sha256}

        def given() -> tuple[Any, ...]:
            return last.data["rivals"], self.request.model, self.designing, case, number, made

        return self.request.design(case, number), self.designing.fingerprint, last.sha256, given

    def _to_diagnose(
        self, number: int, case: int, chain: _Chain
    ) -> tuple[Path, str, str, Callable[[], tuple[Any, ...]]]:
        request, of = self.request, chain.driven[-1].sha256
        made = {"seal": self.seals[case], "of": of}

        def given() -> tuple[Any, ...]:
            trials = list(recorded(request.recordings(case), request.model))
            first = len(trials)
            for k in range(1, number + 1):
                trials += recorded(request.made(case, k), request.model)
            before, predicted = chain.reports[-1].data["rivals"], chain.designs[-1].data["predicted"]
            return trials, request.model, first, before, predicted, made

        return request.report(case, number), blind.further_fingerprint(), of, given

    def _stage(
        self,
        executor: Executor,
        number: int,
        what: str,
        going: Mapping[int, _Chain],
        task: Callable[[int, int, _Chain], tuple[Path, str, str, Callable[[], tuple[Any, ...]]]],
        work: Callable[..., str],
    ) -> None:
        """Designs or diagnoses, each in a process of its own."""
        missing = list[tuple[int, Path, Callable[[], tuple[Any, ...]]]]()
        for case, chain in going.items():
            path, fingerprint, of, given = task(number, case, chain)
            if self._current(path, case, fingerprint, of) is None:
                missing.append((case, path, given))
        ended = dict[str, Ended]()
        for index, found in self._counted(number, what, going, missing, executor.each_apart(
            work, (given() for _, _, given in missing)
        )):  # fmt: skip
            case, path, _ = missing[index]
            if isinstance(found, Ended):
                ended[f"case_{case:04d}"] = found
            else:
                write_text(path, found)
        require_all(ended, "designed a trial of" if what == "designs" else "diagnosed")

    def _make(self, executor: Executor, number: int, going: Mapping[int, _Chain]) -> None:
        """Trials with the robots, by processes that draw them again."""
        request = self.request
        missing = [
            (case, chain)
            for case, chain in going.items()
            if self._current(request.driven(case, number), case, None, chain.designs[-1].sha256) is None
        ]
        work = partial(_made, request, number, self.limits)
        tasks = ((self._truth(case), chain.designs[-1].data) for case, chain in missing)
        for index, (recording, said) in self._counted(number, "trials", going, missing, executor.each(work, tasks)):
            case, chain = missing[index]
            if recording is not None:
                write_folder(request.made(case, number), [recording])
            proof = {"seal": self.seals[case], "of": chain.designs[-1].sha256}
            write_text(request.driven(case, number), blind.as_text({**said, "proof": proof}))

    def _counted(
        self, number: int, what: str, going: Mapping[int, _Chain], missing: Sequence[Any], done: Iterator[T]
    ) -> Iterator[T]:
        """The same, with how far it is told."""
        stage, finished = f"trial {number}: {what}", len(going) - len(missing)
        self.progress(stage, finished, len(going))
        for one in done:
            yield one
            finished += 1
            self.progress(stage, finished, len(going))

    def _truth(self, case: int) -> dict[str, Any]:
        """For the robot alone."""
        path = self.request.truth(case)
        return opened((read_text(path) or "").strip(), self.seals[case], str(path))


def _made(
    request: Request, number: int, limits: Limits, truth: Mapping[str, Any], design: Mapping[str, Any]
) -> tuple[Recording | None, dict[str, Any]]:
    return make_trial(request, truth, Design.from_dict(design), number, limits)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
