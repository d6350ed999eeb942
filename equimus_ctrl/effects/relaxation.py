"""A pressure that follows its target with a lag and a greatest rate, in closed form, with its first two moments."""

from __future__ import annotations

import math

from numba import njit

SMALL_SHARE = 1e-3
"""Below this many time constants the closed forms lose digits and their series are used."""


@njit(cache=True, nogil=True, error_model="numpy")
def decay_moments(x: float) -> tuple[float, float, float]:
    """(e⁻ˣ, ∫₀¹ e⁻ˣˢ ds, ∫₀¹ s e⁻ˣˢ ds)."""
    if x < SMALL_SHARE:
        return math.exp(-x), 1.0 - x / 2.0 + x * x / 6.0, 0.5 - x / 3.0 + x * x / 8.0
    lost = -math.expm1(-x)
    return 1.0 - lost, lost / x, (lost - x * (1.0 - lost)) / (x * x)


@njit(cache=True, nogil=True, error_model="numpy")
def relax(
    pressure: float, target: float, fill: float, vent: float, rate: float, duration: float
) -> tuple[float, float, float]:
    """dP/dt = (target − P)/τ, at most ``rate`` in size, with τ = fill while the pressure rises, vent while it falls.

    Exact for a constant target: first a ramp at the greatest rate, then an exponential.

    Args:
        pressure: at the start [Pa].
        target: [Pa].
        fill: [s], 0 for none.
        vent: [s], 0 for none.
        rate: [Pa/s], inf for no limit.
        duration: [s].

    Returns:
        (P at the end [Pa], ∫P ds [Pa·s], ∫P s ds [Pa·s²]).
    """
    gap = target - pressure
    tau = fill if gap > 0.0 else vent
    area, moment, past = 0.0, 0.0, 0.0
    if rate < math.inf and abs(gap) > rate * tau:
        ramp = min(abs(gap) / rate - tau, duration)
        climb = rate if gap > 0.0 else -rate
        area = (pressure + 0.5 * climb * ramp) * ramp
        moment = (0.5 * pressure + climb * ramp / 3.0) * ramp * ramp
        if ramp == duration:
            return pressure + climb * ramp, area, moment
        gap -= climb * ramp
        past = ramp
    left = duration - past
    if tau <= 0.0:
        piece, first, gap_end = 0.0, 0.0, 0.0
    else:
        decay, mean, centre = decay_moments(left / tau)
        piece, first, gap_end = gap * mean * left, gap * centre * left * left, gap * decay
    area += target * left - piece
    moment += 0.5 * target * left * left - first + past * (target * left - piece)
    return target - gap_end, area, moment


@njit(cache=True, nogil=True, error_model="numpy")
def relax_along(
    pressure: float, target: float, slope: float, fill: float, vent: float, rise: float, fall: float, duration: float
) -> tuple[float, float, float]:
    """``relax`` towards a target that moves along a line, target + slope·t; exact.

    The gap g = target + slope·t − P obeys dg/dt = slope − g/τ where |g| ≤ rate·τ, and dg/dt = slope ∓ rate beyond. What
    follows is cut where g changes its sign, and with it τ, and where the greatest rate begins or ceases to bind.

    Args:
        pressure: as in ``relax``, as what is not named here.
        target: at the start [Pa].
        slope: of the target [Pa/s].
        fill: as there.
        vent: as there.
        rise: greatest rate up [Pa/s].
        fall: greatest rate down [Pa/s].
        duration: [s].
    """
    area, moment, past = 0.0, 0.0, 0.0
    binds, eased = False, False
    while past < duration:
        left, gap = duration - past, target - pressure
        up = gap > 0.0 or (gap == 0.0 and slope > 0.0)
        sign, tau, rate = (1.0, fill, rise) if up else (-1.0, vent, fall)
        most = rate * tau if tau > 0.0 else 0.0
        grows = sign * gap >= most and sign * slope > rate
        if binds or grows or (sign * gap > most and not eased):
            if rate == math.inf:  # at once
                pressure = target
                eased = True
                continue
            closing = rate - sign * slope
            span = min((sign * gap - most) / closing, left) if closing > 0.0 else left
            piece = (pressure + 0.5 * sign * rate * span) * span
            first = (0.5 * pressure + sign * rate * span / 3.0) * span * span
            pressure += sign * rate * span
            binds, eased = False, span < left
            target += slope * span
            if eased:
                pressure = target - sign * most
        elif tau <= 0.0:
            span = left
            piece = (target + 0.5 * slope * span) * span
            first = (0.5 * target + slope * span / 3.0) * span * span
            target += slope * span
            pressure = target
        else:
            final = slope * tau
            span, meets = left, False
            if gap * final < 0.0:
                until = tau * math.log1p(-gap / final)
                span, meets = (until, True) if until < left else (left, False)
            elif sign * final > most:
                until = tau * math.log((final - gap) / (final - sign * most))
                span, binds = (until, True) if until < left else (left, False)
            decay, mean, centre = decay_moments(span / tau)
            off = gap - final
            piece = (target + 0.5 * slope * span - final - off * mean) * span
            first = (0.5 * (target - final) + slope * span / 3.0 - off * centre) * span * span
            target += slope * span
            pressure = target - (0.0 if meets else sign * most if binds else final + off * decay)
            eased = False
        area += piece
        moment += first + past * piece
        past = duration if span == left else past + span
    return pressure, area, moment
