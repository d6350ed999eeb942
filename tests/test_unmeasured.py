"""Joints that no column tells of, and that move by themselves: ``--unmeasured``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import corrected_xml, refusal

from equimus_ctrl import workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.fit import fit
from equimus_ctrl.identification.parameters import free_parameters
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.csvfile import write
from equimus_ctrl.types import Array, Recording

SWING = """<mujoco model="swing"><compiler angle="radian"/><option timestep="0.001"/><worldbody>
  <body name="cart"><joint name="rail" type="slide" axis="1 0 0" damping="2"/>
    <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
    <body name="bob"><joint name="string" axis="0 1 0" damping="0.01"/>
      <inertial mass="0.5" pos="0 0 -0.3" diaginertia="0.002 0.002 0.001"/><site name="end" pos="0 0 -0.4"/>
    </body></body></worldbody>
  <actuator><motor name="push" joint="rail"/></actuator></mujoco>"""
"""A load that hangs from a cart, whose swing nobody measures."""

GRIPPER = """<mujoco model="gripper"><compiler angle="radian"/><option timestep="0.001"/><worldbody>
  <body name="left"><joint name="finger" axis="0 1 0" damping="0.02" armature="1e-3"/>
    <inertial mass="0.1" pos="0 0 -0.05" diaginertia="1e-4 1e-4 1e-5"/></body>
  <body name="right" pos="0.1 0 0"><joint name="mimic" axis="0 1 0" damping="0.02" armature="1e-3"/>
    <inertial mass="0.2" pos="0 0 -0.05" diaginertia="1e-4 1e-4 1e-5"/></body></worldbody>
  <equality><joint joint1="mimic" joint2="finger" polycoef="0.1 -0.8 0.2 0 0"/></equality>
  <actuator><motor name="motor" joint="finger"/></actuator></mujoco>"""
TIMES = np.arange(401) / 200


def stepped(xml: str, start: Array, torque: Array, dt: float) -> Array:
    """(n, nq) at the samples, MuJoCo stepped alone under a torque that is held from row to row."""
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = dt
    data, rows = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = np.split(start, 2)
    per = round((TIMES[1] - TIMES[0]) / dt)
    for value in torque:
        rows.append(data.qpos.copy())
        data.ctrl[0] = value
        for _ in range(per):
            mujoco.mj_step(model, data)
    return np.array(rows)


PUSH = 4 * np.sin(4 * TIMES) * (TIMES < 1.5)
BEGIN = np.array([0.0, 0.4, 0.1, -1.0])


def swung(noise: float = 0.0, name: str = "swung", begin: Array = BEGIN, seed: int = 0) -> Recording:
    shown = stepped(SWING, begin, PUSH, 5e-5)[:, :1] + np.random.default_rng(seed).normal(0, noise, (len(TIMES), 1))
    moving = {"settled": "no"}
    return Recording(name, TIMES, PUSH[:, None], shown, ("push",), ("rail",), before=PUSH[:1], notes=moving)


def model_of(tmp_path: Path, xml: str, joint: str) -> Model:
    (tmp_path / "it.xml").write_text(xml)
    return workflow.load_model(tmp_path / "it.xml", unmeasured=[joint])


@pytest.mark.parametrize(("engine", "dt", "most"), [("reduced", 1e-3, 2e-5), ("mujoco", 1e-4, 5e-4)])
def test_both_engines_move_a_joint_that_nobody_measures(
    tmp_path: Path, engine: EngineName, dt: float, most: float
) -> None:
    model = model_of(tmp_path, SWING, "string")
    assert model.robot.joint_names == ("rail",) and model.robot.unmeasured_names == ("string",)
    (own,) = workflow.gather([swung()], model)
    start = np.array([[0.0, 0.1, 0.4, -1.0]])  # the cart's place and rate, then the load's
    (found,) = engine_for(model, engine, dt).simulate([model], [Trial.of(own, [0.0])], [start], 1)
    wanted = stepped(SWING, BEGIN, PUSH, 2e-5)[:, 0]
    assert np.abs(found.position[0, :, 0] - wanted).max() < most * np.ptp(wanted)


def test_where_it_begins_and_its_parameters_are_fitted(tmp_path: Path) -> None:
    model = model_of(tmp_path, SWING, "string")
    trials = workflow.gather([swung(1e-4), swung(1e-4, "other", np.array([0.0, -0.2, 0.0, 0.5]), 1)], model)
    segments = cut(model, trials)
    assert [s.free_start for s in segments] == [4, 4] and segments[0].start[2] == pytest.approx(0.0, abs=1e-6)
    (_, second, *_), known = cut(model, trials, shoot=0.5), trials[0].supposed
    assert known is not None and second.trial.start == pytest.approx(0.5)
    np.testing.assert_allclose(second.start[2:], np.concatenate([part[0] for part in known.at([0.5])[:2]]))
    wrong = model.with_parameters({"bob.mass": 0.6, "string.damping": 0.02})
    engine = engine_for(model, "reduced", 2e-3)
    found = fit(free_parameters(wrong, ["bob.mass", "string.damping"]), segments, simulator=Simulator(engine, 1))
    numbers = found.model.robot.parameters()
    assert numbers["bob.mass"] == pytest.approx(0.5, rel=0.01)
    assert numbers["string.damping"] == pytest.approx(0.01, rel=0.05)
    np.testing.assert_allclose(found.starts[0][2:], [0.4, -1.0], atol=0.02)
    assert found.rmse[0] < 1.2e-4


def test_what_it_may_have_done_is_found_along_the_measured_motion(tmp_path: Path) -> None:
    """Of a load that hangs at rest at first: with the cart's motion alone, no force on it."""
    model, hanging = model_of(tmp_path, SWING, "string"), np.zeros(4)
    (own,) = workflow.gather([swung(begin=hanging)], model)
    assert own.supposed is not None and own.supposed.joints == ("string",)
    wanted = stepped(SWING, hanging, PUSH, 5e-5)[:, 1]
    assert np.abs(own.supposed.position[:, 0] - wanted).max() < 0.02 * np.ptp(wanted)
    tilted = model_of(tmp_path, SWING.replace("<option ", '<option gravity="3 0 -9.81" '), "string")
    (other,) = workflow.gather([swung(begin=hanging)], tilted)
    assert other.supposed is not None
    assert other.supposed.position[0, 0] == pytest.approx(-np.arctan2(3, 9.81), abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_a_joint_that_is_tied_to_another_begins_where_that_puts_it(tmp_path: Path, engine: EngineName) -> None:
    model = model_of(tmp_path, GRIPPER, "mimic")
    assert model.robot.unmeasured_names == ("mimic",) and model.robot.loose_count == 0
    torque = 0.1 * np.sin(6 * TIMES)
    q, v = 0.3, 1.0
    start = np.array([q, 0.1 - 0.8 * q + 0.2 * q * q, v, (-0.8 + 0.4 * q) * v])
    wanted = stepped(GRIPPER, start, torque, 5e-5)
    own = Recording("grip", TIMES, torque[:, None], wanted[:, :1], ("motor",), ("finger",))
    (own,) = workflow.gather([own], model)
    assert own.supposed is not None
    assert np.abs(own.supposed.position[:, 0] - wanted[:, 1]).max() < 0.02 * np.ptp(wanted[:, 1])
    (segment,) = cut(model, [own])
    assert segment.free_start == 2
    (found,) = engine_for(model, engine, 2e-4).simulate([model], [segment.trial], [np.array([[q, v]])], 1)
    assert np.abs(found.position[0, :, 0] - wanted[:, 0]).max() < 2e-3 * np.ptp(wanted[:, 0])


@pytest.mark.slow
def test_a_joint_is_prescribed_one_measured_and_one_neither(tmp_path: Path) -> None:
    """A crane on a rail that is moved, the angle of its rope measured, and not that of the load below its hook."""
    crane = SWING.replace(
        '<site name="end" pos="0 0 -0.4"/>',
        """<body name="load" pos="0 0 -0.4"><joint name="hook" axis="0 1 0" damping="0.005"/>
        <inertial mass="0.3" pos="0 0 -0.2" diaginertia="0.001 0.001 0.001"/></body>""",
    )
    heavy, dt, rows = 1e6, 5e-5, []
    model = mujoco.MjModel.from_xml_string(
        crane.replace('axis="1 0 0" damping="2"', f'axis="1 0 0" armature="{heavy}"')
    )
    model.opt.timestep = dt
    data, place, rate = mujoco.MjData(model), 0.1 * np.sin(5 * TIMES), lambda time: 0.5 * np.cos(5 * time)
    data.qpos[1:] = 0.2, -0.1
    for time in dt * np.arange(round(TIMES[-1] / dt) + 1):
        rows.append(data.qpos[1:].copy())
        data.qpos[0], data.qvel[0] = 0.1 * np.sin(5 * time), rate(time)
        data.qfrc_applied[0] = heavy * (rate(time + dt) - rate(time)) / dt
        mujoco.mj_step(model, data)
    wanted = np.array(rows)[:: round(TIMES[1] / dt)]
    (tmp_path / "crane.xml").write_text(crane)
    robot = workflow.load_model(tmp_path / "crane.xml", prescribe=["rail"], unmeasured=["hook"])
    shown = np.column_stack([place, wanted[:, 0]])
    recorded = Recording("crane", TIMES, np.empty((len(TIMES), 0)), shown, (), ("rail", "string"))
    (own,) = workflow.gather([recorded], robot)
    assert own.joints == ("string",) and own.poses.shape == (len(TIMES), 3)
    names: tuple[EngineName, ...] = ("reduced", "mujoco")
    for name in names:
        start = [np.array([[0.2, 0.0, -0.1, 0.0]])]
        (found,) = engine_for(robot, name, 2e-4).simulate([robot], [Trial.of(own, [0.2])], start, 1)
        assert np.abs(found.position[0, :, 0] - wanted[:, 0]).max() < 2e-3 * np.ptp(wanted[:, 0])


def test_files_models_and_the_command_line_hold_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = model_of(tmp_path, SWING, "str*")
    workflow.save_model(tmp_path / "kept.toml", model.with_parameters({"string.damping": 0.03}), tmp_path / "it.xml")
    again = workflow.load_model(tmp_path / "kept.toml")
    assert again.robot.unmeasured_names == ("string",) and again.robot.parameters()["string.damping"] == 0.03
    assert mujoco.MjModel.from_xml_string(corrected_xml(again)[0]).dof_damping.tolist() == [2, 0.03]
    write(tmp_path / "swung.csv", swung(1e-4, begin=np.zeros(4)))
    given = [str(tmp_path / "swung.csv"), "--model", str(tmp_path / "it.xml")]
    assert main(["score", *given, "--unmeasured", "string", "--json"]) == 0
    assert '"rail"' in capsys.readouterr().out
    assert main(["score", *given]) == 2
    told = " ".join(capsys.readouterr().err.split())
    assert "or moves by itself with --unmeasured" in told
    assert main(["score", *given, "--unmeasured", "strin"]) == 2
    assert "unmeasured: there is no joint 'strin'" in " ".join(capsys.readouterr().err.split())


def test_what_cannot_be_left_unmeasured_is_told(tmp_path: Path) -> None:
    assert "acts on no joint that is measured" in refusal(lambda: model_of(tmp_path, SWING, "rail"))
    assert "no joint is left that is measured" in refusal(lambda: model_of(tmp_path, SWING, "*"))
    path = tmp_path / "it.xml"
    both = refusal(lambda: workflow.load_model(path, unmeasured=["string"], prescribe=["string"]))
    assert "string is prescribed and unmeasured" in both
    turned = GRIPPER.replace('joint1="mimic" joint2="finger"', 'joint1="finger" joint2="mimic"')
    assert "expected a line, or the equality the other way round" in refusal(
        lambda: model_of(tmp_path, turned, "mimic")
    )
    line = model_of(tmp_path, turned.replace(" 0.2 0 0", " 0 0 0"), "mimic")
    at, _ = line.robot.with_unmeasured(np.array([0.3]), np.array([0.0]), np.empty(0))
    assert pytest.approx(0.1 - 0.8 * at[1]) == 0.3
    model = model_of(tmp_path, SWING, "string")
    end = replace(swung(), sites={"end.x": TIMES}, notes={"also": "site.end.x"})
    (own,) = workflow.gather([end], model)
    assert "site end is moved by joints that are not measured" in refusal(lambda: cut(model, [own]))
    bare = swung()
    engine = engine_for(model, "mujoco")
    told = refusal(lambda: engine.simulate([model], [Trial.of(bare, [0.0])], [np.zeros((1, 2))], 1))
    assert "does not say where string may begin" in told


@pytest.mark.long
@pytest.mark.slow
def test_what_is_missing_at_a_measured_joint_is_found_beside_one_that_nobody_measures(tmp_path: Path) -> None:
    """Dry friction of a cart whose load swings, from another state in each of four trials."""
    rng, friction, dt = np.random.default_rng(3), 0.5, 2e-4
    rubs = f'frictionloss="{friction}" solreffriction="-1 {-1 / dt}" solimpfriction="0.9999 0.9999 0.001 0.5 2"'
    xml, trials = SWING.replace('damping="2"', f'damping="2" {rubs}'), []
    for k in range(4):
        force = 5 * np.sin(rng.uniform(2, 5) * TIMES + rng.uniform(0, 6)) + 2 * np.sin(rng.uniform(5, 9) * TIMES)
        shown = stepped(xml, rng.normal(0, [0.1, 0.2, 0.1, 0.5]), force, dt)[:, :1]
        shown += rng.normal(0, 1e-4, shown.shape)
        trials.append(Recording(f"swung_{k}", TIMES, force[:, None], shown, ("push",), ("rail",)))
    found = workflow.diagnose(trials, model_of(tmp_path, SWING, "string"), threads=1)
    record = found.to_dict()
    assert [(own["effect"], list(own["locations"])) for own in record["findings"]] == [("coulomb_friction", ["rail"])]
    assert found.findings[0].parameters["friction"].value == pytest.approx(friction, rel=0.05)
    assert record["verdict"] == "explained"
    assert [note for note in record["notes"] if note.endswith("from a start that is fitted: string")]
