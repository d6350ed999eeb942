"""Diagnosis on small blinded ground truths: what is there is found, what is not there is not."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from equimus_ctrl.diagnosis.candidates import candidates
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, diagnose
from equimus_ctrl.diagnosis.experiment import Design, _pair
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.holdout import Holdout, choose_holdout, split
from equimus_ctrl.diagnosis.hypothesis import Part, default_free_parameters, model_of, parameters_of, with_part
from equimus_ctrl.diagnosis.localization import localise
from equimus_ctrl.diagnosis.results import SCHEMA, Diagnosis, Equivalent, Named
from equimus_ctrl.diagnosis.search import Search
from equimus_ctrl.diagnosis.search_state import SearchHistory, SearchState
from equimus_ctrl.diagnosis.unexplained import ResidualAnalysis
from equimus_ctrl.effects.base import REGISTRY, Effect, catalogue, parse
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.rest import rest_pose
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.report.diagnosis_text import remains
from equimus_ctrl.types import Array, Recording

DURATION, RATE = 5.0, 100.0


def recordings(
    effects: tuple[Effect, ...],
    *,
    count: int = 4,
    noise: float = 1e-3,
    seed: int = 0,
    commanded: Callable[[int, Array], Array] = lambda trial, levels: levels,
) -> list[Recording]:
    """Trials of a leg with wrong numbers and effects, stepped by pressures, on the reduced engine.

    ``commanded`` says which pressures (8, 2) a trial gets in the place of those drawn.
    """
    rng = np.random.default_rng(seed)
    nominal = nominal_model()
    names = [f"{a}.{key}" for a in ("maa", "baa") for key in ("stiffness", "area", "damping")]
    wrong = {name: nominal.parameters()[name] * (1 + 0.1 * rng.uniform(-1, 1)) for name in names}
    leg = Model(nominal.morphology.with_parameters(wrong), effects)
    found = []
    for k in range(count):
        time = np.arange(0, DURATION, 1 / RATE)
        levels = commanded(k, rng.uniform((0.0, 0.0), (3e4, 2.2e4), (8, 2)))
        command = levels[np.minimum((time / 0.7).astype(int), 7)]
        start = rest_pose(leg, command[0])
        trial = Trial(f"trial_{k}", time, command, command[0], 0.0, start, time)
        clean = simulate([leg], [trial], dt=1e-3, check=False)[0].position[0]
        measured = clean + noise * rng.normal(size=clean.shape)
        found.append(Recording(f"trial_{k}", time, command, measured, ("maa", "baa"), ("hip", "knee")))
    return found


def found_in(effects: tuple[Effect, ...], **options: object) -> Diagnosis:
    model = nominal_model()
    trials = recordings(effects, **options)  # type: ignore[arg-type]
    return diagnose(default_free_parameters(model), split(model, trials), settings=DiagnosisSettings(threads=2))


@cache
def single(text: str) -> Diagnosis:
    """Of a leg with one effect."""
    return found_in((parse(text),))


@pytest.mark.slow
def test_wrong_numbers_and_noise_alone_are_consistent() -> None:
    found = found_in(())
    assert found.verdict == "consistent"
    assert not found.findings and not found.unexplained
    assert found.excess_variance["nominal"] > 1 and found.excess_variance["corrected"] < 0.01
    smallest = {str(d.named): d for d in found.detectable}
    assert 0 < smallest["dead_zone at baa"].size < 500
    assert smallest["dead_zone at baa"].unit == "Pa"
    for joint, own in found.to_dict()["noise_rad"].items():
        assert own == pytest.approx(1e-3, rel=0.1), joint


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        "dead_zone:baa:threshold=1500",
        "payload_mass:foot:mass=0.05",
        "sensor_scale:knee:scale=1.05",
    ],
)
def test_one_effect_is_named_sized_and_confirmed_by_trials_left_out(text: str) -> None:
    effect = parse(text)
    found = single(text)
    assert found.verdict == "explained"
    (finding,) = found.findings
    assert (finding.named.effect, finding.named.locations) == (effect.name, (effect.location,))
    for key, value in effect.parameters().items():
        estimate = finding.parameters[key]
        assert estimate.value == pytest.approx(value, rel=0.1)
        assert estimate.low < estimate.value < estimate.high
    evidence = finding.evidence
    assert evidence.gain > evidence.threshold and evidence.validation_gain > 0 and evidence.log10_p_value < -3
    assert evidence.share > 0.9 and evidence.validation_share > 0.8
    assert np.all(found.rmse("corrected", "validation") < 1.2e-3)
    assert found.corrected.effects[0].name == effect.name


@pytest.mark.slow
def test_alike_in_several_places_is_one_finding() -> None:
    found = found_in((parse("first_order_lag:maa:time_constant=0.1"), parse("first_order_lag:baa:time_constant=0.1")))
    (finding,) = found.findings
    assert finding.named.locations == ("maa", "baa")
    assert finding.parameters["time_constant"].value == pytest.approx(0.1, rel=0.05)


@pytest.mark.slow
def test_physics_of_no_catalogue_is_unexplained_placed_and_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    from equimus_ctrl.proof.outside import Cogging

    # The ground truth knows an effect that the diagnosis does not.
    monkeypatch.setitem(REGISTRY, "cogging", Cogging)
    trials = recordings((Cogging("knee", size=0.03, pitch=0.3),))
    monkeypatch.delitem(REGISTRY, "cogging")
    model = nominal_model()
    found = diagnose(default_free_parameters(model), split(model, trials), settings=DiagnosisSettings(threads=2))
    assert found.verdict == "unexplained"
    assert found.unexplained[0].location == "knee"
    assert found.unexplained[0].depends_on == "pos.knee"
    left = found.unexplained[0]
    assert left.unit == "N·m" and len(left.x) == len(left.force) == len(left.band) > 10
    inside = (left.x > np.quantile(left.x, 0.2)) & (left.x < np.quantile(left.x, 0.8))
    true = 0.03 * np.sin(2 * np.pi * left.x / 0.3)
    assert np.corrcoef(left.force[inside], true[inside])[0, 1] > 0.8


@pytest.mark.slow
def test_a_search_goes_on_once_after_an_effect_was_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    ends: list[list[str]] = []

    def refusing(data: Data, base: Fitted, best: Fitted, without: object) -> ResidualAnalysis:
        labels = [part.candidate.label for part in best.hypothesis]
        ends.append(labels)
        kept = "dead_zone:baa"
        return ResidualAnalysis(
            (), {k: "said so" for k, label in enumerate(labels) if label != kept and kept in labels}
        )

    monkeypatch.setattr("equimus_ctrl.diagnosis.stages.residual_analysis", refusing)
    model = nominal_model()
    effects = (parse("dead_zone:baa:threshold=2000"), parse("coulomb_friction:knee:friction=0.01"))
    parts = split(model, recordings(effects), validation=["trial_3"])
    found = diagnose(default_free_parameters(model), parts, settings=DiagnosisSettings(threads=2))
    assert set(ends[0]) == {"dead_zone:baa", "coulomb_friction:knee"}
    # What stands in for the friction the next time is withdrawn as well, and nothing looked for in its place.
    assert set(ends[1]) == {"dead_zone:baa", "stribeck_friction:knee"} and ends[2:] == [["dead_zone:baa"]]
    assert [str(f.named) for f in found.findings] == ["dead_zone at baa"]
    assert [str(named) for named in found.rejected] == ["coulomb_friction at knee", "stribeck_friction at knee"]
    reasons = {d.decision: d.reason for d in found.decisions if d.stage == "unexplained"}
    assert reasons == {f"{kind}_friction:knee rejected": "said so" for kind in ("coulomb", "stribeck")}


def test_what_holds_of_the_trials_fitted_but_of_no_leg_for_those_held_out_is_unexplained() -> None:
    model = nominal_model()
    changed = recordings((parse("payload_mass:foot:mass=0.3"),))
    trials = [*recordings(())[:3], replace(changed[3], name="loaded")]
    parts = split(model, trials, validation=["loaded"])
    found = diagnose(default_free_parameters(model), parts, settings=DiagnosisSettings(threads=2))
    assert found.verdict == "unexplained" and not found.findings
    assert found.unexplained and all(left.only_on == "validation" and left.excess > 3 for left in found.unexplained)
    assert np.all(found.rmse("corrected", "train") < 1.2e-3)
    assert "on validation trials, whatever the parameters" in " ".join(remains(found))
    assert found.to_dict()["unexplained"][0]["only_on"] == "validation"


@pytest.mark.slow
def test_trials_held_out_that_show_what_the_others_could_not_are_no_mismatch() -> None:
    model = nominal_model()
    # Nothing that is fitted presses on baa: the last trial alone tells its area.
    parts = split(model, recordings((), commanded=lambda k, p: p * [1.0, k == 3]), validation=["trial_3"])
    settings = DiagnosisSettings(threads=2, exclude=("creep", "hysteresis"))
    found = diagnose(default_free_parameters(model), parts, settings=settings)
    assert found.rmse("corrected", "validation").max() > 3e-3
    assert found.verdict == "consistent" and not found.unexplained
    ranked = {r.named.effect for r in found.ranking}
    assert "dead_zone" in ranked and ranked.isdisjoint(settings.exclude)
    assert "Not looked for, as was asked: creep, hysteresis." in found.notes


@pytest.mark.slow
def test_where_only_trials_held_out_show_it_others_are_held_out_instead() -> None:
    model = nominal_model()
    effect = parse("dead_zone:baa:threshold=2000")

    def commanded(trial: int, levels: Array) -> Array:
        return levels if trial in (3, 7, 11) else np.maximum(levels, 4e3)  # held out at first

    trials = recordings((effect,), count=12, commanded=commanded)
    found = diagnose(default_free_parameters(model), split(model, trials), settings=DiagnosisSettings(threads=2))
    assert found.verdict == "explained"
    assert [str(f.named) for f in found.findings] == ["dead_zone at baa"]
    assert {s.trial.name for s in found.validation} == {"trial_2", "trial_6", "trial_10"}
    assert {s.trial.name for s in found.test} == {"trial_11"}
    assert any(note.startswith("trial_3, trial_7, held out at first, showed") for note in found.notes)
    assert [d.decision for d in found.decisions if d.stage == "other_holdout"] == [
        "held out instead: trial_2, trial_6, trial_10"
    ]
    trials = trials[:8]
    said = diagnose(
        default_free_parameters(model),
        split(model, trials, validation=["trial_[37]"]),
        settings=DiagnosisSettings(threads=2),
    )  # whoever says which judge is not overruled
    assert said.verdict == "unexplained" and said.unexplained[0].only_on == "validation"
    assert {s.trial.name for s in said.validation} == {"trial_3", "trial_7"}
    # What the test set alone shows is told, and changes nothing of what was chosen.
    only = diagnose(default_free_parameters(model), split(model, trials), settings=DiagnosisSettings(threads=2))
    assert only.verdict == "unexplained" and {left.only_on for left in only.unexplained} == {"test"}
    assert {s.trial.name for s in only.test} == {"trial_7"} and "on test trials" in " ".join(remains(only))
    assert only.rmse("corrected", "validation").max() < 1.2e-3 < 1e-2 < only.rmse("corrected", "test").max()


@pytest.mark.slow
@pytest.mark.parametrize(("largest", "places"), [(1.2e4, ("maa",)), (2.2e4, ("maa", "baa"))])
def test_an_effect_is_named_where_it_shows_and_nowhere_else(largest: float, places: tuple[str, ...]) -> None:
    # Where no command of baa comes near the level, it is the same at both valves.
    model, level = nominal_model(), {"level": 14e3}
    effects = tuple(parse(f"saturation:{place}:level=14000") for place in ("maa", "baa"))
    parts = split(model, recordings(effects, commanded=lambda k, p: np.minimum(p, [3e4, largest])))
    data = Data(default_free_parameters(model), parts.train, reduced_simulator(threads=2))
    pool = candidates(model, parts.train)
    search = Search(data, pool)
    both = next(c for c in pool if c.label == "saturation:maa+baa")
    base = data.base()
    best, tried = search.refit(SearchHistory(), base, (Part(both, level),))
    found = search.go_on(SearchState(base, best, (base,), ((),), tried))
    (part,) = found.best.hypothesis
    assert part.candidate.locations == places
    assert part.values["level"] == pytest.approx(14e3, rel=1e-2)
    others = {alternative.label for alternative in found.alternatives[0]}
    assert ("saturation:maa+baa" in others) == (places == ("maa",))
    # Where no more parts are looked for, what else could be there is all the same.
    still = search.go_on(replace(found, alternatives=((),)), further=False)
    assert still.best.label == found.best.label and still.alternatives[0]


@pytest.mark.slow
def test_the_same_recordings_give_the_same_bits_on_any_number_of_threads() -> None:
    model = nominal_model()
    trials = recordings((parse("dead_zone:maa:threshold=2000"),), count=3)
    reports = []
    for threads in (1, 2):
        found = diagnose(
            default_free_parameters(model), split(model, trials), settings=DiagnosisSettings(threads=threads)
        )
        record = found.to_dict()
        del record["seconds"]
        reports.append(json.dumps(record))
    assert reports[0] == reports[1]


@pytest.mark.slow
def test_the_report_is_plain_data_of_the_schema() -> None:
    record = single("dead_zone:baa:threshold=1500").to_dict()
    assert record["schema"] == SCHEMA == "equimus-ctrl/diagnosis/2"
    assert json.loads(json.dumps(record, allow_nan=False)) == record
    finding = record["findings"][0]
    assert set(finding) == {"effect", "locations", "parameters", "evidence", "equivalent"}
    assert finding["parameters"]["threshold"]["unit"] == "Pa"
    # The only effect explains alone what it explains, and what all do.
    assert finding["evidence"]["share_alone"] == finding["evidence"]["share"]
    assert record["explained_share"]["train"] == pytest.approx(finding["evidence"]["share"], abs=1e-9)
    assert (record["explained_share"]["test"] is None) == (not record["trials"]["test"])
    assert record["shooting_interval_s"] is None
    assert set(record["rmse_rad"]) == {"train", "validation", "test"}
    assert set(record["rmse_rad"]["validation"]) == {"nominal", "refitted", "corrected"}
    assert record["where"][0]["share"] >= record["where"][1]["share"]


@pytest.mark.slow
def test_a_users_own_effect_takes_part() -> None:
    from equimus_ctrl.workflow.plugins import load_plugins

    load_plugins([Path(__file__).parents[1] / "docs" / "examples" / "drag.py"])
    effect = parse("quadratic_drag:knee:coefficient=0.05")
    found = found_in((effect,))
    (finding,) = found.findings
    assert (finding.named.effect, finding.named.locations) == ("quadratic_drag", ("knee",))
    assert next(iter(finding.parameters.values())).value == pytest.approx(0.05, rel=0.2)


def test_candidates_cover_the_catalogue_and_leave_out_a_second_name_for_the_foot() -> None:
    model = nominal_model()
    parts = split(model, recordings((), count=2))
    pool = candidates(model, parts.train)
    assert {c.effect.name for c in pool} == set(catalogue("elastic"))
    labels = {c.label for c in pool}
    assert "payload_mass:foot" in labels and "payload_mass:calf" not in labels
    assert {"transport_delay:maa", "transport_delay:baa", "transport_delay:maa+baa"} <= labels
    assert "joint_stop:hip+knee" not in labels
    for c in pool:
        for guess in c.guesses:
            model_of(model, (Part(c, guess),))  # each can be attached


def test_a_leg_that_hardly_moves_has_all_candidates_with_sizes_within_their_bounds() -> None:
    model = nominal_model()
    stuck = [
        replace(r, position=r.position[:1] + 5e-3 * (r.position - r.position[:1])) for r in recordings((), count=2)
    ]
    pool = candidates(model, split(model, stuck).train)
    assert {c.effect.name for c in pool} == set(catalogue("elastic"))
    cubic = {g["cubic"] for c in pool if c.effect.name == "nonlinear_stiffness" for g in c.guesses}
    assert cubic == {-1e6, 1e6}  # what its motion would ask for is beyond


def test_a_part_that_excludes_others_takes_their_place() -> None:
    model = nominal_model()
    parts = split(model, recordings((), count=2))
    pool = {c.label: c for c in candidates(model, parts.train)}
    lag, both, dead = (pool[k] for k in ("first_order_lag:maa", "asymmetric_lag:maa+baa", "dead_zone:maa"))
    old = (Part(lag, lag.guesses[0]), Part(dead, dead.guesses[0]))
    new = with_part(model, old, Part(both, both.guesses[0]))
    assert [p.candidate.label for p in new] == ["dead_zone:maa", "asymmetric_lag:maa+baa"]
    free = parameters_of(default_free_parameters(model), new)
    assert free.names[-2:] == ("maa.asymmetric_lag.fill", "maa.asymmetric_lag.vent")
    assert free.free[-1].also == ("baa.asymmetric_lag.vent",)
    moved = free.model_at(np.array([*free.start[:-2], 0.2, 0.3]))
    assert [e.parameters() for e in moved.effects if e.name == "asymmetric_lag"] == [{"fill": 0.2, "vent": 0.3}] * 2


@pytest.mark.slow
def test_equivalents_come_with_the_experiment_that_tells_them_apart() -> None:
    # MAA pulls at the hip alone: over a small range dry friction of either looks the same.
    model = nominal_model()
    trials = recordings((parse("coulomb_friction:maa:friction=0.06"),), noise=2e-3)
    designs = []
    for amplitude in (2e3, 9e3):
        t = np.arange(0, 5, 0.01)
        wave = 1.2e4 + amplitude * np.sin(4 * t)[:, None] * np.ones(2)
        designs.append(Design("chirp", {"amplitude": amplitude / 1e3}, t, wave))
    found = diagnose(
        default_free_parameters(model),
        split(model, trials),
        settings=DiagnosisSettings(threads=2),
        designs=lambda: designs,
    )
    (finding,) = found.findings
    named = {(finding.named.effect, finding.named.locations)}
    named |= {(e.effect, e.locations) for e in finding.equivalent}
    assert {("coulomb_friction", ("maa",)), ("coulomb_friction", ("hip",))} <= named
    assert found.experiment is not None and found.experiment.distance > 0
    assert {str(n) for n in found.experiment.separates} == {"coulomb_friction at maa", "coulomb_friction at hip"}


def test_an_experiment_separates_a_finding_from_the_fit_of_its_equivalent() -> None:
    first, second, fits = object(), object(), [object(), object()]
    end: Any = SimpleNamespace(best=SimpleNamespace(hypothesis=(first, second)))
    findings: Any = [
        SimpleNamespace(part=second, law=None, named="second"),
        SimpleNamespace(part=object(), law=first, named="first"),  # at one of several places
    ]
    other: Any = [Equivalent(Named("dead_zone", ("baa",)), fit) for fit in fits]  # type: ignore[arg-type]
    assert _pair(end, findings, [(other[0],), ()]) == ("first", other[0])
    assert _pair(end, findings, [(other[0],), (other[1],)]) == ("second", other[1])
    assert _pair(end, findings, [(), ()]) is None and _pair(end, findings, ()) is None


def test_which_trials_are_held_out() -> None:
    model = nominal_model()
    trials = recordings((), count=5)
    usual = split(model, trials)
    assert [s.trial.name for s in usual.validation] == ["trial_3"]
    chosen = split(model, trials, validation=["trial_[01]"])
    assert [s.trial.name for s in chosen.validation] == ["trial_0", "trial_1"]
    assert not usual.test  # too few trials
    more = split(model, recordings((), count=8))
    assert [[s.trial.name for s in part] for part in (more.validation, more.test)] == [["trial_3"], ["trial_7"]]
    assert more.other is not None and [s.trial.name for s in more.other.test] == ["trial_7"]
    named = split(model, trials, test=["trial_0"])
    assert [[s.trial.name for s in part] for part in (named.validation, named.test)] == [["trial_4"], ["trial_0"]]
    with pytest.raises(ConfigError, match="trial trial_1 is for validation and for the test"):
        split(model, trials, validation=["trial_1"], test=["trial_[12]"])
    with pytest.raises(ConfigError, match="every trial is for the test"):
        split(model, trials, test=["*"])
    assert {s.recording_name for s in usual.train} == {"trial_0", "trial_1", "trial_2", "trial_4"}
    (train,), (heldout,) = (getattr(split(model, trials[:1]), key) for key in ("train", "validation"))
    assert train.trial.sample_times[-1] < heldout.trial.sample_times[0]
    assert heldout.trial.start == 0.0  # the motion is followed from the beginning
    late = split(model, trials, until=3.0)
    assert len(late.train) == len(late.validation) == 5
    with pytest.raises(ConfigError, match=r"for validation: there is no trial 'trial_9'; did you mean 'trial_4'"):
        split(model, trials, validation=["trial_9"])
    with pytest.raises(ConfigError, match="every trial is held out"):
        split(model, trials, validation=["*"])
    with pytest.raises(ConfigError, match="fitted is what comes before 100 s, but the last trial ends at "):
        split(model, trials, until=100.0)
    end = float(trials[0].time[-1])
    for options, sentence in (
        ({"until": -1.0}, "fitted is what comes before -1 s, but the first trial begins at 0 s"),
        ({"until": end - 0.1}, "no trial has 60 samples after that, too few to judge by"),
        ({"until": 2.5, "window": (0.0, 2.0)}, "fitted is what comes before 2.5 s, but what counts ends at 2 s"),
        ({"until": 0.5, "window": (1.0, 2.0)}, "fitted is what comes before 0.5 s, but what counts begins at 1 s"),
        ({"window": (2.0, 1.0)}, "the window goes from 2 to 1 s, expected the earlier time first"),
        ({"window": (np.nan, 1.0)}, "the window goes from nan to 1 s"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            split(model, trials, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "given", "validation", "test", "other"),
    [
        (2, {}, "1", "", ""),
        (3, {}, "2", "", ""),
        (4, {}, "3", "", "2"),
        (8, {}, "3", "7", "26"),
        (9, {"test": ["0"]}, "48", "0", "37"),
        (3, {"test": ["2"]}, "1", "2", ""),
        (2, {"test": ["1"]}, "", "1", ""),
        (8, {"validation": ["[01]"]}, "01", "", ""),
        (8, {"by_time": True}, "", "", ""),
        (8, {"by_time": True, "test": ["3"]}, "", "3", ""),
    ],
)
def test_what_is_held_out_follows_from_the_names(
    count: int, given: dict[str, Any], validation: str, test: str, other: str
) -> None:
    chosen = choose_holdout([str(k) for k in range(count)], **given)
    assert chosen == Holdout(*(frozenset(map(int, places)) for places in (validation, test, other)))


def test_of_a_trial_alone_of_its_kind_the_end_is_held_out() -> None:
    names = [*(f"step_{k}" for k in range(8)), "triangle"]
    chosen = choose_holdout(names)
    assert chosen == Holdout(frozenset({3}), frozenset({7}), frozenset({2, 6}), frozenset({8}), frozenset({8}))
    assert choose_holdout([*names[:4], "triangle"]).last == frozenset()  # without a test set all of it validates
    assert choose_holdout(names, test=["step_0"]).last == frozenset()
    assert choose_holdout(names, validation=["step_0"]).ends == frozenset()
    assert choose_holdout(["walk", "run", "jump", "rest", "fall"]).ends == frozenset()  # no kind has several
    assert choose_holdout(["walk"]) == Holdout(ends=frozenset({0}))


def test_the_end_of_a_trial_alone_of_its_kind_is_divided() -> None:
    trials = recordings((), count=8)
    trials = [replace(r, name=f"step_{k}") for k, r in enumerate(trials)] + [replace(trials[0], name="triangle")]
    parts = split(nominal_model(), trials)
    first, last = float(trials[-1].time[0]), float(trials[-1].time[-1])
    times = [
        [s.trial.sample_times for s in own if s.recording == 8] for own in (parts.train, parts.validation, parts.test)
    ]
    ends = [first + share * (last - first) for share in (0.75, 0.875, 1.0)]
    assert [len(own) for own in times] == [1, 1, 1]
    assert [own[0][-1] for own in times] == pytest.approx(ends, abs=0.02)
    assert times[0][0][-1] < times[1][0][0] < times[1][0][-1] < times[2][0][0]


@pytest.mark.parametrize(
    ("samples", "sets"), [(480, "train validation test"), (320, "train validation"), (200, "train")]
)
def test_an_end_that_is_too_short_to_judge_by_is_not_lost(samples: int, sets: str) -> None:
    trials = [replace(r, name=f"step_{k}") for k, r in enumerate(recordings((), count=8))]
    short = trials[0]
    rows = slice(0, samples)
    alone = replace(
        short, name="alone", time=short.time[rows], position=short.position[rows], command=short.command[rows]
    )
    parts = split(nominal_model(), [*trials, alone])
    whole = {"train": parts.train, "validation": parts.validation, "test": parts.test}
    found = {name: [s for s in own if s.recording == 8] for name, own in whole.items()}
    assert " ".join(name for name, own in found.items() if own) == sets
    assert sum(len(s.trial.sample_times) for own in found.values() for s in own) == samples


def spoilt(change: str) -> list[Recording]:
    good = recordings((), count=2)
    first = good[0]
    position, command = np.array(first.position), np.array(first.command)
    if change == "nan":
        position[7, 1] = np.nan
        return [replace(first, position=position), good[1]]
    if change == "degrees":
        return [replace(r, position=np.rad2deg(r.position)) for r in good]
    if change == "still command":
        return [replace(r, command=np.full_like(command, 1e4), before=None) for r in good]
    if change == "still joint":
        return [replace(r, position=np.column_stack([np.full(len(r.time), 1.5), r.position[:, 1]])) for r in good]
    if change == "short":
        return [Recording("tiny", first.time[:20], command[:20], position[:20], first.actuators, first.joints)]
    return [replace(r, joints=("shin", "toe")) for r in good]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ("nan", "trial_0: holds numbers that are not finite"),
        ("degrees", r"trial_0: hip reaches [0-9.]+ rad, more than two turns; are the angles in degrees"),
        ("still command", "the commands never move"),
        ("still joint", "joint hip never moves"),
        ("short", "tiny: has 20 samples over 0.19 s, too short to diagnose"),
        ("columns", "has joints shin, toe"),
    ],
)
def test_recordings_that_cannot_tell_are_refused_in_one_sentence(change: str, sentence: str) -> None:
    with pytest.raises(ConfigError, match=sentence):
        split(nominal_model(), spoilt(change))
    with pytest.raises(ConfigError, match="no recording was given"):
        split(nominal_model(), [])


def test_where_says_which_joint_phase_and_region() -> None:
    model = nominal_model()
    parts = split(model, recordings((), count=2))
    noise = (JointNoise(1e-3), JointNoise(1e-3))
    residuals: list[Array] = []
    for s in parts.train:
        r = np.zeros_like(s.measured)
        r[s.measured[:, 1] > np.quantile(s.measured[:, 1], 0.7), 1] = 0.02
        residuals.append(r)
    first, second = localise(model, parts.train, residuals, noise)
    assert (first.location, second.location) == ("knee", "hip")
    assert first.share > 0.99
    assert "knee angles" in first.region
