"""The recordings of real machines in the project's format: ``python convert.py FOLDER`` writes one folder a machine.

What they are, and whose, stands in ``SOURCES.md`` beside the recordings, which are found as everywhere
(``EQUIMUS_RECORDINGS`` or ``../shared/recordings``). Angles, forces and times are taken as they are; commands that are
recorded faster than positions are wanted become their means.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.signal import savgol_filter

from equimus_ctrl.recordings import find_recordings, write
from equimus_ctrl.types import Array, Recording

EVERY = 5
"""Of EMPS' 1 kHz every so many samples are kept."""
NEWTON_PER_VOLT = 35.15
UNDISTURBED = {
    "pd__1nm_torque_limited_swingup_failure__data_measured": (11.7, 17.2),
    "energy_shaping__data_measured": (0.0, 4.3),
    "energy_shaping__data_measured_1kg": (0.0, 6.0),
    "sac__data_measured": (0.0, 4.2),
    "ddp__data_measured": (0.0, math.inf),
}
"""Of the simple pendulum's runs the parts in which nobody pushed [s]."""
REVERSAL = 0.2
"""Speed shortly before and after a reversal by which it counts as one [rad/s]."""
NOMINAL_VOLTS, NOMINAL_GAIN = 7.4, 100
"""For which the servo's stiffness and torque stand in its model."""


def ascending(time: Array) -> Array:
    """(n,) which rows' times go on."""
    return np.concatenate([[True], np.diff(np.maximum.accumulate(time)) > 0])


def recording(
    name: str, time: Array, commands: Mapping[str, Array], positions: Mapping[str, Array], notes: Mapping[str, str]
) -> Recording:
    """A trial; rows whose time does not go on are left out."""
    kept = ascending(time)
    command, position = (np.column_stack(list(table.values()))[kept] for table in (commands, positions))
    return Recording(name, time[kept], command, position, tuple(commands), tuple(positions), notes=notes)


def emps(folder: Path) -> dict[str, list[Recording]]:
    """Force as command; and the closed loop, its goal as command.

    The pulses that one file has beside the controller's output are in that output already: a regression of it on the
    motion and the pulses finds −0.03 ± 0.02 of them, where a force on the carriage would have −1.
    """
    trials, loops = [], []
    for name in ("DATA_EMPS", "DATA_EMPS_PULSES"):
        data = {
            key: np.ravel(value) for key, value in loadmat(folder / "emps" / f"{name}.mat").items() if key[:2] != "__"
        }
        n = len(data["t"]) // EVERY
        force = NEWTON_PER_VOLT * data["vir"][: n * EVERY].reshape(n, EVERY).mean(axis=1)
        time, position = data["t"][: n * EVERY : EVERY], data["qm"][: n * EVERY : EVERY]
        notes = {"source": f"emps/{name}.mat"}
        trials.append(recording(name.lower(), time, {"motor": force}, {"screw": position}, notes))
        if name == "DATA_EMPS":
            # All of it: between two kept goals the loop is so stiff that a step as long would saturate it. The
            # controller compares goal and position of one instant: held beside a position that moves, a goal is late.
            together = notes | {"interpolation": "linear"}
            whole = recording(f"{name.lower()}_loop", data["t"], {"servo": data["qg"]}, {"screw": data["qm"]}, together)
            loops.append(whole)
    return {"emps": trials, "emps_loop": loops}


def simple_pendulum(folder: Path) -> dict[str, list[Recording]]:
    """Torque as command; the runs with the heavier bob apart."""
    found: dict[str, list[Recording]] = {"simple_pendulum": [], "simple_pendulum_1kg": []}
    for name, (low, high) in UNDISTURBED.items():
        path = folder / "simple_pendulum" / f"{name}.csv"
        if not path.exists():
            continue
        table = np.genfromtxt(path, delimiter=",", names=True)
        inside = (table["time"] >= low) & (table["time"] <= high)
        t, q, torque = (table[key][inside] for key in ("time", "position", "torque"))
        trial = recording(name, t, {"motor": torque}, {"hinge": q}, {"source": f"simple_pendulum/{name}.csv"})
        found["simple_pendulum_1kg" if name.endswith("_1kg") else "simple_pendulum"].append(trial)
    return found


def compensation(time: Array, position: Array, velocity: Array, torque: Array) -> Array:
    """What a controller adds in the direction of motion: half of the jump of its torque at reversals, by arctan.

    A controller that knows angles and rates alone has no other reason to jump there. How steep the owners' law is
    (``arctan(100·velocity)``) is theirs; how large is read off.

    Args:
        time: (n,) ascending [s].
        position: (n,) of the joint [rad].
        velocity: (n,) as the controller knew it [rad/s].
        torque: (n,) recorded [N·m].
    """
    grid = np.arange(time[0], time[-1], 2e-3)
    speed = savgol_filter(np.interp(grid, time, position), 41, 3, deriv=1, delta=2e-3)
    push = np.interp(grid, time, torque)
    jumps = []
    for k in np.flatnonzero(speed[:-1] * speed[1:] < 0):
        if 60 < k < len(grid) - 60 and min(abs(speed[k - 25]), abs(speed[k + 25])) > REVERSAL:
            after, before = np.median(push[k + 10 : k + 30]), np.median(push[k - 30 : k - 10])
            jumps.append(np.sign(speed[k + 25]) * (after - before))
    return np.asarray(np.median(jumps) / 2 * np.arctan(100 * velocity) / (np.pi / 2))


def double_pendulum(folder: Path) -> dict[str, list[Recording]]:
    """Measured torques as commands; where friction is compensated also without what does that."""
    found: dict[str, list[Recording]] = {}
    keys = {"c1": ("pos_meas1", "pos_meas2", "tau_meas1", "tau_meas2"), "a0": ("pos1", "pos2", "tau1", "tau2")}
    for design, files in (
        ("c1", ("design_C1_143339", "design_C1_154220")),
        ("a0", ("design_A0_friction_compensated",)),
    ):
        for name in files:
            table = np.genfromtxt(folder / "double_pendulum" / f"{name}.csv", delimiter=",", names=True, autostrip=True)
            q1, q2, tau1, tau2 = (table[key] for key in keys[design])
            notes = {"source": f"double_pendulum/{name}.csv"}
            trial = recording(
                name, table["time"], {"motor1": tau1, "motor2": tau2}, {"shoulder": q1, "elbow": q2}, notes
            )
            found.setdefault(f"double_pendulum_{design}", []).append(trial)
            if design == "a0":
                kept = ascending(table["time"])
                asked = np.column_stack(
                    [
                        tau[kept] - compensation(table["time"][kept], q[kept], table[key][kept], tau[kept])
                        for q, tau, key in ((q1, tau1, "vel1"), (q2, tau2, "vel2"))
                    ]
                )
                found["double_pendulum_a0_asked"] = [replace(trial, name=f"{name}_asked", command=asked)]
    return found


def xl330(folder: Path) -> dict[str, list[Recording]]:
    """Goal as command; the firmware's gain and the supply differ between runs and stand in the notes.

    Where the torque is switched off, to let the arm drop, a run ends here: a goal is no command then.
    """
    trials = []
    for path in sorted((folder / "xl330" / "processed").glob("*.json")):
        data = json.loads(path.read_text(encoding="utf-8"))
        entries: Sequence[Mapping[str, float]] = data["entries"]
        rows = list(itertools.takewhile(lambda row: row["torque_enable"], entries))
        t, q, goal, volts = (
            np.array([row[key] for row in rows]) for key in ("timestamp", "position", "goal_position", "input_volts")
        )
        supply = float(np.median(volts)) / NOMINAL_VOLTS
        notes = {
            "source": f"xl330/processed/{path.name}",
            "times.servo.kp": f"{supply * data['kp'] / NOMINAL_GAIN:.6g}",
            "times.servo.voltage_limit": f"{supply:.6g}",
        }
        name = f"{data['trajectory']}_kp{data['kp']}"
        trials.append(recording(name, t, {"servo": goal}, {"horn": q}, notes))
    return {"xl330": trials}


def main(target: Path) -> None:
    """Write all machines' recordings."""
    folder = find_recordings()
    if folder is None:
        raise SystemExit("no recordings: set EQUIMUS_RECORDINGS to their folder")
    for machine in (emps, simple_pendulum, double_pendulum, xl330):
        for name, trials in machine(folder).items():
            (target / name).mkdir(parents=True, exist_ok=True)
            for trial in trials:
                write(target / name / f"{trial.name}.csv", trial)
            print(f"{name}: {len(trials)} trials")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="The recordings of real machines in the project's format.")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("real_machines"), help="to write to")
    main(parser.parse_args().folder)
