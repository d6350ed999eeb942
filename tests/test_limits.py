"""Limits of experiments: what a file says, by how much motions leave them, and what shrinking promises."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mjcf_models import RIG, pendulum, refusal

from equimus_ctrl import presets
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.encoding import encode
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.experiments.families import FAMILIES
from equimus_ctrl.experiments.limits import GIVE, MARGIN, Limits, Motions, shrunk
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

LEG = nominal_leg()
ARM = MjcfRobot("arm", pendulum('damping="0.4" range="-0.8 0.8" limited="true"'))
REST = np.array([10e3, 40e3])
"""Pressures under which the leg's knee leans on its stop [Pa]."""
DOC = Path(__file__).parents[1] / "docs" / "formats.md"


def still(limits: Limits, positions: Array, rates: Array | None = None, rest: Array | None = None) -> Motions:
    """One motion (n, nj) as one of one model."""
    q = np.asarray(positions, dtype=float)[None]
    return Motions(np.arange(q.shape[1]) / 100, q, np.zeros_like(q) if rates is None else np.asarray(rates)[None],
                   q[:, 0] if rest is None else np.asarray(rest)[None])  # fmt: skip


def test_a_robots_own_limits_are_the_default() -> None:
    own = Limits.of(LEG)
    low, high = LEG.joint_range
    assert np.array_equal(own.joint_low, low) and np.array_equal(own.joint_high, high)
    np.testing.assert_allclose(own.joint_margin, MARGIN * (high - low))
    assert own.command_high.tolist() == [50e3, 50e3] and np.isinf(own.command_rate).all()
    assert Limits.of(RIG).joint_margin.tolist()[0] == 0.0 or np.isfinite(RIG.joint_range[1][0])
    assert "drive" not in refusal(lambda: Limits.of(ARM).bounds(np.zeros(1)))
    assert "expected motor.low and motor.high in --limits" in refusal(lambda: Limits.of(ARM).bounds(np.zeros(1)))
    goal = '<position name="goal" joint="pivot" kp="60" kv="1"/>'
    servo = Limits.of(MjcfRobot("servo", pendulum('range="-0.8 0.7" limited="true"', drive=goal)))
    assert servo.command_low.tolist() == [-0.8] and servo.command_high.tolist() == [0.7]
    assert np.isinf(Limits.of(MjcfRobot("servo", pendulum(drive=goal))).command_high).all()
    given = Limits.read(ARM, options={"motor.low": "-1", "motor.high": "2", "motor.rate": "5"})
    bounds = given.bounds(np.zeros(1))
    assert (bounds.low[0], bounds.high[0], bounds.rate[0], bounds.before) == (-1.0, 2.0, 5.0, 0.5)


def test_a_hinge_without_a_range_goes_one_turn_unless_a_user_says_more() -> None:
    free = MjcfRobot("free", pendulum())
    assert np.isinf(free.joint_range).all()
    own = Limits.of(free)
    assert own.joint_low.tolist() == [-2 * np.pi] and own.joint_high.tolist() == [2 * np.pi]
    turned = np.linspace(0, 7, 20)[:, None]
    assert own.excess(still(own, turned)).left
    assert not Limits.read(free, options={"pivot.high": "10"}).excess(still(own, turned)).left


def test_the_file_of_the_documentation_is_read_and_options_come_before_it() -> None:
    text = DOC.read_text(encoding="utf-8").split("equimus-ctrl/limits/1")[1].split("```")[0]
    data = presets.tomllib.loads('format = "equimus-ctrl/limits/1' + text)
    own = Limits.read(LEG, data, {"maa.high": "30e3", "joints.knee.rate": "4", "before": "0.8"}, "limits.toml")
    assert own.command_high.tolist() == [30e3, 50e3] and own.before == 0.8 and own.duration == data["duration"]
    assert own.joint_rate.tolist() == [np.inf, 4.0] and own.command_rate[0] == data["actuators"]["maa"]["rate"]
    short = Limits.read(LEG, {"duration": 0.6, "before": 0.1, "after": 0.1})
    assert short.duration == 0.6


@pytest.mark.parametrize(
    ("data", "options", "said"),
    [
        ({"format": "other"}, {}, "own.toml: format is 'other', expected 'equimus-ctrl/limits/1'"),
        ({"durration": 3}, {}, "own.toml: there is no key 'durration'; did you mean 'duration'?"),
        ({"actuators": {"mma": {"low": 0}}}, {}, "own.toml: there is no actuator 'mma'; did you mean 'maa'?"),
        ({"joints": {"hip": {"speed": 1}}}, {}, "own.toml: joints.hip: there is no key 'speed'"),
        ({"joints": {"hip": {"low": "1"}}}, {}, "own.toml: joints.hip.low is '1', expected a number"),
        ({"joints": {"hip": {"low": 0.1}}}, {}, "joints.hip.low is 0.1, outside the robot's own range, 0.523599 to"),
        ({"actuators": {"maa": {"high": 6e4}}}, {}, "actuators.maa.high is 60000, outside the robot's own range"),
        ({"actuators": {"maa": {"low": 3e4, "high": 2e4}}}, {}, "the range of commands of maa is 30000 to 20000"),
        ({"joints": {"hip": {"margin": 2.0}}}, {}, "with a margin of 2, expected some room between"),
        ({"joints": {"hip": {"margin": -1.0}}}, {}, "own.toml: the margin of hip is -1, expected at least 0"),
        ({"joints": {"hip": {"rate": 0.0}}}, {}, "own.toml: the rate of hip is limited to 0, expected more than 0"),
        ({"duration": 0.9}, {}, "own.toml: duration is 0.9 s, expected more than both rests, 1 s"),
        ({"before": 7.0}, {}, "own.toml: before is 7 s, expected 0 to less than the duration, 6 s"),
        ({"duration": float("nan")}, {}, "own.toml: duration is nan, expected a number"),
        ({}, {"maa.high": "much"}, "limits: maa.high is 'much', expected a number"),
        ({}, {"mma.high": "1"}, "there is no limit 'mma.high'; did you mean 'maa.high'?"),
    ],
)
def test_what_cannot_be_is_one_sentence(data: dict[str, object], options: dict[str, str], said: str) -> None:
    assert said in refusal(lambda: Limits.read(LEG, data, options, "own.toml"))


def test_how_far_each_limit_is_left_which_and_when() -> None:
    limits = Limits.read(LEG, options={"knee.rate": "2", "hip.margin": "0.1", "knee.margin": "0"})
    q = np.tile([1.2, 0.5], (50, 1))
    v = np.zeros_like(q)
    inside = limits.excess(still(limits, q, v))
    assert not inside.left and inside.worst < 0 and inside.by.shape == (6,)
    q[20, 0], v[30, 1] = 0.523599 + 0.06, -2.5
    found = limits.excess(still(limits, q, v))
    span = LEG.joint_range[1] - LEG.joint_range[0]
    assert found.by[0] == pytest.approx(0.04 / span[0], abs=1e-6) and found.by[5] == pytest.approx(0.25)
    assert found.left and found.when[0] == 0.2 and found.when[5] == 0.3
    assert str(found) == "knee too fast: 143.2°/s at 0.3 s with model 0, where 114.6°/s may be"
    q[40, 1] = 2.5
    assert str(limits.excess(still(limits, q))) == (
        "knee above its range: 143.2° at 0.4 s with model 0, where 114.6° may be"
    )
    q[41, 1] = np.nan
    assert str(limits.excess(still(limits, q))) == "the simulation of model 0 is lost at 0.41 s"


def test_a_rest_at_a_stop_is_no_violation_but_going_farther_is() -> None:
    """The leg's knee rests beyond its lower end under these pressures: its stop gives way."""
    limits = Limits.of(LEG)
    rest = rest_pose(nominal_model(), REST)
    assert rest[1] < limits.joint_low[1] + limits.joint_margin[1]
    q = np.tile(rest, (50, 1))
    assert not limits.excess(still(limits, q)).left
    q[10, 1] += 0.3
    assert not limits.excess(still(limits, q)).left
    q[20, 1] = rest[1] - 2 * GIVE * 2.035
    assert limits.excess(still(limits, q)).left


def test_the_leg_may_be_moved_from_its_stop_and_back() -> None:
    """What presses on the stop while the hip moves is no violation; what goes through it is."""
    limits, model = Limits.of(LEG), nominal_model()
    times = np.arange(0, 6, 0.01)

    def motions(amplitude: float, z: Array) -> Motions:
        u = FAMILIES["steps"].commands(z, times, limits.bounds(REST), amplitude)
        rest = rest_pose(model, u[0])
        trial = Trial("steps", times, u, u[0], 0.0, rest, times, inner=True)
        return Motions.of(simulate([model], [trial], check=False), times)

    rng = np.random.default_rng(0)
    for z in rng.random((4, FAMILIES["steps"].dimension(2))):
        assert not limits.excess(motions(1.0, z)).left
    tight = Limits.read(LEG, options={"hip.high": "1.6"})
    z = np.r_[np.full(6, 0.5), np.full(4, 0.9), np.full(4, 0.1)]
    amplitude, found = shrunk(lambda a: motions(a, z), tight)
    assert 0.1 < amplitude < 1.0 and not found.left and found.worst > -0.05
    assert tight.excess(motions(amplitude + 0.02, z)).left


def test_what_a_lost_simulation_says_does_not_count() -> None:
    motion, times = np.zeros((2, 5, 2)), np.arange(5.0)
    motion[1, 3:] = 1e6
    found = Motions.of([Predicted(motion[:, :, :1], np.array([5, 3]), motion)] * 2, times)
    assert found.position.shape == (4, 5, 1) and found.rest.tolist() == [[0.0]] * 4
    excess = Limits.of(ARM).excess(found)
    assert excess.left and str(excess) == "the simulation of model 1 is lost at 3 s"


def test_none_is_offered_that_was_not_looked_at() -> None:
    """Where smaller designs may move more, what is given is still within the limits."""
    limits = Limits.read(ARM, options={"pivot.margin": "0"})

    def motions(amplitude: float) -> Motions:
        far = 0.9 if 0.2 < amplitude < 0.4 or amplitude > 0.7 else 0.5
        return still(limits, np.array([[0.0], [far]]))

    amplitude, found = shrunk(motions, limits)
    assert not limits.excess(motions(amplitude)).left and not found.left
    assert shrunk(lambda a: still(limits, np.array([[0.0], [0.1 * a]])), limits)[0] == 1.0
    assert "a robot at rest leaves the limits: pivot too fast" in refusal(
        lambda: shrunk(lambda a: still(limits, np.zeros((2, 1)), np.ones((2, 1))), Limits.read(
            ARM, options={"pivot.rate": "0.5"})))  # fmt: skip


DRAWS = 9


def test_a_true_robot_leaves_the_limits_no_more_often_than_one_in_draws_and_one() -> None:
    """Designs shrunk to the very edge: then the promise is sharp, 1/(n + 1), whatever the distribution."""
    limits, rng = Limits.read(ARM, options={"pivot.margin": "0"}), np.random.default_rng(0)
    seeds, left = 600, 0
    for _ in range(seeds):
        gains = np.exp(rng.normal(0.0, 0.5, DRAWS + 1)) + rng.exponential(0.3)

        def motions(amplitude: float, own: Array = gains[:-1]) -> Motions:
            q = np.stack([np.zeros(len(own)), 3.0 * amplitude * own], axis=1)[:, :, None]
            return Motions(np.array([0.0, 1.0]), q, np.zeros_like(q), q[:, 0])

        amplitude, _ = shrunk(motions, limits, near=3e-3)
        left += limits.excess(motions(amplitude, gains[-1:])).left
    scatter = (seeds * 0.1 * 0.9) ** 0.5
    assert left <= seeds / (DRAWS + 1) + 3 * scatter
    assert left >= 0.7 * seeds / (DRAWS + 1)  # it can fail: the promise is sharp here


def test_so_does_a_pendulum_drawn_from_the_same_uncertainty() -> None:
    limits, rng = Limits.read(ARM, options={"motor.low": "-3", "motor.high": "3", "duration": "2"}), np.random.default_rng(1)  # fmt: skip
    draws, seeds, levels = 4, 60, 12
    times = np.arange(0, 2.0, 0.02)
    z = np.array([0.3, 0.0, 0.9, 0.5, 1.0, 0.1])
    values = Model(ARM).parameters()
    names = ("arm.mass", "pivot.damping", "pivot.armature")
    # Without its ends: what would go beyond them shows.
    free = MjcfRobot("free", pendulum('damping="0.4"'))
    models = [
        Model(free.with_parameters({name: values[name] * np.exp(rng.normal(0, 0.3)) for name in names}))
        for _ in range(seeds * (draws + 1))
    ]
    coded = encode(models)
    found = []
    for k in range(levels + 1):
        u = FAMILIES["multisine"].commands(z, times, limits.bounds(np.zeros(1)), k / levels)
        trial = Trial("waves", times, u, u[0], 0.0, np.zeros(1), times, inner=True)
        (own,) = simulate(coded, [trial], dt=4e-3, check=False)
        assert own.motion is not None
        found.append(own.motion.reshape(seeds, draws + 1, len(times), 2))
    left = shrunken = 0
    for seed in range(seeds):

        def motions(amplitude: float, own: slice = slice(draws), seed: int = seed) -> Motions:
            motion = found[int(amplitude * levels)][seed, own]
            return Motions(times, motion[..., :1], motion[..., 1:], motion[:, 0, :1])

        amplitude, _ = shrunk(motions, limits)
        shrunken += 0 < amplitude < 1
        left += limits.excess(motions(amplitude, slice(draws, None))).left
    assert shrunken > seeds / 2
    assert 0 < left <= seeds / (draws + 1) + 3 * (seeds * 0.2 * 0.8) ** 0.5
