"""What ``diagnose --by folder`` says of two simulated units of a robot: ``python benchmarks/units.py``.

A pendulum and an arm of two joints, driven by motors. Unit A is the nominal one but for dry friction; unit B has other
friction, friction alone, another mass of the last link, or is alike. Each has four trials of four seconds with 0.5 mrad
of noise, simulated by MuJoCo with a step of 20 µs. A row shows what was true and what was said.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.effects import CoulombFriction
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import write
from equimus_ctrl.report.diagnosis_units import departures, differing
from equimus_ctrl.report.diagnosis_words import listed, short
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Recording

NOISE, STEP, SECONDS, TRIALS = 5e-4, 2e-5, 4.0, 4
LINK = """<body name="{name}" pos="0 0 {at}"><joint name="{joint}" axis="0 -1 0" armature="{armature}" damping="0.05"/>
<inertial pos="0 0 {com}" mass="{mass}" diaginertia="{inertia} {inertia} 0.001"/>{more}</body>"""
FORE = LINK.format(name="fore", at=-0.4, joint="elbow", armature=0.006, com=-0.15, mass=0.6, inertia=0.004, more="")
UPPER = LINK.format(name="upper", at=0, joint="shoulder", armature=0.01, com=-0.2, mass=1.0, inertia=0.01, more=FORE)
ARM = LINK.format(name="arm", at=0, joint="hinge", armature=0.004, com=-0.4, mass=0.6, inertia=0.002, more="")


@dataclass(frozen=True)
class Units:
    """Two units of a robot: dry friction of the last joint [N·m], and the mass of the last link of B over that of A."""

    words: str
    friction: tuple[float, float]
    mass: float = 1.0


CASES = {
    "friction": Units("friction 0.31 in A, 0.52 in B", (0.31, 0.52)),
    "alike": Units("friction 0.31 in both", (0.31, 0.31)),
    "alone": Units("friction 0.31 in B alone", (0.0, 0.31)),
    "mass": Units("last link 20 % heavier in B", (0.0, 0.0), 1.2),
}


def robot_of(joints: int) -> MjcfRobot:
    """A pendulum, or an arm of two joints."""
    bodies, names = ((ARM, ["hinge"]), (UPPER, ["shoulder", "elbow"]))[joints - 1]
    motors = "".join(f'<motor name="motor_{name}" joint="{name}"/>' for name in names)
    xml = f"""<mujoco model="arm"><option timestep="0.002" integrator="implicitfast"/><worldbody>{bodies}</worldbody>
    <actuator>{motors}</actuator></mujoco>"""
    return MjcfRobot("arm", xml, source="arm.xml")


def record(real: Model, folder: Path, seed: int) -> None:
    """Write trials of sums of two sines, as large as friction lets move."""
    folder.mkdir(parents=True)
    rng, robot, time_of = np.random.default_rng(seed), real.robot, np.arange(0, SECONDS, 0.01)
    size = 1.0 if real.effects else 0.6
    for k in range(TRIALS):
        command = np.column_stack(
            [
                size * rng.uniform(0.6, 1.2) * np.sin(2 * np.pi * rng.uniform(0.3, 1.0) * time_of + rng.uniform(0, 6))
                + 0.3 * size * np.sin(2 * np.pi * rng.uniform(1.5, 3.0) * time_of)
                for _ in robot.actuator_names
            ]
        )
        start = rng.uniform(-0.5, 0.5, len(robot.joint_names))
        trial = Trial(f"run_{k}", time_of, command, command[0], 0.0, start, time_of)
        angle = simulate_mjcf([real], [trial], threads=1, dt=STEP)[0].position[0]
        angle = angle + rng.normal(0, NOISE, angle.shape)
        recording = Recording(trial.name, time_of, command, angle, robot.actuator_names, robot.joint_names)
        write(folder / f"{trial.name}.csv", recording)


def diagnosed(joints: int, units: Units, seed: int, most: int) -> Diagnosis:
    """What is said of two units."""
    robot = robot_of(joints)
    joint, mass = robot.joint_names[-1], f"{('arm', 'fore')[joints - 1]}.mass"
    with tempfile.TemporaryDirectory() as scratch:
        folders = [Path(scratch) / name for name in "AB"]
        for k, (folder, friction) in enumerate(zip(folders, units.friction, strict=True)):
            own = robot.with_parameters({mass: robot.parameters()[mass] * (units.mass if k else 1.0)})
            effects = (CoulombFriction(joint, friction),) if friction else ()
            record(Model(own, effects), folder, 10 * seed + k)
        return workflow.diagnose(folders, Model(robot), by="folder", most=most)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print a row for each robot, case and seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--joints", type=int, nargs="+", default=[1, 2], choices=(1, 2))
    parser.add_argument("--case", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--most", type=int, default=2, help="largest number of effects")
    given = parser.parse_args(arguments)
    for joints in given.joints:
        for name in given.case:
            for seed in given.seeds:
                begun = time.perf_counter()
                found = diagnosed(joints, CASES[name], seed, given.most)
                effects = listed([short(finding.named) for finding in found.findings]) or "no effect"
                said = " ".join([f"{found.verdict}, {effects}.", *differing(found), *departures(found)])
                print(
                    f"| {joints} | {CASES[name].words} | {seed} | {said} | {time.perf_counter() - begun:.0f} s |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
