"""The batch engine: many models through many trials, each as if it were alone, and as an independent oracle says."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np
import pytest
from morphologies import STRUCTURES, integrate, newton_acceleration, random_morphology, random_poses

from equimus_ctrl.effects import (
    REGISTRY,
    AsymmetricLag,
    Backlash,
    CoulombFriction,
    Creep,
    DeadZone,
    Effect,
    FirstOrderLag,
    ForceEffect,
    GravityTilt,
    Hysteresis,
    ParallelSpring,
    PayloadMass,
    RateLimit,
    Saturation,
    SensorDelay,
    SensorOffset,
    TransportDelay,
    make,
)
from equimus_ctrl.effects.base import parameter, register
from equimus_ctrl.effects.force import Parameters, force_laws
from equimus_ctrl.engines import lane_functions
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.encoding import encode
from equimus_ctrl.engines.lane_equations import FUNCTIONS, load_lanes
from equimus_ctrl.engines.lane_functions import LANES, ROW_GAPS, ROW_PRESSED, ROW_PRESSURE, ROW_RATE, ROW_X
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.augmented import law_parameters, slots_of
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import Phase, pack, structure
from equimus_ctrl.types import Array, Recording

LEG = nominal_leg()
FREE = replace(LEG, joints=tuple(replace(j, lower=None, upper=None) for j in LEG.joints))
START = np.array([1.3, 0.9])
COMMANDS = np.array([[12e3, 2e3], [18e3, 9e3], [5e3, 4e3]])


def trial(name: str = "t", until: float = 1.2, start: Array = START, shift: float = 0.0, n: int = 61) -> Trial:
    return Trial(
        name,
        shift + np.array([0.0, 0.35, 0.8]),
        COMMANDS,
        COMMANDS[0] / 2,
        shift,
        start,
        shift + np.linspace(0, until, n),
    )


def crowd(n: int, seed: int = 0) -> list[Model]:
    """Legs of all sorts: numbers, and effects on every side, spread at random."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(n):
        values = {name: value * rng.uniform(0.8, 1.2) for name, value in LEG.parameters().items() if "damping" in name}
        pool: list[Effect] = [
            CoulombFriction("hip", rng.uniform(0, 0.3)),
            CoulombFriction("knee", rng.uniform(0, 0.05)),
            CoulombFriction("baa", rng.uniform(0, 1)),
            Creep("maa", rng.uniform(0, 100), 0.2),
            Hysteresis("baa", rng.uniform(0, 1), 0.02),
            AsymmetricLag("maa", 0.05, 0.1),
            TransportDelay("baa", rng.uniform(0, 0.1)),
            RateLimit("baa", 5e4),
            DeadZone("maa", rng.uniform(0, 3e3)),
            SensorOffset("knee", 0.1),
            SensorDelay("hip", rng.uniform(0, 0.05)),
            Backlash("knee", 0.02),
            PayloadMass("foot", rng.uniform(0, 0.1)),
            GravityTilt("base", rng.uniform(-0.1, 0.1)),
        ]
        chosen = rng.random(len(pool)) < 0.4
        effects = tuple(effect for effect, taken in zip(pool, chosen, strict=True) if taken)
        found.append(Model(LEG.with_parameters(values), effects))
    return found


def same(a: Sequence[Predicted], b: Sequence[Predicted]) -> bool:
    return all(
        np.array_equal(x.position, y.position) and np.array_equal(x.reached, y.reached)
        for x, y in zip(a, b, strict=True)
    )


# --- against the oracle -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("phase", ["swing", "stance"])
@pytest.mark.parametrize("name", STRUCTURES)
def test_a_lanes_equations_of_motion_are_newtons(name: str, phase: Phase) -> None:
    """Another set of numbers in every lane."""
    form = structure(random_morphology(name, 0, stops=True))
    lanes = load_lanes(form, phase, force_laws())
    x, pressures, rate, pressing, asking = (
        lanes.robot[place] for place in (ROW_X, ROW_PRESSURE, ROW_RATE, ROW_PRESSED, ROW_GAPS)
    )
    laws = slots_of(form, force_laws())
    robots = [random_morphology(name, seed, stops=True) for seed in range(LANES)]
    nj, na = len(robots[0].joints), len(robots[0].actuators)
    rng = np.random.default_rng(1)
    w = lanes.work()
    rows = w.reshape(-1, LANES)
    rows[x : x + nj] = np.array([random_poses(m, rng, 1)[0] for m in robots]).T
    rows[x + nj : x + 2 * nj] = rng.normal(0, 2, (nj, LANES))
    rows[pressures : pressures + na] = rng.uniform(0, 5e4, (na, LANES))
    for lane, m in enumerate(robots):
        p = np.concatenate([pack(m), law_parameters(laws, [], m.joint_names, m.actuator_names)])
        lane_functions.prepare_lane(lanes.robot, p, w, lane)
    lane_functions.lane_start(lanes.robot, w)
    lane_functions.lane_gaps(lanes.robot, w)
    pressed, gaps = (rows[row : row + 2 * nj] for row in (pressing, asking))
    pressed[:] = gaps > 0
    assert 0 < pressed.sum() < pressed.size
    lane_functions.lane_grips(lanes.robot, w)
    lane_functions.lane_motion(lanes.robot, w)
    for lane, m in enumerate(robots):
        q, v = rows[x:][: 2 * nj, lane].reshape(2, nj)
        pressure = rows[pressures:][:na, lane]
        expected = newton_acceleration(m, q, v, pressure, phase=phase)
        found = rows[rate + nj :][:nj, lane]
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("name", "phase"),
    [
        ("mono_and_bi", "swing"),
        pytest.param("mono_and_bi", "stance", marks=pytest.mark.slow),
        pytest.param("branched", "swing", marks=pytest.mark.slow),
    ],
)
def test_robots_move_as_newton_says(name: str, phase: Phase) -> None:
    robots = [random_morphology(name, seed) for seed in range(3)]
    times, rng = np.arange(0, 0.31, 0.03), np.random.default_rng(3)
    na = len(robots[0].actuators)
    before, commands = rng.uniform(0, 2e4, na), rng.uniform(0, 2e4, (1, na))
    poses = np.array([random_poses(m, rng, 1, 0.3, 0.9)[0] for m in robots])
    one = Trial("t", np.array([0.0]), commands, before, 0.0, poses[0], times)
    found = simulate([Model(m, phase=phase) for m in robots], [one], starts=[poses], threads=1)[0]
    assert found.sound.all()
    for m, q0, q in zip(robots, poses, found.position, strict=True):
        expected, _ = integrate(
            lambda t, q, v, m=m: newton_acceleration(m, q, v, commands[0], phase=phase),
            q0, np.zeros_like(q0), times, rtol=1e-7, atol=1e-9,
        )  # fmt: skip
        assert np.ptp(expected, axis=0).max() > 0.02
        np.testing.assert_allclose(q, expected, rtol=0, atol=2e-6)


# --- one kernel, many sets --------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def together() -> list[Predicted]:
    found = simulate(crowd(19), trials(), threads=1)
    assert all(one.sound.all() for one in found)
    return found


def trials() -> list[Trial]:
    """One that moves freely, and one in which some legs hit the knee's stop."""
    thrown = trial("b", until=0.7, start=np.array([1.6, 0.15]), shift=3.3)
    return [trial("a"), replace(thrown, commands=COMMANDS * [1, 3], velocity=np.array([0.3, -6.0]))]


def test_models_differ_and_each_is_what_it_is_alone() -> None:
    """To the bit: neither who else is in the call nor the position in a block matters, friction or none."""
    for k, model in enumerate(crowd(19)):
        for one, all_of_them in zip(simulate([model], trials()), together(), strict=True):
            np.testing.assert_array_equal(one.position[0], all_of_them.position[k])
    plain = simulate([replace(model, effects=()) for model in crowd(19)], trials())[1].position
    assert plain[:, :, 1].min() < -0.035, "the knee should hit its stop"
    ends = together()[0].position[:, -1]
    assert len(np.unique(ends, axis=0)) == 19


@pytest.mark.parametrize("threads", [1, 2, 5, None])
def test_the_number_of_threads_changes_no_bit(threads: int | None) -> None:
    assert same(simulate(crowd(19), trials(), threads=threads), together())


def test_neither_does_the_order_of_the_models() -> None:
    order = np.random.default_rng(2).permutation(19)
    mixed = simulate([crowd(19)[k] for k in order], trials(), threads=1)
    for one, all_of_them in zip(mixed, together(), strict=True):
        np.testing.assert_array_equal(one.position, all_of_them.position[order])


def test_nor_coding_them_beforehand_nor_the_other_trials() -> None:
    coded = encode(crowd(19))
    assert same(simulate(coded, trials()), together())
    assert same(simulate(coded, trials()[1:]), together()[1:])


def test_neighbours_that_differ_in_the_command_before_alone_are_told_apart() -> None:
    """And those that differ in one valve, or one command, alone."""
    one = replace(trial(), before=np.array([30e3, 10e3]))
    variants = [(Saturation("maa", 20e3),), (Saturation("maa", 25e3),), (), (TransportDelay("maa", 0.02),),
                (DeadZone("baa", 2.5e3),)]  # fmt: skip
    models = [Model(LEG, effects) for effects in variants]
    found = simulate(models, [one], threads=1)[0].position
    for k, model in enumerate(models):
        np.testing.assert_array_equal(found[k], simulate([model], [one])[0].position[0])
    # Without a lag what was before the first row is over when the motion starts.
    lagged = [Model(LEG, (*effects, FirstOrderLag("maa", 0.1))) for effects in variants[:3]]
    found = simulate(lagged, [one], threads=1)[0].position
    assert len(np.unique(found[:, -1], axis=0)) == 3
    for k, model in enumerate(lagged):
        np.testing.assert_array_equal(found[k], simulate([model], [one])[0].position[0])


def test_what_kernels_are_told_of_a_structure_has_a_place_each() -> None:
    places = [n for name, n in vars(lane_functions).items() if name.isupper() and name not in ("LANES", "LENGTH")]
    assert sorted(places) == list(range(lane_functions.LENGTH))
    robot = load_lanes(structure(LEG), "swing", ()).robot
    assert all(robot[place] != 0 for place in FUNCTIONS.values())


def test_one_structure_has_one_set_of_equations_and_all_have_one_kernel() -> None:
    laws = force_laws()
    lanes = load_lanes(structure(LEG), "swing", laws)
    assert load_lanes(structure(ideal_leg()), "swing", laws) is lanes
    assert load_lanes(structure(random_morphology("mono_and_bi", 7)), "swing", laws) is lanes
    other = load_lanes(structure(random_morphology("one_joint", 7)), "swing", laws)
    assert other.kernel is lanes.kernel and other.n_joints < lanes.n_joints
    # Compiled once for all of them: one signature.
    simulate([crowd(19)[0], Model(ideal_leg())], trials())
    assert len(lanes.kernel.run_trials.signatures) == 1


def test_what_is_handed_in_is_left_alone() -> None:
    one, coded = trial(), encode(crowd(3))
    kept = [array.copy() for array in (one.times, one.commands, one.before, one.position, one.sample_times)]
    numbers = coded.parameters.copy()
    starts = [np.tile(START, (3, 1))]
    simulate(coded, [one], starts=starts)
    for before, after in zip(kept, (one.times, one.commands, one.before, one.position, one.sample_times), strict=True):
        np.testing.assert_array_equal(before, after)
    np.testing.assert_array_equal(coded.parameters, numbers)
    np.testing.assert_array_equal(starts[0], np.tile(START, (3, 1)))


# --- starts and windows -----------------------------------------------------------------------------------------


def test_every_model_may_start_elsewhere() -> None:
    models, rng = crowd(11), np.random.default_rng(4)
    starts = [START + rng.normal(0, 0.1, (11, 2)) for _ in range(2)]
    found = simulate(models, trials(), starts=starts)
    for t, one in enumerate(trials()):
        for k, model in enumerate(models):
            alone = simulate([model], [one.starting_from(starts[t][k])])[0]
            np.testing.assert_array_equal(found[t].position[k], alone.position[0])


def test_a_start_may_have_velocities() -> None:
    models, v = crowd(3), np.array([[0.5, -1.0], [0.0, 2.0], [-1.0, 0.3]])
    whole = simulate(models, [trial()], starts=[np.hstack([np.tile(START, (3, 1)), v])])[0]
    for k, model in enumerate(models):
        alone = simulate([model], [replace(trial(), velocity=v[k])])[0]
        np.testing.assert_array_equal(whole.position[k], alone.position[0])
    assert np.abs(whole.position - simulate(models, [trial()])[0].position).max() > 0.01


def recorded() -> Recording:
    time = 2.0 + np.arange(0, 1.2, 0.01)
    commands = np.where(time[:, None] < 2.3, (12e3, 2e3), np.where(time[:, None] < 2.8, (18e3, 9e3), (5e3, 4e3)))
    return Recording(
        "r", time, commands, np.tile(START, (120, 1)), LEG.actuator_names, LEG.joint_names, before=[1e3, 0.0]
    )


def test_a_window_continues_the_whole() -> None:
    """Its commands and pressures have their past; its angles and rates start where the whole has them."""
    model = Model(FREE, (AsymmetricLag("maa", 0.2, 0.4), TransportDelay("baa", 0.15), RateLimit("baa", 3e4)))
    whole = Trial.of(recorded(), START)
    h, begin = 1e-4, 2.437
    at = np.array([begin - h, begin, begin + h])
    around = simulate([model], [replace(whole, sample_times=at)])[0].position[0]
    part = replace(Trial.of(recorded(), around[1], (begin, 2.9)), velocity=(around[2] - around[0]) / (2 * h))
    assert (part.start, part.sample_times[0], part.sample_times[-1]) == (begin, 2.44, 2.9)
    found = simulate([model], [part])[0].position[0]
    inside = (recorded().time >= begin) & (recorded().time <= 2.9)
    np.testing.assert_allclose(found, simulate([model], [whole])[0].position[0][inside], rtol=0, atol=3e-6)
    settled = simulate([model], [replace(part, times=part.times[60:], commands=part.commands[60:])])[0].position[0]
    assert np.abs(found - settled).max() > 1e-3, "the past should matter"


def test_windows_take_the_rows_within_them() -> None:
    r = recorded()
    whole = Trial.of(r, START)
    np.testing.assert_array_equal(whole.sample_times, r.time)
    assert whole.start == r.time[0]
    early = Trial.of(r, START, (0.0, 2.05))
    assert early.start == r.time[0] and len(early.sample_times) == 6
    np.testing.assert_array_equal(early.times, r.time)


def test_a_trial_without_samples_gives_none() -> None:
    found = simulate(crowd(2), [replace(trial(), sample_times=np.empty(0))])[0]
    assert found.position.shape == (2, 0, 2) and found.sound.all()


def test_a_sample_at_the_start_is_the_start() -> None:
    found = simulate([Model(LEG)], [replace(trial(), sample_times=np.zeros(1))])[0]
    np.testing.assert_array_equal(found.position[0], [START])


# --- divergence -------------------------------------------------------------------------------------------------

STIFF = LEG.with_parameters({"maa.stiffness": 1e9})
RUBBING = (CoulombFriction("hip", 0.2), CoulombFriction("knee", 0.05), CoulombFriction("baa", 1.0))


def stiffer(stiffness: float) -> Model:
    return Model(LEG.with_parameters({"maa.stiffness": stiffness}), RUBBING)


@pytest.mark.parametrize("place", [0, 3, 7, 10])
def test_a_lane_that_diverges_harms_no_other(place: int) -> None:
    sound = [Model(model.morphology, RUBBING) for model in crowd(11)]
    models = [*sound[:place], Model(STIFF, RUBBING), *sound[place:]]
    found, alone = simulate(models, [trial()], threads=1)[0], simulate(sound, [trial()], threads=1)[0]
    others = np.arange(12) != place
    np.testing.assert_array_equal(found.position[others], alone.position)
    np.testing.assert_array_equal(found.sound, others)
    assert found.reached[place] == simulate([models[place]], [trial()])[0].reached[0] < 61


def test_it_is_reported_with_the_first_sample_that_could_not_be_had() -> None:
    """Stiffnesses from the last stable one on: the more, the sooner. Up to then there are angles of a leg."""
    models = [stiffer(k) for k in np.geomspace(2e5, 1e9, 16)]
    dense = replace(trial(), sample_times=np.arange(0, 1.2, 1e-3))
    found = simulate(models, [dense])[0]
    assert found.sound[0] and not found.sound[-1]
    assert found.reached[-1] <= found.reached[~found.sound].max()
    for k in np.flatnonzero(~found.sound):
        reached = found.reached[k]
        assert np.all(np.abs(found.position[k, :reached]) < 20)
        # What was reached does not depend on how often one looks.
        sparse = np.array([0.0, 0.0005, 0.01, 0.1, 0.5, 1.0])
        few = simulate([models[k]], [replace(dense, sample_times=sparse)])[0]
        assert few.reached[0] == np.searchsorted(sparse, dense.sample_times[reached] - 1e-3 + 1e-12, side="right")


def test_a_late_sensor_shows_the_divergence_later() -> None:
    dense = replace(trial(), sample_times=np.arange(0, 1.2, 1e-3))
    late = Model(STIFF, (*RUBBING, SensorDelay("hip", 0.05), SensorDelay("knee", 0.05)))
    prompt, delayed = simulate([Model(STIFF, RUBBING), late], [dense])[0].reached
    assert delayed == pytest.approx(prompt + 50, abs=1)


def test_a_start_that_is_too_fast_reaches_nothing() -> None:
    found = simulate([Model(LEG)] * 2, [replace(trial(), velocity=np.array([0.0, 1e4]))])[0]
    np.testing.assert_array_equal(found.reached, 0)
    assert not found.sound.any()


# --- what cannot be ---------------------------------------------------------------------------------------------


def test_models_that_differ_in_structure_or_phase_are_refused() -> None:
    other = Model(random_morphology("branched", 0))
    for models in ([Model(LEG), other], [Model(LEG), Model(LEG, phase="stance")]):
        with pytest.raises(ConfigError) as caught:
            simulate(models, [trial()])
        name = models[1].name
        assert str(caught.value) == f"{name} and nominal_leg differ in structure or phase, so they cannot run together"


def test_no_model_is_refused() -> None:
    with pytest.raises(ConfigError, match="no model was given to simulate"):
        simulate([], [trial()])


@pytest.mark.parametrize("dt", [0.0, -1e-3, math.nan, math.inf])
def test_a_step_that_cannot_be_is_refused(dt: float) -> None:
    with pytest.raises(ConfigError, match=rf"the physics step is {dt:g} s, expected more than 0"):
        simulate([Model(LEG)], [trial()], dt=dt)


@dataclass(frozen=True)
class Ghost(Effect):
    """Of a kind that no engine has heard of."""

    name = "ghost"
    side = "force"
    sits_at = ("joint",)
    summary = "haunts"
    size: float = parameter("1", 0.0, 1.0, "of the ghost")


def test_effects_of_an_unknown_kind_are_refused_by_name() -> None:
    with pytest.raises(ConfigError) as caught:
        encode([Model(LEG), Model(LEG, (Ghost("knee", 0.5),))])
    start = "nominal_leg: the reduced engine does not simulate effect ghost at 'knee' (it does: "
    assert str(caught.value).startswith(start)
    for name in ("coulomb_friction", "payload_mass", "sensor_delay", "transport_delay", "dead_zone"):
        assert name in str(caught.value)


# --- a law of one's own -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Magnet(ForceEffect):
    """Cogging with a memory: −size·sin(3(x − z)), dz/dt = (x − z)/time."""

    name = "magnet"
    sits_at = ("joint",)
    summary = "pulls the joint towards where it was"
    n_states = 1
    neutral = {"size": 0.0}  # noqa: RUF012
    size: float = parameter("N·m", 0.0, 10.0, "of the pull")
    time: float = parameter("s", 0.01, 10.0, "until it has moved along")

    @classmethod
    def force(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> ca.SX:
        return -p["size"] * ca.sin(3 * (x - z[0]))

    @classmethod
    def state_rate(cls, x: ca.SX, rate: ca.SX, z: Sequence[ca.SX], p: Parameters) -> Sequence[ca.SX]:
        return ((x - z[0]) / p["time"],)

    @classmethod
    def rest_state(cls, x: ca.SX, p: Parameters) -> Sequence[ca.SX]:
        return (x,)


@pytest.fixture
def magnet() -> Iterator[None]:
    register(Magnet)
    yield
    del REGISTRY["magnet"]


@pytest.mark.slow
@pytest.mark.usefixtures("magnet")
def test_a_law_of_ones_own_takes_part_without_any_other_change() -> None:
    robot = random_morphology("one_joint", 2)
    effect = make("magnet", "joint0", {"size": 0.4, "time": 0.15})
    model = Model(robot, (effect, ParallelSpring("joint0", 0.3, 0.1)))
    assert model_from_dict(model_to_dict(model)) == model
    k, q0, pressure = Kinematics(robot), np.array([0.6]), np.array([1e4])
    times = np.arange(0, 0.6, 0.02)

    def slope(t: float, x: Array, v: Array) -> Array:
        push = -0.4 * math.sin(3 * (x[0] - x[1])) - 0.3 * (x[0] - 0.1)
        return np.array([k.acceleration(x[:1], v[:1], pressure, [push])[0], (v[0] - v[1]) / 0.15])

    # The state as a second coordinate: dz/dt = (x − z)/T is z̈ = (ẋ − ż)/T from ż = 0 at x = z.
    expected, _ = integrate(slope, np.array([q0[0], q0[0]]), np.zeros(2), times)
    one = Trial("t", np.zeros(1), pressure[None, :], pressure, 0.0, q0, times)
    found = simulate([model, Model(robot)], [one], threads=1)[0]
    np.testing.assert_allclose(found.position[0, :, 0], expected[:, 0], rtol=0, atol=1e-7)
    assert np.abs(found.position[0] - found.position[1]).max() > 0.02


def test_it_is_gone_with_its_registration() -> None:
    assert Magnet not in force_laws()
    with pytest.raises(ConfigError, match="there is no effect 'magnet'"):
        make("magnet", "hip", {"size": 1.0, "time": 1.0})
