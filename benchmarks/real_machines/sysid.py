"""mujoco.sysid and equimus_ctrl on the same recordings, the same XML and the same free numbers.

The last trial by name is held out. The others are cut into short windows: what drives the machines is recorded as a
force, and open loop a simulation drifts. Both tools get the same windows, bounds, physics step and threads, and begin
at the model as it came.

We fit each window's start along; mujoco.sysid takes starts as given, and gets those that our search begins from, off a
parabola through the samples around. So there are two judges, both with our engine: each window from the start that fits
it best, as we search, and each from its measured start, as mujoco.sysid does. The two engines are the same MuJoCo.

Rows of mujoco.sysid:
    as such: a hook of its own makes the residual the position's error and nothing else.
    own residual: without the hook. It divides each window by that window's norm, which makes windows near 0 count most,
        and compares a joint's sensor, which a rollout gives a step late, as if it were in time.
    free starts: starts are free here too, by a rollout function written for it below; timed once, for it takes long.
Its commands are means over physics steps, as in our engine: it interpolates them, and steps so come half a sample
early. Friction begins off its bound of 0, as it advises. All else are its defaults.

Its intervals take residuals as independent of one another; ours allow for those that hang together over time. Seconds
are those of the searches, without intervals; a set is one set of parameters simulated in all windows.

    python benchmarks/real_machines/sysid.py [--recordings FOLDER] [--json FILE] [--only emps|pendulum]
"""

from __future__ import annotations

import argparse
import io
import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import convert
import mujoco
import numpy as np

from equimus_ctrl import workflow
from equimus_ctrl.errors import RecordingError
from equimus_ctrl.identification.residuals import joint_rmse, residuals_of
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import simulator_for
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import find_recordings
from equimus_ctrl.types import Array, Recording

try:
    from mujoco import sysid
except ImportError:
    sysid = None

HERE = Path(__file__).resolve().parent
THREADS = 2
ROUNDS = 3


@dataclass(frozen=True)
class Machine:
    """What is compared on.

    Attributes:
        xml: name of the model and its recordings.
        trials: reads them.
        bounds: of the free numbers.
        window: length [s].
        away: how far a window's position and rate may begin from the measured ones, for mujoco.sysid alone, which wants
            bounds of everything [m and m/s, or rad and rad/s].
        unit: of errors, a thousandth of the SI unit.
    """

    xml: str
    trials: Callable[[Path], Mapping[str, list[Recording]]]
    bounds: Mapping[str, tuple[float, float]]
    window: float
    away: tuple[float, float]
    unit: str


MACHINES = {
    "emps": Machine(
        "emps",
        convert.emps,
        {"carriage.mass": (30.0, 300.0), "screw.damping": (0.0, 1000.0), "screw.frictionloss": (0.0, 100.0)},
        1.0,
        (0.05, 0.5),
        "mm",
    ),
    "pendulum": Machine(
        "simple_pendulum",
        convert.simple_pendulum,
        {
            "arm.mass": (0.2, 2.0),
            "arm.inertia": (0.001, 0.1),
            "hinge.damping": (0.0, 1.0),
            "hinge.frictionloss": (0.0, 1.0),
        },
        2.0,
        (0.3, 3.0),
        "mrad",
    ),
}


@dataclass(frozen=True)
class Found:
    """What a search found: the values, half their intervals of 95 %, its seconds, and the sets it simulated."""

    values: Array
    half: Array
    seconds: float
    sets: int


@dataclass(frozen=True, eq=False)
class Task:
    """A machine's model, its trials to fit, and their windows."""

    machine: Machine
    model: Model
    trials: list[Recording]
    segments: list[Segment]

    @property
    def xml(self) -> Path:
        return HERE / f"{self.machine.xml}.xml"


def ours(task: Task) -> Found:
    machine = task.machine
    found = workflow.identify_recordings(
        task.trials,
        task.model,
        free=list(machine.bounds),
        bounds=machine.bounds,
        shoot=machine.window,
        threads=THREADS,
        folds=0,
    )
    place = [found.fit.parameters.names.index(name) for name in machine.bounds]
    half = found.fit.uncertainty.half_width
    return Found(found.fit.theta[place], half[place], found.seconds, found.fit.evaluations)


def theirs(task: Task, own_residual: bool = False, free_starts: bool = False) -> Found:
    spec = mujoco.MjSpec.from_file(str(task.xml))
    parameters = sysid.ParameterDict()
    start = task.model.parameters()
    for name, (low, high) in task.machine.bounds.items():
        parameters.add(sysid.Parameter(name, start[name], low, high, modifier=modifier(spec, name)))
    parameters.move_off_bounds()
    group = sequences(spec, task.segments)
    hooks: dict[str, Any] = {} if own_residual else {"modify_residual": position_error}
    if free_starts:
        measured, away = np.array([s.start for s in task.segments]), np.array(task.machine.away)
        parameters.add(sysid.Parameter("starts", measured, measured - away, measured + away))
        hooks["custom_rollout"] = from_free_starts(group.initial_state)
    residual = sysid.build_residual_fn(models_sequences=[group], n_threads=THREADS, **hooks)
    sets = 0

    def counted(x: Array, given: Any) -> Any:
        nonlocal sets
        sets += x.shape[1] if x.ndim > 1 else 1
        return residual(x, given)

    begun = time.perf_counter()
    # It leaves a Jacobian for the intervals only where it prints each step.
    best, result = sysid.optimize(parameters, counted, verbose=False, output=io.StringIO())
    seconds = time.perf_counter() - begun
    _, half = sysid.calculate_intervals(residual(result.x, best)[0], result.jac)
    p = len(task.machine.bounds)
    return Found(np.asarray(result.x[:p]), np.asarray(half[:p]), seconds, sets)


def modifier(spec: Any, name: str) -> Callable[[Any, Any], None]:
    """Writes one number into a spec; an inertia scales all three moments, as with us."""
    place, _, kind = name.partition(".")
    moments = np.array(spec.body(place).inertia) if kind == "inertia" else np.zeros(3)

    def write(changed: Any, parameter: Any) -> None:
        value = float(parameter.value[0])
        if kind == "mass":
            changed.body(place).mass = value
        elif kind == "inertia":
            changed.body(place).inertia = value * moments / moments.max()
        elif kind == "damping":
            changed.joint(place).damping = [value, 0.0, 0.0]
        else:
            changed.joint(place).frictionloss = value

    return write


def sequences(spec: Any, segments: Sequence[Segment]) -> Any:
    """The windows as mujoco.sysid takes them, each on a clock of its own."""
    for joint in spec.joints:
        kinds = mujoco.mjtSensor, mujoco.mjtObj
        spec.add_sensor(
            name=joint.name, type=kinds[0].mjSENS_JOINTPOS, objtype=kinds[1].mjOBJ_JOINT, objname=joint.name
        )
    model = spec.compile()
    states, controls, sensors = [], [], []
    for segment in segments:
        trial = segment.trial
        states.append(sysid.create_initial_state(model, *np.split(segment.start, 2)))
        times = trial.sample_times - trial.start
        steps = int(np.ceil(times[-1] / model.opt.timestep)) + 1
        # A hair short, or it may round the number of steps up and squeeze the commands.
        clock = model.opt.timestep * np.arange(steps + 1) * (1 - 1e-12)
        controls.append(sysid.TimeSeries.from_control_names(clock, means(segment, clock), model))
        sensors.append(sysid.TimeSeries.from_names(times, segment.measured, model))
    return sysid.ModelSequences("machine", spec, [s.trial.name for s in segments], states, controls, sensors)


def means(segment: Segment, clock: Array) -> Array:
    """(n, na) means over the steps that begin on a clock of a window of commands that hold until the next."""
    trial = segment.trial
    whole = np.vstack([np.zeros(trial.commands.shape[1]), np.cumsum(trial.commands[:-1].T * np.diff(trial.times), 1).T])
    # The last command holds on.
    ends = np.append(trial.times, trial.times[-1] + 1.0)
    whole = np.vstack([whole, whole[-1] + trial.commands[-1]])
    edges = trial.start + np.append(clock, 2 * clock[-1] - clock[-2])
    sums = np.column_stack([np.interp(edges, ends, column) for column in whole.T])
    return np.diff(sums, axis=0) / np.diff(edges)[:, None]


def position_error(
    parameters: Any, predicted: Any, measured: Any, model: Any, return_pred_all: bool, state: Array, **more: Any
) -> tuple[Array, Any, Any]:
    """Measured − predicted positions [m or rad], all samples alike; see ``mujoco.sysid.ModifyResidualFn``."""
    inside = (measured.times >= state[0, 0]) & (measured.times <= state[-1, 0])
    measured = sysid.TimeSeries(measured.times[inside], measured.data[inside], measured.signal_mapping)
    # Sensors of a rollout belong to the state before each step.
    path = sysid.TimeSeries(state[:, 0], state[:, 1 : 1 + model.nq], measured.signal_mapping)
    shown = path.resample(measured.times)
    return measured.data - shown.data, shown, measured


def from_free_starts(measured: Sequence[Array]) -> Callable[..., Any]:
    """A rollout from the parameter "starts". Which window it is about is told by its measured start, the object."""
    window = {id(state): k for k, state in enumerate(measured)}

    def run(initial_states: Sequence[Array], param_dicts: Sequence[Any], **given: Any) -> Any:
        states = [
            np.append(state[:1], parameters["starts"].value[window[id(state)]])
            for state, parameters in zip(initial_states, param_dicts, strict=True)
        ]
        return sysid.sysid_rollout(initial_states=states, **given)

    return run


METHODS: dict[str, tuple[Callable[[Task], Found], int]] = {
    "equimus_ctrl": (ours, ROUNDS),
    "mujoco.sysid, as such": (theirs, ROUNDS),
    "mujoco.sysid, own residual": (lambda task: theirs(task, own_residual=True), ROUNDS),
    "mujoco.sysid, free starts": (lambda task: theirs(task, free_starts=True), 1),
}
"""Each with how often it is timed."""


def judged(model: Model, segments: Sequence[Segment]) -> dict[str, float]:
    """RMSE over windows [mm or mrad] from the starts that fit best, and from those measured."""
    simulator = simulator_for(model, threads=THREADS)
    found = simulator([model], segments, [s.start[None, :] for s in segments])
    plain = [s.measured - np.where(f.sound[0], f.position[0], np.nan) for s, f in zip(segments, found, strict=True)]
    fitted = residuals_of(model, segments, simulator)
    return {key: 1e3 * float(joint_rmse(r)[0]) for key, r in (("best_start", fitted), ("measured_start", plain))}


def searched(task: Task) -> dict[str, list[Found]]:
    """All methods in turn, round after round; the first round only warms up."""
    rounds: dict[str, list[Found]] = {method: [] for method in METHODS}
    for k in range(1 + ROUNDS):
        for method, (search, times) in METHODS.items():
            if k > ROUNDS - times or (k == 0 and times > 1):
                found = search(task)
                rounds[method] += [found] if k else []
    return rounds


def compare(name: str, folder: Path) -> dict[str, Any]:
    machine = MACHINES[name]
    model = workflow.load_model(HERE / f"{machine.xml}.xml")
    *trials, unseen = sorted(machine.trials(folder)[machine.xml], key=lambda trial: trial.name)
    fitted, heldout = (cut(model, some, shoot=machine.window) for some in (trials, [unseen]))
    start = model.parameters()
    came = Found(np.array([start[n] for n in machine.bounds]), np.full(len(machine.bounds), np.nan), np.nan, 0)
    rows = []
    for method, all_found in {"as it came": [came], **searched(Task(machine, model, trials, fitted))}.items():
        last = all_found[-1]
        values = dict(zip(machine.bounds, last.values.tolist(), strict=True))
        found = model.with_parameters(values)
        rows.append(
            {
                "method": method,
                "parameters": {
                    n: {"value": v, "half_width": float(h) if np.isfinite(h) else None}
                    for (n, v), h in zip(values.items(), last.half, strict=True)
                },
                "rmse_fitted": judged(found, fitted),
                "rmse_heldout": judged(found, heldout),
                "seconds": statistics.median(f.seconds for f in all_found) if last.sets else None,
                "sets": last.sets,
            }
        )
    return {
        "machine": name,
        "rmse_unit": machine.unit,
        "window_s": machine.window,
        "heldout": unseen.name,
        "windows_fitted": len(fitted),
        "windows_heldout": len(heldout),
        "positions_fitted": sum(s.measured.size for s in fitted),
        "positions_heldout": sum(s.measured.size for s in heldout),
        "rows": rows,
    }


def show(result: Mapping[str, Any]) -> None:
    print(
        f"\n{result['machine']}: {result['windows_fitted']} windows of about {result['window_s']:g} s fitted "
        f"({result['positions_fitted']} positions), {result['windows_heldout']} of {result['heldout']} held out "
        f"({result['positions_heldout']})"
    )
    judges = tuple(result["rows"][0]["rmse_fitted"])
    print(f"{'RMSE [' + result['rmse_unit'] + ']':27}" + "".join(f"{j.replace('_', ' '):>20}" for j in judges))
    print(f"{'':27}" + f"{'fitted':>10}{'held out':>10}" * len(judges) + f"{'seconds':>9}{'sets':>6}")
    for row in result["rows"]:
        cells = "".join(f"{row['rmse_fitted'][j]:10.3f}{row['rmse_heldout'][j]:10.3f}" for j in judges)
        print(f"{row['method']:27}{cells}" + (f"{row['seconds']:9.2f}{row['sets']:6d}" if row["sets"] else ""))
    print(f"{'value ± 95 %':27}" + "".join(f"{n:>22}" for n in result["rows"][0]["parameters"]))
    for row in result["rows"]:
        cells = "".join(f"{shown(p['value'], p['half_width']):>22}" for p in row["parameters"].values())
        print(f"{row['method']:27}{cells}")


def shown(value: float, half: float | None) -> str:
    return f"{value:.5g}" if half is None else f"{value:.5g} ± {half:.2g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=Path, help="folder that holds emps and simple_pendulum")
    parser.add_argument("--json", type=Path, help="file for the same as data")
    parser.add_argument("--only", choices=tuple(MACHINES))
    options = parser.parse_args()
    # Without the packages it needs, mujoco.sysid can be imported all the same, and is empty.
    if not hasattr(sysid, "optimize"):
        print("skipped: mujoco.sysid is not here; pip install 'mujoco[sysid]'")
        return
    try:
        folder = find_recordings(options.recordings)
    except RecordingError as error:
        print(f"skipped: {error}")
        return
    results = []
    for name in [options.only] if options.only else MACHINES:
        if folder is None or not (folder / MACHINES[name].xml).is_dir():
            print(f"skipped {name}: there are no recordings of it; set EQUIMUS_RECORDINGS to their folder")
            continue
        results.append(compare(name, folder))
        show(results[-1])
    if options.json and results:
        options.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
