"""What is missing at a joint is found while others are moved by hand: recordings by MuJoCo stepped alone."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_prescribed import ARM, ROBOT
from test_prescribed_base import COLUMNS, FLYER

from equimus_ctrl import workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.csvfile import write
from equimus_ctrl.types import Array, Recording

RATE, DT, NOISE, FRICTION, HEAVY = 200, 5e-4, 5e-4, 0.05, 1e6


def shaken_by_hand(rng: np.random.Generator, name: str) -> Recording:
    """Five seconds of the arm with dry friction at its elbow, held by MuJoCo's constraint.

    Its shoulder is as heavy as a house, pulled by what accelerates it as wanted, and put where it belongs in each step.
    """
    rubs = f'frictionloss="{FRICTION}" solreffriction="-1 {-1 / DT}" solimpfriction="0.9999 0.9999 0.001 0.5 2"'
    xml = ARM.replace('damping="0.05"', f'damping="0.05" {rubs}').replace('armature="0.01"', f'armature="{HEAVY}"')
    model = mujoco.MjModel.from_xml_string(xml.replace('timestep="0.001"', f'timestep="{DT}" tolerance="0"'))
    data, times = mujoco.MjData(model), np.arange(5 * RATE + 1) / RATE
    w, size, phase = 2 * np.pi * rng.uniform(0.5, 2.5, 3), rng.uniform(0.1, 0.3, 3), rng.uniform(0, 6, 3)
    turn, rows = rng.uniform(2, 6), []
    data.qpos[1] = rng.normal(0, 0.3)

    def moved(time: float) -> Array:
        return np.array([size @ np.sin(w * time + phase), (size * w) @ np.cos(w * time + phase)])

    for time in DT * np.arange(round(times[-1] / DT) + 1):
        rows.append(data.qpos[1])
        data.qpos[0], data.qvel[0] = moved(time)
        data.ctrl[1] = 0.3 * np.sin(turn * (time + DT / 2))
        data.qfrc_applied[0] = HEAVY * (moved(time + DT)[1] - data.qvel[0]) / DT
        mujoco.mj_step(model, data)
    elbow = np.array(rows)[:: round(1 / RATE / DT)]
    shown = np.column_stack([[moved(t)[0] for t in times], elbow]) + rng.normal(0, NOISE, (len(times), 2))
    torque, notes = 0.3 * np.sin(turn * times)[:, None], {"interpolation": "linear"}
    return Recording(name, times, torque, shown, ("motor",), ("shoulder", "elbow"), notes=notes)


@pytest.mark.slow
def test_friction_at_the_other_joint_is_found() -> None:
    rng = np.random.default_rng(4)
    trials = [shaken_by_hand(rng, f"shaken_{k}") for k in range(4)]
    found = workflow.diagnose(trials, Model(ROBOT), threads=1)
    record = found.to_dict()
    assert [(own["effect"], list(own["locations"])) for own in record["findings"]] == [("coulomb_friction", ["elbow"])]
    assert found.findings[0].parameters["friction"].value == pytest.approx(FRICTION, rel=0.05)
    assert record["verdict"] == "explained" and list(record["noise_rad"]) == ["elbow"]
    assert [note for note in record["notes"] if "the motion of shoulder (0.5" in note or "shoulder (0.4" in note]
    assert record["models"]["corrected"]["prescribe"] == ["shoulder"]
    assert all("shoulder" not in str(value) for key, value in record.items() if key not in ("notes", "models"))


def flown(rng: np.random.Generator, name: str) -> Recording:
    """Two seconds of a body that is flown about, with dry friction at its arm, by MuJoCo's free joint.

    The hull is so heavy that the arm does not move it, and put where it belongs in each step.
    """
    rubs = f'frictionloss="{FRICTION}" solreffriction="-1 {-1 / DT}" solimpfriction="0.9999 0.9999 0.001 0.5 2"'
    hull = f'<inertial mass="{HEAVY}" pos="0 0 0" diaginertia="{HEAVY} {HEAVY} {HEAVY}"/>'
    xml = FLYER.replace('<inertial mass="2" pos="0.02 0 0" diaginertia="0.03 0.02 0.04"/>', hull)
    model = mujoco.MjModel.from_xml_string(xml.replace('damping="0.02"', f'damping="0.02" {rubs}'))
    model.opt.timestep, model.opt.tolerance = DT, 0.0
    data, times, down = mujoco.MjData(model), np.arange(2 * RATE + 1) / RATE, np.array(model.opt.gravity)
    w, phase, turn = 2 * np.pi * rng.uniform(0.5, 2.0, 6), rng.uniform(0, 6, 6), rng.uniform(2, 6)
    size, rows = np.array([0.1, 0.1, 0.05, 1.0, 0.3, 0.3]) * rng.uniform(0.5, 1.0, 6), []

    def pose(at: Array) -> tuple[Array, Rotation]:
        along = size * np.sin(np.outer(at, w) + phase)
        return along[:, :3] + [0, 0, 1], Rotation.from_euler("ZYX", along[:, 3:])

    def rate(time: float) -> Array:
        """Of the place in the room, and of the turn in the body."""
        place, turned = pose(np.array([time - 1e-5, time + 1e-5]))
        return np.concatenate([place[1] - place[0], (turned[0].inv() * turned[1]).as_rotvec()]) / 2e-5

    for time in DT * np.arange(round(times[-1] / DT) + 1):
        rows.append(data.qpos[7])
        (place,), turned = pose(np.array([time]))
        data.qpos[:7] = np.concatenate([place, turned.as_quat()[0][[3, 0, 1, 2]]])
        data.qvel[:6], data.ctrl[0] = rate(time), 0.3 * np.sin(turn * (time + DT / 2))
        data.qfrc_applied[:6] = HEAVY * (rate(time + DT) - data.qvel[:6]) / DT
        data.qfrc_applied[:3] -= HEAVY * down
        mujoco.mj_step(model, data)
    arm = np.array(rows)[:: round(1 / RATE / DT)] + rng.normal(0, NOISE, len(times))
    place, turned = pose(times)
    quaternion = (turned * Rotation.from_rotvec(rng.normal(0, 6e-4, (len(times), 3)))).as_quat()[:, [3, 0, 1, 2]]
    shown = np.column_stack([place + rng.normal(0, 3e-4, place.shape), quaternion, arm])
    torque, notes = 0.3 * np.sin(turn * times)[:, None], {"interpolation": "linear"}
    return Recording(name, times, torque, shown, ("motor",), (*COLUMNS, "swing"), notes=notes)


@pytest.mark.long
@pytest.mark.slow
def test_friction_at_a_limb_of_a_free_base_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(2)
    (tmp_path / "flyer.xml").write_text(FLYER)
    for k in range(4):
        write(tmp_path / f"flown_{k}.csv", flown(rng, f"flown_{k}"))
    given = [str(tmp_path), "--model", str(tmp_path / "flyer.xml"), "--prescribe", "base", "--threads", "1", "--json"]
    assert main(["diagnose", *given]) == 0
    record = json.loads(capsys.readouterr().out)
    (own,) = record["findings"]
    assert (own["effect"], list(own["locations"])) == ("coulomb_friction", ["swing"])
    assert own["parameters"]["friction"]["value"] == pytest.approx(FRICTION, rel=0.05)
    assert record["verdict"] == "explained"
    assert [note for note in record["notes"] if "the motion of base.x (0.3 mm)" in note and "base.turn_z" in note]
