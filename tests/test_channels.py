"""Recorded velocities and positions of sites as measurements beside joint positions."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mjcf_models import CRANE, refusal
from pendulum_runs import MOTOR, PENDULUM
from scipy.integrate import solve_ivp

from equimus_ctrl import recordings, workflow
from equimus_ctrl.diagnosis.linear_response import linearise
from equimus_ctrl.diagnosis.observed import observed
from equimus_ctrl.effects import SensorDelay, SensorOffset, SensorScale, ViscousFriction
from equimus_ctrl.engines.base import EngineName
from equimus_ctrl.engines.choice import engine_for
from equimus_ctrl.engines.mjcf_motion import simulated_response
from equimus_ctrl.engines.mjcf_realised import realise
from equimus_ctrl.engines.mjcf_sites import site_positions
from equimus_ctrl.engines.motion import motion
from equimus_ctrl.identification.channels import Channels, channels_of, unused, with_channels
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.identification.simulators import Simulator, simulator_for
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings.checks import RecordingWarning
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

ARM = MjcfRobot("arm", PENDULUM.format(drive=MOTOR))
MASS, LENGTH, ARMATURE, GRAVITY, TIP = 0.6, 0.4, 0.004, 9.81, 0.5
TIME = np.arange(0.0, 4.0, 0.01)


def torque(k: int, time: Array) -> Array:
    return np.asarray((0.6 + 0.2 * k) * np.sin(2 * np.pi * (0.4 + 0.2 * k) * time) + 0.3 * np.sin(13.0 * time + k))


def swung(k: int, mass: float = MASS, damping: float = 0.0, start: Sequence[float] = (0.3, 0.0)) -> Array:
    """(n, 2) angle and rate of the pendulum by an adaptive method, the torque going along lines."""
    about = ARMATURE + 0.002 + mass * LENGTH**2
    given = torque(k, TIME)

    def rates(t: float, x: Array) -> list[float]:
        push = float(np.interp(t, TIME, given))
        return [x[1], (push - mass * GRAVITY * LENGTH * math.sin(x[0]) - damping * x[1]) / about]

    found = solve_ivp(
        rates, (0.0, TIME[-1]), start, t_eval=TIME, method="DOP853", rtol=1e-10, atol=1e-10, max_step=5e-3
    )
    return np.asarray(found.y.T)


def trials(angle: float, rate: float, site: float = 0.0, *, damping: float = 0.0, count: int = 3) -> list[Recording]:
    """Recordings with noise of these standard deviations [rad, rad/s, m]."""
    rng, made = np.random.default_rng(4), []
    for k in range(count):
        q, v = swung(k, damping=damping).T
        noisy = [x[:, None] + rng.normal(0, s, (len(x), 1)) for x, s in ((q, angle), (v, rate))]
        tip = {"tip.x": TIP * np.sin(q), "tip.z": -TIP * np.cos(q)}
        sites = {name: x + rng.normal(0, site, len(x)) for name, x in tip.items()} if site else {}
        notes = {"interpolation": "linear"}
        made.append(
            Recording(
                f"t{k}", TIME, torque(k, TIME)[:, None], noisy[0], ("drive",), ("hinge",), noisy[1], notes=notes,
                sites=sites,
            )
        )  # fmt: skip
    return made


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_true_rates_and_positions_are_those_of_an_independent_integration(engine: EngineName) -> None:
    """Whatever the joint's own sensor shows."""
    effects = (SensorOffset("hinge", 0.3), SensorScale("hinge", 1.2), SensorDelay("hinge", 0.05))
    (segment,) = cut(Model(ARM, effects), with_channels(trials(1e-9, 1e-9), ["vel.hinge"])[:1])
    true, dt = swung(0), {"reduced": 1e-3, "mujoco": 2e-5}[engine]
    model = Model(ARM, effects)
    chosen = engine_for(model, engine, dt)
    (found,) = chosen.simulate([model], [segment.trial], [true[:1]], 1)
    assert found.motion is not None
    assert np.abs(found.motion[0] - true).max() < {"reduced": 2e-5, "mujoco": 2e-3}[engine]
    assert np.abs(found.position[0] - true[:, :1]).max() > 0.1


def test_sites_are_where_the_joints_put_them() -> None:
    q = np.linspace(-2, 2, 7)[None, :, None]
    where = site_positions(ARM, q, ["tip"])
    expected = np.stack([TIP * np.sin(q[0, :, 0]), np.zeros(7), -TIP * np.cos(q[0, :, 0])], axis=-1)
    np.testing.assert_allclose(where[0, :, 0], expected, atol=1e-12)
    lost = site_positions(ARM, np.full_like(q, np.nan), ["tip"])
    assert np.isnan(lost).all()


def test_sites_of_a_slide_on_a_hinge_follow_both() -> None:
    """The crane's tip: a rod that slides along a turning arm."""
    q = np.array([[[0.4, 0.1]]])
    (((tip, floor),),) = site_positions(CRANE, q, ["tip", "floor"])
    inside = np.array([0.03, 0.01, -0.5 - 0.1 - 0.2])
    c, s = math.cos(0.4), math.sin(0.4)
    np.testing.assert_allclose(
        tip, [c * inside[0] + s * inside[2], 0.01, 1 - s * inside[0] + c * inside[2]], atol=1e-12
    )
    np.testing.assert_allclose(floor, 0.0)


def test_no_parameter_moves_a_site_along_its_link() -> None:
    """Else sites would have to be found for each model by itself."""
    q = np.array([[[0.4, 0.1]]])
    expected = site_positions(CRANE, q, ["tip", "floor"])[0, 0]
    for name, value in CRANE.parameters().items():
        own = realise(Model(CRANE).with_parameters({name: value + 0.01})).mujoco
        data = mujoco.MjData(own)
        for joint, place in zip(CRANE.joint_names, q[0, 0], strict=True):
            data.joint(joint).qpos[0] = place
        mujoco.mj_kinematics(own, data)
        found = [data.site(site).xpos for site in ("tip", "floor")]
        np.testing.assert_allclose(found, expected, atol=1e-12, err_msg=name)


def fisher(channels: Sequence[int], noise: Sequence[float]) -> float:
    """Standard deviation of the mass by the Cramér–Rao bound, starts free: differences of independent integrations.

    Args:
        channels: 0 for the angle, 1 for the rate, 2 and 3 for x and z of the tip.
        noise: of each.
    """

    def outputs(k: int, mass: float = MASS, start: tuple[float, float] = (0.3, 0.0)) -> Array:
        q, v = swung(k, mass, start=start).T
        return np.column_stack([q, v, TIP * np.sin(q), -TIP * np.cos(q)])[:, list(channels)] / noise

    h, information = 1e-5, 0.0
    for k in range(3):
        mass = (outputs(k, MASS + h) - outputs(k, MASS - h)).ravel() / (2 * h)
        starts = [
            (outputs(k, start=(0.3 + a, b)) - outputs(k, start=(0.3 - a, -b))).ravel() for a, b in ((h, 0), (0, h))
        ]
        basis = np.linalg.qr(np.column_stack(starts))[0]
        beyond = mass - basis @ (basis.T @ mass)
        information += float(beyond @ beyond)
    return 1 / math.sqrt(information)


ALSO = [
    ([], [0], [5e-3]),
    (["vel.*"], [0, 1], [5e-3, 5e-3]),
    (["site.*"], [0, 2, 3], [5e-3, 4e-4, 4e-4]),
    (["vel.hinge", "site.tip.x"], [0, 1, 2], [5e-3, 5e-3, 4e-4]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("also", "channels", "noise"), ALSO, ids=[str(own[0]) for own in ALSO])
def test_intervals_are_as_narrow_as_information_theory_says(
    also: list[str], channels: list[int], noise: list[float]
) -> None:
    """With each channel's own noise, estimated along: 1.96 standard deviations by the Cramér–Rao bound."""
    recorded = trials(5e-3, 5e-3, 4e-4)
    model = Model(ARM).with_parameters({"arm.mass": 0.65})
    with pytest.warns(RecordingWarning, match="not compared"):
        fit = workflow.identify_recordings(recorded, model, free=["arm.mass"], also=also, folds=0, shoot=math.inf).fit
    assert fit.uncertainty.half_width[0] == pytest.approx(1.96 * fisher(channels, noise), rel=0.15)
    assert abs(fit.theta[0] - MASS) < 1.6 * fit.uncertainty.half_width[0]
    assert len(fit.rmse) == 1 and fit.residuals[0].shape[1] == len(channels)
    np.testing.assert_allclose(np.sqrt((np.concatenate(fit.residuals) ** 2).mean(axis=0)), noise, rtol=0.1)


def test_good_rates_make_up_for_poor_angles_and_without_them_the_interval_is_wide() -> None:
    recorded = trials(0.1, 2e-3)
    model = Model(ARM, (ViscousFriction("hinge", 0.02),))
    free = ["hinge.viscous_friction.damping"]
    with pytest.warns(RecordingWarning, match="vel.hinge"):
        poor = workflow.identify_recordings(recorded, model, free=free, folds=0).fit.uncertainty.half_width[0]
    found = workflow.identify_recordings(recorded, model, free=free, also=["vel.*"], folds=2)
    assert found.fit.uncertainty.half_width[0] < 0.1 * poor
    assert abs(found.fit.theta[0]) < 1.6 * found.fit.uncertainty.half_width[0]
    assert found.check is not None and len(found.check.rmse) == 1
    assert [channel["name"] for channel in found.to_dict()["channels"]] == ["vel.hinge"]
    assert found.to_dict()["channels"][0]["rmse"] == pytest.approx(2e-3, rel=0.1)


def test_changes_of_channels_are_their_differences() -> None:
    channels = Channels((1, 0), (("tip", 2), ("floor", 0), ("tip", 0)))
    rng = np.random.default_rng(0)
    along, change, h = rng.normal(0, 0.3, (5, 4)), rng.normal(0, 1, (5, 4, 2)), 1e-5
    found = channels.changes(CRANE, along, change, np.empty((5, 0, 2)))
    for k in range(2):
        moved = np.stack([along + h * change[:, :, k], along - h * change[:, :, k]])
        ahead, behind = channels.of_motion(CRANE, moved)
        np.testing.assert_allclose(found[:, :, k], (ahead - behind) / (2 * h), atol=1e-5)


def test_both_engines_agree_on_what_small_forces_change_of_all_that_is_compared() -> None:
    """The equations linearised along the motion, and MuJoCo's simulations of each force, with a sensor's own errors."""
    model = Model(ARM, (ViscousFriction("hinge", 0.1), SensorScale("hinge", 1.1), SensorDelay("hinge", 0.03)))
    segments = cut(model, with_channels(trials(1e-9, 1e-9, 1e-9)[:1], ["vel.hinge", "site.tip.x"]), shoot=2.0)[:1]
    start, trial = np.array([0.3, 0.0]), segments[0].trial
    m = len(trial.sample_times)
    pushes = [np.random.default_rng(1).normal(0, 1, (m - 1, 1, 2)).cumsum(axis=0) / 10]
    exact = observed(linearise(model, [motion(model, trial, start, 1e-3)]), ARM, segments).response(pushes)
    stepped = observed(simulated_response(model, [trial], [start], np.ones(1)), ARM, segments).response(pushes)
    assert exact[0].shape == (m, 3, 2)
    for c in range(3):
        size = np.abs(exact[0][:, c]).max()
        assert size > 1e-3 and np.abs(exact[0][:, c] - stepped[0][:, c]).max() < 0.04 * size


def test_channels_beside_zeros_and_shooting_intervals_are_those_of_their_rows() -> None:
    notes = {"also": "vel.hinge site.tip.z", "zero.hinge": "free"}
    recorded = [replace(t, notes={**t.notes, **notes}) for t in trials(1e-4, 1e-4, 1e-4)[:1]]
    model, whole = Model(ARM), recorded[0]
    segments = cut(model, recorded, shoot=1.0)
    assert [len(s.outputs) for s in segments] == [len(s.measured) for s in segments]
    np.testing.assert_array_equal(np.concatenate([s.outputs[:, 1] for s in segments]), whole.velocity[:, 0])
    np.testing.assert_array_equal(np.concatenate([s.outputs[:, 2] for s in segments]), whole.sites["tip.z"])
    np.testing.assert_array_equal(segments[1].first(12).outputs, segments[1].outputs[:12])
    found = Simulator(simulator_for(model).engine, 1)([model], segments, [s.start[None] for s in segments])
    assert all(p.position.shape == (1, len(s.measured), 3) for p, s in zip(found, segments, strict=True))
    assert np.abs(np.concatenate([p.position[0] - s.outputs for p, s in zip(found, segments, strict=True)])).max() < 0.1


@pytest.mark.slow
def test_a_diagnosis_by_rates_names_the_friction_that_poor_angles_hide() -> None:
    recorded = trials(0.08, 4e-3, damping=0.01, count=4)
    found = workflow.diagnose(recorded, Model(ARM), free=["arm.mass"], also=["vel.*"], most=1, threads=1)
    assert [(f.named.effect, f.named.locations) for f in found.findings] == [("viscous_friction", ("hinge",))]
    estimate = found.findings[0].parameters["damping"]
    assert estimate.low < 0.01 < estimate.high and estimate.high - estimate.low < 0.004
    (channel,) = found.channels
    assert (channel.name, channel.unit) == ("vel.hinge", "rad/s") and channel.noise == pytest.approx(4e-3, rel=0.1)
    assert found.to_dict()["channels"][0]["name"] == "vel.hinge"
    assert found.residuals["refitted"].train[0].shape[1] == 1


def test_files_keep_sites_and_refuse_what_is_none(tmp_path: Path) -> None:
    (trial,) = trials(1e-3, 1e-3, 1e-3, count=1)
    limits = recordings.Limits.of_mjcf(["hinge"], ["drive"])
    file = tmp_path / "t0.csv"
    recordings.write(file, trial)
    read = recordings.read(file, limits=limits)
    assert list(read.sites) == ["tip.x", "tip.z"]
    np.testing.assert_array_equal(read.sites["tip.z"], trial.sites["tip.z"])
    file.write_text(file.read_text().replace("site.tip.z", "site.tip.w"))
    assert "there is no column 'site.tip.w'" in refusal(lambda: recordings.read(file, limits=limits))
    told = refusal(lambda: recordings.write(file, replace(trial, sites={"tip": trial.time})))
    assert told.endswith("site 'tip' cannot be written; expected a site and an axis, such as tip.x")


def test_what_cannot_be_compared_is_told() -> None:
    (trial,) = trials(1e-3, 1e-3, 1e-3, count=1)
    assert unused([trial]) == ["vel.hinge", "site.tip.x", "site.tip.z"]
    assert unused(with_channels([trial], ["site.*"])) == ["vel.hinge"]
    assert unused([replace(trial, velocity=None, sites={}, measured=trial.command)]) == ["meas.drive"]
    told = refusal(lambda: with_channels([trial], ["vel.elbow"]))
    assert told.startswith("t0: to compare beside positions: there is no column 'vel.elbow'")
    wrong = replace(trial, sites={"top.x": trial.time})
    told = refusal(lambda: channels_of(Model(ARM), with_channels([wrong], ["site.*"])[0]))
    assert told.startswith("t0: column site.top: there is no site 'top'; did you mean 'tip'?")
    other = replace(with_channels([trial], ["site.*"])[0], name="t1")
    with pytest.warns(RecordingWarning):
        told = refusal(lambda: workflow.identify_recordings([*with_channels([trial], ["vel.*"]), other], Model(ARM)))
    assert told.startswith("t1 and t0 do not compare the same columns")
