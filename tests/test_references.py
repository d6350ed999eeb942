"""References: against numpy's interpolation, closed forms, and the foot's position worked out on paper."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import equimus_ctrl as eq


@pytest.fixture(scope="module")
def kinematics() -> eq.Kinematics:
    return eq.Kinematics(eq.nominal_leg())


def foot(hip: float, knee: float) -> np.ndarray:
    """Thigh and calf of 0.25 m each; x to the right, y down."""
    return 0.25 * np.array([math.cos(hip) + math.cos(hip + knee), math.sin(hip) + math.sin(hip + knee)])


CORNERS = np.array([[1.35, 0.55], [1.75, 0.9], [1.55, 0.25]])


@pytest.fixture(scope="module")
def path(kinematics: eq.Kinematics) -> eq.SampledReference:
    return eq.foot_path(kinematics, CORNERS, 1.5, 7.0)


def test_hold_is_constant_and_read_only() -> None:
    given_pose = np.array([1.0, 0.2])
    hold = eq.HoldReference(given_pose)
    given_pose[0] = 9.0
    for time in (-1.0, 0.0, 1e9):
        assert hold.position(time).tolist() == [1.0, 0.2]
    with pytest.raises(ValueError):
        hold.position(0.0)[0] = 3.0
    with pytest.raises(
        eq.ConfigError, match=r"reference pose: expected 1 dimension\(s\), got an array of shape \(1, 2\)"
    ):
        eq.HoldReference([[1.0, 2.0]])


@given(
    # Multiples of a millisecond: between subnormal times numpy's own interpolation overflows.
    st.lists(st.integers(-50_000, 50_000).map(lambda n: n / 1000), min_size=1, max_size=12, unique=True).map(sorted),
    st.integers(0, 2**31),
    st.lists(st.floats(-60, 60), min_size=1, max_size=8),
)
def test_samples_are_joined_by_straight_lines(times: list[float], seed: int, asked: list[float]) -> None:
    values = np.random.default_rng(seed).normal(size=(len(times), 2))
    reference = eq.SampledReference(times, values)
    for time in [*asked, *times]:
        expected = [np.interp(time, times, column) for column in values.T]
        np.testing.assert_allclose(reference.position(time), expected, atol=1e-9)


@pytest.mark.parametrize(
    ("times", "values", "sentence"),
    [
        ([0.0, 1.0], [[1.0, 2.0]], "2 times for 1 values"),
        ([], np.empty((0, 2)), "0 times for 0 values"),
        ([0.0, 0.0], [[1.0], [2.0]], "times must ascend"),
        ([1.0, 0.0], [[1.0], [2.0]], "times must ascend"),
        ([0.0, 1.0], [1.0, 2.0], "reference values: expected 2 dimension"),
        ([[0.0, 1.0]], [[1.0], [2.0]], "reference times: expected 1 dimension"),
    ],
)
def test_samples_must_fit(times: object, values: object, sentence: str) -> None:
    with pytest.raises(eq.ConfigError, match=sentence):
        eq.SampledReference(times, values)


@pytest.mark.parametrize(("times", "values"), [([0.0, math.nan], [[1.0], [2.0]]), ([0.0, 1.0], [[1.0], [math.nan]])])
def test_samples_must_be_numbers(times: list[float], values: list[list[float]]) -> None:
    with pytest.raises(eq.ConfigError):
        eq.SampledReference(times, values)


def test_a_function_is_asked_at_every_instant() -> None:
    reference = eq.FunctionReference(lambda time: (time, 2 * time))
    assert reference.position(1.5).tolist() == [1.5, 3.0]
    assert reference.position(1.5).dtype == np.float64


def test_minimum_jerk_is_the_quintic() -> None:
    s = np.linspace(0, 1, 201)
    np.testing.assert_allclose(eq.minimum_jerk(s), 10 * s**3 - 15 * s**4 + 6 * s**5, atol=1e-15)
    assert eq.minimum_jerk([-2.0, 3.0]).tolist() == [0.0, 1.0]
    np.testing.assert_allclose(eq.minimum_jerk(s) + eq.minimum_jerk(1 - s), 1.0, atol=1e-15)
    speed = np.gradient(eq.minimum_jerk(s), s)
    assert speed.max() == pytest.approx(15 / 8, rel=1e-3) and abs(speed[[0, -1]]).max() < 1e-3


@given(st.floats(0.6, 2.5), st.floats(0.05, 1.9))
def test_the_foot_is_put_where_it_should_be(hip: float, knee: float) -> None:
    kinematics = eq.Kinematics(eq.nominal_leg())
    target = foot(hip, knee)
    # Of the two poses that reach a point only one bends the knee forwards; the stops rule the other out.
    found = eq.pose_of_foot(kinematics, target, [1.5, 0.5])
    np.testing.assert_allclose(foot(*found), target, atol=1e-6)
    np.testing.assert_allclose(found, [hip, knee], atol=1e-3)


def test_a_guess_outside_the_joint_ranges_will_do(kinematics: eq.Kinematics) -> None:
    np.testing.assert_allclose(eq.pose_of_foot(kinematics, foot(1.4, 0.6), [9.0, 0.3]), [1.4, 0.6], atol=1e-5)


def test_a_far_guess_does_not_put_a_place_out_of_reach(kinematics: eq.Kinematics) -> None:
    np.testing.assert_allclose(eq.pose_of_foot(kinematics, foot(1.4, 0.6), [9.0, -9.0]), [1.4, 0.6], atol=1e-5)


def test_a_foot_out_of_reach_is_a_sentence(kinematics: eq.Kinematics) -> None:
    with pytest.raises(eq.ConfigError) as caught:
        eq.pose_of_foot(kinematics, [0.0, 0.6], [1.57, 0.1])
    said = str(caught.value)
    assert "cannot reach (0.000, 0.600) m within the joint ranges" in said and "misses it by 100" in said
    with pytest.raises(eq.ConfigError, match="cannot reach"):
        eq.pose_of_foot(kinematics, foot(0.3, 0.3), [0.6, 0.2])  # takes a hip below its stop, or the other knee


def test_poses_one_after_the_other_are_those_one_by_one(kinematics: eq.Kinematics) -> None:
    turn = np.linspace(0, 2 * np.pi, 60)
    feet = foot(1.45, 0.9) + 0.03 * np.array([np.cos(turn), np.sin(turn)]).T
    near, one = [1.4, 0.8], []
    for place in feet:
        one.append(eq.pose_of_foot(kinematics, place, one[-1] if one else near))
    found = eq.poses_of_foot(kinematics, feet, near)
    np.testing.assert_allclose(found, one, atol=1e-7)
    np.testing.assert_allclose([foot(*pose) for pose in found], feet, atol=1e-11)


def test_a_foot_that_jumps_goes_to_the_pose_that_is_near() -> None:
    """A large step of Newton's method would end where the knee is bent the other way."""
    leg = eq.nominal_leg()
    hip, knee = (
        replace(joint, lower=replace(joint.lower, angle=-end), upper=replace(joint.upper, angle=end))
        for joint, end in zip(leg.joints, (3.0, 2.5), strict=True)
    )
    wide = eq.Kinematics(replace(leg, joints=(hip, knee)))
    place = wide.foot([1.3, 0.5])
    assert wide.follow_foot([place], [1.4, -0.1])[0] == pytest.approx([1.8, -0.5], abs=0.01)
    assert eq.poses_of_foot(wide, [place], [1.4, -0.1])[0] == pytest.approx([1.3, 0.5], abs=1e-5)


def test_places_of_no_foot(kinematics: eq.Kinematics) -> None:
    assert eq.poses_of_foot(kinematics, np.empty((0, 2)), [1.4, 0.6]).shape == (0, 2)
    with pytest.raises(eq.ConfigError, match=r"have shape \(2,\), expected \(n, 2\)"):
        eq.poses_of_foot(kinematics, foot(1.4, 0.6), [1.4, 0.6])


def test_poses_go_on_behind_one_that_newton_does_not_find(kinematics: eq.Kinematics) -> None:
    """A way from the edge of the joint ranges to a place far away at once."""
    edge = float(kinematics.morphology.joint_range[1][1])
    poses = np.array([[1.4, edge - 1e-9], [1.4, edge - 0.1], [1.9, 0.5], [1.9, 0.6]])
    found = eq.poses_of_foot(kinematics, [foot(*pose) for pose in poses], [1.4, edge - 0.01])
    np.testing.assert_allclose(found, poses, atol=1e-5)
    with pytest.raises(eq.ConfigError, match="cannot reach"):
        eq.poses_of_foot(kinematics, [foot(1.4, 0.6), [0.0, 0.6]], [1.4, 0.6])


def test_the_path_is_straight_and_at_minimum_jerk(path: eq.SampledReference) -> None:
    corners = [foot(*pose) for pose in CORNERS]
    for time in np.linspace(0.0, 7.0, 211):
        leg, share = int(time // 1.5), time % 1.5 / 1.5
        a, b = corners[leg % 3], corners[(leg + 1) % 3]
        progress = 10 * share**3 - 15 * share**4 + 6 * share**5
        # Straight in joint angles between the samples, so off the line by less than (speed/rate)² / 8.
        np.testing.assert_allclose(foot(*path.position(time)), a + progress * (b - a), atol=3e-5)


def test_the_path_passes_its_corners_at_rest(path: eq.SampledReference) -> None:
    for k in range(5):
        np.testing.assert_allclose(path.position(1.5 * k), CORNERS[k % 3], atol=1e-5)
        step = path.position(1.5 * k + 1 / 120) - path.position(1.5 * k)
        assert np.abs(step).max() < 1e-4
    np.testing.assert_allclose(path.position(0.7), path.position(0.7 + 4.5), atol=1e-9)
    assert path.times[-1] >= 7.0


def test_the_path_can_be_coarse(kinematics: eq.Kinematics) -> None:
    coarse = eq.foot_path(kinematics, CORNERS, 0.01, 0.02, rate=10.0)
    assert len(coarse.times) >= 6 and np.all(np.diff(coarse.times) > 0)
    np.testing.assert_allclose(coarse.position(0.01), CORNERS[1], atol=1e-5)


def test_a_path_through_a_place_out_of_reach_is_refused(kinematics: eq.Kinematics) -> None:
    # Both ends are within reach with a straight knee, the line between them is nearer; the other way round it is not.
    with pytest.raises(eq.ConfigError, match="cannot reach"):
        eq.foot_path(kinematics, [[0.6, 1.95], [2.5, 1.95]], 1.0, 1.0, rate=20.0)
