"""Designed trials: they keep the limits, decide what can be decided, say what cannot, and come out the same again."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from mjcf_models import refusal
from rival_legs import delays, frictions

from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import ConfigError, ModelError, NothingFeasible
from equimus_ctrl.experiments import forecast as forecast_module
from equimus_ctrl.experiments import ground as ground_module
from equimus_ctrl.experiments.conditions import known_conditions
from equimus_ctrl.experiments.design import designed, told_pairs
from equimus_ctrl.experiments.families import families
from equimus_ctrl.experiments.ground import Ground
from equimus_ctrl.experiments.limits import Limits
from equimus_ctrl.experiments.predicted import Commands
from equimus_ctrl.experiments.results import Designed
from equimus_ctrl.experiments.separation import separations
from equimus_ctrl.models.model import Model

RANGE = {"drive.low": "-1.2", "drive.high": "1.2", "duration": "2.5"}


def limits_of_the_pendulum(**more: str) -> Limits:
    given = {key.replace("_", "."): value for key, value in more.items()}
    return Limits.read(frictions().model.robot, None, {**RANGE, **given})


def quickly(rivals: Rivals, limits: Limits, evaluations: int, draws: int) -> Designed:
    """A design of steps from few that are tried."""
    return designed(
        rivals, limits, over_families=families(["steps"]), evaluations=evaluations, draws=draws, refits=2,
        simulator=rivals.simulator(1),
    )  # fmt: skip


@cache
def design(seed: int = 0) -> Designed:
    return designed(
        frictions(), limits_of_the_pendulum(), over_families=families(["steps", "triangle"]), seed=seed,
        evaluations=30, draws=19, refits=8, simulator=frictions().simulator(1),
    )  # fmt: skip


@pytest.mark.slow
def test_a_design_decides_between_two_frictions() -> None:
    found = design()
    (pair,) = found.pairs
    assert pair.ending in ("one trial", "repeats") and found.separates == (pair,) and not found.inseparable
    assert pair.harder.gap > 10 and pair.harder.interval[0] < pair.harder.gap < pair.harder.interval[1]
    assert {own.family for own in found.tried} == {"steps", "triangle"}
    assert found.evaluations == sum(own.evaluations for own in found.tried) >= 30
    assert found.leaves_with == 1 / 20


@pytest.mark.slow
def test_it_does_better_than_what_comes_to_mind() -> None:
    """A step of half the range, up and down."""
    found, rivals = design(), frictions()
    plain = Commands(np.array([0.0, 0.5, 1.2, 2.0]), np.array([[0.0], [0.6], [-0.6], [0.0]]), 2.5)
    gaps = [own.distance(0, 1) for own in separations(rivals, [found.commands, plain], simulator=rivals.simulator(1))]
    assert gaps[0] > 1.5 * gaps[1]


@pytest.mark.slow
def test_the_same_seed_gives_the_same_bits() -> None:
    design.cache_clear()
    first = design()
    design.cache_clear()
    again = design()
    assert first is not again
    assert first.commands.commands.tobytes() == again.commands.commands.tobytes()
    assert first.to_dict() == again.to_dict()


def test_commands_begin_and_end_at_rest_within_their_range() -> None:
    rows = design().commands.commands
    times = design().commands.times
    assert np.all(rows[times <= 0.5] == rows[0]) and np.all(rows[times >= 2.0] == rows[0])
    assert rows.min() >= -1.2 and rows.max() <= 1.2 and np.ptp(rows) > 0.2


def test_no_draw_leaves_the_limits_and_tight_ones_shrink_the_design() -> None:
    rivals, tight = frictions(), limits_of_the_pendulum(hinge_high="0.3", hinge_low="-0.3", hinge_margin="0")
    found = quickly(rivals, tight, 15, 19)
    assert not found.excess.left and -0.5 < found.excess.worst <= 0
    ground = Ground.of(rivals, tight, found.condition, rivals.simulator(1))
    models = [own.model_at(t) for own in rivals.rivals for t in own.draws(np.random.default_rng([0, 1]), 19)]
    (motions,) = ground.crowd(models).motions([found.commands])
    assert not tight.excess(motions).left
    assert np.abs(motions.position).max() <= 0.3 < np.abs(design().commands.commands).max()


def test_a_course_is_shrunk_until_all_of_many_stay_within() -> None:
    rivals, tight = frictions(), limits_of_the_pendulum(hinge_high="0.3", hinge_low="-0.3", hinge_margin="0")
    ground = Ground.of(rivals, tight, known_conditions((), rivals.model)[0], rivals.simulator(1))
    models = [own.model_at(t) for own in rivals.rivals for t in own.draws(np.random.default_rng(3), 10)]
    crowd = ground.crowd(models)
    course = families(["steps"])[0].commands(np.full(10, 0.9), ground.times, ground.bounds)
    share, excess = crowd.within(course)
    assert 0 < share < 1 and not excess.left
    (more,) = crowd.motions([ground.trial(ground.rest + (share + 0.03) * (course - ground.rest))])
    assert tight.excess(more).left


def test_models_that_rest_nowhere_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    rivals = delays()
    ground = Ground.of(
        rivals, Limits.read(rivals.model.robot), known_conditions((), rivals.model)[0], rivals.simulator(1)
    )
    models, real = [own.model for own in rivals.rivals], ground_module.rest_pose

    def rest_pose(model: Model, *args: Any) -> Any:
        if model is models[0]:
            raise ModelError("it rests nowhere")
        return real(model, *args)

    whole = ground.crowd(models)
    monkeypatch.setattr(ground_module, "rest_pose", rest_pose)
    monkeypatch.setattr(ground_module, "as_noted", lambda model, notes: model)
    left = ground.crowd(models)
    assert left.models == tuple(models[1:]) and np.array_equal(left.starts, whole.starts[1:])
    with pytest.raises(ModelError, match="nowhere"):
        ground.crowd(models[:1])


@cache
def late() -> Designed:
    rivals = delays()
    return quickly(rivals, Limits.read(rivals.model.robot, None, {"duration": "2.5"}), 12, 9)


def test_what_rests_nowhere_is_not_in_a_forecast(monkeypatch: pytest.MonkeyPatch) -> None:
    real, first = ground_module.rest_pose, [True]

    def rest_pose(*args: Any) -> Any:
        if first and first.pop():
            raise ModelError("it rests nowhere")
        return real(*args)

    monkeypatch.setattr(forecast_module, "DRAWS", 4)
    whole = forecast_module.forecast(late(), delays().simulator(1))
    monkeypatch.setattr(ground_module, "rest_pose", rest_pose)
    found = forecast_module.forecast(late(), delays().simulator(1))
    assert np.isnan(found.middle[0]).all() and np.array_equal(found.middle[1:], whole.middle[1:])
    assert np.array_equal(found.low, whole.low) and np.array_equal(found.high, whole.high)


def test_late_sensors_and_late_valves_are_inseparable_and_a_pressure_sensor_is_named() -> None:
    found = late()
    (pair,) = found.inseparable
    assert pair.places == (0, 1) and pair.harder.repeats == np.inf and pair.harder.chance < 0.05
    best = found.remedies[0, 1][0]
    assert best.kind == "sensor" and best.name.startswith(("pressure.", "vel."))
    by_name = {own.name: own for own in found.remedies[0, 1]}
    assert by_name["pressure.maa"].gap > 100 > 1 > by_name["pressure.maa"].without
    assert by_name["pressure.maa"].unit == "Pa" and by_name["pressure.maa"].noise == 500.0
    assert by_name["maa.stiffness"].gap < 1
    assert found.settles(by_name["pressure.maa"]) and not found.settles(by_name["maa.stiffness"])


def test_a_condition_is_taken_where_it_helps() -> None:
    """Dry friction at the hinge, or a friction that is twice as large where twice the weight hangs there: none here."""
    rivals = frictions()
    limits = limits_of_the_pendulum()
    conditions = known_conditions(["payload:tip=0.3"], rivals.model)
    found = designed(
        rivals, limits, conditions=conditions, over_families=families(["steps"]), evaluations=24, draws=9, refits=2,
        simulator=rivals.simulator(1),
    )  # fmt: skip
    assert {own.condition for own in found.tried} == {"", "payload:tip=0.3"}
    assert found.commands.notes == found.condition.notes


def test_a_payload_changes_what_is_predicted() -> None:
    rivals = frictions()
    commands = design().commands
    loaded = replace(commands, notes={"payload.tip": "0.3"})
    plain, other = separations(rivals, [commands, loaded], simulator=rivals.simulator(1))
    assert other.gap(0, 1) != pytest.approx(plain.gap(0, 1), rel=0.02)


def test_time_ends_a_search_with_its_best_so_far() -> None:
    rivals, asked = frictions(), iter([False, False, False, True, *[True] * 99])
    found = designed(
        rivals, limits_of_the_pendulum(), over_families=families(["steps"]), evaluations=10_000, draws=5, refits=2,
        over=lambda: next(asked), simulator=rivals.simulator(1),
    )  # fmt: skip
    assert found.timed_out and found.evaluations < 100 and found.pairs


def test_what_cannot_be_designed_is_one_sentence() -> None:
    rivals = frictions()
    alone = replace(rivals, rivals=rivals.rivals[:1])
    assert "leaves one explanation (coulomb_friction at hinge)" in refusal(
        lambda: designed(alone, limits_of_the_pendulum())
    )
    still = limits_of_the_pendulum(hinge_rate="1e-9")
    with pytest.raises((NothingFeasible, ConfigError), match="limits"):
        designed(rivals, still, over_families=families(["steps"]), evaluations=15, simulator=rivals.simulator(1))


def test_of_many_each_is_told_from_the_first() -> None:
    rivals = frictions()
    many = replace(rivals, rivals=rivals.rivals * 3)
    assert len(told_pairs(rivals)) == 2
    assert told_pairs(many) == [*((0, k) for k in range(1, 6)), *((k, 0) for k in range(1, 6))]
