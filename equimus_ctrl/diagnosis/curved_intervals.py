"""95 % intervals of an effect's parameters where the fit is curved, by profile likelihood.

θ ± t·s holds where predictions are linear in the parameters. A tether to a far point and a stiffer one to a near point
pull alike: such a minimum is long and curved, and derivatives there tell little of how long. So predictions are
simulated at both ends of an interval, the other parameters moved along as derivatives say. Where the misfit does not
rise as it should, the others are refitted there, and the end goes to where the misfit has risen as far (Bates and
Watts, 1988, Nonlinear Regression Analysis and Its Applications, ch. 6; the signed root of the rise is their ζ).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.diagnosis.fitting import Data, Fitted
from equimus_ctrl.errors import SimulationDiverged
from equimus_ctrl.identification.fit import FitSettings, fit
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.identification.whitened_fit import WhitenedFit, whiten_fit
from equimus_ctrl.types import Array

CURVED = 0.2
"""Share by which the root of the rise may differ from a straight fit's before the others are refitted."""
CLOSE = 0.05
"""Share of the root of the rise to which an end is found."""
NEAR, FARTHER = 0.25, 2.0
"""Share of a straight fit's interval at which others are refitted first, and the factor by which it grows."""
WELL_BETWEEN = 0.1
"""Share of the distance between two values that is kept from both of them."""
LOOKS = 10
"""How many values are refitted at for one end, at most."""
REFIT = FitSettings(1e-4, 20)
"""Of the others at one value."""


@dataclass(frozen=True)
class _Way:
    """Where an end lies, and how the others go along.

    Attributes:
        place: of the parameter in θ.
        width: half of the interval of a straight fit, negative towards its lower end [unit of the parameter].
        change: (p,) of all parameters with it, as derivatives say [unit of each].
        root: ζ, the root of the rise of the misfit there, of a straight fit.
    """

    place: int
    width: float
    change: Array
    root: float


def curved_ends(data: Data, fitted: Fitted, places: Sequence[int]) -> dict[tuple[int, int], float]:
    """Ends of intervals that are not where ``Uncertainty.half_width`` has them, by profile likelihood.

    Args:
        data: that was fitted to.
        fitted: the hypothesis.
        places: of parameters in θ, whose intervals are finite and along which predictions do not jump.

    Returns:
        (place, −1 or 1) → that end, the bound where the misfit does not rise enough within it, ±inf where it does
        nowhere that was looked at [unit of the parameter]. None where nothing else is free.

    Raises:
        BudgetSpent: where the budget ends.
    """
    if len(fitted.fit.theta) < 2:
        return {}
    whitened = whiten_fit(data.times, fitted.fit, fitted.noise)
    ways = list(_ways(fitted, whitened, places))
    return {
        (way.place, int(np.sign(way.width))): _end(data, fitted, way)
        for way, rise in zip(ways, _rises(data, fitted, whitened, ways), strict=True)
        if not abs(math.sqrt(max(rise, 0.0)) / way.root - 1.0) < CURVED
    }


def _ways(fitted: Fitted, whitened: WhitenedFit, places: Sequence[int]) -> Iterator[_Way]:
    """To both ends of each parameter's interval, but those that lie beyond its bounds."""
    at, parameters, slopes = fitted.fit, fitted.fit.parameters, whitened.slopes
    for place in places:
        along = np.linalg.lstsq(np.delete(slopes, place, axis=1), -slopes[:, place], rcond=None)[0]
        change = np.insert(along, place, 1.0)
        own, half = float(np.linalg.norm(slopes @ change)), float(at.uncertainty.half_width[place])
        for width in (-half, half):
            steps = width / parameters.scale[place]
            if own * abs(steps) > 0 and parameters.low[place] < at.theta[place] + width < parameters.high[place]:
                yield _Way(place, width, change * steps * parameters.scale, own * abs(steps))


def _rises(data: Data, fitted: Fitted, whitened: WhitenedFit, ways: Sequence[_Way]) -> list[float]:
    """Rises of the misfit at the ends, the other parameters refitted there to first order; inf where it diverges."""
    if not ways:
        return []
    data.budget.check()
    at, parameters = fitted.fit, fitted.fit.parameters
    thetas = [np.clip(at.theta + way.change, parameters.low, parameters.high) for way in ways]
    models = [parameters.model_at(theta) for theta in [at.theta, *thetas]]
    predicted = data.simulator(models, at.problem.segments, [np.tile(s, (len(models), 1)) for s in at.starts])
    changes = [np.moveaxis(p.position[1:] - p.position[0], 0, -1) for p in predicted]
    residuals = whitened.residual[:, None] - whitened.columns(data.times, changes)
    found = []
    for way, residual in zip(ways, residuals.T, strict=True):
        if np.all(np.isfinite(residual)):
            beside = Nuisance.of(np.delete(whitened.slopes, way.place, axis=1))
            there, here = (float((beside.project_out(r[:, None]) ** 2).sum()) for r in (residual, whitened.residual))
            found.append(there - here)
        else:
            found.append(math.inf)
    return found


def _end(data: Data, fitted: Fitted, way: _Way) -> float:
    """Where the misfit has risen by ζ², all others refitted; see ``curved_ends``.

    From near the fit outwards, each refit begun where the ones before it lead: far from a fit its minimum is lost.
    Where that is not found within ``LOOKS``, the end is the nearest value at which the misfit has risen by more.
    """
    at = fitted.fit
    bounds = at.parameters.low[way.place], at.parameters.high[way.place]
    bound = float(bounds[way.width > 0])
    farthest = (bound - float(at.theta[way.place])) / way.width

    def value(share: float) -> float:
        return bound if share == farthest else float(at.theta[way.place]) + share * way.width

    def held(share: float, begins: Sequence[Array]) -> tuple[float, Array]:
        try:
            return _held(data, fitted, way.place, value(share), begins)
        except SimulationDiverged:
            return math.inf, begins[0]

    floor, begun = held(0.0, [at.theta])
    inner, outer = (0.0, 0.0), (math.inf, math.inf)  # (share of the width, ζ) about the end
    slope, share = way.change, min(NEAR, farthest)
    for _ in range(LOOKS):
        cost, theta = held(share, [begun + slope * (share - inner[0]), begun])
        root = math.sqrt(max(cost - floor, 0.0))
        if abs(root - way.root) < CLOSE * way.root or (root < way.root and share == farthest):
            return value(share)
        if root < way.root:
            slope, begun, inner = (theta - begun) / (share - inner[0]), theta, (share, root)
        else:
            outer = (share, root)
        share = _between(inner, outer, way.root, farthest)
    return value(outer[0]) if math.isfinite(outer[0]) else math.copysign(math.inf, way.width)


def _between(inner: tuple[float, float], outer: tuple[float, float], root: float, farthest: float) -> float:
    """The share at which the root is expected to be reached, from one where it is not and one where it is exceeded.

    Well between both: where a refit has lost its minimum, the root is far too large.
    """
    (near, low), (far, high) = inner, outer
    if not math.isfinite(far):
        return min(near * FARTHER, farthest)
    within = (root - low) / (high - low) if math.isfinite(high) else 0.0
    return near + (far - near) * min(max(within, WELL_BETWEEN), 1 - WELL_BETWEEN)


def _held(data: Data, fitted: Fitted, place: int, value: float, begins: Sequence[Array]) -> tuple[float, Array]:
    """(misfit, (p,) θ) of all parameters but one, which is held at a value."""
    data.budget.check()
    parameters, at = fitted.fit.parameters, fitted.fit
    held = parameters.held(place, value)
    begin = [(np.clip(np.delete(theta, place), held.low, held.high), at.starts) for theta in begins]
    found = fit(held, at.problem.segments, simulator=data.simulator, settings=REFIT, noise=fitted.noise, begin=begin)
    return found.cost, np.insert(found.theta, place, value)
