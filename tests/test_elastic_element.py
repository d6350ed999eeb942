"""The element on anyone's MjSpec: its motion, what it refuses, and the settings of the solver."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest
from morphologies import integrate

from equimus_ctrl.errors import ModelError
from equimus_ctrl.models.mjcf import SolverSettings, add_elastic_actuator, build_spec, close_elements, compile_model
from equimus_ctrl.robots.elastic.leg import nominal_leg

ROD = {"mass": 0.3, "stiffness": 90.0, "damping": 2.5, "rest_length": 0.25}

PENDULUM = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 -9.7" timestep="0.001" integrator="RK4"/>
  <worldbody>
    <site name="hook" pos="0.3 0 0.05" {hook}/>
    <body name="arm">
      <joint name="swing" axis="0 1 0" damping="0.05"/>
      <inertial mass="0.6" pos="0 0 -0.2" diaginertia="0.004 0.004 0.004"/>
      <site name="ring" pos="0.02 0 -0.3"/>
      <site name="knob" pos="0 0 -0.1"/>
    </body>
  </worldbody>
</mujoco>
"""


def hand_derived(theta: float, omega: float, force: float, rod: dict[str, float] = ROD) -> float:
    """Angular acceleration of PENDULUM with a rod from the fixed hook to the ring.

    One end of the rod is at rest, so its kinetic energy is m|v|²/6 of the ring's velocity and half its weight hangs on
    the ring: (I + M c² + m r²/3) α = −M g c sin θ + ½ m g ∂y/∂θ + (F − k (l − l0) − c l') ∂l/∂θ − d ω, θ about +y.
    """
    x = 0.02 * math.cos(theta) - 0.3 * math.sin(theta)  # a turn about +y takes z towards x
    z = -0.02 * math.sin(theta) - 0.3 * math.cos(theta)
    slope_x, slope_z = z, -x  # ∂x/∂θ, ∂z/∂θ
    length = math.hypot(x - 0.3, z - 0.05)
    arm = ((x - 0.3) * slope_x + (z - 0.05) * slope_z) / length
    push = force - rod["stiffness"] * (length - rod["rest_length"]) - rod["damping"] * arm * omega
    moment = 0.004 + 0.6 * 0.2**2 + rod["mass"] * (0.02**2 + 0.3**2) / 3
    torque = -0.6 * 9.7 * 0.2 * math.sin(theta) - rod["mass"] * 9.7 / 2 * slope_z + push * arm - 0.05 * omega
    return torque / moment


def users_own(hook: str = "", change: Callable[[str], str] = lambda xml: xml) -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(change(PENDULUM.format(hook=hook)))


def closed(spec: mujoco.MjSpec, theta: float, omega: float, ctrl: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = spec.compile()
    data = mujoco.MjData(model)
    swing = model.joint("swing")
    data.qpos[swing.qposadr[0]], data.qvel[swing.dofadr[0]] = theta, omega
    close_elements(model, data)
    data.ctrl[:] = ctrl
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize(("origin", "insertion"), [("hook", "ring"), ("ring", "hook")])
@pytest.mark.parametrize("area", [1.0, 4e-4])
def test_on_a_pendulum_of_ones_own_it_gives_the_hand_derived_motion(origin: str, insertion: str, area: float) -> None:
    """Carried by the world or by the moving arm: the same."""
    spec = users_own()
    returned = add_elastic_actuator(spec, "muscle", origin, insertion, area=area, **ROD)
    assert returned.name == "muscle"
    for theta, omega, force in [(0.0, 0.0, 0.0), (0.4, -2.0, 5.0), (-1.0, 3.0, 12.0)]:
        model, data = closed(spec, theta, omega, force / area)
        found = data.qacc[model.joint("swing").dofadr[0]]
        assert found == pytest.approx(hand_derived(theta, omega, force), rel=1e-3, abs=1e-2)
    model, data = closed(spec, 0.4, -2.0, 5.0 / area)
    times = np.linspace(0, 1, 11)
    expected, _ = integrate(
        lambda t, q, v: np.array([hand_derived(q[0], v[0], 5.0)]), np.array([0.4]), np.array([-2.0]), times
    )
    swing = model.joint("swing").qposadr[0]
    for angle in expected[1:, 0]:
        for _ in range(100):
            mujoco.mj_step(model, data)
        assert data.qpos[swing] == pytest.approx(angle, abs=1e-5)
    end, ring = data.site("muscle/end").xpos, data.site(insertion).xpos
    assert np.linalg.norm(end - ring) < 1e-6


def on_a_post(xml: str) -> str:
    """The hook on a body of its own that is fixed to the world."""
    site = '<site name="hook" pos="0.3 0 0.05" />'
    assert site in xml
    return xml.replace(site, '<body name="post" pos="0.3 0 0"><site name="hook" pos="0 0 0.05"/></body>')


@pytest.mark.parametrize(
    ("hook", "change"),
    [
        pytest.param("", lambda xml: xml, id="plain"),
        pytest.param('quat="0.9393727 0 0.3428978 0"', lambda xml: xml, id="site turned within the plane"),
        pytest.param('euler="0 0.7 0"', lambda xml: xml, id="the same by euler angles"),
        pytest.param(
            "",
            lambda xml: xml.replace(
                '<site name="hook" pos="0.3 0 0.05" />',
                '<frame pos="0.3 0 0"><site name="hook" pos="0 0 0.05"/></frame>',
            ),
            id="site in a frame",
        ),
        pytest.param(
            'type="capsule" size="0.01" fromto="0.2 0 0.05 0.4 0 0.05"',
            lambda xml: xml.replace('pos="0.3 0 0.05"', ""),
            id="site given by its ends",
        ),
        pytest.param(
            "",
            lambda xml: xml.replace('angle="radian"', ""),
            id="angles in degrees",
        ),
        pytest.param(
            "",
            lambda xml: xml.replace("<worldbody>", '<default><joint armature="0.1" damping="3"/></default><worldbody>')
            .replace('damping="0.05"', 'damping="0.05" armature="0"'),
            id="other defaults for joints",
        ),
        pytest.param(
            "",
            lambda xml: xml.replace("<worldbody>", '<default><joint range="-0.1 0.1"/></default><worldbody>')
            .replace('damping="0.05"', 'damping="0.05" limited="false"'),
            id="limited joints by default",
        ),
        pytest.param(
            "",
            lambda xml: xml.replace(
                "<worldbody>",
                '<default><general gear="5" biastype="affine" biasprm="1 -10 0" dyntype="filter" dynprm="0.1" '
                'ctrlrange="0 1" forcerange="-1 1"/>'
                '<tendon stiffness="50" damping="9" springlength="0.1" range="0 0.1"/></default><worldbody>',
            ),
            id="other defaults for actuators and tendons",
        ),
        pytest.param("", on_a_post, id="site on a body fixed to another"),
        pytest.param(
            "",
            lambda xml: on_a_post(xml).replace("<compiler ", '<compiler fusestatic="true" '),
            id="such bodies fused"
        ),
    ],
)  # fmt: skip
def test_it_fits_whatever_way_the_users_model_is_written(hook: str, change: Callable[[str], str]) -> None:
    spec = users_own(hook, change)
    add_elastic_actuator(spec, "muscle", "hook", "ring", **ROD)
    model, data = closed(spec, 0.4, -2.0, 5.0)
    found = data.qacc[model.joint("swing").dofadr[0]]
    assert found == pytest.approx(hand_derived(0.4, -2.0, 5.0), rel=1e-3)


@pytest.mark.parametrize(
    "turned",
    [
        'quat="0.70710678 0.70710678 0 0"',
        'euler="1.57079633 0 0"',
        'zaxis="0 -1 0"',
    ],
)
def test_the_elements_plane_is_that_of_the_origin_site(turned: str) -> None:
    """The same pendulum lying in x and −y: the site is turned by a quarter about x, so that its own y is the axis."""

    def lay_down(xml: str) -> str:
        for upright, lying in [
            ('gravity="0 0 -9.7"', 'gravity="0 9.7 0"'),
            ('axis="0 1 0"', 'axis="0 0 1"'),
            ('pos="0.3 0 0.05"', 'pos="0.3 -0.05 0"'),
            ('pos="0 0 -0.2"', 'pos="0 0.2 0"'),
            ('pos="0.02 0 -0.3"', 'pos="0.02 0.3 0"'),
        ]:
            assert upright in xml
            xml = xml.replace(upright, lying)
        return xml

    spec = users_own(turned, lay_down)
    add_elastic_actuator(spec, "muscle", "hook", "ring", **ROD)
    model, data = closed(spec, 0.4, -2.0, 5.0)
    found = data.qacc[model.joint("swing").dofadr[0]]
    assert found == pytest.approx(hand_derived(0.4, -2.0, 5.0), rel=1e-3)


def test_bodies_need_no_names() -> None:
    spec = mujoco.MjSpec()
    first = spec.worldbody.add_body()
    first.add_joint(name="one", axis=(0, 1, 0))
    first.add_geom(size=(0.05, 0, 0))
    first.add_site(name="here", pos=(0.1, 0, 0))
    second = first.add_body(pos=(0, 0, -0.3))
    second.add_joint(name="two", axis=(0, 1, 0))
    second.add_geom(size=(0.05, 0, 0))
    second.add_site(name="there", pos=(0.05, 0, -0.1))
    add_elastic_actuator(spec, "muscle", "here", "there", **ROD)
    spec.compile()


def test_a_users_own_joint_may_be_called_hinge() -> None:
    spec = users_own(change=lambda xml: xml.replace('name="swing"', 'name="door/hinge"'))
    add_elastic_actuator(spec, "muscle", "hook", "ring", **ROD)
    model = spec.compile()
    close_elements(model, mujoco.MjData(model))


def test_two_elements_on_one_model_do_not_disturb_each_other() -> None:
    spec = users_own()
    add_elastic_actuator(spec, "one", "hook", "ring", **{**ROD, "mass": 0.1})
    add_elastic_actuator(spec, "two", "hook", "ring", **{**ROD, "mass": 0.2})
    both = {key: value * (1 if key == "rest_length" else 2) for key, value in ROD.items()} | {"mass": 0.3}
    model, data = closed(spec, 0.4, -2.0, 5.0)
    found = data.qacc[model.joint("swing").dofadr[0]]
    assert found == pytest.approx(hand_derived(0.4, -2.0, 10.0, both), rel=1e-3)


def test_a_command_range_limits_the_command_and_none_does_not() -> None:
    spec = users_own()
    add_elastic_actuator(spec, "limited", "hook", "ring", command_range=(0.0, 3.0), **ROD)
    add_elastic_actuator(spec, "free", "hook", "ring", **ROD)
    model, data = closed(spec, 0.4, 0.0, 7.0)
    np.testing.assert_allclose(data.actuator_force, [3.0, 7.0])
    assert list(model.actuator_ctrllimited) == [1, 0]
    assert list(model.actuator_ctrlrange[0]) == [0.0, 3.0]


def add(change: dict[str, Any]) -> None:
    spec = users_own()
    arguments: dict[str, Any] = {"name": "muscle", "origin": "hook", "insertion": "ring", **ROD, **change}
    add_elastic_actuator(spec, arguments.pop("name"), arguments.pop("origin"), arguments.pop("insertion"), **arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origin": "knob"}, "actuator 'muscle': both sites are on body 'arm', so it cannot lengthen"),
        ({"mass": 0.0}, "actuator 'muscle': mass is 0, expected more than 0"),
        ({"mass": -0.1}, "actuator 'muscle': mass is -0.1, expected more than 0"),
        ({"mass": math.nan}, "actuator 'muscle': mass is nan, expected more than 0"),
        ({"rest_length": 0.0}, "actuator 'muscle': rest_length is 0, expected more than 0"),
        ({"rest_length": math.nan}, "actuator 'muscle': rest_length is nan, expected more than 0"),
    ],
)
def test_what_cannot_be_added_is_said_in_one_sentence(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError) as caught:
        add(change)
    assert str(caught.value) == message


@pytest.mark.parametrize("end", ["origin", "insertion"])
def test_a_site_that_does_not_exist_is_named_beside_those_that_do(end: str) -> None:
    with pytest.raises(ModelError) as caught:
        add({end: "hock"})
    assert str(caught.value).startswith("actuator 'muscle': there is no site 'hock'")
    for name in ("hook", "ring", "knob"):
        assert name in str(caught.value).partition("known: ")[2]


def test_a_model_without_sites_says_so() -> None:
    with pytest.raises(ModelError, match=r"there is no site 'hook' \(known: none\)"):
        add_elastic_actuator(mujoco.MjSpec(), "muscle", "hook", "ring", **ROD)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mass": math.inf}, "mass is inf, expected more than 0"),
        ({"rest_length": math.inf}, "rest_length is inf, expected more than 0"),
        ({"stiffness": -1.0}, "stiffness is -1, expected at least 0"),
        ({"stiffness": math.nan}, "stiffness is nan, expected at least 0"),
        ({"damping": -1.0}, "damping is -1, expected at least 0"),
        ({"damping": math.inf}, "damping is inf, expected at least 0"),
    ],
)
def test_numbers_a_morphology_would_refuse_are_refused_here_too(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError) as caught:
        add(change)
    assert str(caught.value) == f"actuator 'muscle': {message}"


@pytest.mark.parametrize(
    "change", [{"area": 0.0}, {"area": math.nan}, {"command_range": (3.0, 1.0)}, {"command_range": (0.0, math.nan)}]
)
def test_an_area_or_a_range_a_morphology_would_refuse_is_refused_here_too(change: dict[str, Any]) -> None:
    with pytest.raises(ModelError, match="actuator 'muscle'"):
        add(change)


def test_a_model_that_does_not_compile_is_named_with_the_reason() -> None:
    spec = users_own()
    spec.worldbody.add_body(name="ghost").add_joint(name="free")
    with pytest.raises(ModelError, match=r"actuator 'muscle': the model it is added to does not compile \("):
        add_elastic_actuator(spec, "muscle", "hook", "ring", **ROD)


def test_a_name_used_twice_is_refused() -> None:
    spec = users_own()
    add_elastic_actuator(spec, "muscle", "hook", "ring", **ROD)
    with pytest.raises(ModelError, match="'muscle'"):
        add_elastic_actuator(spec, "muscle", "hook", "knob", **ROD)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"integrator": "RK45"},
            "there is no integrator 'RK45'; did you mean 'RK4'? (known: Euler, RK4, implicit, impl",
        ),
        ({"timestep": -1e-3}, "timestep is -0.001, expected more than 0"),
        ({"timestep": math.nan}, "timestep is nan, expected more than 0"),
        ({"time_constant": 0.0}, "time_constant is 0, expected more than 0"),
        ({"tolerance": math.inf}, "tolerance is inf, expected more than 0"),
        ({"impedance": 1.0}, "impedance is 1, expected between 0 and 1"),
        ({"iterations": 0}, "iterations is 0, expected at least 1"),
    ],
)
def test_solver_settings_that_cannot_be_are_refused_in_a_sentence(settings: dict[str, Any], message: str) -> None:
    for use in (compile_model, build_spec):
        with pytest.raises(ModelError) as caught:
            use(nominal_leg(), settings=SolverSettings(**settings))
        assert str(caught.value).startswith(f"solver settings: {message}")
    with pytest.raises(ModelError, match="solver settings"):
        add_elastic_actuator(users_own(), "muscle", "hook", "ring", settings=SolverSettings(**settings), **ROD)


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_each_integrator_by_its_own_name(integrator: str) -> None:
    model = compile_model(nominal_leg(), settings=SolverSettings(integrator=integrator))
    assert model.opt.integrator == getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
