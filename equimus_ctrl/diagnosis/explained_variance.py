"""How much of residuals some columns explain beside nuisance parameters, on fitted and on held-out trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.identification.projection import Nuisance
from equimus_ctrl.types import Array

CUT = 1e-6
"""Directions of columns below this share of the strongest, before projecting out nuisances, count as none: they are
the rounding of simulated answers."""
RIDGE = 1e-5
"""Default price of the columns' coefficients, see ``explained``: the coefficient of a direction is halved at 0.003 of
the strongest, and hardly changed from 0.03 on."""


@dataclass(frozen=True, eq=False)
class Explained:
    """What some columns explain of a residual.

    Attributes:
        total: ‖r‖² with the nuisances fitted, χ² where r is white of unit variance; so are the next two.
        gain: by how much the columns lower it.
        held_out: by how much columns that were fitted without a fold lower the fold's own part of it, over all folds;
            0 without folds. Columns that mean nothing come out below 0.
        coefficients: (k,) of the columns.
        rank: how many directions the columns have beyond the nuisances.
    """

    total: float
    gain: float
    held_out: float
    coefficients: Array
    rank: int

    @property
    def share(self) -> float:
        """Of the total that is gained."""
        return self.gain / self.total if self.total > 0 else 0.0


def explained(
    residual: Array,
    nuisance: Nuisance,
    columns: Array,
    ridge: float = RIDGE,
    folds: Sequence[Sequence[slice]] = (),
) -> Explained:
    """Fit columns beside nuisances to a residual by least squares, with a price on the columns' coefficients.

        min ‖r − Q b − C c‖² + ridge·s²·‖D c‖²,    D the norms of the columns, s the largest singular value of C D⁻¹

    Held out, c is fitted without a fold's rows, but b with them. The nuisances are few and the same for all columns;
    were they refitted too, those that the fold itself determines, such as its trials' initial states, would be
    extrapolated, and their errors would mask the columns. As they have seen the fold, the gain there is conservative.

    Along the principal directions of C D⁻¹ less its projection onto Q, with eigenvalues λ and orthonormal B, the price
    is Σ pᵢcᵢ², p = ridge·s²/λ. So cᵢ = (Bᵀr)ᵢ/(1 + pᵢ), and χ² falls by 2cᵀBᵀr − cᵀc = Σ (1 + 2pᵢ) cᵢ².

    Args:
        residual: (n,) r, white, of unit variance.
        nuisance: with the orthonormal basis Q of the nuisances' Jacobian.
        columns: (n, k) C.
        ridge: see above; 0 for none.
        folds: each the rows that are held out together, those of some shooting intervals.

    Raises:
        ConfigError: where numbers of rows differ.
    """
    n = len(residual)
    if len(nuisance.basis) != n or len(columns) != n:
        raise ConfigError(
            f"residual, nuisances and columns have {n}, {len(nuisance.basis)} and {len(columns)} rows, expected as many"
        )
    r = nuisance.project_out(residual)
    size = np.linalg.norm(columns, axis=0)
    size[size == 0] = 1.0
    unit = columns / size
    strongest = np.linalg.eigvalsh(unit.T @ unit).max(initial=0.0)
    free = nuisance.project_out(unit)
    strength, turn = np.linalg.eigh(free.T @ free)
    seen = strength > CUT**2 * strongest
    turn = turn[:, seen] / np.sqrt(strength[seen])
    basis, price = free @ turn, ridge * strongest / strength[seen]
    c = basis.T @ r / (1 + price)
    gain = float((1 + 2 * price) * c @ c)
    return Explained(float(r @ r), gain, _held_out(r, basis, price, folds), turn @ c / size, int(seen.sum()))


def _held_out(r: Array, basis: Array, price: Array, folds: Sequence[Sequence[slice]]) -> float:
    """By how much χ² of the folds falls, each with coefficients that were fitted without it.

    With G = B_fᵀB_f and t = B_fᵀr_f of a fold's rows, c solves (1 + p − G) c = Bᵀr − t, and ‖r_f‖² − ‖r_f − B_f c‖² =
    2cᵀt − cᵀG c.

    Args:
        r: (n,) residual without the nuisances.
        basis: (n, k) B, orthonormal.
        price: (k,) p of the coefficients.
        folds: see ``explained``.
    """
    fall = 0.0
    grams = [sum(basis[rows].T @ basis[rows] for rows in fold) for fold in folds]
    targets = [sum(basis[rows].T @ r[rows] for rows in fold) for fold in folds]
    for gram, target in zip(grams, targets, strict=True):
        c = np.linalg.lstsq(np.diag(1 + price) - gram, basis.T @ r - target, rcond=CUT)[0]
        fall += float(2 * c @ target - c @ gram @ c)
    return fall
