"""Projection onto the orthogonal complement of the Jacobian of nuisance parameters, to first order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import qr

from equimus_ctrl.types import Array

DEPENDENT = 1e-9
"""Share of its own norm that a column has beside the others below which it has no direction of its own: what finite
differences and rounding leave."""


@dataclass(frozen=True, eq=False)
class Nuisance:
    """The span of some columns C.

    Attributes:
        basis: (N, r) Q, orthonormal, r the rank of C.
        factor: (r, p) QᵀC.
    """

    basis: Array
    factor: Array

    @classmethod
    def of(cls, columns: Array) -> Nuisance:
        """The span of columns (N, p), each in units of its norm (QR with column pivoting; Golub & Van Loan, 5.4.2).

        A column that depends on others to within ``DEPENDENT`` adds no direction, for its remainder is rounding.
        """
        size = np.linalg.norm(columns, axis=0)
        size[size == 0] = 1.0
        basis, triangle = np.linalg.qr(columns / size)
        if not triangle.size:
            return cls(basis, triangle)
        # Pivoting the triangle takes no time beside the columns themselves.
        turn, pivots, _ = qr(triangle, mode="economic", pivoting=True, check_finite=False)
        diagonal = np.abs(np.diag(pivots))
        rank = int((diagonal > DEPENDENT * max(float(diagonal[0]), DEPENDENT)).sum())
        if rank < triangle.shape[1]:
            basis, triangle = basis @ turn[:, :rank], turn[:, :rank].T @ triangle
        return cls(basis, triangle * size)

    def project_out(self, values: Array) -> Array:
        """(N,) or (N, k) values less their projection onto the columns, v − QQᵀv."""
        return np.asarray(values - self.basis @ (self.basis.T @ values))

    def squares_beyond(self, values: Array) -> float:
        """‖v − QQᵀv‖² of values v (N,)."""
        return float((values**2).sum() - ((self.basis.T @ values) ** 2).sum())

    def solution(self, along: Array, cut: float) -> Array:
        """(p,) or (p, k) of the columns, of the least-squares fit to values v of which Qᵀv (r,) or (r, k) is given.

        Without directions weaker than ``cut``.
        """
        return np.asarray(np.linalg.lstsq(self.factor, along, rcond=cut)[0])
