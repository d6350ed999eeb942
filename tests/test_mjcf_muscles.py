"""Muscles: arms with MuJoCo's muscles, against MuJoCo stepped by hand."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import refusal

from equimus_ctrl import workflow
from equimus_ctrl.effects import ActuatorGain
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.channels import Channels
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording
from equimus_ctrl.workflow.exports import write_corrected

ARM = """<mujoco model="muscled"><compiler angle="radian"/>
  <option timestep="0.002" integrator="implicitfast"/><worldbody><body name="arm">
  <joint name="elbow" axis="0 -1 0" armature="0.01" damping="0.05" range="-1.5 1.5"/>
  <inertial pos="0 0 -0.25" mass="1.2" diaginertia="0.01 0.01 0.002"/></body></worldbody>
  <tendon><fixed name="flex"><joint joint="elbow" coef="-0.04"/></fixed>
    <fixed name="extend"><joint joint="elbow" coef="0.04"/></fixed></tendon>
  <actuator><muscle name="flexor" tendon="flex" force="60" lengthrange="-0.08 0.08"/>
    <muscle name="extensor" tendon="extend" scale="25" lengthrange="-0.08 0.08" timeconst="0.02 0.06"/></actuator>
</mujoco>"""
"""One muscle with a force of its own, and one whose force MuJoCo takes from what it moves (``acc0``)."""
EVERY = 0.01


def activations(k: int, rows: int) -> Array:
    time = EVERY * np.arange(rows)
    columns = [
        0.25
        + 0.25 * np.sin(2 * np.pi * (0.6 + 0.15 * k) * time + k + i * np.pi)
        + 0.1 * np.sign(np.sin(2 * np.pi * 1.1 * time + i + k))
        for i in range(2)
    ]
    return np.column_stack(columns)  # also below 0, where nothing is


def stepped(given: Array, loss: float = 0.0) -> tuple[Array, Array]:
    """(n, 1) positions and (n, 2) forces by MuJoCo alone, its activations settled under the first row."""
    model = mujoco.MjModel.from_xml_string(ARM)
    model.dof_frictionloss[0] = loss
    data, positions, forces = mujoco.MjData(model), [], []
    data.act[:] = np.clip(given[0], 0, 1)
    for row in given:
        data.ctrl[:] = row
        mujoco.mj_forward(model, data)
        positions.append(data.qpos.copy())
        forces.append(data.actuator_force.copy())
        for _ in range(round(EVERY / model.opt.timestep)):
            mujoco.mj_step(model, data)
    return np.array(positions), np.array(forces)


ROBOT = MjcfRobot("muscled", ARM)


def test_muscles_are_taken_with_mujoco_and_a_sentence_why() -> None:
    assert ROBOT.actuator_names == ("flexor", "extensor") and [d.joint for d in ROBOT.actuators] == ["elbow", "elbow"]
    said = engine_for(Model(ROBOT)).sentence
    assert said == "Engine: mujoco (compiled equations of motion cannot hold muscle 'flexor')."
    assert Channels(forces=(1,)).units(ROBOT) == ("N",)  # along a tendon
    told = refusal(lambda: engine_for(Model(ROBOT), "reduced"))
    assert "muscle 'flexor'; expected --engine mujoco" in told


@pytest.mark.parametrize(("gain", "bias"), [("muscle", "affine"), ("fixed", "muscle")])
def test_gain_and_bias_are_both_of_a_muscle_or_neither(gain: str, bias: str) -> None:
    kinds = f'gaintype="{gain}" biastype="{bias}"'
    numbers = " ".join(f'{key}="0.75 1.05 -1 200 0.5 1.6 1.5 1.3 1.2"' for key in ("gainprm", "biasprm"))
    drive = f'<general name="mixed" joint="elbow" {kinds} {numbers} lengthrange="-1 1"/></actuator>'
    told = refusal(lambda: MjcfRobot("mixed", ARM.replace("</actuator>", drive)))
    assert f"actuator 'mixed' has the gain '{gain}' and the bias '{bias}'" in told


def test_a_muscled_arm_moves_as_mujoco_moves_it_from_rest_and_from_any_instant_on() -> None:
    """At an interval's start a muscle is as active as the commands before have made it."""
    given, time = activations(0, 150), EVERY * np.arange(150)
    q, force = stepped(given)
    whole = Trial("t", time, given, given[0], 0.0, np.zeros(1), time, np.zeros(1), inner=True, forces=True)
    (found,) = simulate_mjcf([Model(ROBOT)], [whole], threads=1)
    np.testing.assert_allclose(found.position[0], q, atol=1e-10)
    assert found.motion is not None and found.forces is not None
    np.testing.assert_allclose(found.forces[0], force, atol=1e-8)
    assert np.ptp(q) > 0.5 and force.min() < -10
    for first in (1, 5, 87):
        start = found.motion[0, first]
        sampled = time[first:]
        later = Trial("t", time, given, given[0], float(time[first]), start[:1], sampled, start[1:], forces=True)
        (part,) = simulate_mjcf([Model(ROBOT)], [later], threads=1)
        assert part.forces is not None
        np.testing.assert_allclose(part.forces[0, 0], force[first], rtol=2e-3, atol=2e-3)
        assert np.abs(part.position[0] - q[first:]).max() < 2e-3


def test_parameters_of_muscles_are_what_mujoco_stores() -> None:
    """A muscle without a force of its own keeps that of the file, however heavy what it moves is."""
    values, base = ROBOT.parameters(), ROBOT.plan.base
    assert values["flexor.force"] == 60 and ROBOT.unit("flexor.force") == "N"
    assert values["extensor.force"] == pytest.approx(25 / base.actuator_acc0[1])
    assert (values["extensor.activation_time"], values["extensor.deactivation_time"]) == (0.02, 0.06)
    changed = {"arm.mass": 2.4, "flexor.force": 70.0, "extensor.deactivation_time": 0.1}
    own = realise(Model(ROBOT, (ActuatorGain("extensor", 0.5),)).with_parameters(changed)).mujoco
    assert own.actuator_acc0[1] < 0.9 * base.actuator_acc0[1]
    for field in (own.actuator_gainprm, own.actuator_biasprm):
        np.testing.assert_allclose(field[:, 2], [70.0, 0.5 * values["extensor.force"]])
        np.testing.assert_array_equal(field[:, [0, 1, 4, 5, 6, 7, 8]], base.actuator_gainprm[:, [0, 1, 4, 5, 6, 7, 8]])
    assert own.actuator_dynprm[1, :2].tolist() == [0.02, 0.1]
    assert not any(name.endswith(("force", "_time")) for name in ROBOT.default_names())


def test_the_xml_that_is_written_moves_alike(tmp_path: Path) -> None:
    model = Model(ROBOT, (ActuatorGain("extensor", 0.8),)).with_parameters({"arm.mass": 1.5})
    path = tmp_path / "whole.xml"
    write_corrected(path, model)
    time = EVERY * np.arange(100)
    trial = Trial("t", time, activations(1, 100), np.zeros(2), 0.0, np.zeros(1), time, np.zeros(1))
    paths = [
        simulate_mjcf([own], [trial], threads=1)[0].position[0]
        for own in (model, Model(MjcfRobot("again", path.read_text())))
    ]
    assert np.abs(paths[0] - paths[1]).max() < 1e-6 and np.ptp(paths[0]) > 0.3


@lru_cache(maxsize=2)
def recorded(loss: float) -> tuple[Recording, ...]:
    """Angles to 1 mrad."""
    rng = np.random.default_rng(5)
    trials = []
    for k in range(4):
        given = activations(k, 200)
        q = stepped(given, loss)[0]
        time = EVERY * np.arange(len(given))
        trials.append(
            Recording(f"t{k}", time, given, q + rng.normal(0, 1e-3, q.shape), ("flexor", "extensor"), ("elbow",))
        )
    return tuple(trials)


def test_score_tells_the_friction_that_a_muscled_arm_lacks() -> None:
    errors = [workflow.score(recorded(loss), Model(ROBOT)).rmse[0] for loss in (0.0, 0.15)]
    assert errors[1] > 5 * errors[0]


@pytest.mark.long
@pytest.mark.slow
def test_a_diagnosis_of_a_muscled_arm_names_the_friction() -> None:
    found = workflow.diagnose(recorded(0.15), Model(ROBOT), most=1, threads=1)
    assert [(f.named.effect, f.named.locations) for f in found.findings] == [("coulomb_friction", ("elbow",))]
    size = found.findings[0].parameters["friction"]
    assert size.value == pytest.approx(0.15, rel=0.05)
