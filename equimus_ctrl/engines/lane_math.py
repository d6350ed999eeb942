"""Elementary functions written so that a loop over lanes can be turned into vector instructions."""

from __future__ import annotations

from numba import njit

_ROUND = 6755399441055744.0
"""1.5·2⁵²: added and taken away again, it rounds a double to a whole number."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _sin_near_zero(r: float) -> float:
    s = r * r
    return r + r * s * (
        -1.66666666666666307295e-1
        + s
        * (
            8.33333333332211858878e-3
            + s
            * (
                -1.98412698295895385996e-4
                + s * (2.75573136213857245213e-6 + s * (-2.50507477628578072866e-8 + s * 1.58962301576546568060e-10))
            )
        )
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _cos_near_zero(r: float) -> float:
    s = r * r
    return (
        1.0
        - 0.5 * s
        + s
        * s
        * (
            4.16666666666665929218e-2
            + s
            * (
                -1.38888888888730564116e-3
                + s
                * (
                    2.48015872888517045348e-5
                    + s
                    * (-2.75573141792967388112e-7 + s * (2.08757008419747316778e-9 + s * -1.13585365213876817300e-11))
                )
            )
        )
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def lane_sin(x: float) -> float:
    """Sine of x to 2e-16 for |x| below 1e5 rad: reduced to |r| ≤ π/4 (Cody and Waite), polynomials of Cephes."""
    k = (x * 0.6366197723675814 + _ROUND) - _ROUND
    r = (x - k * 1.5707963267341256) - k * 6.077100506506192e-11
    quadrant = k - 4.0 * ((k * 0.25 + _ROUND) - _ROUND)  # −2 … 2
    y = _cos_near_zero(r) if abs(quadrant) == 1.0 else _sin_near_zero(r)
    return -y if quadrant == -1.0 or abs(quadrant) == 2.0 else y


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def lane_cos(x: float) -> float:
    """Cosine of x, as ``lane_sin``."""
    k = (x * 0.6366197723675814 + _ROUND) - _ROUND
    r = (x - k * 1.5707963267341256) - k * 6.077100506506192e-11
    quadrant = k - 4.0 * ((k * 0.25 + _ROUND) - _ROUND)
    y = _sin_near_zero(r) if abs(quadrant) == 1.0 else _cos_near_zero(r)
    return -y if quadrant == 1.0 or abs(quadrant) == 2.0 else y
