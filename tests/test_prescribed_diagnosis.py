"""What is missing at a joint is found while another is shaken by hand: recordings by MuJoCo stepped alone."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from test_prescribed import ARM, ROBOT

from equimus_ctrl import workflow
from equimus_ctrl.models.model import Model
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
    found = workflow.diagnose_recordings(trials, Model(ROBOT), threads=1)
    record = found.to_dict()
    assert [(own["effect"], list(own["locations"])) for own in record["findings"]] == [("coulomb_friction", ["elbow"])]
    assert found.findings[0].parameters["friction"].value == pytest.approx(FRICTION, rel=0.05)
    assert record["verdict"] == "explained" and list(record["noise_rad"]) == ["elbow"]
    assert [note for note in record["notes"] if "the motion of shoulder (0.5" in note or "shoulder (0.4" in note]
    assert "shoulder" not in str({key: value for key, value in record.items() if key != "notes"})
