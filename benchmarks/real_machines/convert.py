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
from pathlib import Path

import numpy as np
from scipy.io import loadmat

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
NOMINAL_VOLTS, NOMINAL_GAIN = 7.4, 100
"""For which the servo's stiffness and torque stand in its model."""


def recording(
    name: str, time: Array, commands: Mapping[str, Array], positions: Mapping[str, Array], notes: Mapping[str, str]
) -> Recording:
    """A trial; rows whose time does not go on are left out."""
    kept = np.concatenate([[True], np.diff(np.maximum.accumulate(time)) > 0])
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
            goal = data["qg"][: n * EVERY].reshape(n, EVERY).mean(axis=1)
            loops.append(recording(f"{name.lower()}_loop", time, {"servo": goal}, {"screw": position}, notes))
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


def double_pendulum(folder: Path) -> dict[str, list[Recording]]:
    """Measured torques as commands."""
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
            "times.servo.force_limit": f"{supply:.6g}",
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
