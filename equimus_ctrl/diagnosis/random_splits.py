"""Random halves of the trials: whether an answer hangs on which of them were fitted (stability selection).

Meinshausen & Bühlmann, "Stability selection", J. R. Stat. Soc. B 72 (2010) 417–473, select on random halves of the data
and trust what is selected in nearly all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from equimus_ctrl.diagnosis.holdout import Holdout, choose_holdout

MOST_DRAWS = 200
"""So many draws in vain end the search for a split that is none of those before."""
ENDS = 0.375, 0.625
"""Between what shares of a trial alone, or alone of its kind, is held out: half of it, more or less."""


def random_holdouts(
    names: Sequence[str], count: int, seed: int = 0, *, test: Sequence[str] = (), groups: Sequence[str] = ()
) -> tuple[Holdout, ...]:
    """What is held out in some random splits, no two of them alike and none the default split.

    The test set is that of the default split: it takes no part in any. Of all other trials half are drawn for
    validation, in each group by itself, and the rest are fitted, one at least. Of a trial of which the end is held out
    by default (``Holdout.ends``) a share within ``ENDS`` is.

    Args:
        names: of all trials, in order.
        count: how many splits; fewer come back where no more are found.
        seed: of the draws.
        test: patterns of names of trials, see ``holdout.choose_holdout``.
        groups: of each trial the one that it belongs to.

    Raises:
        ConfigError: as ``holdout.choose_holdout`` does.
    """
    usual = choose_holdout(names, test=test, groups=groups)
    found: list[Holdout] = []
    for number in range(count):
        rng = np.random.default_rng((seed, number))
        drawn = (_drawn(usual, names, groups, rng) for _ in range(MOST_DRAWS))
        own = next((own for own in drawn if all(map(own.differs, (usual, *found)))), None)
        if own is None:
            break
        found.append(own)
    return tuple(found)


def _drawn(usual: Holdout, names: Sequence[str], groups: Sequence[str], rng: np.random.Generator) -> Holdout:
    """One of them."""
    validation: set[int] = set()
    for group in sorted({*groups}) or [""]:
        own = [k for k in range(len(names)) if not groups or groups[k] == group]
        free = [k for k in own if k not in usual.test | usual.ends]
        validation.update(rng.permutation(free)[: len(free) // 2].tolist())
    share = float(rng.uniform(*ENDS)) if usual.ends else usual.share
    return replace(usual, validation=frozenset(validation), other=frozenset(), share=share)
