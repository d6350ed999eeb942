"""Options of ``validate``."""

from __future__ import annotations

from dataclasses import dataclass

from equimus_ctrl.options.fields import at_least, counted, threads_option
from equimus_ctrl.options.offers import option


@dataclass(frozen=True)
class ValidateOptions:
    """How the physics is validated.

    Attributes:
        quick: fewer runs of everything, see ``validation.plan.QUICK``.
        seed: of everything random.
        threads: at most; all cores by default. Changes no error.

    Raises:
        ConfigError: for a value that cannot be.
    """

    quick: bool = option(False, bool, "Fewer runs of everything, no front: half a minute.", "--quick")
    seed: int = option(0, int, "Of everything random.")
    threads: int | None = threads_option("At most; all cores by default. Changes no error.")

    def __post_init__(self) -> None:
        """Check the values."""
        at_least("seed", self.seed, 0)
        counted("threads", self.threads)
