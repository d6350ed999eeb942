"""Cases on disk: recordings for everybody, truths for the end, seals before anything begins.

    <root>/recordings/case_0007/trial_00.csv …    all that a diagnosis may see
    <root>/seals/case_0007.txt                    SHA-256 of the truth
    <root>/truth/case_0007.json                   the truth, one line
    <root>/reports/case_0007.json                 what the diagnosis says
    <root>/baselines/case_0007.json               what simpler methods say
    <root>/further/01/designs/case_0007.json      with experiments: the first designed trial more, by the report alone,
    <root>/further/01/recordings/case_0007/…      what was recorded in it,
    <root>/further/01/driven/case_0007.json       whether the true robot kept the limits,
    <root>/further/01/reports/case_0007.json      and what the diagnosis says with it

A case is complete when its seal is there, for that is written last.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from equimus_ctrl.errors import ConfigError, SimulationDiverged
from equimus_ctrl.executors.base import Executor
from equimus_ctrl.models.model import Model
from equimus_ctrl.preflight.findings import stops
from equimus_ctrl.preflight.scatter import scatter_of
from equimus_ctrl.proof.designs import DURATION, TRIALS
from equimus_ctrl.proof.drawing import ATTEMPTS, Excess, GroundTruth, Kind, findings
from equimus_ctrl.proof.leg_simulation import RATE
from equimus_ctrl.proof.legs import Excitation, Legs
from equimus_ctrl.proof.mjcf import Experiment
from equimus_ctrl.proof.outside import acts_on
from equimus_ctrl.proof.seal import canonical, digest, opened, salted, seal
from equimus_ctrl.proof.sources import CaseSource
from equimus_ctrl.recordings.checks import Limits
from equimus_ctrl.recordings.folders import holds, read_text, write_folder, write_text
from equimus_ctrl.recordings.sets import read_set
from equimus_ctrl.types import Array, Recording

SCHEMA = "equimus-ctrl/proof-truth/1"


@dataclass(frozen=True)
class Request:
    """What a set of cases is made from.

    Attributes:
        root: folder of the proof.
        seed: of the whole.
        kind: of all cases; drawn for each by default.
        trials: of each case.
        duration: of each trial [s].
        rate: physics steps a second.
        experiment: an MJCF robot and what is done with it, in the place of legs and of trials that are drawn.
        excitation: how much trials of legs show.
    """

    root: Path
    seed: int
    kind: Kind | None = None
    trials: int = TRIALS
    duration: float = DURATION
    rate: float = RATE
    experiment: Experiment | None = None
    excitation: Excitation = "rich"

    @classmethod
    def of_mjcf(cls, root: Path, seed: int, kind: Kind | None, experiment: Experiment) -> Request:
        """Of an MJCF robot; trials, their duration and the physics' rate follow from what is done with it."""
        times = [r.time for r in experiment.recordings]
        longest = max(float(t[-1] - t[0]) for t in times)
        return cls(root, seed, kind, len(times), longest, experiment.rate, experiment)

    @property
    def source(self) -> CaseSource:
        """What cases are made from."""
        return self.experiment or Legs(self.trials, self.duration, self.rate, self.excitation)

    @property
    def model(self) -> Model:
        """What a diagnosis takes the robot to be."""
        return self.source.nominal

    @property
    def trial_names(self) -> list[str]:
        """Of every case."""
        return self.source.trial_names

    def ground_truth(self, case: int) -> tuple[GroundTruth, list[Array], dict[str, Any]]:
        """A case's ground truth, for each trial what its sensors would show without noise, and all there is to know.

        Raises:
            ConfigError: where none of many robots in turn can be simulated.
        """
        for attempt in range(ATTEMPTS):
            # What flies apart was no robot, nor can that be judged which equations of motion cannot follow at any step
            # that they take, nor what does not move but for its noise. Another is drawn, from a stream of its own.
            found = self.source.draw(self.seed, case, self.kind, attempt)
            try:
                driven, clean = self.source.simulate(found)
                shown = [scatter_of(recording) for recording in self.source.recorded(driven, clean)]
                if not stops(self.model, shown):
                    return driven, clean, truth_of(self.source, driven, clean)
            except SimulationDiverged:
                continue
        raise ConfigError(
            f"case {case} of seed {self.seed}: {ATTEMPTS} robots in turn diverged on these commands, or did not move"
        )

    def recordings(self, case: int) -> Path:
        """The folder that a diagnosis is given."""
        return self.root / "recordings" / f"case_{case:04d}"

    def seal(self, case: int) -> Path:
        """The file with the case's seal."""
        return self.root / "seals" / f"case_{case:04d}.txt"

    def truth(self, case: int) -> Path:
        """The file with the case's truth."""
        return self.root / "truth" / f"case_{case:04d}.json"

    def report(self, case: int, more: int = 0) -> Path:
        """The file with what the diagnosis says of the case, with so many designed trials more."""
        return self.further(more) / "reports" / f"case_{case:04d}.json"

    def further(self, number: int) -> Path:
        """The folder of designed trials of a number, from 1 on; at 0 that of the proof."""
        return self.root / "further" / f"{number:02d}" if number else self.root

    def design(self, case: int, number: int) -> Path:
        """The file with a designed trial."""
        return self.further(number) / "designs" / f"case_{case:04d}.json"

    def made(self, case: int, number: int) -> Path:
        """The folder with its recording."""
        return self.further(number) / "recordings" / f"case_{case:04d}"

    def driven(self, case: int, number: int) -> Path:
        """The file that says whether the true robot kept the limits in it."""
        return self.further(number) / "driven" / f"case_{case:04d}.json"

    def baselines(self, case: int) -> Path:
        """The file with what simpler methods say of the case."""
        return self.root / "baselines" / f"case_{case:04d}.json"


@dataclass(frozen=True)
class Made:
    """One case that is there.

    Attributes:
        case: its number.
        seal: SHA-256 of its truth.
        seconds: what it took; 0 where it was there already.
    """

    case: int
    seal: str
    seconds: float


DRAWN = ("seed", "case", "kind", "parameters", "outside", "noise_rad", "noise_correlation_s")
"""Of a truth what is drawn, beside its findings; the rest follows from that."""


def redrawn(request: Request, truth: Mapping[str, Any]) -> GroundTruth:
    """A ground truth drawn again from its seed, the same as its truth says.

    Args:
        request: that it was made from.
        truth: its.

    Raises:
        ConfigError: where this version of the program draws another.
    """
    wanted = canonical(_drawn(truth))
    for attempt in range(ATTEMPTS):
        found = request.source.draw(request.seed, truth["case"], request.kind, attempt)
        if canonical(_drawn(_told(found, [{} for _ in findings(found.effects)]))) == wanted:
            return found
    raise ConfigError(
        f"{request.truth(truth['case'])}: this version of the program draws other robots, so no trial more can be made "
        "with this one; expected the version that made it, or another folder"
    )


def _drawn(truth: Mapping[str, Any]) -> dict[str, Any]:
    own = [{key: found[key] for key in ("effect", "locations", "parameters")} for found in truth["findings"]]
    return {**{key: truth[key] for key in DRAWN}, "findings": own}


def truth_of(source: CaseSource, ground_truth: GroundTruth, clean: list[Array]) -> dict[str, Any]:
    """All there is to know of a ground truth, as JSON.

    ``excess`` is what is left of data without noise when the default parameters have been fitted without any effect. In
    a pair ``alone`` says of each finding how much is left when only it is missing.
    """
    nothing = not ground_truth.effects and not ground_truth.outside
    left = source.excess(ground_truth, clean, refit=not nothing)
    found, alone_by = [], dict[str, Excess]()
    for name, _, _ in findings(ground_truth.effects):
        if name not in alone_by:
            others = [e for e in ground_truth.effects if e.name != name]
            alone_by[name] = source.excess(ground_truth, clean, others) if others else left
        alone = alone_by[name]
        scales = {key: scale for (effect, key), scale in ground_truth.scales.items() if effect == name}
        found.append({"alone": alone.total, **({"scales": scales} if scales else {})})
    joints = ground_truth.robot.joint_names
    return {
        "schema": SCHEMA,
        **_told(ground_truth, found),
        "trials": [trial.kind for trial in ground_truth.trials],
        "excess": left.total,
        "excess_joints": dict(zip(joints, left.joints, strict=True)),
        "refitted": left.parameters,
    }


def _told(ground_truth: GroundTruth, more: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What was drawn, as JSON, with more that is known of each finding."""
    joints = ground_truth.robot.joint_names
    found = [
        {"effect": name, "locations": locations, "parameters": parameters, **own}
        for (name, locations, parameters), own in zip(findings(ground_truth.effects), more, strict=True)
    ]
    beyond = [
        {"effect": e.name, "locations": acts_on(e, ground_truth.robot), "parameters": e.parameters()}
        for e in ground_truth.outside
    ]
    return {
        "seed": ground_truth.seed,
        "case": ground_truth.case,
        "kind": ground_truth.kind,
        "parameters": {name: ground_truth.robot.parameters()[name] for name in ground_truth.drawn},
        "findings": found,
        "outside": beyond,
        "noise_rad": dict(zip(joints, ground_truth.noise, strict=True)),
        "noise_correlation_s": ground_truth.correlation,
    }


@dataclass(frozen=True, eq=False)
class NewCase:
    """One case before it is written.

    Attributes:
        line: its truth.
        recordings: all that a diagnosis may see.
        seconds: what it took.
    """

    line: str
    recordings: tuple[Recording, ...]
    seconds: float


def new_case(request: Request, case: int) -> NewCase:
    """One case, which follows from the request and its number alone; no file is touched."""
    began = time.perf_counter()
    ground_truth, clean, truth = request.ground_truth(case)
    seen = request.source.recorded(ground_truth, clean)
    made = {"duration_s": request.duration, "physics_hz": request.rate, "recordings_sha256": digest(seen)}
    line = salted({**truth, **made}, request.seed, case)
    return NewCase(line, tuple(seen), time.perf_counter() - began)


def made_before(request: Request, case: int) -> Made | None:
    """A case that is there; None of one that is not.

    Raises:
        ConfigError: where it was changed, or is of another request.
    """
    known, line = read_text(request.seal(case)), read_text(request.truth(case))
    if known is None or line is None or not holds(request.recordings(case), request.trial_names):
        return None
    truth = opened(line.strip(), known.strip(), f"case {case}")
    _check_same(request, truth)
    return Made(case, known.strip(), 0.0)


def _written(request: Request, case: int, drawn: NewCase) -> Made:
    write_folder(request.recordings(case), drawn.recordings)
    write_text(request.truth(case), drawn.line + "\n")
    write_text(request.seal(case), seal(drawn.line) + "\n")
    return Made(case, seal(drawn.line), drawn.seconds)


def make_case(request: Request, case: int) -> Made:
    """Make one case, unless it is there."""
    return made_before(request, case) or _written(request, case, new_case(request, case))


def _check_same(request: Request, truth: dict[str, Any]) -> None:
    wanted: dict[str, Any] = {"seed": request.seed, "duration_s": request.duration, "physics_hz": request.rate}
    if request.kind is not None:
        wanted["kind"] = request.kind
    for key, value in wanted.items():
        if truth[key] != value:
            raise ConfigError(
                f"{request.root}: case {truth['case']} was made with {key} {truth[key]}, not {value}; choose another "
                "folder"
            )


def make_cases(
    request: Request,
    cases: Iterable[int],
    executor: Executor,
    notify: Callable[[Made], None] = lambda made: None,
) -> list[Made]:
    """Make cases that are not there yet.

    Args:
        request: what of.
        cases: their numbers.
        executor: draws and simulates them; they are written here.
        notify: called with each case as it is done; those are kept, whatever ends the work.

    Returns:
        All of them by number.

    Raises:
        NotAvailable: where the executor cannot go on.
    """
    made, missing = list[Made](), list[int]()
    for case in cases:
        there = made_before(request, case)
        if there is None:
            missing.append(case)
        else:
            notify(there)
            made.append(there)
    for index, drawn in executor.each(partial(new_case, request), ((case,) for case in missing)):
        done = _written(request, missing[index], drawn)
        notify(done)
        made.append(done)
    return sorted(made, key=lambda m: m.case)


def recorded(folder: Path, model: Model) -> tuple[Recording, ...]:
    """A case's recordings.

    Raises:
        RecordingError: where they cannot be read.
    """
    if model.robot.traits.commands_are_pressures:
        return read_set(folder)
    joints, actuators = model.robot.joint_names, model.robot.actuator_names
    return read_set(folder, joints=joints, actuators=actuators, limits=Limits.of_mjcf(joints, actuators))


def open_truth(request: Request, case: int) -> dict[str, Any]:
    """The truth of a case, its seal and the recordings checked.

    Raises:
        ConfigError: where it is not there, or it or the recordings were changed.
        RecordingError: where the recordings cannot be read.
    """
    line, sealed = read_text(request.truth(case)), read_text(request.seal(case))
    if line is None or sealed is None:
        missing = request.truth(case) if line is None else request.seal(case)
        raise ConfigError(f"{missing}: the file is missing, so case {case} cannot be opened")
    truth = opened(line.strip(), sealed.strip(), str(request.truth(case)))
    if digest(recorded(request.recordings(case), request.model)) != truth["recordings_sha256"]:
        raise ConfigError(f"{request.recordings(case)}: the recordings were changed after their truth was sealed")
    return truth
