"""The thresholds by which recordings are judged: meaning, unit and origin of each, as in ``diagnosis.thresholds``."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

from equimus_ctrl.diagnosis.threshold import Threshold, decided_by


@dataclass(frozen=True)
class CheckLimits:
    """The thresholds by which recordings are judged; ``listed`` gives them all."""

    significance: float = decided_by(
        1e-3,
        "",
        "probability of seeing motion where there is noise alone: in a frequency, behind a step of a command, and "
        "in a joint's scatter",
        "theory",
        "χ² of the estimate, with Bonferroni's correction for the number of frequencies, instants or recordings",
        where="findings signals latency",
    )
    gap: float = decided_by(
        5.0,
        "median intervals",
        "a time between rows from which on rows are missing",
        "convention",
        "jitter of an interval is a share of it; with five missing rows a joint may have moved and come back unseen",
        where="scatter",
    )
    burst: float = decided_by(
        0.1,
        "median intervals",
        "a time between rows below which stamps say when rows arrived, not when they were measured",
        "convention",
        "no sensor with a rate of its own is ten times as fast for one sample",
        where="judgement scatter",
    )
    jitter: float = decided_by(
        1.0,
        "noise",
        "the error that a wrong stamp makes at the usual speed of the joint, over the joint's noise, from which on it "
        "matters",
        "theory",
        "a stamp that is off by δt shifts a position by v·δt; as large as the noise, it doubles the variance",
        where="judgement",
    )
    held: float = decided_by(
        0.2,
        "of the rows in motion",
        "share of rows that repeat the value before, though the joint moves by several steps a row: then measurements "
        "come from another clock than rows",
        "convention",
        "a sensor that gives four values in five rows, whose stamps are off by half a row in the mean where it repeats",
        where="judgement signals",
    )
    coarse: float = decided_by(
        3.0,
        "steps of the sensor",
        "travel of a joint's measurements below which its sensor's steps are no noise, but all there is",
        "theory",
        "from a standard deviation of one step on, the quantisation error is white, of variance q²/12 (Widrow & "
        "Kollár, Quantization Noise, 2008); a sine that large travels 2√2 steps, which takes four values, and travel, "
        "unlike the deviation, does not depend on how long a joint rests beside",
        where="findings",
    )
    flat: float = decided_by(
        3.0,
        "noise or steps",
        "motion that a measurement hides at its extreme, and speed in steps a row with which it enters there where "
        "steps are larger than the noise: a clipped sensor or a hard stop, and no rest",
        "theory",
        "three standard deviations; a joint that comes to rest slows down before",
        where="signals",
    )
    saturated: float = decided_by(
        0.05,
        "of the rows",
        "share of rows with a command at its limit from which on it is told",
        "convention",
        "a twentieth of the recording shows nothing of what more command would do",
        where="judgement",
    )
    spread: float = decided_by(
        2.0,
        "noise",
        "difference between repeats from which on something else than noise differs between them",
        "convention",
        "variance above noise three times that of the noise, the number from which a joint's residuals are unexplained "
        "(far_off of diagnose)",
        where="judgement",
    )
    differs: float = decided_by(
        2.0,
        "",
        "ratio of one recording's noise, rate or step to the median of all from which on it is told",
        "convention",
        "a factor of four in the variance, by which one recording would weigh too much or too little",
        where="judgement",
    )
    zero: float = decided_by(
        6.0,
        "standard deviations",
        "difference of two poses at rest under the same commands from which on zeros, friction or creep differ",
        "theory",
        "standard deviation of a mean over the samples of a rest, and of the noise if that is correlated over all "
        "of it",
        where="judgement",
    )

    @classmethod
    def listed(cls) -> Iterator[Threshold]:
        """All of them."""
        for own in fields(cls):
            yield Threshold(own.name, own.default, **own.metadata)  # type: ignore[arg-type]


LIMITS = CheckLimits()
