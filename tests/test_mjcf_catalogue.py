"""Every effect of MJCF robots: seen where it is something, not where it is nothing, and told in its units; and one's own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from effect_cases import CASES
from mjcf_models import BARE, DT, HINGES, RIG, M, Ran, cart, run, swinging
from scipy.integrate import solve_ivp

from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.results import Estimate, Evidence, Finding
from equimus_ctrl.effects import REGISTRY, Effect, ForceEffect, ShapingEffect, catalogue, parameter, register
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.errors import EquimusError
from equimus_ctrl.identification.parameters import unit_of
from equimus_ctrl.models.model import Model
from equimus_ctrl.report.diagnosis_sentences import sentence
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

# --- every effect there is --------------------------------------------------------------------------------------

AT = {
    "shoulder": {"joint": "shoulder", "actuator": "lift", "foot": "tip", "link": "arm", "base": "base"},
    "reach": {"joint": "reach", "actuator": "push", "foot": "tip", "link": "rod", "base": "base"},
}


def rig(name: str, joint: str) -> MjcfRobot | None:
    """One that can have an effect there."""
    cls = REGISTRY[name]
    kind = cls.sits_at[0]
    return next((robot for robot in (RIG, BARE, HINGES) if AT[joint][kind] in cls.places_on(robot)[kind]), None)


def strong(name: str, joint: str) -> Effect:
    """With strong numbers, at the shoulder or at the reach."""
    cls, numbers = REGISTRY[name], CASES[name].mjcf
    assert numbers is not None, f"give effect_cases numbers of {name} for MJCF robots"
    return cls(AT[joint][cls.sits_at[0]], **numbers)


def seen(model: Model) -> Array:
    (found,) = simulate_mjcf([model], [swinging(until=3.0)], threads=1)
    assert found.sound.all()
    return found.position[0]


@pytest.mark.parametrize("name", sorted(catalogue("mjcf")))
def test_every_effect_is_seen(name: str) -> None:
    effect, robot = strong(name, "shoulder"), rig(name, "shoulder")
    assert robot is not None
    change = np.abs(seen(Model(robot, (effect,))) - seen(Model(robot)))
    assert change[:, 0].max() > 0.03


@pytest.mark.parametrize("name", sorted(n for n, c in catalogue("mjcf").items() if c.grows_from() is not None))
def test_effects_that_are_nothing_change_nothing(name: str) -> None:
    """With the first parameter at where they grow from."""
    cls = REGISTRY[name]
    first = next(iter(cls.parameter_info()))
    grown = cls.grows_from()
    assert grown is not None
    values = strong(name, "shoulder").parameters() | {first: grown}
    if issubclass(cls, ForceEffect):
        values |= dict(cls.neutral)
    effect, robot = cls(AT["shoulder"][cls.sits_at[0]], **values), rig(name, "shoulder")
    assert robot is not None
    change = np.abs(seen(Model(robot, (effect,))) - seen(Model(robot)))
    # A drive without play still has a spring, of a few physics steps.
    assert change.max() < (5e-3 if name == "drive_play" else 1e-10)


def finding(model: Model) -> Finding:
    (effect,), (prefix,) = model.effects, model.effect_prefixes()
    values = effect.parameters()
    estimates = {key: Estimate(v, 0.9 * v, 1.1 * v, unit_of(model, prefix + key)) for key, v in values.items()}
    part = Part(Candidate(type(effect), (effect.location,), (values,)), values)
    return Finding(part, estimates, Evidence(800.0, 25.0, -170.0, 200.0, 0.9, 0.9))


@pytest.mark.parametrize("joint", ["shoulder", "reach"])
@pytest.mark.parametrize("name", sorted(catalogue("mjcf")))
def test_every_effect_has_a_sentence_in_its_units(name: str, joint: str) -> None:
    if (robot := rig(name, joint)) is None:
        pytest.skip("a law of turns alone")
    model = Model(robot, (strong(name, joint),))
    text = sentence(finding(model), model)
    assert text.endswith(".") and "_" not in text and "nan" not in text
    of_the_whole = REGISTRY[name].sits_at == ("base",)
    assert model.effects[0].location in text or of_the_whole
    if robot.slides(joint) and not of_the_whole:
        for wrong in ("rad", "°", "N·m", "angle", "pressure"):
            assert wrong not in text, text


# --- effects of one's own ---------------------------------------------------------------------------------------


def relaxing() -> type[ForceEffect]:
    @register
    @dataclass(frozen=True)
    class Relaxing(ForceEffect):
        """−stiffness·(x − z), dz/dt = (x − z)/time_constant."""

        name = "relaxing_spring"
        robots = ("mjcf",)
        sits_at = ("joint",)
        summary = "a spring whose rest follows"
        n_states = 1
        neutral = {"stiffness": 0.0}  # noqa: RUF012
        stiffness: float = parameter("N·m/rad", 0.0, 1e4, "of the spring")
        time_constant: float = parameter("s", 0.02, 100.0, "of its rest")

        @classmethod
        def force(cls, x, rate, z, p):  # type: ignore[no-untyped-def]
            return -p["stiffness"] * (x - z[0])

        @classmethod
        def state_rate(cls, x, rate, z, p):  # type: ignore[no-untyped-def]
            return ((x - z[0]) / p["time_constant"],)

        @classmethod
        def rest_state(cls, x, p):  # type: ignore[no-untyped-def]
            return (x,)

    return Relaxing


def test_an_effect_of_ones_own_may_have_states() -> None:
    effect = relaxing()("way", 50.0, 0.3)
    found = run(cart(), effect, v=1.0)

    def slope(t: float, x: Array) -> list[float]:
        return [x[1], -50.0 * (x[0] - x[2]) / M, (x[0] - x[2]) / 0.3]

    exact = solve_ivp(slope, (0, 1), [0.0, 1.0, 0.0], t_eval=found.t, rtol=1e-10, atol=1e-12).y[0]
    np.testing.assert_allclose(found.x, exact, rtol=0, atol=2 * DT)
    assert np.abs(exact - found.t).max() > 0.3


def test_states_begin_at_rest_where_a_trial_begins() -> None:
    """As on elastic robots."""
    found = run(cart(), relaxing()("way", 50.0, 0.3), q=0.4)
    np.testing.assert_allclose(found.x, 0.4, rtol=0, atol=1e-12)


def attached(make: Callable[[], Effect]) -> Ran | str:
    """The motion with an effect, or the sentence with which it is refused."""
    try:
        return run(cart(), make(), u=1.0)
    except EquimusError as error:
        return str(error)


def test_a_law_of_commands_of_ones_own_acts_or_is_refused() -> None:
    def make() -> Effect:
        @register
        @dataclass(frozen=True)
        class Half(ShapingEffect):
            name = "half_command"
            robots = ("mjcf",)
            summary = "a share of the command"
            order = 9
            share: float = parameter("1", 0.0, 1.0, "that is left")

            def shape(self, commands: Array, own: int) -> Array:
                return np.asarray(commands[:, own] * self.share)

        return Half("motor", 0.5)

    found = attached(make)
    assert "half_command" in found or "Half" in found if isinstance(found, str) else found.x[-1] < 0.2


def test_a_force_along_an_actuator_of_ones_own_acts_or_is_refused() -> None:
    def make() -> Effect:
        @register
        @dataclass(frozen=True)
        class MotorDrag(ForceEffect):
            name = "motor_drag"
            robots = ("mjcf",)
            sits_at = ("actuator",)
            summary = "drag in a motor"
            neutral = {"drag": 0.0}  # noqa: RUF012
            drag: float = parameter("N·s/m", 0.0, 100.0, "for each speed")

            @classmethod
            def force(cls, x, rate, z, p):  # type: ignore[no-untyped-def]
                return -p["drag"] * rate

        return MotorDrag("motor", 8.0)

    found = attached(make)
    assert "motor_drag" in found or "MotorDrag" in found if isinstance(found, str) else found.x[-1] < 0.2
