"""A level surface that a point of an MJCF robot touches: where it rests, with what force, and that a diagnosis finds it."""

from __future__ import annotations

import math
from functools import partial

import mujoco
import numpy as np
import pytest
from mjcf_models import CRANE, DT, RIG, cart, pendulum, refusal, run, swinging
from pendulum_runs import NOISE
from scipy.optimize import minimize

from equimus_ctrl import workflow
from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.place_excitation import excitation_of
from equimus_ctrl.effects import GravityTilt, PayloadMass, PlaneContact
from equimus_ctrl.effects.native import Draft
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.segments import cut
from equimus_ctrl.models.model import Model
from equimus_ctrl.robots.mjcf.export import exported
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array, Recording

TABLE = -0.5
G = 9.81
TIME, SOFT = 0.95 * 2 * DT, 0.9
STIFFNESS = 1 / TIME**2
"""Of contact with MuJoCo's default impedance and a time constant of two steps: [s], 1, [1/s²]."""


def tip(q: Array) -> Array:
    """(…, 3) of the rig."""
    angle, way = q[..., 0], -0.6 - q[..., 1]
    return np.stack(
        [0.05 * np.cos(angle) + way * np.sin(angle), 0 * angle, way * np.cos(angle) - 0.05 * np.sin(angle)], -1
    )


def energy(q: Array) -> float:
    """Of the rig: weights and the spring of its slide [J]."""
    angle, reach = q
    arm = -0.2 * math.cos(angle) - 0.02 * math.sin(angle)
    rod = -(0.5 + reach) * math.cos(angle)
    return float(1.5 * G * arm + 0.5 * G * rod + 60.0 * reach**2)


def fallen(seconds: float = 10.0, angle: float = 1.2, reach: float = 0.0, every: float = 0.01) -> Trial:
    none = np.zeros((1, 2))
    times = np.arange(0.0, seconds, every)
    return Trial("fallen", np.zeros(1), none, none[0], 0.0, np.array([angle, reach]), times)


def forces(model: mujoco.MjModel, q: Array) -> Array:
    """(nv,) of contacts and limits on the joints, at rest in a pose."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    return np.array(data.qfrc_constraint)


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_it_rests_where_the_energy_is_least_above_the_plane(engine: str) -> None:
    """By Lagrange: the multiplier of z ≥ height is the contact's force, from which its penetration follows."""
    model, trial = Model(RIG, (PlaneContact("tip", TABLE),)), fallen()
    if engine == "reduced":
        found = simulate([model], [trial], dt=1e-3, check=False)[0].position[0]
    else:
        found = simulate_mjcf([model], [trial], threads=1)[0].position[0]
    room = {"type": "ineq", "fun": lambda q: tip(q)[2] - TABLE}
    # There is such a place on either side of the pivot.
    aside = [math.copysign(0.5, found[-1, 0]), 0.0]
    least = minimize(energy, aside, method="SLSQP", constraints=[room], options={"ftol": 1e-14})
    assert least.success
    step = 1e-6
    lever = np.array([(tip(least.x + d)[2] - tip(least.x - d)[2]) / (2 * step) for d in step * np.eye(2)])
    slope = np.array([(energy(least.x + d) - energy(least.x - d)) / (2 * step) for d in step * np.eye(2)])
    force = float(lever @ slope / (lever @ lever))
    np.testing.assert_allclose(force * lever, slope, atol=1e-3)
    own = RIG.with_surface("tip", TABLE).mujoco_model()
    np.testing.assert_allclose(forces(own, found[-1]), force * lever, rtol=0.02)
    inverse = float(own.body_invweight0[own.body("rod").id, 0])
    soft = (1 - SOFT) / SOFT**2 * inverse * force / STIFFNESS
    assert force > 1.0 and TABLE - tip(found[-1])[2] == pytest.approx(soft, rel=0.02) and soft < 1e-4
    np.testing.assert_allclose(found[-1], least.x, atol=1e-4)


def test_a_plane_that_is_never_reached_changes_no_bit() -> None:
    trial = swinging(until=3.0)
    for far in (-1.0, -5.0):
        near, bare = (
            simulate_mjcf([m], [trial], threads=1)[0] for m in (Model(RIG, (PlaneContact("tip", far),)), Model(RIG))
        )
        assert np.array_equal(near.position, bare.position)
    near, bare = (
        simulate([m], [trial], dt=1e-3, check=False)[0] for m in (Model(RIG, (PlaneContact("tip", -1.0),)), Model(RIG))
    )
    np.testing.assert_allclose(near.position, bare.position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("below", [1e-3, 0.02])
def test_what_starts_below_it_comes_out_no_faster_than_critical_damping_has_it(below: float) -> None:
    """From a rest r below: r/(e·T). What starts a millimetre below hardly leaves the surface."""
    start = np.array([0.3, 0.02])
    height = float(tip(start)[2]) + below
    model, trial = Model(RIG, (PlaneContact("tip", height),)), fallen(0.5, float(start[0]), float(start[1]), every=1e-3)
    for positions in (
        simulate([model], [trial], dt=1e-3, check=False)[0].position,
        simulate_mjcf([model], [trial], threads=1, dt=1e-4)[0].position,
    ):
        above = tip(positions[0])[:, 2] - height
        speed = below / (math.e * TIME)
        assert 0.5 * speed < np.gradient(above, 1e-3).max() < 1.05 * speed
        assert above.max() < 1.5 * speed**2 / (2 * G)
        # It falls back no faster.
        assert above[100:].min() > -speed * TIME / math.e


def test_it_is_level_whichever_way_gravity_is() -> None:
    """A cart that falls along its slide rests at the height, however the base is tilted afterwards."""
    falls = cart('damping="20"').xml.replace("<worldbody>", '<option gravity="-9.81 0 0"/><worldbody>')
    robot = MjcfRobot("cart", falls)
    assert robot.up == pytest.approx([1.0, 0.0, 0.0])
    for effects in ((PlaneContact("box", -0.3),), (GravityTilt("base", 0.2), PlaneContact("box", -0.3))):
        assert run(robot, *effects, until=5.0).x[-1] == pytest.approx(-0.3, abs=3e-4)


DEFAULTS = """<default><geom solref="0.5 0.1" margin="0.3" condim="6" contype="1" conaffinity="1"/>
  <pair solref="0.5 0.1" margin="0.3" condim="6"/></default>"""


@pytest.mark.parametrize("place", ["tip", "arm"])
def test_it_is_written_as_a_contact_of_two_geoms(place: str) -> None:
    """At a site, and at the centre of mass of a last body, with what it carries; the file's defaults do not count."""
    xml = pendulum(head=DEFAULTS)
    robot = MjcfRobot("p", xml if place == "tip" else xml.replace('<site name="tip" pos="0.2 0 -0.5"/>', ""))
    assert place in (*robot.ends["foot"], *robot.ends["link"])
    model = Model(robot, (PlaneContact(place, -0.25), PayloadMass(place, 0.3)))
    own = robot.with_surface(place, -0.25).with_payload(place, 0.3)
    first, found = own.mujoco_model(), []
    for made in (first, mujoco.MjModel.from_xml_string(exported(own, Draft(first)))):
        found.append([float(forces(made, np.array([q]))[0]) for q in (0.2, 0.4, 2.5)])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5)  # an XML has six digits
    assert found[0][0] != 0 and found[0][2] == 0
    trial = Trial("t", np.zeros(1), np.zeros((1, 1)), np.zeros(1), 0.0, np.array([2.0]), np.arange(0, 4, 0.01))
    rests = simulate_mjcf([model], [trial], threads=1)[0].position[0, -1]
    data = mujoco.MjData(first)
    data.qpos[:] = rests
    mujoco.mj_kinematics(first, data)
    at = data.site("tip").xpos if place == "tip" else data.body("arm").xipos
    assert at[2] == pytest.approx(-0.25, abs=5e-4)


def test_it_weighs_nothing() -> None:
    """Of a body whose inertia follows from its geoms too."""
    geom = '<body name="ball" pos="0 0 -0.6"><geom size="0.1"/><site name="s"/></body>'
    robot = MjcfRobot("p", pendulum(body=geom))
    bare, own = robot.mujoco_model(), robot.with_surface("s", 0.0).mujoco_model()
    assert np.array_equal(bare.body_inertia, own.body_inertia) and np.array_equal(bare.body_mass, own.body_mass)


def test_where_it_cannot_be() -> None:
    one = PlaneContact("tip", 0.0)
    falling = MjcfRobot("adrift", pendulum().replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>'))
    told = refusal(lambda: Model(falling, (one,)))
    assert told == "adrift: gravity is 0, expected more: a level surface lies across it"
    assert "exclude each other" in refusal(lambda: Model(CRANE, (one, PlaneContact("tip", 0.1))))
    assert refusal(lambda: Model(CRANE, (PlaneContact("arm", 0.0),))).endswith("(known: tip)")
    for flag in ("contact", "constraint"):
        off = MjcfRobot("off", pendulum(option=f'<flag {flag}="disable"/>'))
        assert f'<flag {flag}="disable"/>' in refusal(partial(Model, off, (one,)))


def recorded(real: Model, size: float, seed: int) -> list[Recording]:
    """Servos that follow sums of two sines, from rest where these begin."""
    rng, time, found = np.random.default_rng(seed), np.arange(0, 6.0, 0.01), []
    for k in range(3):
        command = np.column_stack(
            [
                middle
                + size * np.sin(2 * np.pi * rng.uniform(0.25, 0.4) * time + rng.uniform(0, 6))
                + 0.1 * np.sin(2 * np.pi * rng.uniform(0.8, 1.4) * time)
                for middle in (0.25, 0.4)
            ]
        )
        trial = Trial(f"t{k}", time, command, command[0], 0.0, np.array([0.1, 0.3]), time)
        angle = simulate_mjcf([real], [trial], threads=1, dt=2e-4)[0].position[0]
        angle = angle + rng.normal(0, NOISE, angle.shape)
        found.append(Recording(f"t{k}", time, command, angle, real.robot.actuator_names, real.robot.joint_names))
    return found


REACHING = MjcfRobot(
    "reaching",
    """<mujoco><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/><worldbody>
      <body name="upper" pos="0 0 0.25"><joint name="shoulder" axis="0 1 0" armature="0.01" damping="0.3"/>
      <inertial pos="0.1 0 0" mass="0.3" diaginertia="0.0005 0.001 0.001"/>
      <body name="fore" pos="0.2 0 0"><joint name="elbow" axis="0 1 0" armature="0.01" damping="0.3"/>
      <inertial pos="0.08 0 0" mass="0.2" diaginertia="0.0003 0.0006 0.0006"/><site name="hand" pos="0.18 0 0"/></body></body>
      </worldbody><actuator><position name="lift" joint="shoulder" kp="15"/><position name="bend" joint="elbow" kp="12"/>
      </actuator></mujoco>""",
)
"""Two links in a vertical plane, each with a servo."""


def hand(q: Array) -> Array:
    """Height of the hand [m]."""
    return np.asarray(0.25 - 0.2 * np.sin(q[:, 0]) - 0.18 * np.sin(q[:, 0] + q[:, 1]))


def test_guesses_begin_at_the_lowest_place_that_was_seen() -> None:
    model, height = Model(REACHING), 0.04
    trials = recorded(Model(REACHING, (PlaneContact("hand", height),)), 0.3, 1)
    segments = cut(model, trials)
    seen = excitation_of(model, segments)["hand"]
    every = np.concatenate([hand(trial.position) for trial in trials])
    assert every.min() <= seen.lowest < height + 1e-3 and seen.lowest + seen.rises <= every.max()
    found = {c.label: c.guesses for c in candidates(model, segments) if c.effect is PlaneContact}
    heights = [guess["height"] for guess in found.pop("plane_contact:hand")]
    assert not found and min(heights) == seen.lowest and max(heights) < seen.lowest + 0.11 * seen.rises
    assert not PlaneContact.degenerate({"height": height}, seen) and PlaneContact.degenerate({"height": 0.2}, seen)
    adrift = MjcfRobot("adrift", REACHING.xml.replace("<worldbody>", '<option gravity="0 0 0"/><worldbody>'))
    assert not [c for c in candidates(Model(adrift), cut(Model(adrift), trials)) if c.effect is PlaneContact]


@pytest.mark.long
@pytest.mark.slow
def test_a_table_that_the_hand_touches_is_found_with_its_height() -> None:
    height = 0.04
    trials = recorded(Model(REACHING, (PlaneContact("hand", height),)), 0.3, 1)
    found = workflow.diagnose(trials, Model(REACHING), most=1)
    assert [(f.named.effect, f.named.locations) for f in found.findings] == [("plane_contact", ("hand",))]
    estimate = found.findings[0].parameters["height"]
    assert estimate.value == pytest.approx(height, abs=1e-3) and estimate.unit == "m"
    assert found.rmse("corrected", "validation")[0] < 1.2 * NOISE
