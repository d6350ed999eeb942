"""The score of a proof on truths and reports made by hand: every line of it can fail."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import pytest
from proof_answers import LAG, RUB, SAID_LAG, SAID_RUB, effect, finding, left, report, scored, truth

from equimus_ctrl.proof.answers import BINS, Places, bin_of
from equimus_ctrl.proof.baselines import TITLES
from equimus_ctrl.proof.estimates import measure_of
from equimus_ctrl.proof.scoring import Score
from equimus_ctrl.proof.shares import Share
from equimus_ctrl.proof.tally import CONSISTENT, NOTHING, UNEXPLAINED, confusion
from equimus_ctrl.report import style
from equimus_ctrl.report.proof_figures import proof_drawings
from equimus_ctrl.report.proof_tables import Sheet, markdown, sheets
from equimus_ctrl.robots.elastic.leg import nominal_leg

# --- counts


@pytest.mark.parametrize(
    ("count", "of", "low", "high"),
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_intervals_are_those_of_newcombe_1998(count: int, of: int, low: float, high: float) -> None:
    assert Share(count, of).interval == pytest.approx((low, high), abs=5e-5)
    mirrored = Share(of - count, of).interval
    assert mirrored == pytest.approx((1 - high, 1 - low), abs=5e-5)


def test_a_share_of_nothing_says_so() -> None:
    nothing = Share.among([])
    assert math.isnan(nothing.value) and nothing.interval == (0.0, 1.0)
    assert str(nothing) == "–" and nothing.to_dict()["share"] is None
    assert str(Share(39, 40)) == "97.5 % (39/40)"


def test_every_excess_has_its_range() -> None:
    assert [bin_of(x) for x in (0.0, 0.03, 0.29, 0.3, 3.0, 29.0, 30.0)] == [BINS[k] for k in (0, 1, 1, 2, 3, 3, 4)]


# --- places


def test_lever_arms_say_on_which_joints_an_actuator_acts() -> None:
    places = Places.of(nominal_leg())
    assert places.joints_of(["maa"]) == {"hip"}
    assert places.joints_of(["baa"]) == {"hip", "knee"}
    assert places.joints_of(["knee"]) == {"knee"}


def test_the_tip_of_the_last_link_is_the_foot() -> None:
    at = [truth("single", effect("payload_mass", where, mass=0.1)) for where in ("foot", "calf", "thigh")]
    found = scored(*((t, report(finding("payload_mass", "calf", mass=0.1))) for t in at))
    assert [case.exact("diagnosis") for case in found.cases] == [True, True, False]
    assert found.ours.misplaced == Share(1, 3)


def test_one_effect_found_in_two_places_apart_is_the_same_as_in_both() -> None:
    both = truth("single", effect("first_order_lag", "maa", "baa", time_constant=0.2))
    apart = report(SAID_LAG, finding("first_order_lag", "baa", time_constant=0.19))
    found = scored((both, apart), (both, report(SAID_LAG)))
    assert [case.exact("diagnosis") for case in found.cases] == [True, False]
    assert len(found.estimates["diagnosis"]) == 2


def test_what_cannot_be_told_apart_counts_as_its_group() -> None:
    group = finding("creep", "maa", equivalent=(("first_order_lag", "maa"), ("dead_zone", "baa")))
    elsewhere = finding("creep", "maa", equivalent=(("first_order_lag", "baa"),))
    found = scored(*((truth("single", LAG), report(said)) for said in (SAID_LAG, group, elsewhere)))
    assert found.ours.single["all"] == Share(1, 3) and found.ours.group["all"] == Share(2, 3)
    pair = truth("pair", LAG, RUB)
    two = scored((pair, report(SAID_RUB, group)), (pair, report(group)), (pair, report(group, group)))
    assert [case.in_group("diagnosis") for case in two.cases] == [True, False, False]
    assert two.ours.pair["all"] == Share(0, 3) and two.ours.pair_group["all"] == Share(1, 3)


def test_a_law_that_is_the_sum_of_two_is_not_distinguishable_from_them() -> None:
    pair = truth("pair", RUB, effect("constant_force", "knee", size=0.1))
    one = finding("asymmetric_friction", "knee", forward=0.1, backward=0.3)
    elsewhere = finding("asymmetric_friction", "hip", forward=0.1, backward=0.3)
    found = scored(*((pair, report(said)) for said in (one, elsewhere)))
    assert [case.in_group("diagnosis") for case in found.cases] == [True, False]
    assert not any(case.exact("diagnosis") for case in found.cases)


@pytest.mark.parametrize(
    ("where", "said", "right"),
    [
        (("hip",), left("hip"), True),
        (("hip",), left("knee"), False),
        (("hip",), left("knee", "hip"), True),
        (("maa",), left("hip", "maa"), True),
        (("maa",), left("knee", "knee"), False),
        (("baa",), left("knee"), True),
        (("baa",), left("hip", "maa"), True),
        (("knee",), left("hip", "baa"), False),
    ],
)
def test_physics_from_outside_is_placed_by_lever_arms(where: tuple[str, ...], said: Any, right: bool) -> None:
    concealed = truth("outside", effect("fade", *where, share=0.2))
    found = scored((concealed, report(unexplained=(said, left("hip"), left("knee")))))
    assert found.ours.outside["all"] == Share(int(right), 1)


# --- each line of the score


def test_false_alarms_are_findings_and_what_is_called_unexplained() -> None:
    white, coloured = truth("none"), truth("none", coloured=True)
    found = scored(
        (white, report()),
        (white, report(SAID_LAG)),
        (coloured, report(unexplained=(left("hip"),))),
        (coloured, report()),
        (coloured, report()),
    )
    shares = found.ours.false_alarms
    assert shares == {"all": Share(2, 5), "white": Share(1, 2), "coloured": Share(1, 3)}


def test_single_effects_are_counted_by_their_strength_and_name() -> None:
    weak = truth("single", effect("creep", "maa", alone=0.1), excess=0.1)
    found = scored(
        (truth("single", LAG, excess=10.0), report(SAID_LAG)),
        (truth("single", LAG, excess=10.0), report(SAID_RUB)),
        (truth("single", RUB, excess=10.0), report(SAID_RUB, unexplained=(left("hip"),))),
        (weak, report()),
    )
    t = found.ours
    assert t.single["all"] == Share(2, 4) and t.single["strong"] == Share(2, 3)
    assert t.single["0.03 to 0.3"] == Share(0, 1) and t.single["3 to 30"] == Share(2, 3)
    assert t.effects == {"coulomb_friction": Share(1, 1), "first_order_lag": Share(1, 2)}
    assert t.with_unexplained == Share(1, 2)


def test_pairs_are_right_as_a_whole_and_counted_in_parts() -> None:
    strong = truth("pair", LAG, RUB)
    half = truth("pair", LAG, {**RUB, "alone": 0.1})
    found = scored((strong, report(SAID_LAG, SAID_RUB)), (strong, report(SAID_LAG)), (half, report(SAID_LAG)))
    t = found.ours
    assert t.pair["all"] == Share(1, 3) and t.pair["strong"] == Share(1, 2)
    assert t.recall == {"all": Share(4, 6), "strong": Share(4, 5)}
    assert t.precision == Share(4, 4)
    wrong = scored((strong, report(SAID_LAG, finding("creep", "maa")))).ours
    assert wrong.precision == Share(1, 2) and wrong.pair["all"] == Share(0, 1)


def test_outside_wrong_names_count_apart() -> None:
    fade = truth("outside", effect("fade", "maa", share=0.2), excess=1.0)
    weak = truth("outside", effect("fade", "maa", share=0.2), excess=0.01)
    found = scored(
        (fade, report(unexplained=(left("hip"),))),
        (fade, report(SAID_LAG, unexplained=(left("hip"),))),
        (fade, report(unexplained=(left("knee"),))),
        (weak, report()),
    )
    t = found.ours
    assert t.outside["strong"] == Share(1, 3) and t.outside["all"] == Share(1, 4)
    assert t.unexplained == Share(2, 3) and t.placed == Share(1, 2)
    assert t.wrong["strong"] == Share(1, 3) and t.wrong["below 0.03"] == Share(0, 1)


def test_a_diagnosis_that_failed_is_right_nowhere() -> None:
    failed = {"proof": {**report()["proof"], "failed": "it broke"}}
    found = scored((truth("none"), failed), (truth("single", LAG), failed), (truth("outside", LAG), failed))
    t = found.ours
    assert t.false_alarms["all"] == Share(1, 1) and t.single["all"] == Share(0, 1) == t.outside["all"]
    assert not found.own and found.to_dict()["cases"][1]["failed"] == "it broke"


def test_the_confusion_matrix_keeps_one_for_every_truth() -> None:
    found = scored(
        (truth("none"), report()),
        (truth("single", LAG), report(SAID_LAG)),
        (truth("single", LAG), report(SAID_RUB, finding("creep", "maa"))),
        (truth("pair", LAG, {**RUB, "alone": 0.01}), report(SAID_LAG)),
        (truth("outside", effect("fade", "maa")), report(unexplained=(left("hip"),))),
    )
    rows = confusion(found.cases)
    assert rows["first_order_lag"] == {"first_order_lag": 2.0, "coulomb_friction": 0.5, "creep": 0.5}
    assert rows["fade"] == {UNEXPLAINED: 1.0} and rows[NOTHING] == {CONSISTENT: 1.0}
    assert "coulomb_friction" not in rows
    assert confusion(found.cases, least=0.0)["coulomb_friction"] == {CONSISTENT: 1.0}


@pytest.mark.parametrize(
    ("name", "where", "key", "true", "expected"),
    [
        ("first_order_lag", "maa", "time_constant", 0.2, (0.2, 0.0)),
        ("sensor_scale", "hip", "scale", 0.96, (0.04, 1.0)),
        ("gravity_tilt", "base", "angle", -0.1, (0.1, 0.0)),
        ("parallel_spring", "hip", "rest", 1.2, (1.0, None)),
        ("nonlinear_stiffness", "maa", "centre", 0.25, (0.07, None)),
        ("joint_stop", "knee", "angle", 0.1, (0.37, None)),
        ("saturation", "maa", "level", 2e4, (2e4, 0.0)),
        ("coulomb_friction", "baa", "friction", 0.5, (0.5, 0.0)),
    ],
)
def test_errors_are_relative_to_what_an_effect_does(
    name: str, where: str, key: str, true: float, expected: tuple[float, float | None]
) -> None:
    scale, zero = measure_of(name, key, where, true)
    assert scale == pytest.approx(expected[0]) and zero == expected[1]


def test_numbers_count_where_the_name_is_right_and_the_effect_strong() -> None:
    pair = truth("pair", LAG, {**RUB, "alone": 0.1})
    open_end = {**SAID_LAG, "parameters": {"time_constant": {"value": 0.3, "low": 0.25, "high": None}}}
    found = scored(
        (pair, report(SAID_LAG, SAID_RUB)), (pair, report(SAID_RUB)), (truth("single", LAG), report(open_end))
    )
    estimates = found.estimates["diagnosis"]
    assert [(n.case, n.of) for n in estimates] == [(0, "first_order_lag"), (2, "first_order_lag")]
    assert [n.error for n in estimates] == pytest.approx([0.05, 0.5])
    assert [n.covered for n in estimates] == [True, False] and [n.bounded for n in estimates] == [True, False]
    # The robot's own parameters count where all that is missing was found.
    assert {n.case for n in found.own} == {0, 2} and all(n.covered for n in found.own)


def test_sizes_of_a_law_at_each_of_several_places_are_compared_place_by_place() -> None:
    rubs = effect("coulomb_friction", "hip", friction=0.02), effect("coulomb_friction", "knee", friction=0.05)
    said = finding("coulomb_friction", "hip", friction=0.021), finding("coulomb_friction", "knee", friction=0.06)
    estimates = scored((truth("pair", *rubs), report(*said))).estimates["diagnosis"]
    assert [n.true for n in estimates] == [0.02, 0.05]
    assert [n.error for n in estimates] == pytest.approx([0.05, 0.2])
    assert [n.covered for n in estimates] == [True, False]
    assert not scored((truth("pair", *rubs), report(said[0]))).estimates["diagnosis"]


def test_the_share_of_the_error_taken_away_is_over_the_true_noise() -> None:
    found = scored((truth("single", LAG), report(SAID_LAG)), (truth("single", RUB), report(SAID_LAG)))
    # Excess before (4 + 2)/2, after (0.2 + 0.4)/2.
    assert [(h.case, h.share) for h in found.heldout] == [(0, pytest.approx(0.9))]


# --- goals


def many(good: Any, bad: Any, n: int = 400, wrong: int = 0) -> list[Any]:
    return [bad] * wrong + [good] * (n - wrong)


GOOD: dict[str, tuple[Any, Any]] = {
    "false_alarms": ((truth("none"), report()), (truth("none"), report(SAID_LAG))),
    "single": ((truth("single", LAG), report(SAID_LAG)), (truth("single", LAG), report(SAID_RUB))),
    "single_group": ((truth("single", LAG), report(SAID_LAG)), (truth("single", LAG), report(SAID_RUB))),
    "pair": ((truth("pair", LAG, RUB), report(SAID_LAG, SAID_RUB)), (truth("pair", LAG, RUB), report(SAID_LAG))),
    "outside": (
        (truth("outside", effect("fade", "maa")), report(unexplained=(left("hip"),))),
        (truth("outside", effect("fade", "maa")), report(unexplained=(left("knee"),))),
    ),
    "error": (
        (truth("single", LAG), report(SAID_LAG)),
        (truth("single", LAG), report(finding("first_order_lag", "maa", time_constant=0.3))),
    ),
    "seconds": ((truth("none"), report()), (truth("none"), report(seconds=100.0))),
}


@pytest.mark.parametrize("name", GOOD)
def test_each_goal_is_met_and_missed(name: str) -> None:
    good, bad = GOOD[name]
    for wrong, state in ((0, "met"), (214, "missed"), (400, "missed")):
        found = scored(*many(good, bad, wrong=wrong))
        (goal,) = [g for g in found.goals if g.name == name]
        if name == "error" and wrong == 214:
            state = "open"  # a median of 400 numbers, 186 of them right, tells nothing
        assert goal.state == state
        # Of so many alike, whose intervals all hold, these are known to be too wide.
        missed = {g.name for g in found.goals if g.judged and g.state == "missed"} - {"coverage", "own_coverage"}
        assert not missed or wrong
    assert name == "seconds" or (missed and not found.accurate)


def test_held_out_error_and_coverage_are_goals_too() -> None:
    poor = report(SAID_LAG)
    poor["rmse_rad"]["test"]["corrected"] = poor["rmse_rad"]["test"]["refitted"]
    narrow = report({**SAID_LAG, "parameters": {"time_constant": {"value": 0.3, "low": 0.29, "high": 0.31}}})
    for own in narrow["parameters"].values():
        own["low"] = own["value"] = own["high"]
    for bad, names in ((poor, {"heldout"}), (narrow, {"coverage", "own_coverage", "error", "main_error"})):
        found = scored(*[(truth("single", LAG), bad)] * 20)
        assert {g.name for g in found.goals if g.state == "missed"} == names
    wide = scored(*[(truth("single", LAG), report(SAID_LAG))] * 400)
    assert {g.name for g in wide.goals if g.state == "missed"} == {"coverage", "own_coverage"}


def test_few_cases_are_too_few_to_claim_anything_and_enough_to_see_what_is_wrong() -> None:
    one = scored((truth("none"), report()))
    states = {g.name: g.state for g in one.goals}
    assert states.pop("seconds") == "met", "which is of these cases"
    assert set(states.values()) == {"too few"} and one.accurate
    for n, state in ((72, "too few"), (73, "met")):  # 73 of 73: from 95.0 % on
        (goal,) = [g for g in scored(*many(*GOOD["single"], n=n)).goals if g.name == "single"]
        assert goal.state == state
    (goal,) = [g for g in scored(*many(*GOOD["single"], n=4, wrong=4)).goals if g.name == "single"]
    assert goal.state == "missed"


def test_what_so_many_can_show() -> None:
    assert not Share(0, 0).can_show(0.0, 1.0) and Share(0, 1).can_show(0.0, 1.0)
    assert Share(5, 140).can_show(0.90, 0.98) and not Share(132, 140).can_show(0.99, 1.0)
    assert not Share(33, 35).can_show(0.92, 0.96), "whatever of 35: intervals are wider"


# --- tables and figures


def mixture(methods: bool = True) -> Score:
    spring = effect("parallel_spring", "knee", alone=1.0, stiffness=0.1, rest=0.5)
    pairs = [
        (truth("none"), report()),
        (truth("none", coloured=True), report(SAID_RUB)),
        (truth("single", LAG), report(SAID_LAG)),
        (truth("single", spring, excess=1.0), report(finding("parallel_spring", "knee", stiffness=0.11, rest=0.45))),
        (truth("single", effect("backlash", "hip", alone=0.01, play=0.002), excess=0.01), report()),
        (truth("pair", LAG, RUB), report(SAID_LAG, SAID_RUB)),
        (truth("outside", effect("fade", "maa"), excess=40.0), report(unexplained=(left("hip"),))),
        (truth("outside", effect("cogging", "knee"), excess=4.0), report(SAID_RUB)),
    ]
    answer = {name: {"findings": [SAID_LAG], "failed": ""} for name in TITLES}
    return scored(*pairs, others=[answer if methods else {} for _ in pairs])


def test_the_score_is_plain_json_and_lists_what_went_wrong() -> None:
    found = mixture()
    record = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert record["schema"] == "equimus-ctrl/proof-score/1"
    assert [line["right"] for line in record["cases"]] == [True, False, True, True, False, True, True, False]
    assert record["baselines"]["bic"]["false_alarms"]["all"]["count"] == 2
    assert record["baselines"]["sparse"]["single"]["strong"]["count"] == 1
    text = markdown({"seed": "0"}, found)
    assert "| 7 | outside | 4 | cogging:knee | coulomb_friction:knee |" in text
    assert "backlash:hip" not in text and "that were not detected are not listed: 1." in text
    assert "| false alarms | 50.0 % (1/2) | 9.45 to 90.5 % | ≤ 1 % | missed |" in text
    assert "bic: forward selection by BIC" in text and "parallel_spring.rest" in text
    assert len(sheets(found)[0].rich(3).rows) == 3
    assert [len(sheet.rich().rows) for sheet in sheets(found)] == [len(sheet.rows) for sheet in sheets(found)]


def test_no_table_of_negatives_is_without_rows() -> None:
    text = markdown({"seed": "0"}, scored((truth("none"), report()), (truth("none"), report())))
    assert "## Answers that were not right\n\nNone.\n" in text
    assert "## Single effects named right\n\nNo case has" in text
    assert not re.search(r"---:? \|\n(\n|$)", text)


@pytest.mark.slow
@pytest.mark.parametrize("full", [True, False])
def test_figures_are_drawn_of_much_and_of_nothing(full: bool, tmp_path: Path) -> None:
    found = mixture() if full else scored((truth("none"), report()))
    files = style.save_all(proof_drawings(found), tmp_path)
    assert {file.stem for file in files} == {"confusion", "power", "false_alarms", "parameters", "coverage", "heldout"}
    assert all(file.stat().st_size > 5000 for file in files)


def test_numbers_of_a_table_stand_to_the_right_and_words_to_the_left() -> None:
    rows = (("1", "pair", "3.5e-08", "≤ 5 %", "backlash:hip"), ("2", "none", "–", "", "nothing"))
    sheet = Sheet("Answers", ("case", "kind", "excess", "goal", "said"), rows)
    assert "\n| --- | --- | ---: | ---: | --- |\n" in sheet.markdown()
    assert [column.justify for column in sheet.rich().columns] == ["left", "left", "right", "right", "left"]
