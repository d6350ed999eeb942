"""Joints whose measured motion is an input: ``--prescribe``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import corrected_xml, refusal

from equimus_ctrl import workflow
from equimus_ctrl.cli.main import main
from equimus_ctrl.diagnosis.linear_response import linearise
from equimus_ctrl.diagnosis.observed import observed
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.diagnosis.plausibility import check, measured_motions
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.mjcf_inverse import inverse_dynamics
from equimus_ctrl.engines.mjcf_motion import mjcf_motion, simulated_response
from equimus_ctrl.engines.motion import motion
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.channels import with_channels
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import Simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import RecordingWarning
from equimus_ctrl.recordings.csvfile import write
from equimus_ctrl.recordings.smoothing import smoothed
from equimus_ctrl.robots.mjcf.editing import Edits
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, PrescribedMotion, Recording
from equimus_ctrl.workflow.mjcf import with_prescribed

ARM = """<mujoco model="arm"><compiler angle="radian"/><option timestep="0.001"/><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 1 0" armature="0.01" damping="0.3" range="-3 3"/>
    <inertial mass="1.2" pos="0 0 -0.15" diaginertia="0.01 0.01 0.001"/>
    <body name="lower" pos="0 0 -0.3"><joint name="elbow" axis="0 1 0" armature="0.002" damping="0.05"/>
      <inertial mass="0.6" pos="0.01 0 -0.12" diaginertia="0.004 0.004 0.0005"/><site name="tip" pos="0 0 -0.25"/>
    </body></body></worldbody>
  <actuator><position name="drive" joint="shoulder" kp="100"/><motor name="motor" joint="elbow"/></actuator></mujoco>"""
ROBOT = MjcfRobot("arm", ARM, source="arm.xml", edits=Edits(prescribe=("shoulder",)))
TIMES = np.arange(301) / 150
START = (0.2, 0.0)


def shaken(times: Array) -> tuple[Array, Array, Array]:
    """Angle, rate and acceleration of the shoulder."""
    w = 7.0
    return 0.5 * np.sin(w * times), 0.5 * w * np.cos(w * times), -0.5 * w * w * np.sin(w * times)


MOTION = smoothed("shaken", ("shoulder",), TIMES, shaken(TIMES)[0][:, None])


def trial(size: float = 0.1) -> Trial:
    """The elbow's motor pulls while the shoulder is shaken; commands are held, the acceleration is not."""
    torque = size * np.cos(5 * TIMES)[:, None]
    return Trial("shaken", TIMES, torque, torque[0], 0.0, np.array(START[:1]), TIMES, prescribed=MOTION)


def elbow_by_hand(own: Trial) -> Array:
    """(m,) the elbow at the samples: its equation alone along the shoulder's motion, Runge and Kutta's method."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data, needed, whole = mujoco.MjData(model), np.zeros(2), np.zeros((2, 2))
    assert own.prescribed is not None
    moved = own.prescribed

    def acceleration(time: float, torque: float, q: float, v: float) -> float:
        (q0,), (v0,), (a0,) = moved.at(time)
        data.qpos[:], data.qvel[:], data.qacc[:] = (q0, q), (v0, v), (a0, 0.0)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_rne(model, data, 1, needed)
        mujoco.mj_fullM(model, data, whole)
        return float((torque + data.qfrc_passive[1] - needed[1]) / whole[1, 1])

    found, (q, v), parts = [START[0]], START, 8
    for k, start in enumerate(own.times[:-1]):
        h, torque = (own.times[k + 1] - start) / parts, float(own.commands[k, 0])
        for t in start + h * np.arange(parts):
            a1 = acceleration(t, torque, q, v)
            a2 = acceleration(t + h / 2, torque, q + h / 2 * v, v + h / 2 * a1)
            a3 = acceleration(t + h / 2, torque, q + h / 2 * v + h * h / 4 * a1, v + h / 2 * a2)
            a4 = acceleration(t + h, torque, q + h * v + h * h / 2 * a2, v + h * a3)
            q, v = q + h * v + h * h / 6 * (a1 + a2 + a3), v + h / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        found.append(q)
    return np.array(found)


def recording(noise: float = 0.0, name: str = "shaken") -> Recording:
    """What sensors of both joints show of ``trial``, at the samples."""
    rng, own = np.random.default_rng(1), trial()
    shown = np.column_stack([shaken(TIMES)[0], elbow_by_hand(own)]) + rng.normal(0, 1, (len(TIMES), 2)) * noise
    return Recording(name, TIMES, own.commands, shown, ("motor",), ("shoulder", "elbow"))


def test_noise_is_smoothed_as_much_as_it_asks_for() -> None:
    rng = np.random.default_rng(0)
    times = np.sort(np.arange(800) / 200 + rng.uniform(-1e-3, 1e-3, 800))
    truth = shaken(times)
    noisy = smoothed("it", ("shoulder",), times, (truth[0] + rng.normal(0, 1e-3, 800))[:, None])
    assert noisy.noise == pytest.approx(1e-3, rel=0.1)
    inside = slice(20, -20)
    assert np.std(noisy.position[inside, 0] - truth[0][inside]) < 4e-4
    assert np.std(noisy.acceleration[inside, 0] - truth[2][inside]) < 0.03 * np.std(truth[2])
    exact = smoothed("it", ("shoulder",), times, truth[0][:, None])
    assert exact.noise == 0 and np.abs(exact.position[:, 0] - truth[0]).max() < 1e-12
    between = (times[1:] + times[:-1]) / 2
    for found, wanted, most in zip(exact.at(between[5:-5]), shaken(between[5:-5]), (1e-7, 1e-4, 1e-2), strict=True):
        np.testing.assert_allclose(found[:, 0], wanted, atol=most)
    assert "has 3 rows" in refusal(lambda: smoothed("it", ("shoulder",), times[:3], truth[0][:3, None]))


def test_the_other_joints_move_as_mujoco_says_along_the_prescribed_motion() -> None:
    own, model = trial(), Model(ROBOT)
    wanted = elbow_by_hand(own)
    (found,) = engine_for(model, "reduced", dt=5e-4).simulate([model], [own], [np.array([START])])
    assert found.position.shape == (1, len(TIMES), 1)
    assert np.abs(found.position[0, :, 0] - wanted).max() < 1e-6 * np.ptp(wanted)
    halves = [engine_for(model, "mujoco", dt).simulate([model], [own], [np.array([START])])[0] for dt in (2e-4, 1e-4)]
    first, second = (half.position[0, :, 0] for half in halves)
    # MuJoCo's own integrator is of first order: without that error
    assert np.abs(2 * second - first - wanted).max() < 1e-5 * np.ptp(wanted)


def test_mujoco_steps_are_those_of_mujoco_with_the_motion_prescribed() -> None:
    """By hand: the force on the shoulder that gives it its acceleration, and its state put right in each step.

    Without damping, which MuJoCo counts by the velocity at the end of a step, of all joints together.
    """
    own = trial(0.0)
    model = mujoco.MjModel.from_xml_string(ARM.replace(' damping="0.3"', "").replace(' damping="0.05"', ""))
    data, dt = mujoco.MjData(model), model.opt.timestep
    data.qpos[1], rows = START[0], []
    edges = dt * np.arange(1001)
    for time in edges:
        rows.append(data.qpos[1])
        (data.qpos[0],), (data.qvel[0],), _ = MOTION.at(time)
        wanted = (MOTION.at(time + dt)[1][0] - data.qvel[0]) / dt
        forces = []
        for force in (0.0, 1.0):
            data.qfrc_applied[0] = force
            mujoco.mj_forward(model, data)
            forces.append(data.qacc[0])
        data.qfrc_applied[0] = (wanted - forces[0]) / (forces[1] - forces[0])
        mujoco.mj_step(model, data)
    there = np.arange(0, 151, 3)  # where a sample is at the end of a step
    undamped = Model(ROBOT).with_parameters({"elbow.damping": 0.0})
    (found,) = engine_for(undamped, "mujoco").simulate([undamped], [own], [np.array([START])])
    by_hand = np.array(rows)[np.round(TIMES[there] / dt).astype(int)]
    assert np.abs(found.position[0, there, 0] - by_hand).max() < 1e-7 * np.ptp(by_hand)


def test_both_engines_tell_the_same_of_what_moves_inside() -> None:
    own, model = trial(), Model(ROBOT)
    inside = motion(model, own, np.array(START), 5e-4)
    beside = mjcf_motion(model, own, np.array(START))
    assert inside.position.shape == beside.position.shape == (len(TIMES), 1)
    assert inside.arm.shape[2] == 1 and inside.coordinates.shape[1] == 2
    for found, wanted in ((beside.position, inside.position), (beside.velocity, inside.velocity)):
        assert np.abs(found - wanted).max() < 0.01 * np.ptp(wanted)
    torque = np.where(np.arange(len(TIMES) - 1) < 20, 1e-3, 0.0)[:, None, None]
    exact = linearise(model, [inside]).response([torque])[0]
    stepped = simulated_response(model, [own], [np.array(START)], np.ones(1), 1).response([torque])[0]
    assert np.abs(exact - stepped).max() < 0.03 * np.abs(exact).max()


def test_a_prescribed_joint_is_no_part_of_what_is_compared_or_estimated() -> None:
    assert (ROBOT.joint_names, ROBOT.prescribed_names, ROBOT.actuator_names) == (("elbow",), ("shoulder",), ("motor",))
    assert not [name for name in ROBOT.parameters() if name.startswith(("shoulder", "upper", "drive"))]
    loose = ARM.replace('name="drive"', 'name="drive" gear="0"')
    assert MjcfRobot("arm", loose, edits=Edits(prescribe=("shoulder",))).actuator_names == ("motor",)
    assert ROBOT.base_names() == ["lower.mass", "lower.com_x", "lower.com_z", "elbow.armature"]
    assert ROBOT.places()["joint"] == ("elbow",) and ROBOT.places()["link"] == ("lower",)
    segments = cut(Model(ROBOT), [with_prescribed(recording(1e-3), ROBOT)], shoot=1.0)
    assert [s.measured.shape[1] for s in segments] == [1, 1] and segments[1].free_start == 2


def test_the_torque_domain_knows_the_motion_and_asks_nothing_of_the_joint() -> None:
    model = Model(ROBOT)
    assert ROBOT.has_torque_domain
    motions = measured_motions(model, [with_prescribed(recording(), ROBOT)])
    (found,) = inverse_dynamics(model, motions, 3)
    assert found.missing.shape[1] == 1
    still = replace(motions[0].trial, prescribed=PrescribedMotion.at_rest(("shoulder",)))
    (without,) = inverse_dynamics(model, [replace(motions[0], trial=still)], 3)
    assert np.std(found.missing) < 0.01 * np.std(without.missing)


BELT = ARM.replace(
    '<actuator><position name="drive" joint="shoulder" kp="100"/><motor name="motor" joint="elbow"/>',
    """<tendon><fixed name="belt"><joint joint="shoulder" coef="0.6"/><joint joint="elbow" coef="1"/></fixed></tendon>
    <actuator><position name="drive" joint="shoulder" kp="100"/><position name="servo" tendon="belt" kp="4" kv="0.2"/>""",
)
"""The elbow's servo sits on a belt that the shoulder winds too."""


def belted(size: float = 0.3) -> tuple[Model, Trial]:
    robot = MjcfRobot("arm", BELT, source="arm.xml", edits=Edits(prescribe=("shoulder",)))
    return Model(robot), replace(trial(size), inner=True, forces=True)


@pytest.mark.slow
@pytest.mark.parametrize(("engine", "dt"), [("reduced", 5e-4), ("mujoco", 1e-4)])
def test_a_drives_force_hangs_on_the_prescribed_motion_too(engine: EngineName, dt: float) -> None:
    """Its command is held from row to row while the acceleration of the shoulder goes along a line."""
    model, own = belted()
    assert model.robot.actuator_names == ("servo",)
    (found,) = engine_for(model, engine, dt).simulate([model], [own], [np.array([START])], 1)
    assert found.forces is not None and found.motion is not None and found.forces.shape == (1, len(TIMES), 1)
    q, v = found.motion[0].T
    along, rate = 0.6 * shaken(TIMES)[0] + q, 0.6 * shaken(TIMES)[1] + v
    wanted = 4 * (own.commands[:, 0] - along) - 0.2 * rate
    assert np.abs(found.forces[0, :, 0] - wanted).max() < 1e-3 * np.ptp(wanted)


def test_both_engines_agree_on_what_small_forces_change_of_a_drives_force_along_a_prescribed_motion() -> None:
    model, own = belted()
    recorded = Recording(
        "shaken", TIMES, own.commands, 0.2 * np.cos(8 * TIMES)[:, None], ("servo",), ("elbow",), prescribed=MOTION,
        measured=np.cos(5 * TIMES)[:, None],
    )  # fmt: skip
    (segment,) = cut(model, with_channels([recorded], ["meas.servo"]))
    start, pushed = np.array(START), segment.trial
    pushes = [np.random.default_rng(1).normal(0, 1, (len(pushed.sample_times) - 1, 1, 2)).cumsum(axis=0) / 100]
    inside = linearise(model, [motion(model, pushed, start, 1e-3)])
    exact = observed(inside, model.robot, [segment]).response(pushes)[0]
    assert inside.drive_response(pushes)[0].shape[1] == 1
    stepped = simulated_response(model, [pushed], [start], np.ones(1), 1)
    by_steps = observed(stepped, model.robot, [segment]).response(pushes)[0]
    size = np.abs(exact[:, 1]).max()
    assert size > 0.01 and np.abs(exact[:, 1] - by_steps[:, 1]).max() < 0.04 * size


def test_a_measured_force_of_the_other_sign_is_told_along_a_prescribed_motion() -> None:
    own, model = with_prescribed(recording(), ROBOT), Model(ROBOT)
    (right,) = with_channels([replace(own, measured=own.command)], ["meas.*"])
    check(model, [right])
    told = refusal(lambda: check(model, [replace(right, measured=-own.command)]))
    assert "meas.motor looks negated" in told and "pos.elbow" in told


def test_a_rope_that_pulls_at_the_elbow_where_the_shoulder_is_bent_is_a_drive_of_it() -> None:
    """What another drive does there is not measured, so the motor's force is not judged by the elbow's motion."""
    roped = ARM.replace("<worldbody>", '<worldbody><site name="hook" pos="0 0 1"/>').replace(
        '<actuator><position name="drive" joint="shoulder" kp="100"/>',
        '<tendon><spatial name="rope"><site site="hook"/><site site="tip"/></spatial></tendon>'
        '<actuator><motor name="reel" tendon="rope"/>',
    )
    robot = MjcfRobot("arm", roped, source="arm.xml", edits=Edits(prescribe=("shoulder",)))
    assert robot.actuator_names == ("reel", "motor")
    whole = mujoco.MjModel.from_xml_string(ARM)
    data, needed = mujoco.MjData(whole), []
    for angle, rate, acceleration in zip(*shaken(TIMES), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = (angle, 0), (rate, 0), (acceleration, 0)
        mujoco.mj_inverse(whole, data)
        needed.append((0.0, data.qfrc_inverse[1]))
    command = np.array(needed)
    own = Recording(
        "it", TIMES, command, np.zeros((len(TIMES), 1)), robot.actuator_names, ("elbow",), prescribed=MOTION,
        measured=np.column_stack([np.full(len(TIMES), np.nan), -command[:, 1]]),
    )  # fmt: skip
    (negated,) = with_channels([own], ["meas.motor"])
    check(Model(robot), [negated])


def test_a_muscle_over_a_prescribed_joint_is_as_strong_as_in_the_file() -> None:
    """MuJoCo takes the force of one without its own, and the range of its lengths, from all joints that it pulls."""
    muscled = BELT.replace(
        '<position name="servo" tendon="belt" kp="4" kv="0.2"/>', '<muscle name="muscle" tendon="belt" scale="50"/>'
    ).replace('name="elbow"', 'name="elbow" range="-2 2"')
    robot = MjcfRobot("arm", muscled, source="arm.xml", edits=Edits(prescribe=("shoulder",)))
    alone, held = MjcfRobot("arm", muscled), robot.plan.base
    assert robot.actuator_names == ("muscle",)
    assert robot.parameters()["muscle.force"] == alone.parameters()["muscle.force"]
    lengths = (own.actuator_lengthrange[own.actuator("muscle").id] for own in (held, alone.plan.base))
    np.testing.assert_array_equal(*lengths)


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_sites_are_where_the_prescribed_motion_has_them(engine: EngineName) -> None:
    model, own = Model(ROBOT), with_prescribed(recording(), ROBOT)
    q = np.column_stack([shaken(TIMES)[0], recording().position[:, 1]])
    tip = -0.3 * np.sin(q[:, 0]) - 0.25 * np.sin(q.sum(axis=1))
    (segment,) = cut(model, with_channels([replace(own, sites={"tip.x": tip})], ["site.tip.x"]))
    (found,) = Simulator(engine_for(model, engine, 2e-4))([model], [segment], [np.array([START])])
    assert np.abs(found.position[0, :, 1] - tip).max() < 2e-3


def test_files_models_and_the_xml_that_is_written_hold_it(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    write(tmp_path / "shaken.csv", recording(1e-3))
    model = workflow.load_model(tmp_path / "arm.xml", prescribe=["should*"])
    assert model.robot.prescribed_names == ("shoulder",)
    score = workflow.score([tmp_path / "shaken.csv"], model)
    assert score.rmse[0] < 0.02 and score.to_dict()["rmse_rad"].keys() == {"elbow"}
    workflow.save_model(tmp_path / "kept.toml", model.with_parameters({"lower.mass": 0.7}), tmp_path / "arm.xml")
    again = workflow.load_model(tmp_path / "kept.toml")
    assert again.robot.prescribed_names == ("shoulder",) and again.robot.parameters()["lower.mass"] == 0.7
    text, left = corrected_xml(again)
    whole = mujoco.MjModel.from_xml_string(text)
    assert not left and (whole.nu, whole.dof_damping[0], whole.dof_armature[0]) == (2, 0.3, 0.01)
    assert whole.body("lower").mass == 0.7 and whole.jnt_range[0].tolist() == [-3, 3]


def test_the_command_line_takes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    write(tmp_path / "shaken.csv", recording(1e-3))
    given = [str(tmp_path / "shaken.csv"), "--model", str(tmp_path / "arm.xml"), "--prescribe"]
    assert main(["recordings", "check", *given, "shoulder"]) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert "taken as measured, and smoothed by as much as their noise: the motion of shoulder (0.9" in told
    assert main(["score", *given, "shoulder", "--json"]) == 0
    assert '"elbow"' in capsys.readouterr().out
    assert main(["score", *given, "sholder"]) == 2
    assert "prescribe: there is no joint 'sholder'" in " ".join(capsys.readouterr().err.split())


def test_what_cannot_be_prescribed_is_told(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(ARM)
    assert "the motion of all joints is prescribed" in refusal(lambda: workflow.load_model(path, prescribe=["*"]))
    assert "MJCF robots alone" in refusal(lambda: workflow.load_model(prescribe=["hip"]))
    (tmp_path / "m.toml").write_text('mjcf = "arm.xml"\nprescribe = "shoulder"\n')
    assert "expected a list of names of joints" in refusal(lambda: workflow.load_model(tmp_path / "m.toml"))
    own = Trial("free", TIMES, np.zeros((len(TIMES), 1)), np.zeros(1), 0.0, np.zeros(1), TIMES)
    engine = engine_for(Model(ROBOT), "mujoco")
    told = refusal(lambda: engine.simulate([Model(ROBOT)], [own], [np.array([START])], 1))
    assert "has the motion of none, expected that of shoulder" in told
    path.write_text(ARM.replace('timestep="0.001"/>', 'timestep="0.001"><flag actuation="disable"/></option>'))
    told = refusal(lambda: workflow.load_model(path, prescribe=["shoulder"]))
    assert "the XML switches actuators off" in told


def test_velocities_of_the_other_joints_alone_are_asked_for(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    rows = "\n".join(f"{k / 100},0,{k / 100},0.1,{k}" for k in range(20))
    (tmp_path / "it.csv").write_text(f"time,cmd.motor,pos.shoulder,pos.elbow,vel.elbow\n{rows}\n")
    model = workflow.load_model(tmp_path / "arm.xml", prescribe=["shoulder"])
    (found,) = workflow.gather([tmp_path / "it.csv"], model)
    assert found.velocity is not None and found.velocity[:, 0].tolist() == list(range(20))
    assert found.prescribed is not None
    np.testing.assert_allclose(found.prescribed.velocity, 1.0, rtol=1e-9)
    (tmp_path / "its.csv").write_text(f"time,cmd.motor,pos.shoulder,pos.elbow,vel.shoulder\n{rows}\n")
    (found,) = workflow.gather([tmp_path / "its.csv"], model)
    assert found.velocity is None
    whole = workflow.load_model(tmp_path / "arm.xml", ignore=["drive"])
    assert "column 'vel.shoulder' is missing" in refusal(lambda: workflow.gather([tmp_path / "it.csv"], whole))


def test_a_shaken_robot_needs_no_drive_of_its_own(tmp_path: Path) -> None:
    passive = ARM.replace('<motor name="motor" joint="elbow"/>', "")
    (tmp_path / "arm.xml").write_text(passive)
    rows = "\n".join(f"{t},{q},{0.2 * np.cos(8 * t)}" for t, q in zip(TIMES, shaken(TIMES)[0], strict=True))
    (tmp_path / "it.csv").write_text(f"# interpolation = linear\ntime,pos.shoulder,pos.elbow\n{rows}\n")
    model = workflow.load_model(tmp_path / "arm.xml", prescribe=["shoulder"])
    assert model.robot.actuator_names == ()
    (own,) = workflow.gather([tmp_path / "it.csv"], model)
    assert own.command.shape == (len(TIMES), 0)
    score = workflow.score([own], model, engine="mujoco")
    assert 0 < score.rmse[0] < 1
    shown = excitation_of(model, cut(model, [own]))
    assert shown["elbow"].force > 0 and shown["elbow"].speed > 0
    check(model, [own])
    whole = tmp_path / "whole.xml"
    whole.write_text(ARM)
    driven = workflow.load_model(whole, prescribe=["shoulder"])
    assert "no column 'cmd.<actuator>'" in refusal(lambda: workflow.gather([tmp_path / "it.csv"], driven))


FLOOR = '<worldbody><geom name="floor" type="plane" size="1 1 0.1" pos="0 0 -0.2"/>'
BONE = '<geom name="bone" type="capsule" fromto="0 0 0 0 0 -0.28" size="0.02" mass="0"/><body name="lower"'
TOUCHING = ARM.replace("<worldbody>", FLOOR).replace('<body name="lower"', BONE)
"""Its upper link goes through the floor wherever the shoulder is."""
OFF = ARM.replace('timestep="0.001"/>', 'timestep="0.001" actuatorgroupdisable="0"/>')


def held(text: str) -> str:
    return ARM.replace("</worldbody>", f"</worldbody>{text}")


ROPE = """<tendon><fixed name="rope" limited="true" range="-0.1 0.1"><joint joint="shoulder" coef="1"/></fixed></tendon>
  <equality><tendon tendon1="rope"/></equality>"""


@pytest.mark.parametrize(
    ("xml", "left"),
    [
        (held('<equality><joint joint1="shoulder"/></equality>'), 0),
        (held('<equality><joint joint1="elbow" joint2="shoulder" active="false"/></equality>'), 1),
        (held('<equality><weld body1="upper"/><connect body1="upper" anchor="0 0 -0.3"/></equality>'), 0),
        (held('<equality><connect body1="lower" body2="upper" anchor="0 0 0" active="false"/></equality>'), 1),
        (held(ROPE), 0),
        (TOUCHING, 0),
        (TOUCHING.replace("<actuator>", '<contact><pair geom1="floor" geom2="bone"/></contact><actuator>'), 0),
        (OFF.replace('<motor name="motor"', '<motor name="motor" group="1"'), 0),
    ],
)
def test_what_holds_a_prescribed_joint_alone_does_not_fight_its_motion(xml: str, left: int) -> None:
    robot = MjcfRobot("arm", xml, source="arm.xml", edits=Edits(prescribe=("shoulder",)))
    assert robot.plan.base.neq == left
    found, wanted = (
        engine_for(Model(own), "mujoco").simulate([Model(own)], [trial()], [np.array([START])], 1)[0].position
        for own in (robot, ROBOT)
    )
    np.testing.assert_array_equal(found, wanted)


def test_what_a_prescribed_joint_touches_is_no_reason_for_another_engine() -> None:
    robot = MjcfRobot("arm", TOUCHING, source="arm.xml", edits=Edits(prescribe=("shoulder",)))
    poses = np.zeros((9, 2))
    assert "compiled equations of motion hold" in engine_for(Model(robot), positions=[poses]).reason
    alone = MjcfRobot("arm", TOUCHING)
    assert "'floor' touches 'bone'" in engine_for(Model(alone), positions=[poses]).reason
    assert mujoco.MjModel.from_xml_string(corrected_xml(Model(robot))[0]).nexclude == 0


def test_a_tendon_over_a_prescribed_joint_alone_is_written_as_it_was() -> None:
    text = """<tendon><fixed name="rope" limited="true" range="-2 2" frictionloss="0.2"><joint joint="shoulder" coef="1"/>
      </fixed><fixed name="belt" limited="true" range="-3 3"><joint joint="elbow" coef="1"/></fixed></tendon>"""
    robot = MjcfRobot("arm", held(text), source="arm.xml", edits=Edits(prescribe=("shoulder",)))
    assert robot.plan.base.tendon_limited.tolist() == [0, 1]
    whole = mujoco.MjModel.from_xml_string(corrected_xml(Model(robot))[0])
    assert whole.tendon_limited.tolist() == [1, 1] and whole.tendon_frictionloss.tolist() == [0.2, 0.0]
    assert whole.tendon_range.tolist() == [[-2, 2], [-3, 3]]


def test_a_prescribed_joint_in_degrees_is_told(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    model, own = workflow.load_model(tmp_path / "arm.xml", prescribe=["shoulder"]), recording(1e-3)

    def as_recorded(factor: float, shift: float) -> Recording:
        shown = np.array(own.position)
        shown[:, 0] = factor * (shown[:, 0] + shift)
        return replace(own, position=shown)

    wrong = as_recorded(np.degrees(1.0), -1.0)
    told = refusal(lambda: check(model, workflow.gather([wrong], model)))
    assert "shoulder goes from" in told and "the model's range is -3 to 3 rad; are the recorded angles in deg" in told
    write(tmp_path / "far.csv", as_recorded(500.0, 0.0))
    with pytest.warns(RecordingWarning, match=r"pos.shoulder goes to .* are these degrees"):
        workflow.gather([tmp_path / "far.csv"], model)


def test_gravity_turns_where_a_joint_that_moves_by_itself_feels_it() -> None:
    xml = ARM.replace('name="shoulder" axis="0 1 0"', 'name="shoulder" axis="1 0 0"')
    robot = MjcfRobot("arm", xml, edits=Edits(prescribe=("shoulder",)))
    np.testing.assert_allclose(np.abs(robot.plan.tilt_axis), [0, 1, 0], atol=1e-12)
