"""Small dense quadratic programs through CasADi's interface to well-kept solvers, each answer checked."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.models.buffered import Buffered
from equimus_ctrl.types import Array

_QUIET: dict[str, dict[str, Any]] = {
    "daqp": {},
    "osqp": {"osqp": {"verbose": False, "eps_abs": 1e-7, "eps_rel": 1e-7, "max_iter": 20_000}},
}
SOLVERS = tuple(_QUIET)
"""Names of solvers: a dual active-set method (DAQP, Arnström et al., 2022) and a splitting of operators (OSQP)."""

FEASIBLE = 1e-5
"""By so much may an answer lie outside its bounds."""
STATIONARY = 1e-4
"""So large may the gradient of the Lagrangian be, beside the gradient where nothing is done yet."""


class QuadraticProgram:
    """min ½ xᵀHx + gᵀx  subject to  lower ≤ x ≤ upper,  least ≤ A x ≤ most.

    Args:
        size: of x.
        rows: (m, size) A, or None.
        solver: one of ``SOLVERS``.

    Raises:
        ConfigError: for a solver that there is not.
    """

    def __init__(self, size: int, rows: Array | None = None, solver: str = "daqp") -> None:
        if solver not in _QUIET:
            raise ConfigError(unknown_name("QP solver", solver, _QUIET))
        self._rows = np.zeros((0, size)) if rows is None else np.asarray(rows)
        shapes = {"h": ca.Sparsity.dense(size, size), "a": ca.Sparsity.dense(*self._rows.shape)}
        options = {"error_on_fail": False, "print_time": False, **_QUIET[solver]}
        function = ca.conic("program", solver, shapes, options)
        self._call = Buffered(function)
        names = [function.name_in(i) for i in range(function.n_in())]
        given = dict(zip(names, self._call.arguments, strict=True))
        self._h, self._g, self._first = given["h"], given["g"], given["x0"]
        self._lower, self._upper, self._least, self._most = (given[k] for k in ("lbx", "ubx", "lba", "uba"))
        given["a"][:] = self._rows.T.ravel()
        found = dict(zip([function.name_out(i) for i in range(function.n_out())], self._call.results, strict=True))
        self._x, self._lam_x, self._lam_a = found["x"], found["lam_x"], found["lam_a"]

    def solve(
        self, hessian: Array, gradient: Array, lower: Array, upper: Array, least: Array | None = None,
        most: Array | None = None,
    ) -> Array | None:  # fmt: skip
        """x, or None where the solver found none that is optimal and within all bounds.

        Args:
            hessian: (n, n) symmetric, positive definite.
            gradient: (n,).
            lower: (n,).
            upper: (n,).
            least: (m,) of A x.
            most: (m,).
        """
        self._h[:], self._g[:] = hessian.ravel(), gradient
        self._lower[:], self._upper[:] = lower, upper
        if least is not None and most is not None:
            self._least[:], self._most[:] = least, most
        self._first[:] = 0.0
        try:
            self._call()
        except RuntimeError:
            return None
        x = self._x.copy()
        return x if self._sound(x) else None

    def _sound(self, x: Array) -> bool:
        if not np.isfinite(x).all():
            return False
        h = self._h.reshape(len(x), len(x))
        left = h @ x + self._g + self._lam_x
        outside = max(float((self._lower - x).max()), float((x - self._upper).max()))
        if len(self._rows):
            product = self._rows @ x
            left = left + self._rows.T @ self._lam_a
            outside = max(outside, float((self._least - product).max()), float((product - self._most).max()))
        most = STATIONARY * max(1.0, float(np.abs(self._g).max()))
        return outside <= FEASIBLE and float(np.abs(left).max()) <= most
