"""The linearised loop: against the simulated one, against closed forms, and its margins against its own eigenvalues."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq, root

import equimus_ctrl as eq
from equimus_ctrl.effects import Effect, make
from equimus_ctrl.effects.sensors import sensor_settings
from equimus_ctrl.effects.valves import valve_settings
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.robots.elastic.morphology import pack
from equimus_ctrl.tuning import stability
from equimus_ctrl.tuning.ensemble import Member, latin_hypercube, make_ensemble
from equimus_ctrl.tuning.objective import Problem, Task
from equimus_ctrl.tuning.stability import (
    SLOPES,
    LinearLeg,
    Margins,
    _steepest,
    largest_modulus,
    linear_leg,
    linear_legs,
    load_response,
    loop_matrix,
    margins,
    sample,
)
from equimus_ctrl.tuning.study import EnsembleSettings, Limits, Weights
from equimus_ctrl.types import Array

DT = 1 / 120
POSE = np.array([1.45, 0.5])


def pid(space: str, *rows: tuple[float, float, float], tf: float = 0.02, ff: bool = True) -> eq.PidSettings:
    names = ("maa", "baa") if space == "length" else ("hip", "knee")
    gains = {name: eq.PidGains(*row) for name, row in zip(names, rows, strict=True)}
    return eq.PidSettings(gains, space, tf, start_time=0.0, feedforward=ff)  # type: ignore[arg-type]


SETTINGS = {
    "length": pid("length", (300, 200, 10), (150, 90, 6)),
    "joint": pid("joint", (2.0, 2.5, 0.1), (1.5, 1.0, 0.08)),
    "raw derivative": pid("length", (200, 300, 8), (200, 50, 4), tf=0.0, ff=False),
}


@pytest.fixture(scope="module")
def legs() -> list[Member]:
    model = eq.nominal_model()
    drawn = make_ensemble(model, EnsembleSettings(members=4), 4, 3)
    quick = replace(drawn[0], name="no valves", valve=valve_settings([], ("maa", "baa")))
    valve = valve_settings(
        (make("first_order_lag", "maa", {"time_constant": 0.05}), make("transport_delay", "baa", {"delay": 0.031})),
        ("maa", "baa"),
    )
    uneven = replace(drawn[0], name="uneven", valve=valve)
    return [*drawn, quick, uneven]


def gain_matrix(settings: eq.PidSettings) -> np.ndarray:
    return settings.gain_matrix(settings.channels(eq.nominal_leg()))


def loop_of(settings: eq.PidSettings, leg: Member, nominal: eq.Morphology | None = None) -> np.ndarray:
    linear = linear_leg(leg, nominal or eq.nominal_leg(), POSE, settings.space, "swing")
    return loop_matrix(sample(linear, DT), gain_matrix(settings))


def disturbed(leg: Member, settings: eq.PidSettings, start: np.ndarray, n: int, nominal: eq.Morphology) -> np.ndarray:
    """(n, 2) angles from ``start`` minus POSE in the compiled loop, the pressures that hold POSE being in force."""
    held = eq.Kinematics(leg.morphology).static_pressure(POSE)
    assert np.all((held > 0) & (held < 50e3))
    task = Task("d", 1.0, np.tile(POSE, (n, 1)), held, POSE + start, True, np.zeros((n, 2)), DT)
    problem = Problem(eq.Model(nominal), [leg], [task], Weights(), Limits(), steps=8)
    q, _, done = problem.simulate(settings, 0, 0)
    assert done == n
    return q - POSE


@pytest.mark.parametrize("space", SETTINGS)
@pytest.mark.parametrize("which", [0, 1, 3, 4, 5], ids=["model", "hardest", "drawn", "no valves", "uneven"])
@pytest.mark.parametrize("informed", [True, False], ids=["knows the leg", "does not"])
def test_a_small_disturbance_dies_as_the_linear_loop_says(
    which: int, space: str, informed: bool, legs: list[Member]
) -> None:
    """Every entry of the loop's matrix counts: leg, valves, whole and broken periods of delay, and the PID's memory."""
    leg, settings, n = legs[which], SETTINGS[space], 180
    nominal = leg.morphology if informed else eq.nominal_leg()
    start = np.array([2e-5, -3e-5])
    found = disturbed(leg, settings, start, n, nominal)
    # Bumpless: the pressures that hold POSE are in force, so the integral begins off its final value by as much as the
    # controller's feed-forward differs between the two poses. The derivative begins with no error before.
    known = eq.Kinematics(nominal)
    held = eq.Kinematics(leg.morphology).static_pressure(POSE)
    force = np.diag([a.area for a in nominal.actuators])

    def standing(pose: np.ndarray) -> np.ndarray:
        unmap = force if settings.space == "length" else known.jacobian(pose).T @ force
        rest = known.static_pressure(pose) if settings.feedforward else np.zeros(2)
        return unmap @ (held - rest)

    matrix = loop_of(settings, leg, nominal)
    x = np.zeros(len(matrix))
    x[:2] = start
    x[-6:-4] = standing(POSE + start) - standing(POSE)
    predicted = np.empty((n, 2))
    for k in range(n):
        predicted[k] = x[:2]
        x = matrix @ x
    scale = np.abs(found).max()
    np.testing.assert_allclose(found / scale, predicted / scale, rtol=0, atol=6e-3)


@pytest.mark.parametrize("space", ["length", "joint"])
def test_gains_below_the_predicted_limit_calm_down_and_gains_above_do_not(space: str, legs: list[Member]) -> None:
    """All gains raised together: the factor at which an eigenvalue reaches 1 parts decay from growth in simulation."""
    leg, settings = legs[1], SETTINGS[space]

    def raised(factor: float) -> eq.PidSettings:
        gains = {k: eq.PidGains(g.kp * factor, g.ki * factor, g.kd * factor) for k, g in settings.gains.items()}
        return replace(settings, gains=gains)

    def excess(factor: float) -> float:
        return float(np.abs(np.linalg.eigvals(loop_of(raised(factor), leg, leg.morphology))).max()) - 1

    assert excess(0.2) < 0 < excess(20.0)
    limit = brentq(excess, 0.2, 20.0)
    for factor, calm in ((0.93 * limit, True), (1.07 * limit, False)):
        found = np.abs(disturbed(leg, raised(factor), np.array([1e-4, 1e-4]), 1200, leg.morphology)).max(axis=1)
        early, late = found[120:360].max(), found[-240:].max()
        assert (late < 0.7 * early) if calm else (late > 1.4 * early), (factor, early, late)


def test_growth_is_at_the_predicted_rate(legs: list[Member]) -> None:
    leg = legs[1]
    settings = pid("length", (1500, 500, 40), (900, 300, 20))
    values = np.linalg.eigvals(loop_of(settings, leg, leg.morphology))
    largest = np.abs(values).max()
    assert 1.01 < largest < 1.1
    # Small enough that ten thousandfold growth stays small.
    found = np.abs(disturbed(leg, settings, np.array([1e-9, 1e-9]), 600, leg.morphology)).max(axis=1)
    peaks = [found[k : k + 60].max() for k in (240, 300, 360, 420)]
    rates = [(b / a) ** (1 / 60) for a, b in itertools.pairwise(peaks)]
    np.testing.assert_allclose(rates, largest, rtol=2e-3)


def test_the_static_gain_is_that_of_the_leg(legs: list[Member]) -> None:
    """C(−A)⁻¹B by pressing a little more on the leg at rest."""
    for leg in legs[1:4]:
        linear = linear_leg(leg, eq.nominal_leg(), POSE, "length", "swing")
        kinematics = eq.Kinematics(leg.morphology)
        held = kinematics.static_pressure(POSE)
        found = linear.c @ np.linalg.solve(-linear.a, linear.b)
        for i in range(2):
            more = np.eye(2)[i] * 5.0
            up, down = (kinematics.lengths(kinematics.equilibrium(held + s * more, POSE)) for s in (1, -1))
            np.testing.assert_allclose(found[:, i], (up - down) / 10.0, rtol=1e-4, atol=1e-12)


def test_a_lag_is_a_state_and_none_is_not(legs: list[Member]) -> None:
    both, none, one = (linear_leg(legs[k], eq.nominal_leg(), POSE, "joint", "swing") for k in (1, 4, 5))
    assert (len(both.a), len(none.a), len(one.a)) == (6, 4, 5)
    np.testing.assert_allclose(np.diag(both.a)[4:], -1 / legs[1].valve[:, 1])
    assert not none.delay.any() and one.delay.tolist() == [0.0, 0.031]
    np.testing.assert_array_equal(both.c, np.hstack([np.eye(2), np.zeros((2, 4))]))


def hand_made(delay: float, tau: float = 0.3) -> LinearLeg:
    """dx/dt = (u(t − delay) − x)/tau, z = x."""
    one = np.ones((1, 1))
    return LinearLeg(-one / tau, one / tau, one, np.array([delay]), one, np.zeros((1, 1)))


@pytest.mark.parametrize("delay", [0.0, 0.003, DT, 2.5 * DT, 4 * DT, 0.1])
def test_a_held_command_is_discretised_exactly(delay: float) -> None:
    """Step response of a first-order lag after a delay: 1 − exp(−(t − delay)/tau) at every instant."""
    sampled = sample(hand_made(delay), DT)
    n = 60
    u = np.zeros(n + 40)
    u[20:] = 1.0
    x = 0.0
    for k in range(20, 20 + n):
        late = k - sampled.whole[0]
        x = sampled.phi[0, 0] * x + sampled.newer[0, 0] * u[late] + sampled.older[0, 0] * u[late - 1]
        passed = (k + 1 - 20) * DT - delay
        assert x == pytest.approx(1 - math.exp(-max(passed, 0.0) / 0.3), abs=1e-12)


def test_the_loop_of_a_first_order_lag_on_paper() -> None:
    """z = x, u = −kp x held: x⁺ = (φ − kp(1 − φ)) x, and the integral's mode with ki."""
    phi = math.exp(-DT / 0.3)
    for kp, ki in ((2.0, 0.0), (5.0, 3.0), (20.0, 40.0)):
        gains = np.array([[kp], [ki], [0.0], [0.02], [0.2], [1.0], [1.0]])
        found = np.linalg.eigvals(loop_matrix(sample(hand_made(0.0), DT), gains))
        small = np.array([[phi - kp * (1 - phi), 1 - phi], [-DT * ki, 1.0]])
        for value in np.linalg.eigvals(small):
            assert np.abs(found - value).min() < 1e-9
        expected = max(np.abs(np.linalg.eigvals(small)).max(), 0.02 / (0.02 + DT))
        assert largest_modulus([sample(hand_made(0.0), DT)], gains) == pytest.approx(expected)


def test_the_largest_of_several_legs_counts() -> None:
    gains = np.array([[3.0], [1.0], [0.1], [0.02], [0.2], [1.0], [1.0]])
    legs = [sample(hand_made(delay), DT) for delay in (0.0, 0.05, 0.2)]
    each = [largest_modulus([leg], gains) for leg in legs]
    assert largest_modulus(legs, gains) == max(each)


# With effects.


EFFECTS: dict[str, tuple[Effect, ...]] = {
    "spring": (make("parallel_spring", "knee", {"stiffness": 0.2, "rest": 0.1}),),
    "cubic spring": (make("nonlinear_stiffness", "maa", {"cubic": 3e4, "centre": 0.2}),),
    "narrowing area": (make("narrowing_area", "maa", {"loss": 1.0}),),
    "late sensor": (make("sensor_delay", "knee", {"delay": 0.03}),),
    "late sensors": tuple(make("sensor_delay", joint, {"delay": s}) for joint, s in (("hip", 0.05), ("knee", DT / 3))),
    "scaled sensor": (make("sensor_scale", "hip", {"scale": 1.05}), make("sensor_offset", "knee", {"offset": 0.05})),
    "dead zone": (make("dead_zone", "maa", {"threshold": 1e3}),),
    "cutoff": (make("cutoff", "maa", {"least": 1e3}),),
    "coupled supply": (make("supply_coupling", "baa", {"share": 0.3}),),
    "several": (
        make("supply_coupling", "maa", {"share": 0.1}),
        make("parallel_spring", "hip", {"stiffness": 0.3, "rest": 1.2}),
        make("sensor_delay", "hip", {"delay": 0.02}),
        make("sensor_scale", "knee", {"scale": 0.9}),
    ),
}


def held_command(model: eq.Model, pose: np.ndarray) -> np.ndarray:
    """(na,) the commands under which a model with its effects rests in a pose [Pa]."""
    first = eq.Kinematics(model.morphology).static_pressure(pose)
    found = root(lambda kpa: rest_pose(model, 1e3 * kpa) - pose, first / 1e3, tol=1e-11)
    assert found.success
    assert np.all((found.x > 0) & (found.x < 50))
    return np.asarray(1e3 * found.x)


def test_a_jump_is_no_slope() -> None:
    """A cutoff at a command at which slopes are looked for, and next to one on either side."""
    leg = eq.nominal_leg()
    span = leg.command_high - leg.command_low
    tried = (leg.command_low + span * latin_hypercube(SLOPES, 2, np.random.default_rng(0)))[:, 0].min()
    for least in (tried, tried + 5e-7 * span, tried - 5e-7 * span):
        found = _steepest((make("cutoff", "maa", {"least": least}),), leg)
        assert found is not None
        np.testing.assert_allclose(found, np.eye(2), atol=1e-8)


@pytest.mark.parametrize(("name", "space"), [(name, ("length", "joint")[k % 2]) for k, name in enumerate(EFFECTS)])
def test_a_small_disturbance_with_effects_dies_as_the_linear_loop_says(name: str, space: str) -> None:
    """From the same pose under the same commands, with and without a small push: what differs is linear."""
    effects, settings, n = EFFECTS[name], SETTINGS[space], 180
    model = eq.Model(eq.nominal_leg(), effects)
    still = EnsembleSettings(members=1, delay=(0.02, 0.02), lag=(0.05, 0.05))
    (leg,) = make_ensemble(model, still, 1, 0)
    kinematics = eq.Kinematics(leg.morphology)
    sensor = sensor_settings(effects, ("hip", "knee"))
    true = (POSE - sensor[:, 0]) / sensor[:, 1]
    command = held_command(model, true)
    push = np.array([2e-5, -3e-5])
    angles = []
    for offset in (np.zeros(2), push):
        task = Task("d", 1.0, np.tile(POSE, (n, 1)), command, true + offset, True, np.zeros((n, 2)), DT)
        q, _, done = Problem(model, [leg], [task], Weights(), Limits(), steps=8).simulate(settings, 0, 0)
        assert done == n
        angles.append(q)
    found = angles[1] - angles[0]
    linear = linear_legs(leg, eq.nominal_leg(), POSE, space, "swing")[0]
    matrix = loop_matrix(sample(linear, DT), gain_matrix(settings))
    x = np.zeros(len(matrix))
    x[:2] = push
    # The sensors have long seen the pose that the leg begins in.
    kept = np.arange(len(linear.a) + 2 * (max(sample(linear, DT).whole) + 1), len(x) - 6)
    x[kept] = np.resize([*push, 0.0, 0.0], len(kept))
    # Bumpless: the integral begins off by as much as the feed-forward of the pose seen differs.
    force = np.diag([a.area for a in leg.morphology.actuators])

    def standing(pose: np.ndarray) -> np.ndarray:
        unmap = force if space == "length" else kinematics.jacobian(pose).T @ force
        return unmap @ (command - kinematics.static_pressure(pose))

    seen = sensor[:, 1] * push
    x[-6:-4] = standing(POSE + seen) - standing(POSE)
    predicted = np.empty((n, 2))
    for k in range(n):
        predicted[k] = x[:2]
        x = matrix @ x
    scale = np.abs(found).max()
    np.testing.assert_allclose(found / scale, predicted / scale, rtol=0, atol=6e-3)


def test_what_is_fed_forward_need_not_be_held_by_the_integral() -> None:
    """Torques that stand turn with the pose into other pressures; those of a model that is known do not stand."""
    effects = (*EFFECTS["several"], make("dead_zone", "maa", {"threshold": 1e3}))
    model = eq.Model(eq.nominal_leg(), effects)
    still = EnsembleSettings(members=1, delay=(0.0, 0.0), lag=(0.0, 0.0))
    (leg,) = make_ensemble(model, still, 1, 0)
    task = Task("d", 1.0, np.tile(POSE, (2, 1)), np.zeros(2), POSE, True, np.zeros((2, 2)), DT)
    problem = Problem(model, [leg], [task], Weights(), Limits(), inverse=True)
    (seen,) = problem.poses()
    static = linear_leg(leg, model.morphology, seen, "joint", "swing")
    known = linear_leg(leg, model.morphology, seen, "joint", "swing", fed=problem.fed(seen))
    assert np.abs(known.pose_gain).max() < 1e-6 * np.abs(static.pose_gain).max()
    np.testing.assert_array_equal(known.a, static.a)


def test_a_pose_beyond_a_stop_is_taken_at_its_edge() -> None:
    stop = make("joint_stop", "knee", {"angle": 0.2, "stiffness": 100.0, "damping": 0.5})
    model = eq.Model(eq.nominal_leg(), (stop,))
    (leg,) = make_ensemble(model, EnsembleSettings(members=1), 1, 0)
    found, edge = (linear_leg(leg, model.morphology, np.array([1.5, knee]), "length", "swing") for knee in (0.1, 0.2))
    np.testing.assert_array_equal(found.a, edge.a)
    assert np.abs(found.a).max() < 1e4


# Margins.


def known(monkeypatch: pytest.MonkeyPatch, *loops: object, cross: float = 0.0) -> list[Margins]:
    """Margins of a loop whose frequency response is given: loops on the diagonal, ``cross`` above it."""

    def response(leg: LinearLeg, gains: np.ndarray, dt: float, omega: np.ndarray) -> np.ndarray:
        found = np.zeros((len(omega), 2, 2), dtype=complex)
        for i, loop in enumerate(loops):
            found[:, i, i] = loop(1j * omega)  # type: ignore[operator]
        found[:, 0, 1] = cross
        return found

    monkeypatch.setattr(stability, "loop_response", response)
    leg = make_ensemble(eq.nominal_model(), EnsembleSettings(), 1, 0)[0]
    return margins(SETTINGS["length"], leg, eq.nominal_leg(), POSE, DT, "swing")


@pytest.mark.parametrize("cross", [0.0, 3.0])
def test_margins_of_loops_from_the_book(monkeypatch: pytest.MonkeyPatch, cross: float) -> None:
    """K/(s(1+s)²) is at the limit at K = 2; an integrator with a delay at the limit has ωT = π/2.

    A path in one direction only leaves both loops as they are.
    """
    k, delay = 0.5, 0.1
    first, second = known(
        monkeypatch, lambda s: k / (s * (1 + s) ** 2), lambda s: 4 / s * np.exp(-s * delay), cross=cross
    )
    assert (first.actuator, second.actuator) == ("maa", "baa")
    assert first.gain == pytest.approx(2 / k, rel=1e-3)
    w = brentq(lambda w: k / (w * (1 + w**2)) - 1, 0.1, 1.0)
    phase = math.pi / 2 - 2 * math.atan(w)
    assert first.crossover == pytest.approx(w, rel=1e-3) and first.phase == pytest.approx(phase, rel=1e-3)
    assert first.delay == pytest.approx(phase / w, rel=1e-3)
    assert second.crossover == pytest.approx(4.0, rel=1e-3)
    assert second.phase == pytest.approx(math.pi / 2 - 4 * delay, rel=1e-3)
    assert second.delay == pytest.approx((math.pi / 2 - 0.4) / 4, rel=1e-3)
    assert second.gain == pytest.approx(math.pi / 2 / 0.1 / 4, rel=1e-3)


def test_a_loop_that_nothing_upsets_has_no_margin(monkeypatch: pytest.MonkeyPatch) -> None:
    first, _ = known(monkeypatch, lambda s: 0.5 / (1 + s), lambda s: 0.1 / (1 + s))
    assert first.gain == first.phase == first.delay == math.inf and math.isnan(first.crossover)
    assert first.to_dict() == {
        "actuator": "maa",
        "gain_margin": None,
        "phase_margin_deg": None,
        "delay_margin_s": None,
        "crossover_rad_s": None,
    }


def test_margins_in_plain_types() -> None:
    assert Margins("maa", 2.0, math.pi / 4, 0.1, 5.0).to_dict() == {
        "actuator": "maa",
        "gain_margin": 2.0,
        "phase_margin_deg": pytest.approx(45.0),
        "delay_margin_s": 0.1,
        "crossover_rad_s": 5.0,
    }


@pytest.mark.parametrize("space", ["length", "joint"])
@pytest.mark.parametrize("which", [0, 1, 2], ids=["model", "hardest", "drawn"])
def test_margins_are_where_an_eigenvalue_reaches_one(which: int, space: str, legs: list[Member]) -> None:
    """Frequency response against state space: a gain or a delay of one loop raised to just there."""
    settings = SETTINGS[space] if which != 1 else pid("length", (300, 200, 10), (120, 60, 5))
    leg, gains = legs[which], gain_matrix(settings)
    linear = linear_leg(leg, eq.nominal_leg(), POSE, settings.space, "swing")
    assert largest_modulus([sample(linear, DT)], gains) < 1
    for i, found in enumerate(margins(settings, leg, eq.nominal_leg(), POSE, DT, "swing")):
        scale, late = np.ones((2, 1)), np.zeros(2)

        def modulus(gain: float, delay: float, i: int = i, scale: np.ndarray = scale, late: np.ndarray = late) -> float:
            scale, late = scale.copy(), late.copy()
            scale[i], late[i] = gain, delay
            changed = replace(
                linear,
                effort_map=scale * linear.effort_map,
                pose_gain=scale * linear.pose_gain,
                delay=linear.delay + late,
            )
            return largest_modulus([sample(changed, DT)], gains)

        if math.isfinite(found.gain):
            assert modulus(0.999 * found.gain, 0.0) < 1 < modulus(1.001 * found.gain, 0.0)
        if found.delay < 1.0:
            assert modulus(1.0, 0.999 * found.delay) < 1 < modulus(1.0, 1.001 * found.delay)


@pytest.mark.parametrize("space", ["length", "joint"])
@pytest.mark.parametrize("name", ["late sensors", "coupled supply", "several"])
def test_margins_with_effects_are_there_too(name: str, space: str) -> None:
    settings = SETTINGS[space]
    gains = gain_matrix(settings)
    (leg,) = make_ensemble(eq.Model(eq.nominal_leg(), EFFECTS[name]), EnsembleSettings(members=1), 1, 0)
    linear = linear_leg(leg, eq.nominal_leg(), POSE, space, "swing")
    assert largest_modulus([sample(linear, DT)], gains) < 1
    for i, found in enumerate(margins(settings, leg, eq.nominal_leg(), POSE, DT, "swing")):
        modulus = []
        for factor in (0.995, 1.005):
            scale = np.ones((2, 1))
            scale[i] = factor * found.gain
            changed = replace(linear, effort_map=scale * linear.effort_map, pose_gain=scale * linear.pose_gain)
            modulus.append(largest_modulus([sample(changed, DT)], gains))
        assert modulus[0] < 1 < modulus[1]


def test_effects_with_states_are_looked_at_twice() -> None:
    """The margins are the least of the loop's with the effects as they are to quick and to slow motion."""
    effects = (make("creep", "baa", {"stiffness": 100.0, "time_constant": 0.3}),)
    (leg,) = make_ensemble(eq.Model(eq.nominal_leg(), effects), EnsembleSettings(members=1), 1, 0)
    assert len(linear_legs(leg, eq.nominal_leg(), POSE, "length", "swing")) == 2
    found = margins(SETTINGS["length"], leg, eq.nominal_leg(), POSE, DT, "swing")
    (plain,) = make_ensemble(eq.nominal_model(), EnsembleSettings(members=1), 1, 0)
    stiff = (make("parallel_spring", "knee", {"stiffness": 0.0, "rest": 0.0}),)
    without = margins(SETTINGS["length"], replace(plain, effects=stiff), eq.nominal_leg(), POSE, DT, "swing")
    for own, other in zip(found, without, strict=True):
        assert own.gain <= other.gain * (1 + 1e-9) and own.delay <= other.delay * (1 + 1e-9)


def test_the_parameter_vector_and_the_morphology_agree(legs: list[Member]) -> None:
    for leg in legs:
        np.testing.assert_array_equal(leg.parameters, pack(leg.morphology))


def test_how_far_a_leg_gives_way_is_what_its_loop_does_instant_by_instant(legs: list[Member]) -> None:
    """Against the loop under a load that is switched on."""
    m, load = eq.nominal_leg(), np.array([3e3, 5e3])
    for leg in legs[:3]:
        sampled = sample(linear_leg(leg, m, POSE, "length", "swing"), DT)
        gains = gain_table(kp=(500.0, 150.0), ki=(800.0, 400.0), kd=(8.0, 6.0))
        matrix = loop_matrix(sampled, gains)
        total = 0.0
        for i in range(2):
            x = np.zeros(len(matrix))
            for _ in range(4000):
                x = matrix @ x
                x[: len(sampled.phi)] += sampled.load[:, i] * load[i]
                total += DT * float(x[:2] @ x[:2]) / 2
        assert load_response(sampled, gains, load) == pytest.approx(math.sqrt(total), rel=1e-3)
        softer = gain_table(kp=(250.0, 75.0), ki=(400.0, 200.0), kd=(4.0, 3.0))
        assert load_response(sampled, softer, load) > 1.2 * load_response(sampled, gains, load)


def test_a_load_acts_on_a_leg_as_its_pressures_do(legs: list[Member]) -> None:
    """In the end C x/P is the leg's static gain, lag or none."""
    for leg in legs[1:5]:
        linear = linear_leg(leg, eq.nominal_leg(), POSE, "length", "swing")
        assert linear.load is not None and linear.joints == 2
        ours = linear.c @ np.linalg.solve(-linear.a, linear.load)
        np.testing.assert_allclose(ours, linear.c @ np.linalg.solve(-linear.a, linear.b), rtol=1e-9)


def gain_table(kp: tuple[float, float], ki: tuple[float, float], kd: tuple[float, float]) -> Array:
    """(7, 2) gains with the default settings."""
    made = [eq.PidGains(*own) for own in zip(kp, ki, kd, strict=True)]
    return eq.PidSettings(dict(zip(("maa", "baa"), made, strict=True))).gain_matrix(("maa", "baa"))
