"""What ``controllers.py`` has controllers do, with which of them, and how a run is scored."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from _peers import ControlLqr, DoMpc, Judo

import equimus_ctrl as eq
from equimus_ctrl import presets
from equimus_ctrl.controllers.custom import as_controller
from equimus_ctrl.executors.where import Where
from equimus_ctrl.models.spread import groups, latin_hypercube, perturbed
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.tuning.autotune import NothingFeasible
from equimus_ctrl.tuning.journal import Memory, RowJournal
from equimus_ctrl.tuning.plant_tuning import make_plant_problem, tune_on_plant
from equimus_ctrl.tuning.study import study_from_dict
from equimus_ctrl.workflow import load_model, load_scenario
from equimus_ctrl.workflow.mjcf import load_mjcf

ROOT = Path(__file__).resolve().parents[1]
CARTPOLE = ROOT / "docs" / "examples" / "cartpole.xml"
NOISE = {"cartpole": 1e-3}
"""Robot → standard deviation of measured positions [rad or m]; ``USUAL_NOISE`` of the others."""
USUAL_NOISE, LATE, MASS = 2e-3, 0.02, 0.15
"""[rad or m]; dead time that no controller is told of [s]; by which share masses and inertias differ."""
LEAD, REST = 2.0, 2.0
"""Before a path begins, and after its end [s]."""
LOST = 0.3
"""A joint so far off its path is lost [rad or m]."""
SWINGS = 0.02
"""A joint that is to rest and moves by more, standard deviation over the last second, swings [rad or m]."""
SETTLING = 20
"""Steps that do not count for times: gains of the first poses, buffers."""

Maker = Callable[[int], Any]
"""Seed → controller."""


class Timed:
    """A controller and the processor time of each of its steps [s], of those in which it thought."""

    def __init__(self, own: Any) -> None:
        self.own, self.times, self.failed = own, list[float](), 0
        self.name = getattr(own, "name", type(own).__name__)

    def init(self, spec: eq.PlantSpec, observation: eq.Observation) -> Any:
        return self.own.init(spec, observation)

    def step(self, observation: eq.Observation, reference: eq.Reference, state: Any) -> tuple[Any, Any]:
        begun = time.process_time()
        command, state = self.own.step(observation, reference, state)
        spent, status = time.process_time() - begun, getattr(state, "status", "")
        if status != "held":
            self.times.append(spent)
        self.failed += status in ("failed", "shifted", "lqr", "hold")
        return command, state


@dataclass(frozen=True)
class Row:
    """One controller on one robot.

    Attributes:
        work: of ``WORKS``.
        robot: its name.
        controller: its name.
        draw: number of the robot and of the noise.
        rmse: of the true joints over what is scored [rad or m].
        tip: of the site over its path [m]; nan where there is none.
        offset: mean over the last second, largest of the joints [rad or m].
        swing: standard deviation over it [rad or m].
        arrival: when it is there for good [s]; nan where it never is, or where that is not asked.
        median: processor time of a step [s].
        p99: alike.
        unsolved: share of steps in which a solver failed or a fallback was taken.
        failure: why it failed; empty where it did not.
    """

    work: str
    robot: str
    controller: str
    draw: int
    rmse: float = float("nan")
    tip: float = float("nan")
    offset: float = float("nan")
    swing: float = float("nan")
    arrival: float = float("nan")
    median: float = float("nan")
    p99: float = float("nan")
    unsolved: float = 0.0
    failure: str = ""


@dataclass(frozen=True, eq=False)
class Work:
    """A robot, what it is to do, and who does it.

    Attributes:
        name: for tables.
        model: as controllers know it.
        scenario: what is done.
        makers: name → controller.
        spread: whether masses differ, and commands are late.
        seconds: that are driven; all by default.
    """

    name: str
    model: eq.Model
    scenario: eq.Scenario
    makers: Mapping[str, Maker]
    spread: bool = False
    seconds: float = 0.0

    def robots(self, draws: int, seed: int) -> list[eq.Model]:
        """Those that are driven."""
        if not self.spread:
            return [self.model] * draws
        robot = self.model.robot
        spread = groups(robot, {"mass": MASS})
        late = tuple(eq.TransportDelay(name, delay=LATE) for name in robot.actuator_names)
        rows = latin_hypercube(draws, len(spread), np.random.default_rng(seed))
        return [eq.Model(perturbed(robot, spread, row), late) for row in rows]


def driven(work: Work, name: str, robot: eq.Model, draw: int, seed: int) -> tuple[Row, eq.Run | None]:
    """One run, scored."""
    own = Timed(as_controller(work.makers[name](seed + draw), name))
    noise = NOISE.get(robot.name, USUAL_NOISE)
    plant = eq.MujocoPlant(robot, nominal=work.model, noise=noise)
    seconds = work.seconds or work.scenario.duration
    row = Row(work.name, robot.name, name, draw)
    try:
        done = eq.run(
            plant, own, work.scenario.reference, seconds, start=work.scenario.start, seed=1000 * seed + draw
        )  # fmt: skip
    except eq.SimulationDiverged:
        return replace(row, failure="diverged"), None
    except eq.EquimusError as error:
        return replace(row, failure=str(error)), None
    return scored(row, work.scenario, done, own), done


def scored(row: Row, scenario: eq.Scenario, done: eq.Run, own: Timed) -> Row:
    """A row with its figures."""
    assert done.truth is not None
    off = done.truth - done.reference
    if scenario.arrival is not None:  # a hinge without range may have turned whole turns more
        off = (off + np.pi) % (2 * np.pi) - np.pi
    low, high = scenario.score_window or (0.0, done.time[-1])
    inside, last = (done.time >= low) & (done.time <= high), done.time > done.time[-1] - 1.0
    tip, arrival = float("nan"), float("nan")
    if scenario.site is not None:
        path = scenario.site
        away = path.places(done.truth[inside]) - path.wanted_at(done.time[inside])
        tip = float(np.sqrt((away**2).sum(axis=1).mean()))
    if scenario.arrival is not None:
        near = scenario.arrival.near(done.spec.joint_units)
        outside = np.flatnonzero((np.abs(off) > near).any(axis=1))
        there = float(done.time[outside[-1] + 1]) if len(outside) and outside[-1] + 1 < len(done.time) else 0.0
        there = np.nan if len(outside) and done.time[-1] - done.time[outside[-1]] < 1.0 else there
        arrival = float(there)
        failure = "" if np.isfinite(arrival) else "not there by the end"
    else:
        failure = "lost" if np.abs(off[inside]).max() > LOST else ""
    swing = float(off[last].std(axis=0).max())
    if not failure and swing > SWINGS and scenario.arrival is None and done.time[-1] > high + 1.0:
        failure = "swings"
    times = np.array(own.times[min(SETTLING, len(own.times) // 2) :])
    return replace(
        row, rmse=float(np.sqrt((off[inside] ** 2).mean())), tip=tip, arrival=arrival, swing=swing, failure=failure,
        offset=float(np.abs(off[last].mean(axis=0)).max()), median=float(np.median(times)),
        p99=float(np.quantile(times, 0.99)), unsolved=own.failed / max(len(own.times), 1),
    )  # fmt: skip


# --- the works ----------------------------------------------------------------------------------------------------


def ours(**nmpc: Any) -> dict[str, Maker]:
    """This package's controllers, as they come."""
    return {
        "lqr": lambda seed: eq.LqrController(),
        "nmpc": lambda seed: eq.NmpcController(eq.NmpcSettings(**nmpc)),
        "sampling": lambda seed: eq.SamplingController(eq.SamplingSettings(seed=seed)),
    }


def stabilise() -> Work:
    """A pole that begins 0.2 rad from upright."""
    model = load_model(CARTPOLE)
    scenario = eq.Scenario(
        "stabilise", "the pole begins 0.2 rad from upright", 6.0, eq.HoldReference(np.zeros(2)),
        start=eq.Start(command=np.zeros(1), position=np.array([0.0, 0.2])), score_window=(5.0, 6.0),
        arrival=eq.Arrival(2.0, 50.0),
    )  # fmt: skip
    return Work("stabilise", model, scenario, {
        **ours(),
        "lqr 1 Hz": lambda seed: eq.LqrController(eq.LqrSettings(bandwidth=1.0)),
        "python-control": lambda seed: ControlLqr(0.1, 0.5, 0.3),
        "do-mpc": lambda seed: DoMpc(0.1, 1.0, 0.3, nodes=25, settle=0.5, wraps=(1,)),
        "judo": lambda seed: Judo(CARTPOLE, 0.1, 1.0, 1.0, 0.1, 0.8, seed, "mppi", every=1, wraps=(1,)),
    })  # fmt: skip


def swing_up() -> Work:
    """A pole that hangs."""
    model = load_model(CARTPOLE)
    scenario = load_scenario("swing_up", model.robot, options={"duration": "7"}, search=False)
    return Work("swing_up", model, replace(scenario, score_window=(6.0, 7.0)), {
        "nmpc": lambda seed: eq.NmpcController(eq.NmpcSettings(nodes=40, stride=5, iterations=20)),
        "sampling": lambda seed: eq.SamplingController(eq.SamplingSettings(seed=seed)),
        "do-mpc": lambda seed: DoMpc(0.3, 10.0, 0.5, nodes=50, stride=4, every=4, settle=0.5, wraps=(1,)),
        "judo": lambda seed: Judo(CARTPOLE, 0.3, 3.0, 1.0, 0.5, 1.2, seed, "cem", nodes=6, every=2, wraps=(1,)),
    })  # fmt: skip


def path_of(model: eq.Model, leg: float, **options: str) -> eq.Scenario:
    """A triangle of a robot's tip, and a rest behind it."""
    whole = LEAD + 3 * leg + REST
    given = {"shape": "triangle", "leg_time": f"{leg:g}", "duration": f"{whole:g}", **options}
    return load_scenario("track", model.robot, options=given, search=False)


SIZES = {"arm2": {"size": "0.15"}}
"""Robot → options of its triangle: stretched as its file has it, an arm of two joints hardly moves one way."""


def arm(file: Path, leg: float) -> Work:
    """Two joints, beside the peers."""
    model = load_model(file)
    return Work("arm", model, path_of(model, leg, **SIZES["arm2"]), {
        **ours(nodes=20),
        "sampling": lambda seed: eq.SamplingController(eq.SamplingSettings(seed=seed)),
        "python-control": lambda seed: ControlLqr(0.02, 0.2, np.array([0.5, 0.07]), integral=0.005, time=0.008),
        "do-mpc": lambda seed: DoMpc(0.02, 0.3, np.array([0.1, 0.015]), nodes=20, settle=0.3, time=0.008),
        "judo": lambda seed: Judo(file, 0.02, 0.2, 1e3, np.array([0.3, 0.06]), 0.4, seed, every=2),
    }, spread=True)  # fmt: skip


def speed(file: Path, leg: float) -> Work:
    """Six joints, NMPC of 20 intervals of two control periods."""
    model = load_model(file)
    return Work("speed", model, path_of(model, leg), {
        "nmpc": lambda seed: eq.NmpcController(eq.NmpcSettings(nodes=20)),
        "do-mpc": lambda seed: DoMpc(0.02, 0.4, 20.0, nodes=20),
    }, seconds=LEAD + leg)  # fmt: skip


def triangle(model: eq.Model, leg: float, candidates: int, seed: int, kept: Path | None) -> Work:
    """Any robot, LQR and NMPC beside the tuned PID with and without feed-forward."""

    @cache
    def settings(name: str) -> eq.PidSettings:  # tuned when it is first asked for
        file = kept and kept / f"pid_{model.name.replace(' ', '_')}_{name.split()[-1]}.toml"
        return tuned(model, FEEDS[name], candidates, seed, file)

    makers: dict[str, Maker] = {name: lambda seed, name=name: eq.PidController(settings(name)) for name in FEEDS}
    own = ours()
    makers |= {name: own[name] for name in ("lqr", "nmpc")}
    return Work("triangle", model, path_of(model, leg, **SIZES.get(model.name, {})), makers, spread=True)


FEEDS: Mapping[str, dict[str, bool]] = {
    "pid none": {"feedforward": False, "inverse": False},
    "pid hold": {"feedforward": True, "inverse": False},
    "pid inverse": {"feedforward": True, "inverse": True},
}
"""What the tuned PID feeds forward: nothing, what holds the reference at rest, its whole motion."""


def tuned(
    model: eq.Model, fed: Mapping[str, bool], candidates: int, seed: int, file: Path | None
) -> eq.PidSettings:  # fmt: skip
    """Gains by ``autotune-pid``'s study for any robot, of a PID that feeds forward so much; placed ones without any.

    Args:
        model: as it is known.
        fed: ``feedforward`` and ``inverse`` of the settings.
        candidates: sets of factors tried.
        seed: of the search.
        file: where they are kept, and found again.
    """
    if file is not None and file.exists():
        return eq.PidSettings.from_dict(presets.read_toml(file), str(file))
    study = study_from_dict(presets.read_toml(ROOT / "tuning" / "pid_any.toml"), "pid_any.toml")
    study = replace(
        study, candidates=candidates, seed=seed, ensemble=replace(study.ensemble, unseen=0),
        settings={**study.settings, **fed},
    )  # fmt: skip
    scenarios = [load_scenario(own.scenario, model.robot, search=False) for own in study.objectives]
    problem = make_plant_problem(study, model, scenarios)
    try:
        found = tune_on_plant(study, problem, RowJournal(Memory()), where=Where(workers=1)).settings
    except NothingFeasible:
        found = problem.first
    settings = eq.PidSettings.from_dict(found.to_dict())
    if file is not None:
        presets.write_text(file, presets.toml_text(settings.to_dict(), f"{model.name}, {candidates} candidates"))
    return settings


def with_motors(file: Path) -> eq.Model:
    """A robot whose actuators are motors in place of what its file has, one a joint, without limits."""
    robot = load_model(file).robot
    made = load_mjcf(file, edits=Edits(ignore=robot.actuator_names, motors=True))
    return eq.Model(replace(made, name=f"{robot.name} motors"))


def table_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Plain JSON types; what is not a number is None."""
    return [{key: None if value != value else value for key, value in asdict(row).items()} for row in rows]
