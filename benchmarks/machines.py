"""How long a diagnosis of an MJCF robot takes: the dry friction of one joint is missing, four trials of 10 s at 200 Hz.

python benchmarks/machines.py [--robots DIR] [--only 1 2 6] [--seed 0] [--record DIR]

The robots move in plain MuJoCo at 0.25 ms under a computed-torque loop that knows the nominal model; what is recorded
are its torques and the joint positions with 1 mrad of noise. All base parameters and dampings are free. With
``--record`` the recordings are written and nothing is diagnosed. ``--robots`` has ``arm2.xml`` and ``ur5e.xml``.
"""

from __future__ import annotations

import argparse
import copy
import json
import time
from pathlib import Path

import mujoco
import numpy as np

from equimus_ctrl import workflow
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import write
from equimus_ctrl.types import Array, Recording

MjModel = mujoco.MjModel

HERE = Path(__file__).resolve().parent
ROBOTS = HERE.parent.parent / "shared" / "recordings" / "concealed_robots" / "robots"
CASES = {
    1: (HERE.parent / "docs" / "examples" / "pendulum.xml", "hinge", 0.1),
    2: (Path("arm2.xml"), "elbow", 0.25),
    6: (Path("ur5e.xml"), "elbow_joint", 4.0),
}
"""Joints → robot, joint whose friction is missing, and its size [N·m]."""
TRIALS, SECONDS, RATE, NOISE, FINE = 4, 10.0, 200.0, 1e-3, 2.5e-4
STIFF = 15.0
"""Natural frequency of the loop, critically damped [rad/s]."""
CRISP = 0.9999
"""Impedance of the friction."""
SCALED = 0.1
"""Masses and inertias of the truth differ from the nominal ones by up to this share."""


def truth(nominal: MjModel, joint: str, size: float, rng: np.random.Generator) -> MjModel:
    """The robot that is recorded."""
    real = copy.copy(nominal)
    for b in range(1, real.nbody):
        share = 1 + rng.uniform(-SCALED, SCALED)
        real.body_mass[b] *= share
        real.body_inertia[b] *= share
    dof = real.joint(joint).dofadr[0]
    real.dof_frictionloss[dof] = size
    real.dof_solref[dof], real.dof_solimp[dof] = (-1.0, -1.0 / FINE), (CRISP, CRISP, 1e-3, 0.5, 2.0)
    real.opt.timestep, real.opt.integrator = FINE, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    mujoco.mj_setConst(real, mujoco.MjData(real))
    return real


def recorded(xml: Path, joint: str, size: float, seed: int) -> list[Recording]:
    """Trials of a robot whose friction at a joint its XML does not know."""
    rng = np.random.default_rng(seed)
    nominal = mujoco.MjModel.from_xml_path(str(xml))
    nominal.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    real = truth(nominal, joint, size, rng)
    at, names = np.arange(0, SECONDS, 1 / RATE), [real.joint(j).name for j in range(real.njnt)]
    motors = tuple(real.actuator(i).name for i in range(real.nu))
    trials = []
    for k in range(TRIALS):
        goal, rate, acceleration = reference(rng, at, real.nq)
        torque, position = tracked(real, nominal, goal, rate, acceleration)
        position = position + rng.normal(0, NOISE, position.shape)
        trials.append(Recording(f"run_{k}", at, torque, position, motors, tuple(names)))
    return trials


def reference(rng: np.random.Generator, at: Array, n: int) -> tuple[Array, Array, Array]:
    """Sums of three sines for each joint: where, how fast, and how fast that changes."""
    w = 2 * np.pi * rng.uniform(0.1, 0.8, (3, n))
    size, phase = rng.uniform(0.1, 0.35, (3, n)), rng.uniform(0, 2 * np.pi, (3, n))
    turn = at[:, None, None] * w + phase
    return (
        (size * np.sin(turn)).sum(axis=1),
        (size * w * np.cos(turn)).sum(axis=1),
        -(size * w**2 * np.sin(turn)).sum(axis=1),
    )


def tracked(real: MjModel, nominal: MjModel, goal: Array, rate: Array, acceleration: Array) -> tuple[Array, Array]:
    """Torques of a computed-torque loop, held between rows, and positions at the rows."""
    data, own = mujoco.MjData(real), mujoco.MjData(nominal)
    data.qpos[:], data.qvel[:] = goal[0], rate[0]
    torque, position = np.empty_like(goal), np.empty_like(goal)
    steps = round(1 / RATE / FINE)
    for k in range(len(goal)):
        own.qpos[:], own.qvel[:] = data.qpos, data.qvel
        own.qacc[:] = acceleration[k] + STIFF**2 * (goal[k] - data.qpos) + 2 * STIFF * (rate[k] - data.qvel)
        mujoco.mj_inverse(nominal, own)
        data.ctrl[:] = own.qfrc_inverse / nominal.actuator_gear[:, 0]
        torque[k], position[k] = data.ctrl, data.qpos
        for _ in range(steps):
            mujoco.mj_step(real, data)
    return torque, position


def main() -> None:
    """Print what was found and how long it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", type=Path, default=ROBOTS)
    parser.add_argument("--only", type=int, nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print JSON on standard output")
    parser.add_argument("--record", type=Path, metavar="DIR", help="write the recordings here, one folder a robot")
    given = parser.parse_args()
    for file in (given.robots / CASES[joints][0] for joints in given.only):
        if not file.is_file():
            raise SystemExit(f"{file}: there is no such file; --robots names the folder, --only leaves robots out")
    rows = []
    for joints in given.only:
        xml, joint, size = CASES[joints]
        xml = given.robots / xml  # an absolute path stays as it is
        trials = recorded(xml, joint, size, given.seed)
        if given.record:
            folder = given.record / f"{joints}_joints"
            folder.mkdir(parents=True, exist_ok=True)
            for trial in trials:
                write(folder / f"{trial.name}.csv", trial)
            continue
        begun, cpu = time.perf_counter(), time.process_time()
        model = Model(workflow.load_mjcf(xml))
        free = ["base_parameters", *(n for n in model.parameters() if n.endswith(".damping"))]
        found = workflow.diagnose(trials, model, free=free)
        seconds, cpu = time.perf_counter() - begun, time.process_time() - cpu
        named = [f"{f.named.effect} at {'+'.join(f.named.locations)}" for f in found.findings]
        numbers = [{k: e.to_dict() for k, e in f.parameters.items()} for f in found.findings]
        rows.append({"joints": joints, "seconds": seconds, "cpu_seconds": cpu, "found": named, "parameters": numbers})
        if not given.json:
            of = ", ".join(f"{name} {numbers}" for name, numbers in zip(named, rows[-1]["parameters"], strict=True))
            print(
                f"{joints} joints, {size:g} N·m: {seconds:.1f} s, {cpu:.1f} s of CPU, {found.verdict}: {of}", flush=True
            )
    if given.json and not given.record:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
