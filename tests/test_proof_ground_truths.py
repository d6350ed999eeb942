"""Blinded ground truths: drawn to the bit, settled, sealed, resumable, and foreign where they should be."""

from __future__ import annotations

import dataclasses
import json
from functools import lru_cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from equimus_ctrl import recordings
from equimus_ctrl.computer import Workers
from equimus_ctrl.effects import (
    REGISTRY,
    Creep,
    Effect,
    Hysteresis,
    ParallelSpring,
    SensorDelay,
    StribeckFriction,
    make,
)
from equimus_ctrl.effects import (
    catalogue as catalogue_of,
)
from equimus_ctrl.effects.force import force_laws
from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS
from equimus_ctrl.engines.mujoco_trials import simulate_mujoco
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.executors.local import OnThisComputer, on_this_computer
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof import outside, sizes
from equimus_ctrl.proof.designs import DURATION, JITTER, SAMPLE_RATE, TOP, design, sample_times
from equimus_ctrl.proof.drawing import GroundTruth, attached, findings, noise, perturbed
from equimus_ctrl.proof.leg_simulation import recordings as recorded
from equimus_ctrl.proof.leg_simulation import simulate
from equimus_ctrl.proof.legs import (
    CORRELATION,
    NOISE,
    SPREAD,
    draw,
    leg_draws,
)
from equimus_ctrl.proof.outside import OUTSIDE, Motion, acts_on
from equimus_ctrl.proof.seal import canonical, opened, salt, salted, seal
from equimus_ctrl.proof.store import Request, make_case, make_cases, open_truth, redrawn
from equimus_ctrl.proof.strength import excess
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array

JOINTS, ACTUATORS = ("hip", "knee"), ("maa", "baa")


@lru_cache(maxsize=1)
def many() -> tuple[GroundTruth, ...]:
    return tuple(draw(11, case, trials=1, duration=1.0) for case in range(400))


def ground_truth(effects: tuple[Effect, ...] = (), beyond: tuple[Effect, ...] = (), trials: int = 1) -> GroundTruth:
    base = draw(3, 1, kind="none", trials=trials, duration=1.5)
    return dataclasses.replace(base, effects=effects, outside=beyond)


def changes(command: Array) -> np.ndarray:
    return np.flatnonzero(np.any(np.diff(command, axis=0) != 0, axis=1)) + 1


def same(a: GroundTruth, b: GroundTruth) -> bool:
    plain = ("case", "seed", "kind", "leg", "effects", "outside", "noise", "correlation")
    trials = all(
        s.name == t.name and np.array_equal(s.time, t.time) and np.array_equal(s.command, t.command)
        for s, t in zip(a.trials, b.trials, strict=True)
    )
    return trials and all(getattr(a, k) == getattr(b, k) for k in plain) and np.array_equal(a.rest_bias, b.rest_bias)


# --- what is drawn


def test_a_case_is_drawn_to_the_bit() -> None:
    for case in range(5):
        assert same(draw(7, case, trials=2, duration=2.0), draw(7, case, trials=2, duration=2.0))
    assert not same(draw(7, 0, trials=2, duration=2.0), draw(7, 1, trials=2, duration=2.0))
    assert not same(draw(7, 0, trials=2, duration=2.0), draw(8, 0, trials=2, duration=2.0))


def test_asking_for_a_kind_leaves_leg_noise_and_trials_as_they_are() -> None:
    one, other = (draw(7, 3, kind=kind, trials=1, duration=1.0) for kind in ("none", "pair"))
    assert one.leg == other.leg and one.noise == other.noise and one.correlation == other.correlation
    assert np.array_equal(one.trials[0].command, other.trials[0].command)


def test_unknown_kinds_and_negative_numbers_are_refused() -> None:
    with pytest.raises(ConfigError, match="pair"):
        draw(1, 1, kind="pairs")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="0 or more"):
        draw(-1, 1)


@pytest.mark.slow
def test_every_effect_and_every_kind_turns_up() -> None:
    assert {r.kind for r in many()} == {"none", "single", "pair", "outside"}
    assert {e.name for r in many() for e in r.effects} == set(sizes.drawn("elastic"))
    assert {e.name for r in many() for e in r.outside} == set(OUTSIDE)


@pytest.mark.slow
def test_each_kind_holds_what_it_says() -> None:
    expected = {"none": (0, 0), "single": (1, 0), "pair": (2, 0), "outside": (0, 1)}
    for r in many():
        assert (len({e.name for e in r.effects}), len(r.outside)) == expected[r.kind]
        assert len(findings(r.effects)) == len({e.name for e in r.effects})


def test_three_effects_are_drawn_where_they_are_asked_for() -> None:
    for case in range(10):
        effects = draw(11, case, kind="triple", trials=1, duration=1.0).effects
        assert len({e.name for e in effects}) == 3


@pytest.mark.slow
def test_effects_sit_in_random_places_and_some_act_alike_in_two() -> None:
    assert {e.location for r in many() for e in r.effects} >= {"hip", "knee", "maa", "baa", "foot", "base", "thigh"}
    alike = [name for r in many() for name, where, _ in findings(r.effects) if len(where) == 2]
    assert alike and all(REGISTRY[name].leg_alike for name in alike)


def in_table(name: str, location: str, parameters: dict[str, float]) -> bool:
    kind = "joint" if location in JOINTS else "actuator"
    table = sizes.leg_table()
    return all(sizes.size_of(table, name, key, kind, location).holds(value) for key, value in parameters.items())


def test_numbers_stay_in_their_ranges() -> None:
    nominal = nominal_leg().parameters()
    for r in many():
        for name, value in r.leg.parameters().items():
            share = SPREAD.get(name.rpartition(".")[2], 0.0) if name.partition(".")[0] in JOINTS + ACTUATORS else 0.0
            assert abs(value - nominal[name]) <= share * abs(nominal[name]) * (1 + 1e-6), name
        assert all(NOISE[0] <= sigma <= NOISE[1] for sigma in r.noise)
        assert r.correlation == 0.0 or CORRELATION[0] <= r.correlation <= CORRELATION[1]
        for name, where, parameters in findings((*r.effects, *r.outside)):
            # What acts alike in several places was drawn for one of them.
            assert any(in_table(name, location, parameters) for location in where)
    assert 0.35 < np.mean([r.correlation == 0.0 for r in many()]) < 0.65


def test_the_leg_spreads_over_its_whole_range() -> None:
    rng, draws = np.random.default_rng(0), leg_draws()
    legs = [perturbed(rng, draws).parameters() for _ in range(300)]
    for name in ("maa.stiffness", "baa.area", "maa.rest_length", "knee.damping"):
        share = np.array([leg[name] for leg in legs]) / nominal_leg().parameters()[name] - 1
        spread = SPREAD[name.rpartition(".")[2]]
        assert share.min() < -0.9 * spread and share.max() > 0.9 * spread


def test_a_symmetric_lag_is_never_called_asymmetric() -> None:
    for seed in range(40):
        for e in draw(seed, 0, kind="pair", trials=1, duration=1.0).effects:
            if e.name == "asymmetric_lag":
                p = e.parameters()
                assert max(p["fill"] / p["vent"], p["vent"] / p["fill"]) >= 1.49


def test_dry_friction_that_breaks_away_hardly_later_is_never_called_stribeck_s() -> None:
    found = [e for r in many() for e in r.effects if isinstance(e, StribeckFriction)]
    rng, draws = np.random.default_rng(4), leg_draws()
    for _ in range(300):
        (effect,) = attached(rng, draws, StribeckFriction)
        assert isinstance(effect, StribeckFriction)
        found.append(effect)
    shares = np.array([e.breakaway / e.friction for e in found])
    assert shares.min() >= 1 / 3 and np.mean(shares < 0.5) > 0.05


@pytest.mark.parametrize("known", [catalogue_of("elastic"), OUTSIDE], ids=["catalogue", "outside"])
def test_the_table_has_one_row_for_each_parameter_at_each_place(known: dict[str, type[Effect]]) -> None:
    shipped = [cls for cls in known.values() if cls.__module__.startswith("equimus_ctrl.")]
    table = sizes.leg_table()
    for cls in shipped:
        for kind in cls.sits_at:
            for location in nominal_leg().places()[kind]:
                for key, meta in cls.parameter_info().items():
                    row = sizes.size_of(table, cls.name, key, kind, location)
                    assert 0 < row.low < row.high or row.law == "linear"
                    assert row.reason
                    ends = {"about one": (1 - row.high, 1 + row.high), "either sign": (-row.high, row.high)}
                    low, high = ends.get(row.law, (row.low, row.high))
                    assert meta["low"] <= low < high <= meta["high"]


def test_a_parameter_without_a_row_is_named() -> None:
    with pytest.raises(ConfigError, match="effect nothing has 0 sizes for 'delay' at 'maa'"):
        sizes.size_of(sizes.leg_table(), "nothing", "delay", "actuator", "maa")


# --- physics from outside


def test_outside_physics_is_not_in_the_catalogue() -> None:
    assert len(OUTSIDE) >= 8
    assert not set(OUTSIDE) & set(REGISTRY)
    assert not set(OUTSIDE.values()) & set(REGISTRY.values())
    assert not {law.__name__ for law in force_laws()} & {cls.__name__ for cls in OUTSIDE.values()}
    for name in OUTSIDE:
        with pytest.raises(ConfigError, match="there is no effect"):
            make(name, "knee", {})


def test_outside_physics_says_what_it_pushes() -> None:
    leg = nominal_leg()
    assert acts_on(outside.CrossSpring("hip", stiffness=0.1), leg) == JOINTS
    assert acts_on(outside.Leak("maa", share=0.1), leg) == ACTUATORS
    assert acts_on(outside.RoughSpot("knee", friction=0.1, centre=0.5, width=0.1), leg) == ("knee",)


def motion() -> tuple[Motion, list[ca.SX]]:
    leg, names = nominal_leg(), JOINTS + ACTUATORS
    x, rate, pressure = ({n: ca.SX.sym(n) for n in names} for _ in range(3))
    time = ca.SX.sym("t")
    return Motion(leg, time, x, rate, pressure), [
        ca.vertcat(*x.values()),
        ca.vertcat(*rate.values()),
        ca.vertcat(*pressure.values()),
        time,
    ]


def pushed(effect: outside.MotionEffect, place: str, *values: object) -> float:
    at, symbols = motion()
    return float(ca.Function("f", symbols, [effect.forces(at)[place]])(*values))


def test_the_cross_spring_has_an_energy() -> None:
    spring, q = outside.CrossSpring("hip", stiffness=0.3), np.array([1.4, 0.6, 0.2, 0.3])

    def energy(hip: float, knee: float) -> float:
        return 0.5 * 0.3 * (hip * knee) ** 2

    slope = (energy(1.4 + 1e-6, 0.6) - energy(1.4 - 1e-6, 0.6)) / 2e-6
    assert pushed(spring, "hip", q, np.zeros(4), np.zeros(4), 0.0) == pytest.approx(-slope, rel=1e-6)


def test_laws_have_the_sizes_that_their_words_say() -> None:
    x, v, pressure = np.array([1.4, 0.6, 0.2, 0.3]), np.array([2.0, -1.0, 0.05, -0.02]), np.array([0, 0, 3e4, 1e4])
    maa = nominal_leg().actuators[0]
    assert pushed(outside.SquareDrag("knee", drag=0.1), "knee", x, v, pressure, 0.0) == pytest.approx(0.1)
    fade = outside.Fade("maa", share=0.2, time_constant=3.0)
    assert pushed(fade, "maa", x, v, pressure, 3.0) == pytest.approx(-0.2 * (1 - np.exp(-1)) * maa.area * 3e4)
    leak = outside.Leak("maa", share=0.1)
    assert pushed(leak, "maa", x, v, pressure, 0.0) == pytest.approx(-0.1 * maa.area * 2e4)
    drift = outside.StiffnessDrift("maa", share=0.01)
    assert pushed(drift, "maa", x, v, pressure, 5.0) == pytest.approx(-0.05 * maa.stiffness * (0.2 - maa.rest_length))
    hum = outside.PeriodicTorque("hip", size=0.1, frequency=2.0)
    assert pushed(hum, "hip", x, v, pressure, 0.125) == pytest.approx(0.1)


# --- trials and noise


def test_sampling_jitters_as_the_concealed_recordings_do() -> None:
    time = sample_times(np.random.default_rng(2), DURATION)
    steps = np.diff(time)
    assert time[0] == 0.0 and 11.95 < time[-1] < 12.0
    assert abs(steps.mean() * SAMPLE_RATE - 1) < 0.01
    assert 0.9 * JITTER < steps.std() < 1.1 * JITTER
    assert abs(np.corrcoef(steps[:-1], steps[1:])[0, 1]) < 0.1
    assert np.array_equal(time, np.round(time, 4))


def test_trials_use_the_range_and_keep_their_first_command_for_a_while() -> None:
    trials = [t for seed in range(4) for t in design(np.random.default_rng(seed))]
    assert {t.kind for t in trials} == {"steps", "multisine", "staircase", "releases"}
    for t in trials:
        assert t.command.min() >= 0.0 and t.command.max() <= TOP
        assert np.array_equal(t.command, np.round(t.command))
        assert 0.25 < t.time[changes(t.command)[0]] < 0.85
        assert len(changes(t.command)) > (500 if t.kind == "multisine" else 3)
    highest = np.max([t.command.max(axis=0) for t in trials], axis=0)
    assert highest[0] > 3.5e4 and highest[1] > 1.8e4


@pytest.mark.parametrize("correlation", [0.0, 0.02, 0.08])
def test_noise_has_the_level_and_colour_it_says(correlation: float) -> None:
    base = draw(5, 2, kind="none", trials=8)
    r = dataclasses.replace(base, correlation=correlation, noise=(1e-3, 3e-3))
    found = noise(r)
    assert np.concatenate(found).std(axis=0) == pytest.approx([1e-3, 3e-3], rel=0.12)
    expected = np.exp(-1 / (SAMPLE_RATE * correlation)) if correlation else 0.0
    lag = [np.corrcoef(x[:-1, j], x[1:, j])[0, 1] for x in found for j in (0, 1)]
    assert np.mean(lag) == pytest.approx(expected, abs=0.05)
    assert all(np.array_equal(a, b) for a, b in zip(found, noise(r), strict=True))
    assert abs(np.corrcoef(found[0][:, 0], found[0][:, 1])[0, 1]) < 0.5


# --- simulation

STRONG: list[tuple[tuple[Effect, ...], tuple[Effect, ...]]] = [
    ((), ()),
    ((ParallelSpring("knee", stiffness=0.3, rest=0.9),), ()),
    ((make("coulomb_friction", "baa", {"friction": 2.0}), Creep("maa", stiffness=50.0, time_constant=0.5)), ()),
    ((StribeckFriction("knee", friction=0.02, breakaway=0.03, velocity=0.05), SensorDelay("hip", delay=0.05)), ()),
    ((make("nonlinear_stiffness", "maa", {"cubic": 1e5, "centre": 0.23}),), ()),
    ((make("narrowing_area", "maa", {"loss": 1.0}),), ()),
    ((make("joint_stop", "knee", {"angle": 0.6, "stiffness": 20.0, "damping": 0.1}),), ()),
    ((), (outside.CrossSpring("hip", stiffness=0.3),)),
    ((), (outside.PressureGrowth("baa", growth=0.01),)),
    ((), (outside.Leak("maa", share=0.2),)),
    ((), (outside.RoughSpot("knee", friction=0.05, centre=0.5, width=0.2),)),
    ((), (outside.Cogging("knee", size=0.02, pitch=0.2),)),
]


@pytest.mark.parametrize(("effects", "beyond"), STRONG, ids=lambda e: "+".join(x.name for x in e) or "-")
def test_trials_start_settled(effects: tuple[Effect, ...], beyond: tuple[Effect, ...]) -> None:
    r = ground_truth(effects, beyond)
    (clean,) = simulate(r)
    still = changes(r.trials[0].command)[0] + 1
    assert still > 20
    assert np.abs(clean[:still] - clean[0]).max() < 5e-6
    assert np.ptp(clean[still:], axis=0).max() > 0.01


def test_friction_holds_the_leg_away_from_where_it_would_rest_without() -> None:
    rubbing = ground_truth((make("coulomb_friction", "knee", {"friction": 0.05}),))
    moved = abs(simulate(rubbing)[0][0, 1] - simulate(ground_truth())[0][0, 1])
    assert 1e-3 < moved < 0.1


def test_the_same_ground_truth_gives_the_same_bits() -> None:
    r = ground_truth((Hysteresis("maa", size=1.0, width=5e-3),), trials=2)
    for a, b in zip(simulate(r), simulate(r), strict=True):
        assert np.array_equal(a, b)


@pytest.mark.slow
@pytest.mark.parametrize(
    "effect",
    [
        Hysteresis("maa", size=2.0, width=5e-3),
        make("coulomb_friction", "knee", {"friction": 0.03}),
        make("asymmetric_lag", "baa", {"fill": 0.1, "vent": 0.2}),
        make("payload_mass", "foot", {"mass": 0.05}),
    ],
    ids=lambda e: e.name,
)
def test_the_plant_s_engine_says_the_same(effect: Effect) -> None:
    r = dataclasses.replace(ground_truth((effect,)), rest_bias=np.zeros((1, 4)))
    (clean,), trial = simulate(r), r.trials[0]
    given = Trial("t", trial.time, trial.command, trial.command[0], 0.0, clean[0], trial.time)
    settings = dataclasses.replace(FAST_SETTINGS, timestep=1 / 1920)
    (found,) = simulate_mujoco([Model(r.leg, (effect,))], [given], settings=settings, threads=1)
    assert np.abs(found.position[0] - clean).max() < 2e-5


def test_outside_physics_moves_the_leg() -> None:
    (plain,) = simulate(ground_truth())
    for name in sorted(OUTSIDE):
        cls = OUTSIDE[name]
        place = "knee" if "joint" in cls.sits_at else "maa"
        rows = [sizes.size_of(sizes.leg_table(), name, key, cls.sits_at[0], place) for key in cls.parameter_info()]
        effect = cls(place, **{row.parameter: row.high for row in rows})
        (moved,) = simulate(ground_truth((), (effect,)), rate=480.0)
        assert np.abs(moved - plain).max() > 3e-3, name


def test_what_a_diagnosis_sees_is_rounded_and_tells_nothing() -> None:
    r = ground_truth((Hysteresis("maa", size=1.0, width=5e-3),))
    clean = simulate(r)
    (seen,) = recorded(r, clean)
    assert not seen.notes and seen.name == "trial_00"
    assert np.abs(seen.position - clean[0] - noise(r)[0]).max() <= 0.5001e-5
    assert np.array_equal(seen.command_before, seen.command[0])


# --- how strong a case is


def test_excess_is_nothing_without_and_grows_with_the_missing_physics() -> None:
    def left(delay: float) -> float:
        r = ground_truth((make("transport_delay", "maa", {"delay": delay}),) if delay else (), trials=2)
        return excess(r, simulate(r)).total

    none, weak, strong = left(0.0), left(0.03), left(0.12)
    assert none < 1e-4 < weak < strong
    r = ground_truth((make("transport_delay", "maa", {"delay": 0.12}),), trials=2)
    clean = simulate(r)
    assert excess(r, clean, r.effects, refit=False).total < 1e-4
    assert excess(r, clean, refit=False).total >= strong


# --- seals


def test_a_seal_is_of_one_truth() -> None:
    truth = {"b": [1.5, 2.0], "a": {"name": "Größe"}}
    line = salted(truth, 1, 2)
    assert "\n" not in line and line.isascii()
    assert line == salted(dict(reversed(truth.items())), 1, 2)
    assert opened(line, seal(line))["b"] == [1.5, 2.0]
    assert len(seal(line)) == 64 and salted(truth, 1, 3) != line != salted(truth, 2, 2)
    assert len({salt(s, c) for s in range(5) for c in range(5)}) == 25
    with pytest.raises(ConfigError, match="changed after it was sealed"):
        opened(line.replace("1.5", "1.6"), seal(line), "case 2")


def test_what_is_no_json_is_not_sealed() -> None:
    with pytest.raises(ConfigError, match="cannot be sealed"):
        canonical({"a": float("nan")})
    with pytest.raises(ConfigError, match="cannot be sealed"):
        canonical({"a": object()})


# --- on disk


def snapshot(root: Path) -> dict[str, tuple[int, bytes]]:
    return {str(p.relative_to(root)): (p.stat().st_mtime_ns, p.read_bytes()) for p in root.rglob("*") if p.is_file()}


HERE = OnThisComputer(Workers())
"""This process."""


def request_in(root: Path, **changed: object) -> Request:
    return dataclasses.replace(Request(root, 21, "pair", trials=2, duration=1.5, rate=480.0), **changed)  # type: ignore[arg-type]


def test_cases_are_made_once_and_to_the_bit(tmp_path: Path) -> None:
    told: list[int] = []
    request = request_in(tmp_path / "a")
    made = make_cases(request, [1, 0], HERE, notify=lambda m: told.append(m.case))
    assert told == [1, 0] and [m.case for m in made] == [0, 1] and all(m.seconds > 0 for m in made)
    before = snapshot(request.root)
    assert len(before) == 2 * (2 + 1 + 1)
    again = make_cases(request, [0, 1], HERE)
    assert all(m.seconds == 0 for m in again) and snapshot(request.root) == before
    other = request_in(tmp_path / "b")
    make_case(other, 1)
    for name, (_, content) in snapshot(other.root).items():
        assert content == before[name][1], name


@pytest.mark.parametrize("lost", ["seal", "truth", "trial"])
def test_what_was_cut_off_is_made_again(tmp_path: Path, lost: str) -> None:
    request = request_in(tmp_path, kind="none", trials=1)
    made = make_case(request, 5)
    path = {"seal": request.seal(5), "truth": request.truth(5), "trial": request.recordings(5) / "trial_00.csv"}[lost]
    before = path.read_bytes()
    path.unlink()
    again = make_case(request, 5)
    assert again.seconds > 0 and again.seal == made.seal and path.read_bytes() == before
    assert not list(tmp_path.rglob("*.tmp"))


def test_the_truth_opens_to_what_was_drawn(tmp_path: Path) -> None:
    request = request_in(tmp_path)
    made = make_case(request, 3)
    truth = open_truth(request, 3)
    r = draw(21, 3, kind="pair", trials=2, duration=1.5)
    assert seal(request.truth(3).read_text().strip()) == made.seal == request.seal(3).read_text().strip()
    assert [(f["effect"], tuple(f["locations"]), f["parameters"]) for f in truth["findings"]] == findings(r.effects)
    assert truth["parameters"] == {k: v for k, v in r.leg.parameters().items() if k in truth["parameters"]}
    assert len(truth["parameters"]) == 10 and truth["excess"] >= 0
    assert truth["excess"] == pytest.approx(np.mean(list(truth["excess_joints"].values())), abs=1e-6)
    assert all(f["alone"] >= 0 for f in truth["findings"])
    trial = request.recordings(3) / "trial_00.csv"
    written = trial.read_text()
    trial.write_text(written.replace("\n0.0,", "\n1e-05,", 1))
    with pytest.raises(ConfigError, match="recordings were changed"):
        open_truth(request, 3)
    trial.write_text(written)
    assert open_truth(request, 3) == truth
    request.truth(3).write_text(json.dumps(truth) + "\n")
    with pytest.raises(ConfigError, match="changed after it was sealed"):
        open_truth(request, 3)
    with pytest.raises(ConfigError, match="case 4 cannot be opened"):
        open_truth(request, 4)


def test_the_folder_that_a_diagnosis_gets_holds_recordings_only(tmp_path: Path) -> None:
    request = request_in(tmp_path, kind="outside")
    make_case(request, 2)
    found = recordings.read_set(request.recordings(2))
    assert [r.name for r in found] == ["trial_00", "trial_01"]
    assert {p.suffix for p in request.recordings(2).iterdir()} == {".csv"}
    (truth,) = open_truth(request, 2)["outside"]
    assert truth["effect"] in OUTSIDE and truth["locations"]
    for path in request.recordings(2).iterdir():
        assert truth["effect"] not in path.read_text()


def test_a_folder_of_another_seed_is_refused(tmp_path: Path) -> None:
    make_case(request_in(tmp_path, kind="none", trials=1), 0)
    with pytest.raises(ConfigError, match="choose another folder"):
        make_case(request_in(tmp_path, kind="none", trials=1, seed=22), 0)
    with pytest.raises(ConfigError, match=r"duration_s 1\.5, not 2"):
        make_case(request_in(tmp_path, kind="none", trials=1, duration=2.0), 0)


@pytest.mark.slow
def test_workers_make_the_same_bits(tmp_path: Path) -> None:
    alone, together = request_in(tmp_path / "a", kind="single"), request_in(tmp_path / "b", kind="single")
    with on_this_computer(2) as two:
        seals = [m.seal for m in make_cases(together, range(2), two)]
    assert [m.seal for m in make_cases(alone, range(2), HERE)] == seals


@pytest.mark.slow
def test_a_leg_that_stays_in_its_stops_is_drawn_again(tmp_path: Path) -> None:
    """A diagnosis refuses recordings of noise alone."""
    request = Request(tmp_path, 30115105, None, 2, 6.0, excitation="poor")
    first = request.source.draw(request.seed, 2)
    _, clean = request.source.simulate(first)
    assert max(np.ptp(own, axis=0).max() for own in clean) < 2e-3
    found, moves, truth = request.ground_truth(2)
    assert min(np.ptp(own, axis=0).min() for own in moves) > 0.02
    assert found.effects != first.effects and redrawn(request, truth).effects == found.effects
