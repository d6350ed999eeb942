"""How a diagnosis fits and searches, as what is known of the robot and of the engine asks."""

from __future__ import annotations

from dataclasses import dataclass, replace

from equimus_ctrl.engines.base import Engine
from equimus_ctrl.robots.base import RobotTraits

PATIENCE, VALLEYS = 1, 20.0
"""Where fits have many local minima, see ``SearchSettings``: forces at joints do much alike there, and rub."""


@dataclass(frozen=True)
class SearchSettings:
    """How a search goes.

    Attributes:
        most_parts: largest number of effects in a hypothesis.
        level: chance of believing in one effect where there is none.
        least_share: of the noise's variance, which an effect has to take away to count at all; two simulations of one
            leg differ by some of that.
        tried: candidates fitted at each stage, for each way to weigh the residuals.
        kept: of them, how many are fitted to the end.
        patience: how many effects in a row may explain far less than a flexible push, for what they do together: of
            two that are missing each may.
        valleys: by so much deviances scatter with where a search ends: dry friction gives a fit many local minima.
        many_minima: fits may end in many local minima, for errors grow along a trial: what a small change does tells
            little of what a fit will find. So all candidates are tried where the promising ones do not lead on and much
            is left, and rivals of a part are found among all that was fitted, not by small differences of deviance.
    """

    most_parts: int = 3
    level: float = 1e-3
    least_share: float = 1.5e-3
    tried: int = 5
    kept: int = 3
    patience: int = 0
    valleys: float = 0.0
    many_minima: bool = False


@dataclass(frozen=True)
class SearchPolicy:
    """What a diagnosis does beside the settings that somebody chose.

    Attributes:
        coarse_derivatives: first looks take derivatives from the coarser engine and end where little is gained, for a
            simulation is costly.
        rescaled_guesses: guesses that change far more than is left are tried in the right size too: along a trial
            errors add up, so what one so large does says little of what a smaller one would do.
        many_minima: see ``SearchSettings``.
    """

    coarse_derivatives: bool = False
    rescaled_guesses: bool = False
    many_minima: bool = False

    @classmethod
    def of(cls, traits: RobotTraits, engine: Engine) -> SearchPolicy:
        """The policy for a robot on an engine."""
        add_up = not traits.held_in_place
        return cls(coarse_derivatives=engine.costly, rescaled_guesses=add_up, many_minima=add_up)

    def applied(self, settings: SearchSettings) -> SearchSettings:
        """Settings of a search with what this policy asks for."""
        if not self.many_minima:
            return settings
        return replace(settings, patience=PATIENCE, valleys=VALLEYS, many_minima=True)
