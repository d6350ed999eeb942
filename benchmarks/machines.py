"""How long a diagnosis of a machine takes: friction concealed in one and two joints, four trials of ten seconds each.

python benchmarks/machines.py [--seed 0] [--record DIR]

With ``--record`` the recordings are written and nothing is diagnosed: ``equimus-ctrl prove DIR/two_joints --model …``
takes their commands.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from equimus_ctrl import workflow
from equimus_ctrl.effects import CoulombFriction, ViscousFriction
from equimus_ctrl.engines.batch import Trial
from equimus_ctrl.engines.machine import simulate_machines
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import write
from equimus_ctrl.types import Recording

HERE = Path(__file__).resolve().parent
MACHINES = {
    "1 joint": (HERE.parent / "docs" / "examples" / "pendulum.xml", {"hinge": 1.2}),
    "2 joints": (HERE / "real_machines" / "double_pendulum_c1.xml", {"shoulder": 1.5, "elbow": 0.8}),
}
NOISE, FINE = 1e-3, 1e-4
FOLDERS = "one_joint", "two_joints"


def recorded(real: Model, sizes: dict[str, float], seed: int) -> list[Recording]:
    """Four trials of ten seconds under sums of sines."""
    rng = np.random.default_rng(seed)
    at = np.arange(0, 10, 0.01)
    m = real.robot
    trials = []
    for k in range(4):
        torque = np.column_stack(
            [
                size * np.sin(2 * np.pi * rng.uniform(0.2, 0.8) * at + rng.uniform(0, 6))
                + 0.4 * size * np.sin(2 * np.pi * rng.uniform(1, 2) * at)
                for size in sizes.values()
            ]
        )
        start = rng.uniform(-0.6, 0.6, len(sizes))
        trial = Trial(f"run_{k}", at, torque, torque[0], 0.0, start, at)
        angle = simulate_machines([real], [trial], dt=FINE)[0].position[0]
        angle = angle + rng.normal(0, NOISE, angle.shape)
        trials.append(Recording(trial.name, at, torque, angle, m.actuator_names, m.joint_names))
    return trials


def main() -> None:
    """Print what was found and how long it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    parser.add_argument("--record", type=Path, metavar="DIR", help="write the recordings here, one folder a machine")
    given = parser.parse_args()
    rows = []
    for label, (xml, sizes) in MACHINES.items():
        machine = workflow.load_machine(xml)
        effects = [e for joint in sizes for e in (CoulombFriction(joint, 0.1), ViscousFriction(joint, 0.03))]
        trials = recorded(Model(machine, tuple(effects)), sizes, given.seed)
        if given.record:
            (given.record / FOLDERS[len(sizes) - 1]).mkdir(parents=True, exist_ok=True)
            for trial in trials:
                write(given.record / FOLDERS[len(sizes) - 1] / f"{trial.name}.csv", trial)
            continue
        begun = time.perf_counter()
        found = workflow.diagnose_recordings(trials, Model(machine))
        seconds = time.perf_counter() - begun
        named = [f"{f.named.effect}:{'+'.join(f.named.locations)}" for f in found.findings]
        windows = len(found.train)
        rows.append({"machine": label, "seconds": seconds, "found": named, "windows": windows})
        if not given.json:
            print(
                f"{label}: {seconds:.1f} s, {windows} windows fitted, {found.verdict}: {', '.join(named)}", flush=True
            )
    if given.json and not given.record:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
