"""Elementary functions written so that a loop over lanes can be turned into vector instructions."""

from __future__ import annotations

from numba import njit

_ROUND = 6755399441055744.0
"""1.5·2⁵²: added and taken away again, it rounds a double to a whole number."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _half_turns(x: float) -> float:
    """The nearest whole number to x/π."""
    return (x * 0.3183098861837907 + _ROUND) - _ROUND


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _rest(x: float, k: float) -> float:
    """What is left of x without k·π, whose first part times k is exact (Cody & Waite, 1980)."""
    return (x - k * 3.1415926534682512) - k * 1.2154201013012384e-10


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _sign(k: float) -> float:
    """−1 where k is odd, else 1."""
    return 1.0 - 2.0 * abs(k - 2.0 * ((k * 0.5 + _ROUND) - _ROUND))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def lane_sin(x: float) -> float:
    """Sine of x to 4e-16 for |x| below 1e5 rad: reduced to |r| ≤ π/2, a polynomial through Chebyshev's nodes.

    No branch, not even a choice between two numbers; polynomials in pairs (Estrin), so that little waits for another.
    """
    k = _half_turns(x)
    r = _rest(x, k)
    s = r * r
    s2 = s * s
    low = (-0.16666666666666666 + s * 0.008333333333333316) + s2 * (
        -0.00019841269841254974 + s * 2.7557319219163183e-06
    )
    high = (-2.5052107616990068e-08 + s * 1.60589773120677e-10) + s2 * (
        -7.643970284142959e-13 + s * 2.7314446091851363e-15
    )
    return _sign(k) * (r + r * s * (low + (s2 * s2) * high))


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def lane_cos(x: float) -> float:
    """Cosine of x, as ``lane_sin``."""
    k = _half_turns(x)
    r = _rest(x, k)
    s = r * r
    s2 = s * s
    low = (-0.5 + s * 0.04166666666666634) + s2 * (-0.0013888888888860709 + s * 2.4801587292446122e-05)
    high = (-2.7557317767308945e-07 + s * 2.087663086667205e-09) + s2 * (
        -1.1464689861744774e-11 + s * 4.6276756860773096e-14
    )
    return _sign(k) * (1.0 + s * (low + (s2 * s2) * high))
