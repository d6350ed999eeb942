"""Random trees: what is drawn occurs, acts and can be drawn again; the reference converges to what MuJoCo's laws say."""

from __future__ import annotations

from collections import Counter

import mujoco
import numpy as np
import pytest

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.validation.random_trees import (
    FEATURES,
    FRICTION,
    SMOOTH,
    acting,
    controls,
    converged,
    hardened,
    random_tree,
    reference,
)

FIRST_ORDER = {"filterexact", "position_timeconst", "actearly", "actrange", "delay", "intvelocity", "integrator"}
SWITCHES = {name for name in FEATURES if "limit" in name or name.startswith(("pid", "dcmotor"))} | FIRST_ORDER

PENDULUM = """<mujoco><option gravity="0 0 0"/><compiler angle="radian"/><worldbody>
  <body><joint name="j" type="hinge" {joint}/><inertial pos="0 0 0" mass="1" diaginertia="1 1 0.5"/></body></worldbody>
  <actuator>{actuator}</actuator></mujoco>"""


def commanded(seed: int, joints: int, features: tuple[str, ...]) -> tuple[str, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    xml = random_tree(rng, joints, features)
    return xml, *controls(rng, mujoco.MjModel.from_xml_string(xml), 3.0)


@pytest.mark.slow
def test_every_feature_occurs_and_acts_in_twenty_trees() -> None:
    """Under other commands than those the trees were drawn with."""
    seen: Counter[str] = Counter()
    for seed in range(20):
        xml, times, ctrl = commanded(seed, 1 + seed % 7, FEATURES)
        seen.update(acting(xml, times, ctrl))
    assert not {name for name in FEATURES if not seen[name]}


def test_the_same_seed_gives_the_same_tree_and_commands() -> None:
    (one, times, ctrl), (other, again, same) = commanded(5, 4, FEATURES), commanded(5, 4, FEATURES)
    assert one == other
    np.testing.assert_array_equal(times, again)
    np.testing.assert_array_equal(ctrl, same)


def test_only_what_is_allowed_is_drawn() -> None:
    xml, times, ctrl = commanded(1, 4, ("slide", "motor", "at_joint", "armature"))
    assert acting(xml, times, ctrl) <= {"slide", "motor", "at_joint", "armature"}
    model = mujoco.MjModel.from_xml_string(commanded(2, 5, SMOOTH)[0])
    assert not set(SMOOTH) & set(FRICTION)
    assert not model.dof_frictionloss.any() and not model.tendon_frictionloss.any()


def test_an_unknown_feature_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match=r"unknown features wings; known are branches, .*gear"):
        random_tree(np.random.default_rng(0), 2, ("wings",))


def test_runge_kutta_converges_to_the_limit_at_once_where_its_laws_are_smooth() -> None:
    xml, times, ctrl = commanded(4, 4, tuple(name for name in SMOOTH if name not in SWITCHES))
    limit = converged(xml, times, ctrl, 1.0)
    assert limit.change < 1e-8
    assert np.abs(reference(xml, times, ctrl, 1.0, 2.5e-4) - limit.q).max() < 2e-8


@pytest.mark.slow
@pytest.mark.parametrize("features", [SMOOTH, FEATURES])
def test_runge_kutta_converges_to_the_limit_as_its_step_where_they_are_not(features: tuple[str, ...]) -> None:
    xml, times, ctrl = commanded(7, 3, features)
    limit = converged(xml, times, ctrl, 1.0)
    assert limit.change < 1e-6
    coarse, fine = (np.abs(reference(xml, times, ctrl, 1.0, step) - limit.q).max() for step in (1e-3, 1.25e-4))
    assert fine < coarse / 4 and fine < 1e-3


@pytest.mark.parametrize(
    ("actuator", "exact"),
    [
        ('<motor joint="j" nsample="9" delay="0.1"/>', lambda t: np.maximum(t - 0.1, 0) ** 2),
        ('<general joint="j" dyntype="integrator" actrange="-0.2 0.2"/>', lambda t: 0.2 * t**2 - 0.04 * t + 0.008 / 3),
        ('<pid joint="j" kp="0.5" slewmax="2" input="pos"/>', lambda t: 1 - 2 * np.sin(t) + 2 * np.sin(t - 0.5)),
    ],
)
def test_the_limit_is_the_exact_solution(actuator: str, exact: object) -> None:
    """Of one hinge of inertia 1/2 under a constant command of 1: what RK4 tends to only as its step."""
    xml = PENDULUM.format(joint="", actuator=actuator)
    times = np.arange(0, 1, 0.1)
    ctrl = np.ones((len(times), mujoco.MjModel.from_xml_string(xml).nu))
    found = converged(xml, times, ctrl, 1.0)
    late = found.times >= 0.5
    assert callable(exact)
    np.testing.assert_allclose(found.q[late, 0], exact(found.times[late]), atol=1e-9)


def test_dry_friction_stops_a_joint_where_coulomb_says() -> None:
    """A torque of 1 for 0.2 s against friction of 0.4, inertia 1/2: accelerated, then braked to rest."""
    xml = PENDULUM.format(joint='frictionloss="0.4"', actuator='<motor joint="j"/>')
    times = np.arange(0, 1, 0.1)
    ctrl = (times < 0.15).astype(float)[:, None]
    v = (1 - 0.4) / 0.5 * 0.2
    rest = 0.5 * v * 0.2 + v**2 / (2 * 0.4 / 0.5)
    found = converged(xml, times, ctrl, 1.0)
    assert found.rate < np.inf
    assert found.q[-1, 0] == pytest.approx(rest, abs=1e-6)
    assert reference(xml, times, ctrl, 1.0, 1e-4)[-1, 0] == pytest.approx(rest, abs=1e-4)


def test_hardened_friction_leaves_the_model_as_it_was() -> None:
    model = mujoco.MjModel.from_xml_string(PENDULUM.format(joint='frictionloss="0.4"', actuator=""))
    assert hardened(model, 1e4).dof_solref[0, 1] == -1e4
    np.testing.assert_array_equal(model.dof_solref[0], [0.02, 1.0])


def test_a_step_that_does_not_divide_the_commands_is_refused() -> None:
    xml = PENDULUM.format(joint="", actuator='<motor joint="j"/>')
    with pytest.raises(ConfigError, match=r"the step 0\.003 s does not divide 0\.1 s"):
        reference(xml, np.array([0.0, 0.1]), np.ones((2, 1)), 0.2, 3e-3)
