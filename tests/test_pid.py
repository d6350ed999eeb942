"""The PID against its law written out in plain Python, and against closed forms; its settings and their messages."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import equimus_ctrl as eq
from equimus_ctrl import presets
from equimus_ctrl.controllers import pid_kernel
from equimus_ctrl.controllers.pid_settings import FORMAT
from equimus_ctrl.plants.mujoco_plant import make_spec

DT = 1 / 120
LOW, HIGH = 0.0, 50e3
AREAS = (0.000403, 0.000436)
SPACES = {"length": ("maa", "baa"), "joint": ("hip", "knee")}


def gains_for(space: str, *rows: tuple[float, float, float]) -> dict[str, eq.PidGains]:
    return {name: eq.PidGains(*row) for name, row in zip(SPACES[space], rows, strict=True)}


SETTINGS = {
    "length": eq.PidSettings(gains_for("length", (400.0, 300.0, 12.0), (150.0, 80.0, 6.0)), "length"),
    "joint": eq.PidSettings(gains_for("joint", (3.0, 4.0, 0.2), (2.0, 1.5, 0.1)), "joint"),
}


# The leg on paper (Zhu et al., 2025): lengths, their slopes and the pressures that balance weight and springs.


def ends(hip: complex, knee: complex) -> list[tuple[tuple[complex, complex], tuple[complex, complex]]]:
    """Both ends of the two actuators, y downwards."""
    beta1, beta2 = math.radians(8.13), math.radians(30.0)
    c = (0.21213 * np.cos(hip - beta1), 0.21213 * np.sin(hip - beta1))
    d = (
        0.25 * np.cos(hip) + 0.10 * np.cos(hip + knee + beta2),
        0.25 * np.sin(hip) + 0.10 * np.sin(hip + knee + beta2),
    )
    return [((0.06, 0.0), c), ((-0.10, 0.0), d)]


def lengths(hip: complex, knee: complex) -> list[complex]:
    return [np.sqrt((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2) for a, b in ends(hip, knee)]


def potential(hip: complex, knee: complex) -> complex:
    """Weight and springs [J]; an actuator's mass is spread evenly, so it hangs at its middle."""
    height = 0.086 * 0.1267 * np.sin(hip) + 0.1033 * (0.25 * np.sin(hip) + 0.139 * np.sin(hip + knee))
    for mass, (a, b) in zip((0.1865, 0.2727), ends(hip, knee), strict=True):
        height += mass * (a[1] + b[1]) / 2
    springs = zip((265.82, 110.36), (0.1803, 0.2565), lengths(hip, knee), strict=True)
    return -9.8 * height + sum(k / 2 * (length - rest) ** 2 for k, rest, length in springs)


def slope(function: Callable[[complex, complex], Any], hip: float, knee: float) -> np.ndarray:
    """d/d(hip, knee) by a complex step, exact to rounding: rows are the function's values."""
    step = 1e-30
    columns = [function(hip + 1j * step, knee), function(hip, knee + 1j * step)]
    return np.array([[np.imag(value) / step for value in np.atleast_1d(column)] for column in columns]).T


def moment_arms(q: Sequence[float]) -> np.ndarray:
    return slope(lengths, q[0], q[1])


def resting(q: Sequence[float]) -> np.ndarray:
    """Pressures that hold q: virtual work s P dl = dV."""
    return np.linalg.solve(moment_arms(q).T * AREAS, slope(potential, q[0], q[1])[0])


@dataclass
class PaperPid:
    """The law of the docstring, step by step."""

    s: eq.PidSettings
    integral: list[float] = field(default_factory=list)
    slow: list[float] = field(default_factory=list)
    last: list[float] = field(default_factory=list)
    offset: np.ndarray = field(default_factory=lambda: np.zeros(2))

    def z(self, q: Sequence[float]) -> list[float]:
        return [float(np.real(x)) for x in lengths(*q)] if self.s.space == "length" else [float(x) for x in q]

    def map(self, w: Sequence[float], y: Sequence[float]) -> np.ndarray:
        if self.s.space == "length":
            return np.array([effort / area for effort, area in zip(w, AREAS, strict=True)])
        return np.linalg.solve(moment_arms(y).T * AREAS, np.array(w))

    def unmap(self, p: np.ndarray, y: Sequence[float]) -> list[float]:
        if self.s.space == "length":
            return [pressure * area for pressure, area in zip(p, AREAS, strict=True)]
        return list((moment_arms(y).T * AREAS) @ p)

    def rest(self, q: Sequence[float]) -> np.ndarray:
        return resting(q) if self.s.feedforward else np.zeros(2)

    def start(self, y: np.ndarray, command: np.ndarray, wanted: np.ndarray) -> None:
        """With r = y and nothing moving, w must be unmap(command − P_static)."""
        z, effort = self.z(y), self.unmap(command - self.rest(y), y)
        gains = [self.s.gains[name] for name in SPACES[self.s.space]]
        b, c = self.s.proportional_weight, self.s.derivative_weight
        self.integral = [e - g.kp * (b - 1) * x for e, g, x in zip(effort, gains, z, strict=True)]
        self.slow, self.last = [0.0, 0.0], [(c - 1) * x for x in z]
        self.offset = y - wanted

    def fading(self, time: float, wanted: np.ndarray, lasts: float) -> np.ndarray:
        """The reference out of which the first pose fades."""
        share = min(time / lasts, 1.0) if lasts else 1.0
        fade = 1 - (10 * share**3 - 15 * share**4 + 6 * share**5)
        return np.asarray(wanted + fade * self.offset)

    def step(self, time: float, y: np.ndarray, wanted: np.ndarray) -> np.ndarray:
        r = self.fading(time, wanted, self.s.start_time)
        late = self.fading(time, wanted, self.s.start_time + 2 * self.s.lateness)
        zy = self.z(y)
        x = [sorted((a, b, own))[1] for a, b, own in zip(self.z(r), self.z(late), zy, strict=True)]
        b, c = self.s.proportional_weight, self.s.derivative_weight
        w, damping = [], []
        for i, name in enumerate(SPACES[self.s.space]):
            g = self.s.gains[name]
            weighted = c * x[i] - zy[i]
            alpha = DT / (self.s.derivative_time + DT)
            self.slow[i] += alpha * ((weighted - self.last[i]) / DT - self.slow[i])
            self.last[i] = weighted
            w.append(g.kp * (b * x[i] - zy[i]) + self.integral[i])
            damping.append(g.kd * self.slow[i])
        steady = self.rest(r) + self.map(w, y)
        command = np.array([min(max(p, LOW), HIGH) for p in steady + self.map(damping, y)])
        back = self.unmap(np.array([min(max(p, LOW), HIGH) for p in steady]) - steady, y)
        for i, name in enumerate(SPACES[self.s.space]):
            tracking = min(DT / self.s.tracking_time, 1.0) if self.s.tracking_time else 1.0
            self.integral[i] += DT * self.s.gains[name].ki * (x[i] - zy[i]) + tracking * back[i]
        return command


@pytest.fixture(scope="module")
def spec() -> eq.PlantSpec:
    leg = eq.nominal_leg()
    return make_spec(leg, DT, leg)


def seen(time: float, position: Sequence[float], command: Sequence[float] = (0.0, 0.0)) -> eq.Observation:
    """What the controller is shown."""
    return eq.Observation(time, np.array(position), time, np.array(command), np.zeros(2, dtype=bool))


def drive(
    settings: eq.PidSettings, spec: eq.PlantSpec, path: np.ndarray, wanted: np.ndarray, command: Sequence[float]
) -> tuple[np.ndarray, Any]:
    """Commands (n, 2) along measured ``path`` (n, 2) and reference ``wanted`` (n, 2), and the last state."""
    controller = eq.PidController(settings)
    state = controller.init(spec, seen(0.0, path[0], command))
    out = []
    for k, (y, r) in enumerate(zip(path, wanted, strict=True)):
        p, state = controller.step(seen(k * DT, y, command), eq.HoldReference(r), state)
        out.append(p)
    return np.array(out), state


def wander(rng: np.random.Generator, n: int, jump: float) -> np.ndarray:
    """A path of angles well inside the workspace, with noise."""
    path = np.cumsum(rng.normal(0, jump, (n, 2)), axis=0)
    return np.array([1.45, 0.5]) + 0.35 * np.tanh(path) + rng.normal(0, 1e-3, (n, 2))


VARIANTS = {
    "default": {},
    "no feed-forward": {"feedforward": False},
    "weights": {"proportional_weight": 0.4, "derivative_weight": 0.0},
    "weights above 1": {"proportional_weight": 1.3, "derivative_weight": 0.7, "feedforward": False},
    "no blend": {"start_time": 0.0},
    "raw derivative": {"derivative_time": 0.0},
    "tight anti-windup": {"tracking_time": 0.004},
    "no anti-windup time": {"tracking_time": 0.0},
    "late": {"lateness": 0.2},
    "late, weights": {"lateness": 0.2, "proportional_weight": 0.6, "derivative_weight": 0.3},
}


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
@pytest.mark.parametrize("space", SPACES)
def test_commands_follow_the_law(spec: eq.PlantSpec, space: str, variant: str) -> None:
    rng = np.random.default_rng(len(variant))
    settings = replace(SETTINGS[space], **VARIANTS[variant])
    path, wanted = wander(rng, 150, 0.03), wander(rng, 150, 0.05)
    before = np.array([12e3, 7e3])
    paper = PaperPid(settings)
    paper.start(path[0], before, wanted[0])
    expected = np.array([paper.step(k * DT, y, r) for k, (y, r) in enumerate(zip(path, wanted, strict=True))])
    found, _ = drive(settings, spec, path, wanted, before)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)  # of up to 50 000 Pa
    limited = (expected == LOW) | (expected == HIGH)
    assert not limited.all()
    if variant in ("tight anti-windup", "raw derivative", "default"):
        assert limited.any(), "the path should bring the commands to a limit too"


@given(
    st.tuples(*[st.floats(0.0, 1e3)] * 6),
    st.floats(0.001, 0.5),
    st.floats(0.0, 1.5),
    st.floats(0.0, 1.5),
    st.booleans(),
    st.sampled_from(sorted(SPACES)),
    st.integers(0, 2**31),
)
def test_any_gains_start_without_a_bump(
    gains: tuple[float, ...], tf: float, b: float, c: float, ff: bool, space: str, seed: int
) -> None:
    """The first command is the one in force, wherever the leg is, whatever the reference asks for."""
    leg = eq.nominal_leg()
    rng = np.random.default_rng(seed)
    command = rng.uniform(LOW, HIGH, 2)
    pose = rng.uniform([0.7, 0.1], [2.0, 1.4])
    settings = eq.PidSettings(
        gains_for(space, gains[:3], gains[3:]), space, tf, proportional_weight=b, derivative_weight=c, feedforward=ff
    )
    controller = eq.PidController(settings)
    first = seen(0.0, pose, command)
    wanted = eq.HoldReference(rng.uniform([0.7, 0.1], [2.0, 1.4]))
    found, _ = controller.step(first, wanted, controller.init(make_spec(leg, DT, leg), first))
    np.testing.assert_allclose(found, command, rtol=0, atol=1e-5)


@pytest.mark.parametrize("noise", [0.0, 0.003])
@pytest.mark.parametrize("space", SPACES)
def test_a_run_starts_without_a_bump(space: str, noise: float) -> None:
    command = np.array([14e3, 9e3])
    run = eq.run(
        eq.MujocoPlant(eq.nominal_model(), noise=noise),
        eq.PidController(SETTINGS[space]),
        eq.HoldReference([1.3, 0.6]),
        0.05,
        start=eq.Start(command=command),
        seed=3,
    )
    np.testing.assert_allclose(run.command[0], command, rtol=0, atol=1e-6)
    if noise == 0:
        # The pose fades out slowly, so the second command stays near too: no kick from the derivative.
        assert np.abs(run.command[1] - command).max() < 50


@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0])
def test_no_kick_at_the_start_with_any_derivative_weight(spec: eq.PlantSpec, weight: float) -> None:
    still = np.tile([1.4, 0.5], (3, 1))
    settings = replace(SETTINGS["length"], derivative_weight=weight)
    commands, _ = drive(settings, spec, still, still + 0.3, (14e3, 9e3))
    assert np.abs(commands - [14e3, 9e3]).max() < 100


def test_blend_goes_smoothly_from_one_to_zero() -> None:
    assert pid_kernel.blend(0.0, 0.3) == 1.0
    assert pid_kernel.blend(0.15, 0.3) == pytest.approx(0.5)
    assert pid_kernel.blend(0.3, 0.3) == pid_kernel.blend(9.0, 0.3) == 0.0
    assert pid_kernel.blend(0.0, 0.0) == 0.0
    weights = np.array([pid_kernel.blend(t, 0.3) for t in np.linspace(0, 0.3, 301)])
    assert np.all(np.diff(weights) <= 0)
    speed = np.diff(weights) / 1e-3
    assert abs(speed[0]) < 0.05 and abs(speed[-1]) < 0.05 and speed.min() == pytest.approx(-1.875 / 0.3, rel=1e-3)


def test_feed_forward_is_the_pressure_that_holds_the_reference(spec: eq.PlantSpec) -> None:
    """Without gains, a start at rest leaves nothing but the static pressures, clipped to the range."""
    kinematics = eq.Kinematics(eq.nominal_leg())
    pose = kinematics.equilibrium([16e3, 12e3])
    nothing = eq.PidSettings(gains_for("length", (0, 0, 0), (0, 0, 0)), start_time=0.0)
    targets = np.array([kinematics.equilibrium(p) for p in ([14e3, 4e3], [20e3, 16e3], [11e3, 11e3])] + [[1.2, 0.2]])
    commands, _ = drive(nothing, spec, np.tile(pose, (4, 1)), targets, kinematics.static_pressure(pose))
    for command, target in zip(commands, targets, strict=True):
        np.testing.assert_allclose(command, np.clip(kinematics.static_pressure(target), LOW, HIGH), atol=1e-4)
        np.testing.assert_allclose(command, np.clip(resting(target), LOW, HIGH), atol=1e-4)
    np.testing.assert_allclose(commands[1], [20e3, 16e3], atol=1e-3)
    assert commands[3, 0] == LOW or commands[3].max() == HIGH


def test_without_integral_gain_a_saturation_is_forgotten(spec: eq.PlantSpec) -> None:
    """A PD law has no memory but its derivative's: after a second at a limit it asks for the same as before."""
    settings = eq.PidSettings(gains_for("length", (200, 0, 0), (200, 0, 0)), start_time=0.0)
    pose = eq.Kinematics(eq.nominal_leg()).equilibrium([14e3, 4e3])
    wanted = np.concatenate([[pose], np.tile([1.2, 0.2], (120, 1)), [pose]])
    commands, _ = drive(settings, spec, np.tile(pose, (122, 1)), wanted, (14e3, 4e3))
    np.testing.assert_allclose(commands[-1], commands[0], atol=1.0)


def test_the_derivative_is_a_first_order_filter(spec: eq.PlantSpec) -> None:
    """Of a ramp of slope m, D after n steps is −m (1 − (T_f/(T_f + dt))ⁿ)."""
    kd, tf, ramp, n = 0.2, 0.05, 0.8, 40
    settings = eq.PidSettings(
        gains_for("joint", (0, 0, kd), (0, 0, 0)), "joint", derivative_time=tf, start_time=0.0, feedforward=False
    )
    path = np.array([[1.2 + ramp * k * DT, 0.5] for k in range(n)])
    before = np.array([25e3, 20e3])
    commands, _ = drive(settings, spec, path, np.tile(path[0], (n, 1)), before)
    torque = np.array([(moment_arms(y).T * AREAS) @ p for y, p in zip(path, commands, strict=True)])
    steps = np.arange(n)
    expected = torque[0, 0] - kd * ramp * (1 - (tf / (tf + DT)) ** steps)
    np.testing.assert_allclose(torque[:, 0], expected, rtol=0, atol=1e-9)
    np.testing.assert_allclose(torque[:, 1], torque[0, 1], rtol=0, atol=1e-9)


def test_a_longer_filter_lets_less_noise_through(spec: eq.PlantSpec) -> None:
    noise = np.array([1.4, 0.5]) + np.random.default_rng(0).normal(0, 1e-4, (200, 2))
    spread = []
    for tf in (0.0, 0.02, 0.1):
        settings = replace(SETTINGS["length"], derivative_time=tf, gains=gains_for("length", (0, 0, 10), (0, 0, 10)))
        spread.append(drive(settings, spec, noise, np.tile([1.4, 0.5], (200, 1)), (20e3, 20e3))[0].std())
    assert spread[0] > 3 * spread[1] > 9 * spread[2]


def longer(pose: np.ndarray, by: float) -> np.ndarray:
    """A change of pose that lengthens both actuators by about as much [m]."""
    return np.linalg.solve(moment_arms(pose), [by, by])


def _wound_up(spec: eq.PlantSpec, tracking_time: float) -> tuple[int, np.ndarray]:
    """Steps at the upper limit after an impossible reference has gone, and the integral just before that."""
    settings = eq.PidSettings(
        gains_for("length", (100, 400, 0), (100, 400, 0)),
        tracking_time=tracking_time,
        start_time=0.0,
        feedforward=False,
    )
    pose = np.array([1.4, 0.5])
    far, near = pose + longer(pose, 0.02), pose - longer(pose, 0.002)
    wound = np.array([far] * 1200)
    commands, state = drive(settings, spec, np.tile(pose, (1200, 1)), wound, (20e3, 20e3))
    assert np.all(commands[-1] == HIGH)
    controller, held = eq.PidController(settings), 0
    integral = state.memory[pid_kernel.INTEGRAL].copy()
    while held < 5000:
        p, state = controller.step(seen((1200 + held) * DT, pose), eq.HoldReference(near), state)
        if p[0] < HIGH:
            break
        held += 1
    return held, integral


def test_anti_windup_forgets_a_long_saturation(spec: eq.PlantSpec) -> None:
    """Back-calculation holds the integral where dt k_i e equals (dt/T_t) of the excess; without it, it grows on."""
    slow, without = _wound_up(spec, 1e9)
    fast, bounded = _wound_up(spec, 0.1)
    assert slow > 600 and fast < 20
    pose = np.array([1.4, 0.5])
    error = np.real(lengths(*(pose + longer(pose, 0.02)))) - np.real(lengths(*pose))
    np.testing.assert_allclose(bounded, HIGH * np.array(AREAS) - 100 * error + 0.1 * 400 * error, rtol=1e-6)
    assert np.all(without > 2 * bounded)


def test_a_robot_on_time_and_one_that_is_late_meet_no_feedback(spec: eq.PlantSpec) -> None:
    """Anywhere between both references there is no error; beyond them errors count from the nearer one."""
    gains = gains_for("joint", (3.0, 4.0, 0.2), (2.0, 1.5, 0.1))
    fed = eq.PidSettings(gains, "joint", lateness=0.15)
    first, n = np.array([1.45, 0.5]), 80
    wanted = np.tile([1.4, 0.56], (n, 1))
    without = replace(fed, gains=gains_for("joint", (0, 0, 0), (0, 0, 0)))

    def behind(late: float) -> np.ndarray:
        fade = np.array([pid_kernel.blend(k * DT, 0.3 + 2 * late) for k in range(n)])[:, None]
        return np.asarray(wanted + fade * (first - wanted))

    before = resting(first)
    for late in (0.0, 0.06, 0.15):
        path = behind(late)
        np.testing.assert_allclose(
            drive(fed, spec, path, wanted, before)[0], drive(without, spec, path, wanted, before)[0], atol=1e-3
        )
    for late, nearer in ((0.3, 0.15), (-0.1, 0.0)):
        one = drive(fed, spec, behind(late), wanted, before)[0]
        nothing = drive(without, spec, behind(late), wanted, before)[0]
        assert np.abs(one - nothing).max() > 100
        # As a PID that knows the nearer reference alone, but for what is fed forward.
        known = replace(fed, lateness=0.0, start_time=0.3 + 2 * nearer)
        other = drive(known, spec, behind(late), wanted, before)[0]
        idle = drive(replace(without, start_time=known.start_time), spec, behind(late), wanted, before)[0]
        free = np.all([np.all((x > LOW) & (x < HIGH), axis=1) for x in (one, nothing, other, idle)], axis=0)
        assert free.mean() > 0.8
        np.testing.assert_allclose((one - nothing)[free], (other - idle)[free], atol=1e-3)


def test_noise_that_a_limit_cuts_off_does_not_move_the_integral(spec: eq.PlantSpec) -> None:
    """The derivative passes noise on; half of it lies beyond a limit that the command is at, and that half has a mean."""
    pose = np.array([1.4, 0.5])
    settings = eq.PidSettings(
        gains_for("length", (0, 1e-9, 20), (0, 1e-9, 20)), derivative_time=0.01, tracking_time=0.05, feedforward=False
    )
    noisy = pose + np.random.default_rng(0).normal(0, 2e-3, (240, 2))
    commands, state = drive(settings, spec, noisy, np.tile(pose, (240, 1)), (LOW, LOW))
    assert (commands == LOW).mean() > 0.3 and commands.max() > 1e3
    assert np.abs(state.memory[pid_kernel.INTEGRAL]).max() < 1e-3


def test_steps_repeat_and_leave_their_state_alone(spec: eq.PlantSpec) -> None:
    controller = eq.PidController(SETTINGS["length"])
    first = seen(0.0, [1.4, 0.5], (14e3, 9e3))
    begin = controller.init(spec, first)
    later = seen(DT, [1.41, 0.52], (14e3, 9e3))
    _, state = controller.step(first, eq.HoldReference([1.2, 0.4]), begin)
    kept = state.memory.copy()
    one, after = controller.step(later, eq.HoldReference([1.2, 0.4]), state)
    two, again = controller.step(later, eq.HoldReference([1.2, 0.4]), state)
    assert np.array_equal(one, two) and np.array_equal(after.memory, again.memory)
    assert np.array_equal(state.memory, kept)
    assert not one.flags.writeable


def test_it_moves_the_leg_to_where_it_should_be() -> None:
    """Integral action on a leg whose numbers the controller does not know: no error is left at rest."""
    leg = eq.nominal_leg()
    other = leg.with_parameters({"maa.stiffness": 290.0, "baa.area": 0.0004, "calf.mass": 0.12})
    run = eq.run(
        eq.MujocoPlant(eq.Model(other), nominal=leg),
        eq.PidController(SETTINGS["length"]),
        eq.HoldReference([1.35, 0.55]),
        9.0,
    )
    np.testing.assert_allclose(run.position[-1], [1.35, 0.55], atol=1.5e-3)


# Settings.

NUMBERS = st.floats(0.0, 1e6, allow_subnormal=False)
NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), min_size=1, max_size=12)


@given(
    st.dictionaries(NAMES, st.builds(eq.PidGains, NUMBERS, NUMBERS, NUMBERS), min_size=1, max_size=4),
    st.sampled_from(sorted(SPACES)),
    st.tuples(*[NUMBERS] * 5),
    st.sampled_from([(False, False), (True, False), (True, True)]),
)
def test_settings_survive_toml(
    gains: dict[str, eq.PidGains], space: str, numbers: tuple[float, ...], fed: tuple[bool, bool]
) -> None:
    settings = eq.PidSettings(gains, space, *numbers, *fed)  # type: ignore[arg-type]
    text = presets.toml_text(settings.to_dict(), "written by a test")
    assert eq.PidSettings.from_dict(tomllib.loads(text)) == settings


def test_whole_numbers_will_do() -> None:
    data = tomllib.loads("derivative_time = 0\n[gains.maa]\nkp = 5\n[gains.baa]\nkp = 1\nki = 2\nkd = 3\n")
    settings = eq.PidSettings.from_dict(data)
    assert settings.gains == {"maa": eq.PidGains(5.0), "baa": eq.PidGains(1.0, 2.0, 3.0)}
    assert isinstance(settings.gains["maa"].kp, float)
    assert settings.space == "length" and settings.feedforward is True


def test_the_tuned_settings_of_the_repository_load() -> None:
    path = presets.find("controllers", "pid.toml")
    assert path is not None
    settings = eq.PidSettings.from_dict(presets.read_toml(path), str(path))
    assert settings.gain_matrix(settings.channels(eq.nominal_leg())).shape == (7, 2)


GOOD: dict[str, Any] = {"format": FORMAT, "gains": {"maa": {"kp": 1.0}, "baa": {"kp": 1.0}}}
WRONG = {
    "format": ({"format": "equimus-ctrl/pid/9"}, "f.toml: format is 'equimus-ctrl/pid/9', expected '" + FORMAT + "'"),
    "unknown key": ({"derivativ_time": 1}, "f.toml: there is no key 'derivativ_time'; did you mean 'derivative_time'?"),
    "text": ({"tracking_time": "0.2"}, "f.toml: tracking_time is '0.2', expected a number"),
    "boolean for a number": ({"start_time": True}, "f.toml: start_time is True, expected a number"),
    "number for a boolean": ({"feedforward": 1}, "f.toml: feedforward is 1, expected true or false"),
    "text for a boolean": ({"inverse": "yes"}, "f.toml: inverse is 'yes', expected true or false"),
    "nothing to feed": ({"feedforward": False, "inverse": True}, "f.toml: inverse is true, which is a way to feed"),
    "negative": ({"derivative_time": -0.1}, "f.toml: derivative_time is -0.1, expected a finite number of at least 0"),
    "NaN": ({"proportional_weight": math.nan}, "f.toml: proportional_weight is nan, expected a finite number"),
    "infinite": ({"derivative_weight": math.inf}, "f.toml: derivative_weight is inf, expected a finite number"),
    "space": ({"space": "lengths"}, "f.toml: there is no PID space 'lengths'; did you mean 'length'? (known: joint,"),
    "space of another kind": ({"space": 3}, "f.toml: there is no PID space '3' (known: joint, length)"),
    "no gains": ({"gains": None}, "f.toml: there is no [gains.<channel>] table"),
    "empty gains": ({"gains": {}}, "f.toml: there is no [gains.<channel>] table"),
    "gains a number": ({"gains": 3}, "f.toml: there is no [gains.<channel>] table"),
    "gains without channels": ({"gains": {"kp": 3}}, "f.toml: gains.kp is 3, expected a table with kp, ki and kd"),
    "gain unknown": (
        {"gains": {"maa": {"kp": 1, "kii": 2}}},
        "f.toml: gains.maa: there is no key 'kii'; did you mean 'ki'?",
    ),
    "gain text": ({"gains": {"maa": {"kp": "1"}}}, "f.toml: gains.maa: kp is '1', expected a number"),
    "gain boolean": ({"gains": {"maa": {"kp": False}}}, "f.toml: gains.maa: kp is False, expected a number"),
    "gain negative": ({"gains": {"maa": {"kp": -1}}}, "f.toml: gains.maa: kp is -1, expected a finite number of at"),
    "gain NaN": ({"gains": {"maa": {"kp": 1, "kd": math.nan}}}, "f.toml: gains.maa: kd is nan, expected a finite"),
    "no kp": ({"gains": {"maa": {"ki": 1}}}, "f.toml: gains.maa: 'kp' is missing"),
}


@pytest.mark.parametrize("case", WRONG, ids=str)
def test_a_wrong_setting_is_named(case: str) -> None:
    change, sentence = WRONG[case]
    with pytest.raises(eq.ConfigError) as caught:
        eq.PidSettings.from_dict({**GOOD, **change}, "f.toml")
    assert str(caught.value).startswith(sentence) and "\n" not in str(caught.value)


def test_gains_must_be_those_of_the_robot(spec: eq.PlantSpec) -> None:
    one = eq.PidGains(1.0)
    for gains, sentence in (
        ({"maa": one}, "channel 'baa' has none (given: maa)"),
        ({"maa": one, "baa": one, "caa": one}, "there is no length channel 'caa'; did you mean"),
        ({"hip": one, "knee": one}, "there is no length channel 'hip' (known: baa, maa)"),
    ):
        with pytest.raises(eq.ConfigError, match="PID gains") as caught:
            eq.PidController(eq.PidSettings(gains)).init(spec, seen(0.0, [1.4, 0.5]))
        assert sentence in str(caught.value)


def test_a_robot_it_cannot_drive_is_refused(spec: eq.PlantSpec) -> None:
    first = seen(0.0, [1.4, 0.5])
    with pytest.raises(eq.ControllerError, match="nominal model, and this plant carries none"):
        eq.PidController(SETTINGS["length"]).init(replace(spec, model=None), first)
    lame = replace(spec, actuators=("maa",))
    with pytest.raises(eq.ControllerError, match=r"at least as many actuators as joints.* has 1 for 2.*length"):
        eq.PidController(SETTINGS["joint"]).init(lame, first)
    late = replace(SETTINGS["joint"], decoupled=True, lateness=0.1)
    with pytest.raises(
        eq.ConfigError, match=r"lateness is 0\.1 s, which is of a PID that is not decoupled .* expected 0"
    ):
        eq.PidController(late).init(spec, first)


def test_the_gain_matrix_has_the_kernels_rows() -> None:
    settings = eq.PidSettings(gains_for("length", (1, 2, 3), (4, 5, 6)), "length", 0.1, 0.2, 0.3, 0.4)
    expected = [[1, 4], [2, 5], [3, 6], [0.1] * 2, [0.2] * 2, [0.3] * 2, [0.4] * 2]
    np.testing.assert_array_equal(settings.gain_matrix(("maa", "baa")), expected)
    np.testing.assert_array_equal(settings.gain_matrix(("baa", "maa"))[:, ::-1], expected)


def test_a_channel_may_have_a_tracking_time_of_its_own() -> None:
    plain = eq.PidSettings(gains_for("length", (1, 2, 3), (4, 5, 6)), tracking_time=0.2)
    own = replace(plain, gains={**plain.gains, "baa": replace(plain.gains["baa"], tracking_time=0.05)})
    found = eq.PidSettings.from_dict(own.to_dict())
    assert found == own
    np.testing.assert_array_equal(found.gain_matrix(("maa", "baa"))[pid_kernel.TRACKING], [0.2, 0.05])
    with pytest.raises(
        eq.ConfigError, match=r"gains\.baa: tracking_time is -1, expected a finite number of at least 0"
    ):
        eq.PidSettings.from_dict({"gains": {"baa": {"kp": 1.0, "tracking_time": -1.0}}})
