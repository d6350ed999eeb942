"""Explanations after a trial, which trial is worth making, and how predictions are set beside what became of them."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from rival_legs import of_a_pendulum, rivals_of, with_other

from equimus_ctrl.diagnosis.holdout import Holdout, choose_holdout, split
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import NOTHING, refitted_to, rival_of
from equimus_ctrl.experiments.loop import (
    Belief,
    Predicted,
    Realised,
    belief_of,
    fitted_share,
    held_out,
    hopeless,
    known_from,
    label_of,
    no_longer_left,
    realised,
    unforeseen,
    why,
    why_not,
    with_better,
    worth_making,
)
from equimus_ctrl.experiments.power import Power, margin
from equimus_ctrl.experiments.results import Pair
from equimus_ctrl.models.model import Model
from equimus_ctrl.presets import plain
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Recording


def predicted(chance: float = 0.9, repeats: float = 1.0, gap: float = 50.0, other: str = "b") -> Predicted:
    return Predicted("a", other, gap, 30.0, 80.0, chance, repeats)


def test_beliefs_are_by_how_much_each_is_behind_the_first() -> None:
    now = of_a_pendulum()
    gone = replace(now.rivals[1], effects=(), deviance=math.inf)
    belief = belief_of(now, [gone])
    first, second, last = belief.explanations
    assert first.behind == 0.0 and first.left and first.label == now.rivals[0].label
    # Both have one parameter of their own, so that what it costs is the same.
    assert second.behind == pytest.approx(now.rivals[1].deviance - now.rivals[0].deviance)
    assert last.label == NOTHING and not last.left and math.isinf(last.behind)
    assert belief.left == (first, second)
    assert Belief.from_dict(json.loads(json.dumps(plain(belief.to_dict())))) == belief
    assert "not distinguished from viscous_friction" in str(belief) and f"; no longer left: {NOTHING}" in str(belief)


def test_an_effect_of_known_size_is_another_one_at_another_size() -> None:
    rival = of_a_pendulum().rivals[0]
    assert label_of(rival) == rival.label
    free = tuple(f for f in rival.parameters.free if f.name == "arm.mass")
    given = tuple(f.name for f in rival.parameters.free if f not in free)
    (effect,) = rival.model.effects
    sizes = []
    for size in (0.1, 0.2):
        model = Model(rival.model.robot, (replace(effect, friction=size),))
        parameters = replace(rival.parameters, model=model, free=free)
        own = replace(rival, parameters=parameters, theta=rival.theta[:1], given=given)
        sizes.append(label_of(own))
    assert sizes == [f"{rival.label} (friction 0.1 N·m)", f"{rival.label} (friction 0.2 N·m)"]


def test_what_is_fitted_again_to_the_same_trials_stays_where_it_was(diagnosis: Diagnosis) -> None:
    before = rival_of(diagnosis.base, diagnosis.best.noise)
    once = refitted_to(before, diagnosis)
    assert once.deviance < before.deviance  # that one was made in few steps
    twice = refitted_to(once, diagnosis)
    assert twice.deviance == pytest.approx(once.deviance, abs=1.0)
    assert twice.theta == pytest.approx(once.theta, rel=0.02)


def test_what_a_diagnosis_no_longer_leaves_is_fitted_to_its_trials(diagnosis: Diagnosis) -> None:
    before, now = rivals_of(diagnosis), diagnosis.rivals
    (gone,) = no_longer_left(before, diagnosis, now)
    assert gone.label == NOTHING and gone.deviance > now.rivals[0].deviance + 100
    assert no_longer_left(before, with_other(diagnosis), before) == ()
    assert no_longer_left(None, diagnosis, now) == ()


def test_what_fits_better_than_what_is_named_stays_an_explanation() -> None:
    now = of_a_pendulum()
    first, second = now.rivals
    other = replace(second, effects=(), deviance=first.deviance - 1e3)
    after, gone = with_better(replace(now, rivals=(first,)), [replace(second, deviance=math.inf), other])
    assert [own.label for own in after.rivals] == [first.label, NOTHING] and len(gone) == 1
    assert after.rivals[1].deviance == other.deviance and not after.rivals[1].accepted
    assert len(after.named) == 2  # so experiments do not end with one that is left
    hidden = replace(other, effects=second.effects, given=("hinge.viscous_friction.damping",))
    assert len(with_better(replace(now, rivals=(first,)), [hidden])[0].named) == 2
    assert with_better(now, []) == (now, ())


def test_a_diagnosis_begins_also_at_what_was_left_before() -> None:
    before = of_a_pendulum()
    dry, viscous = known_from(before)
    ((named, values),) = dry.effects
    (effect,) = before.rivals[0].model.effects
    assert str(named) == before.rivals[0].label and values == {"hinge": effect.parameters()}
    assert dry.parameters["arm.mass"] == before.rivals[0].theta[0]
    assert set(viscous.effects[0][1]["hinge"]) == {"damping"}
    assert known_from(None) == ()


def test_a_gap_is_realised_by_what_the_trial_added() -> None:
    before = of_a_pendulum()
    first, second = before.rivals
    pairs = (
        Predicted(first.label, second.label, 40.0, 20.0, 60.0, 0.9, 1.0),
        Predicted(second.label, first.label, 30.0, 10.0, 50.0, 0.8, 1.0),
    )
    grown = replace(first, deviance=first.deviance - 800.0), replace(second, deviance=second.deviance - 765.0)
    (found,) = realised(before, pairs, replace(before, rivals=grown[:1]), grown[1:])
    assert found == Realised(pairs[0], pytest.approx(35.0), True)
    assert Realised.from_dict(json.loads(json.dumps(found.to_dict()))) == found
    (still,) = realised(before, pairs, replace(before, rivals=grown[::-1]))
    assert still.predicted == pairs[1] and still.gap == pytest.approx(-35.0) and not still.settled


def test_what_is_no_longer_asked_for_is_settled_only_where_it_is_excluded() -> None:
    before = of_a_pendulum()
    first, second = before.rivals
    pairs = (Predicted(first.label, second.label, 40.0, 20.0, 60.0, 0.9, 1.0),)
    behind = before.ahead(0, 1)
    needed = margin(before)
    for more, settled in ((needed - 1.0, False), (needed + 1.0, True)):
        other = replace(second, deviance=second.deviance - behind + more)
        (found,) = realised(before, pairs, replace(before, rivals=(first,)), (other,))
        assert found.settled is settled and found.gap == pytest.approx(more - behind)


@pytest.mark.parametrize(
    ("own", "left", "worth"),
    [
        ([predicted()], 1, True),
        ([predicted(chance=0.01, repeats=4.0)], 4, True),
        ([predicted(chance=0.01, repeats=4.0)], 3, False),
        ([predicted(chance=0.2, repeats=math.inf)], 1, False),
        ([predicted(chance=0.2, repeats=math.inf)], 4, True),  # one of them by luck
        ([predicted(chance=0.2, repeats=math.inf, other=other) for other in "bcd"], 1, True),  # one of the pairs
        ([predicted(chance=0.0, repeats=math.inf)], 99, False),
    ],
)
def test_a_trial_is_worth_making_that_may_settle_something(own: list[Predicted], left: int, worth: bool) -> None:
    assert worth_making(own, left) is worth
    assert worth_making([predicted(chance=0.0, repeats=math.inf, other="e"), *own], left) is worth


def test_of_a_pair_either_explanation_may_be_true() -> None:
    one = predicted(chance=0.9)
    for chance, worth in ((0.0, False), (0.2, True)):
        back = replace(one, true=one.other, other=one.true, chance=chance, repeats=math.inf)
        assert worth_making([replace(one, repeats=math.inf), back], 1) is worth


def test_what_is_named_is_hopeless_whatever_is_to_be_seen_beside_it() -> None:
    one, beside = predicted(chance=0.0, repeats=math.inf), predicted(other="a and c (size 1)")
    assert worth_making([one, beside], 1)
    assert hopeless(["a", "b"], [one, beside]) == (one,)
    assert not hopeless(["a", "b", "c"], [one, beside])  # nothing is known of the third
    assert not hopeless(["a", "b"], [predicted(), beside]) and not hopeless(["a"], [one, beside])


@pytest.mark.parametrize(
    ("chance", "settled", "against"), [(0.96, False, True), (0.96, True, False), (0.9, False, False)]
)
def test_what_should_have_been_settled_and_is_not_speaks_against_all_explanations(
    chance: float, settled: bool, against: bool
) -> None:
    one = Realised(predicted(chance=chance), 2.0, settled)
    assert unforeseen([one]) == ((one,) if against else ())


def test_nothing_to_tell_apart_is_worth_no_trial() -> None:
    assert not worth_making([], 9)
    assert why_not(()) == "within the limits and the budget nothing more can be distinguished"


def test_reasons_name_the_pair_that_is_surest() -> None:
    pairs = [predicted(chance=0.6, other="c"), predicted(repeats=2.0), predicted(chance=0.1, other="d")]
    said = why(pairs)
    assert said.startswith("it distinguishes a from b by an expected gap of 50 (30 to 80)") and "chance of 90 %" in said
    assert "2 such trials" in said and "of 2 other pairs 1 more likely than not" in said
    assert "60 of them would be needed" in why_not([predicted(chance=0.01, repeats=60.0)])
    back = replace(predicted(chance=0.2, repeats=math.inf), true="b", other="a")  # the harder way round counts
    assert why_not([predicted(chance=1.0), back]).endswith(
        "b from a with a chance of 20 %, and no number of them would do"
    )
    assert Predicted.from_dict(json.loads(json.dumps(predicted(repeats=math.inf).to_dict()))).repeats == math.inf


def recorded(name: str, duration: float = 3.0) -> Recording:
    """A trial of a leg, in which something moves."""
    times, robot = np.arange(0.0, duration, 0.01), nominal_leg()
    moves = np.sin(3.0 * times)[:, None] * [1.0, 0.5]
    return Recording(name, times, 1e4 * (1.0 + moves), moves, robot.actuator_names, robot.joint_names)


def test_of_designed_trials_the_end_is_held_out() -> None:
    many = [recorded(f"poor_{k}") for k in range(8)]
    usual = choose_holdout([own.name for own in many])
    assert held_out(many, 0) == usual and held_out(many, 1) == replace(usual, ends=frozenset({8}), apart=frozenset({8}))
    few = many[:2]
    assert held_out(few, 0) == Holdout(ends=frozenset({0, 1}))
    assert held_out(few, 2) == Holdout(ends=frozenset(range(4)), apart=frozenset({2, 3}))
    assert held_out(few, 1, ["poor_*"]) is None
    short = [few[0], recorded("poor_1", 1.5)]  # of which the end is too short to judge by
    assert held_out(short, 1) == Holdout(frozenset({1}), ends=frozenset({2}), apart=frozenset({2}))
    assert fitted_share() == 0.75 and fitted_share(["poor_*"]) == 1


@pytest.mark.parametrize("count", [1, 2, 3, 4, 8])
def test_what_is_fitted_once_stays_fitted(count: int) -> None:
    """So what a trial changes in the likelihoods is that trial's own."""
    model = Model(nominal_leg())
    given, made = [recorded(f"poor_{k}") for k in range(count)], [recorded(f"designed_{k}") for k in range(3)]

    def fitted(several: list[Recording], designed: int) -> set[tuple[str, float]]:
        parts = split(model, several, heldout=held_out(given, designed))
        return {(several[s.recording].name, float(t)) for s in parts.train for t in s.trial.sample_times}

    before = fitted(given, 0)
    for k in range(3):
        now = fitted([*given, *made[: k + 1]], k + 1)
        assert before < now and {name for name, _ in now - before} == {made[k].name}
        before = now


def test_predictions_are_of_the_labels_of_rivals() -> None:
    rivals = of_a_pendulum()
    both = (power(0, 1), power(1, 0))
    first, second = Predicted.of(rivals, [Pair(both, "settled"), Pair(both, "one trial")])
    assert (first.true, first.other) == (rivals.rivals[0].label, rivals.rivals[1].label)
    assert (second.true, second.other) == (first.other, first.true)
    assert first.gap == 100.0 and first.low < 100.0 < first.high


def power(first: int, second: int) -> Power:
    return Power(first, second, np.array([100.0]), 0.0, 10.0, 0.99, 1.0)
