"""A diagnosis made by hand of a leg whose valve has a dead zone, and findings of every effect there is."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from effect_cases import PLAUSIBLE

from equimus_ctrl.diagnosis.coordinates import Coordinate, read
from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.localization import excess_variances
from equimus_ctrl.diagnosis.residuals import ResidualForce, ResidualLocation, Residuals
from equimus_ctrl.diagnosis.results import (
    Detectable,
    Diagnosis,
    Estimate,
    Evidence,
    Finding,
    Named,
    Ranked,
    Rejected,
)
from equimus_ctrl.effects import REGISTRY
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.identification.noise import white_noise
from equimus_ctrl.identification.parameters import free_parameters, unit_of
from equimus_ctrl.identification.residuals import residuals_of
from equimus_ctrl.identification.segments import Segment, cut
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.types import Recording

DRAG = Path(__file__).resolve().parents[1] / "docs" / "examples" / "drag.py"
NOISE = 2e-3
TRUE = 2.8e3
NAMES = ("first", "<b>x", "third")


def part_of(name: str, locations: tuple[str, ...], values: dict[str, float]) -> Part:
    return Part(Candidate(REGISTRY[name], locations, (values,)), values)


def finding_of(part: Part, spread: float = 0.05, evidence: Evidence | None = None) -> Finding:
    whole = replace(nominal_model(), effects=part.effects)
    prefix = whole.effect_prefixes()[0]
    estimates = {
        key: Estimate(value, *sorted((value * (1 - spread), value * (1 + spread))), unit_of(whole, prefix + key))
        for key, value in part.values.items()
    }
    return Finding(part, estimates, evidence or Evidence(812.0, 26.4, -171.3, 205.0, 0.93, 0.91))


def plausible(name: str, spread: float = 0.05) -> Finding:
    return finding_of(part_of(name, *PLAUSIBLE[name]), spread)


def trial(model: Model, index: int) -> Trial:
    """Six seconds of pressures that jump every 1.2 s."""
    rng = np.random.default_rng(index)
    before = np.array([12e3, 6e3])
    times = np.arange(0.0, 6.0, 1 / 60)
    levels = rng.uniform([2e3, 0.0], [34e3, 18e3], (5, 2))
    commands = np.where(times[:, None] < 0.3, before, levels[np.minimum(times / 1.2, 4).astype(int)])
    start = Kinematics(model.morphology).equilibrium(before)
    return Trial(NAMES[index], times, commands, before, 0.0, start, times)


def recorded(model: Model) -> list[Recording]:
    """Three trials of a leg, with noise."""
    trials = [trial(model, k) for k in range(3)]
    rng = np.random.default_rng(7)
    found = []
    for one, predicted in zip(trials, simulate([model], trials, dt=2e-3), strict=True):
        measured = predicted.position[0] + NOISE * rng.standard_normal(predicted.position[0].shape)
        found.append(
            Recording(one.name, one.times, one.commands, measured, ("maa", "baa"), ("hip", "knee"), before=one.before)
        )
    return found


def diagnosed() -> Diagnosis:
    """A leg whose BAA has a dead zone, its parameters and the threshold fitted; found, and something left besides."""
    nominal = nominal_model()
    part = part_of("dead_zone", ("baa",), {"threshold": TRUE})
    recordings = recorded(replace(nominal, effects=part.effects))
    train = tuple(cut(nominal, recordings[:2], fit_start=True))
    heldout = tuple(replace(s, recording=2) for s in cut(nominal, recordings[2:]))
    simulator = reduced_simulator(threads=1)
    data = Data(free_parameters(nominal), list(train), simulator)
    weights = white_noise([np.full((9, 2), NOISE)])
    starts = [s.start for s in train]
    base = data.coarse_fit((), [(data.free.start, starts)], weights, 4)
    begin = (np.append(data.free.start, TRUE), starts)
    best = data.coarse_fit((part,), [begin], weights, 3)
    models = {"nominal": nominal, "refitted": base.fit.model, "corrected": best.fit.model}
    train_residuals = {
        "nominal": tuple(residuals_of(nominal, train, simulator)),
        "refitted": base.fit.residuals,
        "corrected": best.fit.residuals,
    }
    residuals = {
        state: Residuals(train_residuals[state], tuple(residuals_of(model, heldout, simulator)))
        for state, model in models.items()
    }
    return assembled(nominal, base, best, train, heldout, residuals)


def assembled(
    nominal: Model,
    base: Fitted,
    best: Fitted,
    train: tuple[Segment, ...],
    heldout: tuple[Segment, ...],
    residuals: dict[str, Residuals],
) -> Diagnosis:
    value, width = float(best.fit.theta[-1]), float(best.fit.uncertainty.half_width[-1])
    other = Named("supply_coupling", ("baa",))
    found = Finding(
        best.hypothesis[0],
        {"threshold": Estimate(value, value - width, value + width, "Pa")},
        Evidence(base.deviance - best.deviance, 26.4, -math.inf, 205.0, 0.93, 0.91),
        (other,),
    )
    x = np.linspace(0.9, 1.7, 61)
    force = ResidualForce(
        location="hip", share=0.7, coordinates=read("pos.hip·vel.hip"), places=("hip",), gain=88.0, threshold=43.2,
        unit="N·m·s/rad", axis=Coordinate("pos", "hip"), axis_unit="rad", x=x, force=0.02 * np.sin(9 * x),
        band=np.full(61, 4e-3),
    )  # fmt: skip
    ranking = [
        Ranked(found.named, 500.0, 812.0, 35.0),
        Ranked(other, 430.0, 806.0, 35.0),
        *(Ranked(Named(name, locations), 90.0 / k, None, 35.0) for k, (name, (locations, _)) in enumerate(PLAUSIBLE.items(), 1)),
    ]  # fmt: skip
    sigma = np.array([own.sigma for own in best.noise])
    return Diagnosis(
        verdict="partly_explained",
        model=nominal,
        refitted=base.fit.model,
        corrected=best.fit.model,
        base=base,
        best=best,
        train=train,
        validation=heldout,
        test=(),
        residuals=residuals,
        sigma=sigma,
        where=(
            ResidualLocation(
                "knee", 0.83, "at rest (91% of the excess error in 47% of the samples)", "commands of baa of 0 to 4 kPa"
            ),
            ResidualLocation("hip", 0.17, "nowhere in particular", "nowhere in particular"),
        ),
        findings=(found,),
        unexplained=(force,),
        rejected=(
            Rejected(Named("creep", ("maa",)), "unexplained", "it explains nothing more beside a residual force"),
        ),
        ranking=tuple(ranking),
        detectable=(),
        excess_variance={s: float(excess_variances(r.train, sigma).mean()) for s, r in residuals.items()},
        notes=("maa.damping ended at a bound & more.",),
        seconds=21.3,
    )


def explained(d: Diagnosis) -> Diagnosis:
    return replace(d, verdict="explained", unexplained=(), rejected=(), notes=())


def unexplained(d: Diagnosis) -> Diagnosis:
    return replace(d, verdict="unexplained", findings=())


def consistent(d: Diagnosis) -> Diagnosis:
    smallest = (
        Detectable(Named("dead_zone", ("baa",)), "threshold", 61.0, "Pa"),
        Detectable(Named("dead_zone", ("maa", "baa")), "threshold", 50.0, "Pa"),
        Detectable(Named("sensor_scale", ("hip",)), "scale", 2e-3, "1"),
        Detectable(Named("saturation", ("baa",)), "level", math.nan, "Pa"),
    )
    return replace(
        d,
        verdict="consistent",
        findings=(),
        unexplained=(),
        rejected=(),
        notes=(),
        detectable=smallest,
    )


VERDICTS = {
    "partly_explained": lambda d: d,
    "explained": explained,
    "unexplained": unexplained,
    "consistent": consistent,
}
