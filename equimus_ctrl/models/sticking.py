"""Dry friction at the end of a step: which of its rows stick, and the impulses that hold these, in CasADi.

Impulses x at the rows change their rates by A x, A = GM⁻¹Gᵀ. Coulomb's law over a step: a row's impulse is at one of
its bounds and the rate does not go with it, or it is between them and the rate is 0. Rows are taken to be at a bound or
to stick, these are solved for, and which are which follows from the solution until it no longer changes (primal-dual
active sets; Hintermüller, Ito & Kunisch, 2002).
"""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

SINGULAR = 1e-12
"""Share of its own mobility that a row has beside others, below which they hold it already."""


@dataclass(frozen=True, eq=False)
class Sticking:
    """CasADi SX expressions; the symbols are all but ``sides``, ``still_sought`` and ``found``.

    Attributes:
        side: (nr,) 1 or −1 where friction is at its upper or lower bound, 0 where a row sticks.
        sought: (1,) 1 where friction is sought still, else 0.
        phi: (nr,) friction.
        slip: (nr,) the rows' rates with it at the end of the step.
        mobility: (nr, nr) A.
        bound: (nr,) the greatest friction.
        span: (nr,) for how long a row's friction acts.
        sides: (nr,) ``side`` as ``phi`` and ``slip`` ask for.
        still_sought: (1,) ``sought``, where ``sides`` are others than ``side``.
        found: (2 nr,) ``slip`` and ``phi`` with that friction, where it is sought.
    """

    side: ca.SX
    sought: ca.SX
    phi: ca.SX
    slip: ca.SX
    mobility: ca.SX
    bound: ca.SX
    span: ca.SX
    sides: ca.SX
    still_sought: ca.SX
    found: ca.SX


def sticking(n: int) -> Sticking:
    """What finds the friction of n rows."""
    side, sought, phi, slip, bound, span = (
        ca.SX.sym(name, size)
        for name, size in (("side", n), ("sought", 1), ("phi", n), ("slip", n), ("bound", n), ("span", n))
    )
    mobility = ca.SX.sym("mobility", n, n)
    own = ca.diag(mobility) * span
    asked = phi - ca.if_else(own > 0, slip / own, 0)
    sides = (asked >= bound) - (asked <= -bound) * (asked < bound)
    changes = ca.SX(0)
    for r in range(n):
        changes = changes + (sides[r] != side[r])
    sticks = side == 0
    to_bound = ca.if_else(sticks, 0, side * bound - phi) * span
    change = sought * _held(mobility, sticks, to_bound, -(slip + mobility @ to_bound))
    found = ca.vertcat(slip + mobility @ change, phi + change / span)
    return Sticking(
        side, sought, phi, slip, mobility, bound, span, sides, sought * (changes > 0) if n else sought, found
    )


def _held(mobility: ca.SX, sticks: ca.SX, given: ca.SX, aim: ca.SX) -> ca.SX:
    """(n,) ``given`` where a row does not stick, and what solves A x = aim for those that do: by L D Lᵀ."""
    n = sticks.numel()
    x = [ca.if_else(sticks[r], aim[r], given[r]) for r in range(n)]
    lower = [[ca.SX(0)] * n for _ in range(n)]
    inverse: list[ca.SX] = []
    for r in range(n):
        scaled: list[ca.SX] = []
        for s in range(r):
            entry = mobility[r, s] * (sticks[r] * sticks[s])
            for t in range(s):
                entry = entry - scaled[t] * lower[s][t]
            scaled.append(entry)
        pivot = ca.if_else(sticks[r], mobility[r, r], 1)
        least = SINGULAR * pivot
        for s in range(r):
            lower[r][s] = scaled[s] * inverse[s]
            pivot = pivot - scaled[s] * lower[r][s]
        inverse.append(ca.if_else(pivot > least, 1 / pivot, 0))
    for r in range(n):
        for s in range(r):
            x[r] = x[r] - lower[r][s] * x[s]
    for r in reversed(range(n)):
        x[r] = x[r] * inverse[r]
        for s in range(r + 1, n):
            x[r] = x[r] - lower[s][r] * x[s]
    return ca.vertcat(*x, ca.SX(0, 1))
