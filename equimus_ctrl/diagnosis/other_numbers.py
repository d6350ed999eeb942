"""Numbers that a diagnosis depends on and that are no thresholds of ``policy``: what they decide, and of what they are.

They stand in the modules they are of, each with its reason under it. ``benchmarks/thresholds.py`` does not vary them.
tests/test_policy.py holds this list to the code: each value is that of its module, and no module of ``diagnosis`` has a
number with a name in capitals that is not here, but for grids of values and what divides the progress that is told.

Two have no name there. ``FitSettings.confidence``, 0.95, is that of all intervals; where minima are many, an effect
whose sizes may be nothing by it is not taken (``Data.may_be_nothing``), and a richer law is listed beside a simpler one
that it fits better than by it (``findings``). ``Effect.degenerate`` compares with 1: a stop
softer than what holds its joint, and less than one wave of a ripple, are rejected beside unexplained residuals. What
differs between robots, such as how well a leg's damping is known, stands in ``RobotTraits``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

from equimus_ctrl.diagnosis.threshold import Basis

Role = Literal["evidence", "method", "looked at", "arithmetic", "told"]
"""What a number does:

- evidence: it can change a verdict or a name as a threshold does. It stands elsewhere because what it is of is asked
  before a diagnosis begins, or is no part of it (a fit's uncertainty, an effect).
- method: it belongs to an estimate that decisions rest on: of noise, of held-out trials, of forces.
- looked at: it bounds what is tried, fitted or screened. What is beyond is missed, never accepted.
- arithmetic: steps of differences and what rounding leaves.
- told: it says how much of an answer is told or drawn.
"""
Value = float | tuple[float, ...] | Mapping[str, float]


@dataclass(frozen=True)
class OtherNumber:
    """One number, or a few of one kind.

    Attributes:
        module: under ``equimus_ctrl``.
        name: of it there.
        value: of it.
        role: see ``Role``.
        basis: what kind of reason there is.
        decides: what it decides.
    """

    module: str
    name: str
    value: Value
    role: Role
    basis: Basis
    decides: str


Row = tuple[str, Value, Role, Basis, str]

_ROWS: Mapping[str, tuple[Row, ...]] = {
    # --- what recordings and models have to be ---------------------------------------------------------------------
    "diagnosis.simulated": (
        (
            "SETTLED",
            0.05,
            "method",
            "convention",
            "rounds on the discretisation error end: it changes by less than this of the noise",
        ),
        ("ROUNDS", 6, "method", "convention", "so many of them at most"),
        ("NEARER", 0.5, "evidence", "theory", "the error is shown once: the number is nearer to 1 than to 0 or 2"),
        (
            "SQUARES_LEFT",
            0.1,
            "looked at",
            "convention",
            "residuals are the error times a number: another step is asked",
        ),
        ("SHORTEST", 1 / 16, "looked at", "convention", "of the XML's step, the shortest one that is asked"),
        ("NOISELESS", 1e-4, "looked at", "convention", "noise, of the motion, below which laws with states are asked"),
    ),
    "diagnosis.plausibility": (
        (
            "UNLIKE",
            0.5,
            "evidence",
            "convention",
            "columns are exchanged: what a joint's own drive correlates with less",
        ),
        ("UNIT", 5.0, "evidence", "convention", "forces have another unit; servos are softer than the model says"),
        ("LEAST_ROWS", 30, "evidence", "convention", "independent samples below which no correlation is looked at"),
        ("BEYOND", 0.25, "evidence", "convention", "angles lie beyond a joint's range by this share of it"),
        ("MOST_OUTSIDE", 0.5, "evidence", "convention", "share of the samples that have to lie there"),
        ("MOST_INSIDE", 0.9, "evidence", "convention", "share that another unit has to put within the range"),
        ("WHOLE_TURNS", 2, "evidence", "convention", "turns beyond which angles are not in radians"),
        ("RANGE_OF_DEGREES", 7.0, "evidence", "theory", "ranges below so many degrees were radians: 2π is 6.3"),
        ("COARSE", 2.0, "told", "theory", "an encoder's steps are told: they are most of the noise"),
        ("POWER", 1e-3, "told", "convention", "an encoder has whole bits"),
        ("ROUNDED", 1e-9, "arithmetic", "convention", "forces that vary by so little do not vary"),
        ("FEW", 10, "looked at", "convention", "poses in which a joint's drives are looked for"),
        ("WIDTHS", (4, 8, 16), "looked at", "convention", "widths of test functions"),
        ("LONG_ENOUGH", 8, "looked at", "convention", "widths that a recording has to last"),
        ("DEGREE", 0.017453292519943295, "arithmetic", "theory", "π/180"),
    ),
    "diagnosis.conventions": (
        ("ALIKE", 0.9, "evidence", "convention", "correlation from which on two forces are one, but for size"),
        ("LEAST_MENDED", 2, "evidence", "convention", "joints that one change of convention has to put right"),
        ("FALLS", 0.1, "evidence", "convention", "what such a change leaves of the missing power, at most"),
        ("SAME", 0.5, "told", "convention", "changes told beside the best one"),
        ("LACKS", 0.02, "evidence", "convention", "share of a drive's power that has to be missing"),
        (
            "TURNS",
            (-1.5707963267948966, 1.5707963267948966, 3.141592653589793),
            "looked at",
            "convention",
            "zeros tried",
        ),
    ),
    "diagnosis.servo_gains": (
        ("SHOWN", 0.05, "evidence", "convention", "share of a joint's lag by which its servo's stiffness is shown"),
        ("VARIES", 0.5, "evidence", "convention", "share of a load that varies, to tell it from a constant distance"),
        ("LOADED", 0.05, "evidence", "convention", "share of a load that gravity and others make"),
        ("LEAST_ROWS", 30, "evidence", "convention", "independent samples below which nothing is shown"),
        ("WITHIN", 10.0, "looked at", "convention", "bounds of a stiffness that is estimated"),
        ("WIDTHS", (4, 8, 16), "looked at", "convention", "widths of test functions"),
        ("NO_LIMIT", 1e6, "arithmetic", "convention", "a limit that limits nothing"),
        ("NO_ROTOR", 1e-9, "arithmetic", "convention", "a rotor without inertia"),
    ),
    # --- which trials are fitted, and how they are cut ----------------------------------------------------------------
    "diagnosis.random_splits": (
        ("MOST_DRAWS", 200, "arithmetic", "convention", "draws in vain that end the search for another split"),
        ("ENDS", (0.375, 0.625), "method", "convention", "share of a trial alone that a random split holds out"),
    ),
    "diagnosis.holdout": (
        ("EVERY", 4, "method", "convention", "one trial in so many is held out"),
        ("LAST", 0.25, "method", "convention", "share of a trial alone that is held out"),
        ("LEAST_DURATION", 1.0, "method", "convention", "trials shorter than this [s] are of no use"),
        ("LEAST_SAMPLES", 60, "method", "convention", "nor those of fewer samples"),
        ("MOST_TIME", 240.0, "looked at", "convention", "seconds times joints that are fitted"),
        ("ENOUGH", 8.0, "looked at", "convention", "length of the intervals taken from longer recordings [s]"),
    ),
    "diagnosis.intervals": (
        ("LENGTHS", (8.0, 4.0, 2.0, 1.0, 0.5), "method", "convention", "shooting intervals that are tried [s]"),
        ("CLOSE_TO_MEASURED", 0.5, "method", "convention", "error below which a model's prediction stays close"),
        ("MOSTLY", 0.8, "method", "convention", "share of the intervals in which it has to"),
        ("LOOKED_AT", 30, "method", "convention", "intervals of a length that decide"),
        ("ONCE", 1.5, "method", "convention", "length of short intervals, in crossings of a joint's range"),
        ("FORGOTTEN", 0.2, "method", "convention", "share of a change of the start that is left, at most"),
    ),
    "diagnosis.search_stage": (
        ("SEARCH_BUDGET", 0.75, "looked at", "convention", "share of a budget after which a search ends"),
    ),
    # --- noise, fits and their intervals ------------------------------------------------------------------------------
    "identification.noise": (
        ("LAGS", (0.25, 0.5, 1.0), "method", "theory", "lags over which second differences bound noise"),
        ("SHORTEST", 2e-3, "method", "convention", "shortest correlation of noise [s]"),
        ("LEAST", 1e-7, "method", "convention", "least noise"),
        ("SAME", 1e-9, "arithmetic", "theory", "values that are the same but for rounding"),
        ("LEAST_STEPS", 10, "method", "convention", "an encoder's step is looked for in so many differences at least"),
        ("SMALL_DIFFERENCES", 0.1, "method", "convention", "quantile of the differences that is about a step"),
        ("ONE_STEP", 1.5, "method", "theory", "differences below so many steps are of one"),
        ("OFF_STEP", 0.05, "method", "convention", "how near to whole steps differences have to be"),
        ("WHOLE_STEPS", 0.95, "method", "convention", "share of them that has to be"),
        ("GUESSED_SHARES", (0.1, 0.5, 0.95), "looked at", "convention", "where the search for the noise begins"),
        ("GUESSED_TIMES", (0.01, 0.03), "looked at", "convention", "the same [s]"),
        ("TOLERANCES", {"xatol": 1e-3, "fatol": 1e-7, "maxiter": 120}, "arithmetic", "convention", "where it ends"),
    ),
    "identification.uncertainty": (
        ("UNSEEN", 1e-6, "evidence", "theory", "directions without effect: an effect along one has no name of its own"),
        ("INVOLVED", 1e-2, "evidence", "theory", "parameters that belong to such a direction"),
        ("ZERO", 2.0, "method", "theory", "where residuals' correlation ends: its own error"),
        ("KERNEL", 4, "method", "convention", "correlation times over which scores are summed"),
        ("STRONG", 0.9, "told", "convention", "parameters that are told to trade off"),
    ),
    "identification.projection": (
        ("DEPENDENT", 1e-9, "arithmetic", "theory", "what finite differences leave of a column in the span of others"),
    ),
    "identification.fit": (
        ("IDLE", 1e-9, "arithmetic", "theory", "parameters that are not moved: without effect"),
        ("UNSEEN", 1e-3, "method", "convention", "nor those that change predictions by less of the residuals"),
        ("LEAST_DAMPING", 1e-12, "arithmetic", "convention", "of a step"),
        ("MOST_DAMPING", 1e12, "arithmetic", "convention", "of a step: a fit ends beyond"),
    ),
    "identification.residuals": (
        ("DIVERGED", 3.0, "method", "convention", "residual where a simulation diverges [rad, m or a channel's unit]"),
        ("STARTS", 3, "method", "convention", "how often initial states of held-out trials are improved"),
        ("PARTS", (0.125, 0.25, 0.5), "method", "convention", "of a segment, over which they are improved first"),
        ("DIFFERENCE", 1e-5, "arithmetic", "theory", "step of differences"),
        ("SMALL_DIFFERENCE", 1e-7, "arithmetic", "theory", "of those that grow along a segment"),
    ),
    "identification.segments": (
        ("WIDE", 3.0, "method", "convention", "how much wider the prior of an initial state is than it seems"),
        ("LEAST_REACH", 1e-3, "method", "convention", "least motion of a channel, by which its residuals are weighed"),
        ("LEAST_TRUST", 1e-4, "method", "convention", "least weight of how far a start is from the measured one"),
        ("INSTANTS", 200, "method", "convention", "instants that show how well initial states are read off"),
        ("LEAST_SAMPLES", 10, "method", "convention", "of a segment"),
        ("DELAY_SHARE", 0.2, "looked at", "convention", "longest delay, a bound: at it an effect is not named"),
    ),
    "diagnosis.fitting": (
        (
            "CONVERGED_GAIN",
            0.5,
            "method",
            "convention",
            "gain below which a fit has converged; see Thresholds.exchange",
        ),
        ("PROFILE_FALL", 3.84, "method", "theory", "ends of an interval by profile likelihood: χ²(1), 95 %"),
        ("ROUNDS", 4, "method", "convention", "how often noise and parameters are estimated in turn"),
        ("GRID_NARROWER", 5.0, "looked at", "convention", "grids over parameters in which predictions jump"),
        ("COARSE_TOLERANCE", 10, "looked at", "convention", "where quick fits with coarse derivatives end"),
        ("BLIND", 1e-6, "looked at", "theory", "share of a change below which predictions are even in a parameter"),
        ("BESIDE", (0.005, 0.02, 0.05), "looked at", "convention", "how far beside that fits begin, of its bounds"),
        ("BESIDE_STEPS", 30, "looked at", "convention", "steps of these fits"),
    ),
    "diagnosis.curved_intervals": (
        ("CURVED", 0.2, "method", "convention", "departure of a rise's root from a straight fit's, before refits"),
        ("CLOSE", 0.05, "method", "convention", "share of the root to which an end is found"),
        ("NEAR", 0.25, "method", "convention", "share of a straight interval at which others are refitted first"),
        ("FARTHER", 2.0, "method", "convention", "how much farther they are refitted next"),
        ("WELL_BETWEEN", 0.1, "method", "convention", "what the next value keeps from those about the end"),
        ("LOOKS", 10, "method", "convention", "refits for one end"),
    ),
    # --- what is looked for -------------------------------------------------------------------------------------------
    "diagnosis.candidates": (("BETWEEN_ROWS", 0.5, "looked at", "theory", "shortest delay, a bound too"),),
    "effects.bodies": (
        ("HIGHEST", 0.1, "evidence", "convention", "a surface higher than so is none: it is rejected beside residuals"),
    ),
    "effects.drives": (
        ("SOFT", 1.0, "looked at", "convention", "frequency below which a soft drive is none, a bound [Hz]"),
    ),
    "diagnosis.place_excitation": (
        ("SLOPE_SAMPLES", 4, "looked at", "convention", "samples by which speeds are read off, for first guesses"),
        ("FEW", 400, "looked at", "convention", "samples that show what a place covers"),
        ("SELDOM", 0.95, "looked at", "convention", "what is seldom exceeded"),
        ("LEAST_WAY", 1e-3, "looked at", "convention", "a point that moves less hardly moves [m]"),
        ("EDGE", 0.01, "looked at", "convention", "samples beyond what a coordinate covers"),
    ),
    "diagnosis.moved_parameters": (
        ("LOOKS", 3, "looked at", "theory", "Newton steps of a guess that parameters nearly cancel"),
        ("STRONG", 0.03, "looked at", "convention", "directions along which parameters are moved then"),
    ),
    "diagnosis.guessed_changes": (
        ("LEAST", 0.3, "looked at", "convention", "guesses are rescaled by no less"),
        ("MOST", 3.0, "looked at", "convention", "and by no more"),
        ("WHITE", 0, "arithmetic", "theory", "the place of a whitening"),
        ("ESTIMATED", 1, "arithmetic", "theory", "the place of the other"),
    ),
    "diagnosis.screening": (
        ("PROMISING", 2, "looked at", "convention", "guesses of a candidate at which its fit may begin"),
        ("SHORTER", (0.5, 0.25), "looked at", "convention", "shares of a first-order change at which fits begin too"),
        ("WEAK", 1e-8, "arithmetic", "theory", "directions that are not changed at all"),
    ),
    "diagnosis.groups": (("TRIED", 3, "looked at", "convention", "values of groups that are fitted in a round"),),
    "diagnosis.policy": (("PATIENCE", 1, "looked at", "convention", "rounds that a residual force may outdo"),),
    # --- the torque domain --------------------------------------------------------------------------------------------
    "diagnosis.torque_screening": (
        ("CORRELATED", 1.5, "evidence", "theory", "what χ² there is divided by before thresholds are asked"),
        ("KNOWN_WITHIN", 0.5, "method", "convention", "what is known of parameters before"),
        ("WIDTHS", (2, 4, 6, 8, 12, 16, 24, 32, 48, 64), "method", "convention", "widths of test functions"),
        ("FLAT", 0.1, "method", "convention", "where wider ones are tried no more"),
        ("CROSSES", 0.3, "method", "convention", "the widest, in crossings of a joint's range"),
        (
            "LEAST_SHARE",
            0.5,
            "looked at",
            "convention",
            "recordings shorter than this share of the longest are left out",
        ),
        ("LEAST_WIDTHS", 10, "looked at", "convention", "and those shorter than so many widths"),
        ("WEAK", 1e-10, "arithmetic", "theory", "directions that count as none"),
    ),
    "diagnosis.imitators": (
        ("IMITATES", 0.5, "looked at", "convention", "share of what a part changes that another law imitates"),
        ("MOST_IMITATORS", 5, "looked at", "convention", "so many are fitted in its place"),
        ("ROUNDS", 4, "looked at", "convention", "how often such a fit goes on"),
    ),
    "diagnosis.wider_laws": (("MORE", 2, "looked at", "convention", "further joints, at least, of a wider law"),),
    "diagnosis.compensation": (("WEAK", 1e-6, "looked at", "convention", "directions that make up for nothing"),),
    "diagnosis.torque_columns": (("STEP", 1e-3, "arithmetic", "theory", "step of differences"),),
    "diagnosis.torque_guesses": (
        ("FAR", 3.0, "looked at", "convention", "noise above which laws are looked for in the torque domain"),
        ("EVALUATIONS", 20, "looked at", "convention", "of a fit there"),
        ("WORST", 1e3, "arithmetic", "convention", "what is left where a robot cannot have an effect"),
    ),
    "diagnosis.torque_start": (
        ("START_SHARE", 0.1, "looked at", "convention", "what a law explains with which a search begins"),
        (
            "ABOUT",
            0.9,
            "looked at",
            "convention",
            "what a simpler law explains of that; one law in the place of several",
        ),
        ("BEHIND", 0.05, "looked at", "convention", "candidates that are not simulated in a round"),
        ("AT_LEAST", 12, "looked at", "convention", "but these are"),
        ("SURE", 3.0, "looked at", "theory", "standard errors of a law's size at a place, to begin with it"),
    ),
    # --- residual forces ----------------------------------------------------------------------------------------------
    "diagnosis.residual_force": (
        ("SLOWEST", 0.2, "looked at", "theory", "disturbances in time [Hz]"),
        ("FASTEST", 4.0, "looked at", "theory", "the same"),
        ("PERIOD_SAMPLES", 5, "looked at", "convention", "samples in a period of the fastest"),
        ("LONGEST", 12.0, "looked at", "convention", "how close frequencies are [s]"),
        ("FOLDS", 3, "method", "convention", "of the cross-validation"),
        ("BOUND", 1e9, "method", "convention", "answers of an instability: such a force explains nothing"),
    ),
    "diagnosis.explained_variance": (
        ("CUT", 1e-6, "method", "theory", "directions of columns that count as none"),
        ("RIDGE", 1e-5, "method", "convention", "price of a force's coefficients"),
    ),
    "diagnosis.force_basis": (
        ("FUNCTIONS", 8, "looked at", "convention", "splines along one coordinate"),
        ("SPOTS", 16, "looked at", "convention", "of dry friction over the angle"),
        ("FINE", 40, "looked at", "convention", "of finer detail"),
        ("SURFACE", 5, "looked at", "convention", "along each of two coordinates"),
        ("DEGREE", 3, "looked at", "convention", "of the splines"),
        ("SLOW", 1e-3, "looked at", "convention", "rate over which dry friction turns"),
        ("MEMORIES", (0.1, 0.3, 1.0, 3.0, 10.0), "looked at", "convention", "time constants [s]"),
        ("AT_ONCE", 512, "arithmetic", "convention", "columns carried along together"),
    ),
    "diagnosis.linear_response": (
        ("STILL", 1e-6, "arithmetic", "convention", "rate up to which a place with dry friction sticks"),
        ("LOCK", 1e6, "arithmetic", "convention", "how fast its motion dies away then"),
        ("SPEED", 30.0, "arithmetic", "convention", "a velocity as large as a position of 1"),
        ("SMALL", 1e-6, "arithmetic", "theory", "step of a difference"),
        ("LARGEST", 0.5, "arithmetic", "theory", "of a series"),
        ("TERMS", 10, "arithmetic", "theory", "of it"),
    ),
    "diagnosis.force_response": (("STEP", 2e-3, "arithmetic", "convention", "physics step of linearised motions [s]"),),
    "diagnosis.unexplained": (
        ("TRIED", 5, "looked at", "convention", "residual forces that may replace an effect"),
        ("MOST", 3, "told", "convention", "residual forces that are reported"),
        ("REFIT", 12, "looked at", "convention", "steps of the fit to everything"),
        ("UNTOLD", 1e-4, "told", "convention", "what of a force's curve is not determined"),
        ("POINTS", 61, "told", "convention", "of the curve"),
        ("CONFIDENT", 1.96, "told", "theory", "of its band: normal distribution, 95 %"),
    ),
    "diagnosis.forces_beside": (
        ("WIDER", (1, 2), "looked at", "convention", "widths at which the torque domain is asked for smooth forces"),
        ("CONFIDENT", 1.96, "told", "theory", "of a force's band: normal distribution, 95 %"),
    ),
    "diagnosis.smooth_laws": (("POINTS", 61, "told", "convention", "of a force's curve"),),
    "diagnosis.friction_over_angle": (
        ("COVERED", (0.02, 0.98), "method", "convention", "quantiles of measured angles that its knots are between"),
        ("SIZES", (0.01, 0.03, 0.1, 0.3), "looked at", "convention", "with which fits of it begin"),
        ("REFINED", 4, "looked at", "convention", "times that its knots are moved to where it is largest"),
        ("CLOSER", 3, "looked at", "convention", "times that they are closer together there then"),
        ("PEAKS", 2, "looked at", "convention", "angles at which that is tried"),
        ("EVEN", 0.1, "method", "convention", "share of even knots in those that follow the samples"),
    ),
    # --- what is told -------------------------------------------------------------------------------------------------
    "diagnosis.explanations": (
        ("MOST", 8, "told", "convention", "explanations that are kept beside the one given, for experiments"),
        ("GUESSES", 500, "looked at", "convention", "of sizes, for the smallest detectable ones"),
        ("MOST_LOOKED_AT", 16, "looked at", "convention", "effects that may hide beside what was found"),
        ("MOST_NEAREST", 3, "told", "convention", "of those that come nearest to what has no name"),
    ),
    "diagnosis.smallest_sizes": (
        ("ROUNDS", 4, "looked at", "convention", "how often sizes are looked at again"),
        ("NEAR", 1.5, "told", "convention", "factor of χ² from the threshold within which a size is told"),
        ("FAR", 10.0, "told", "convention", "and beyond which nothing is said of it"),
        ("MOST_CHANGED", 30.0, "looked at", "convention", "factor by which a size changes from one round to the next"),
    ),
    "diagnosis.rivals": (
        (
            "MOST_HIDDEN",
            4,
            "told",
            "convention",
            "effects that may hide beside what was found, or fit better than what is named",
        ),
        (
            "UNIFORM",
            12.0,
            "told",
            "theory",
            "variance of what recordings do not show: uniform within bounds",
        ),
        ("STEPS", 20, "told", "convention", "of a fit of a rival to other trials, or of another size"),
        ("TIGHT", 1e-12, "arithmetic", "convention", "room for what is at a bound, in units of its scale"),
    ),
    "diagnosis.localization": (
        ("JUST", 0.5, "told", "convention", "how long after a command is just after it [s]"),
        ("STILL", 0.05, "told", "convention", "speed of a joint at rest"),
        ("LEAST_SAMPLES", 0.03, "told", "convention", "samples of a phase that is told"),
        ("DENSE", 1.2, "told", "convention", "its excess variance"),
        ("REGIONS", 3, "told", "convention", "of a coordinate"),
        ("SLOPE", 4, "told", "convention", "samples by which speeds are read off"),
    ),
}


def other_numbers() -> Iterator[OtherNumber]:
    """All of them, module by module."""
    for module, rows in _ROWS.items():
        for name, value, role, basis, decides in rows:
            yield OtherNumber(module, name, value, role, basis, decides)
