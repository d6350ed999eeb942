"""Drives on one supply that exert less, the more all of them ask for."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from coupled_arm import ARM_OF_HINGES, recorded_alone
from mjcf_models import DT, HINGES, RIG, cart, corrected_xml, refusal, swinging

from equimus_ctrl import workflow
from equimus_ctrl.effects import MotorDeadZone, SupplySag
from equimus_ctrl.effects.valves import shaped_commands
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.models.model import Model, model_from_dict, model_to_dict
from equimus_ctrl.report.diagnosis_sentences import sentence
from equimus_ctrl.robots.mjcf.robot import MjcfRobot
from equimus_ctrl.types import Array

DROP = 0.02


def test_all_lose_the_share_that_all_of_them_ask_for_and_none_turns_round() -> None:
    asked = np.array([[4.0, -6.0], [-1.0, 0.0], [0.0, 0.0], [30.0, -20.0]])
    left = np.array([[0.8 * 4.0, 0.8 * -6.0], [-0.98, 0.0], [0.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(shaped_commands((SupplySag("base", DROP),), ("a", "b"), asked), left, atol=1e-15)
    dead = shaped_commands((SupplySag("base", DROP), MotorDeadZone("a", 1.0)), ("a", "b"), asked[:1])
    np.testing.assert_allclose(dead, [[(1 - DROP * 9.0) * 3.0, (1 - DROP * 9.0) * -6.0]])


def moved(engine: str, model: Model, share: Array) -> Array:
    """Under commands that are as much smaller, those before the first row included."""
    given = swinging(until=1.5)
    trial = replace(given, commands=given.commands * share[1:], before=given.before * share[0])
    if engine == "reduced":
        return np.asarray(simulate([model], [trial], dt=DT, check=False)[0].position[0])
    return np.asarray(simulate_mjcf([model], [trial], threads=1)[0].position[0])


@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_it_moves_as_under_commands_that_are_as_much_smaller(engine: str) -> None:
    given = swinging(until=1.5)
    share = 1 - DROP * np.abs(np.vstack([given.before, given.commands])).sum(axis=1, keepdims=True)
    assert share.min() < 0.9
    own = moved(engine, Model(HINGES, (SupplySag("base", DROP),)), np.ones_like(share))
    np.testing.assert_allclose(own, moved(engine, Model(HINGES), share), rtol=0, atol=1e-12)
    assert np.abs(own - moved(engine, Model(HINGES), np.ones_like(share))).max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["reduced", "mujoco"])
def test_a_drive_asks_for_no_more_than_its_range_lets_it(engine: str) -> None:
    """MuJoCo clips commands there; where that is switched off they count as they are."""
    limited = '<motor ctrlrange="-2 2" ctrllimited="true"'
    free = HINGES.xml.replace("<option ", "<option><flag clampctrl='disable'/></option><option ")
    given = swinging(until=1.5)
    for xml, most in ((HINGES.xml, 2.0), (free, np.inf)):
        model = Model(MjcfRobot("limited", xml.replace("<motor", limited)), (SupplySag("base", DROP),))
        rows = np.vstack([given.before, given.commands])
        taken = np.clip(rows, -most, most) / np.where(rows == 0, 1.0, rows)
        sagging = moved(engine, Model(HINGES, model.effects), taken)
        np.testing.assert_allclose(moved(engine, model, np.ones_like(taken)), sagging, rtol=0, atol=1e-12)
    assert np.abs(rows).min(axis=1).max() > 2.0


def test_only_several_motors_with_commands_of_one_unit_share_a_supply() -> None:
    motor, servo = '<motor name="motor" joint="way"/>', '<position name="servo" joint="way" kp="10"/>'
    speed = '<velocity name="speed" joint="way" kv="10"/>'
    refused = [RIG, cart(), cart(drive=motor + servo), cart(drive=motor + speed), cart(drive=servo + speed)]
    for robot in refused:
        assert "supply_sag" in refusal(lambda robot=robot: Model(robot, (SupplySag("base", 0.1),)))
    taken = cart(drive=motor + '<motor name="second" joint="way"/>')
    assert Model(taken, (SupplySag("base", 0.1),)).effects


@pytest.mark.parametrize(
    ("robot", "unit"),
    [
        (HINGES, "1/(N·m)"),
        (cart(drive='<motor name="a" joint="way"/><motor name="b" joint="way"/>'), "1/N"),
        (MjcfRobot("e", HINGES.xml.replace("<motor", '<general gainprm="5"')), "1"),
    ],
)
def test_what_is_lost_is_told_for_each_unit_of_the_commands(robot: MjcfRobot, unit: str) -> None:
    from test_mjcf_catalogue import finding

    model = Model(robot, (SupplySag("base", DROP),))
    told = finding(model)
    assert told.parameters["drop"].unit == unit
    each = unit.removeprefix("1/").strip("()")
    assert f"for each {'unit' if each == '1' else each} of all commands" in sentence(told, model)


def test_it_is_kept_in_a_model_file_and_told_as_missing_from_the_xml() -> None:
    model = Model(HINGES, (SupplySag("base", DROP),))
    back = model_from_dict(model_to_dict(model), read_mjcf=lambda *_: HINGES)
    assert back.effects == model.effects
    xml, left = corrected_xml(model)
    assert left == ("supply_sag at base",) and "Not in here: supply_sag at base." in xml
    assert mujoco.MjModel.from_xml_string(xml).nu == 2


def test_its_curve_is_what_is_left_of_forces_over_all_that_is_asked_for() -> None:
    from test_guesses import SEEN

    (curve,) = SupplySag("base", DROP / SEEN.command).curves(HINGES, SEEN)
    assert (curve.x_unit, curve.y_unit, curve.without) == ("N·m", "1", 1.0)
    np.testing.assert_allclose(curve.along[[0, -1]], [0.0, 2 * SEEN.command])
    np.testing.assert_allclose(curve.values, 1 - DROP * curve.along / SEEN.command)


@pytest.mark.long
@pytest.mark.slow
def test_a_diagnosis_names_it_and_no_gain_or_saturation() -> None:
    """Recordings by MuJoCo alone."""
    trials = recorded_alone(4, seed=2, acts=lambda u: u * max(1 - DROP * np.abs(u).sum(), 0.0))
    found = workflow.diagnose(trials, Model(ARM_OF_HINGES), most=1)
    assert [f.named.effect for f in found.findings] == ["supply_sag"] and found.verdict == "explained"
    drop = found.findings[0].parameters["drop"]
    assert drop.low <= DROP <= drop.high and drop.value == pytest.approx(DROP, rel=0.02)
