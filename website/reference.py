"""Reference pages made from the code: commands, Python, effects with their figures, thresholds."""

from __future__ import annotations

from pathlib import Path

import effect_figures
import reference_commands
import reference_effects
import reference_python
import reference_thresholds


def pages(root: Path) -> dict[str, str]:
    """Path on the site → Markdown, or SVG of a figure.

    Args:
        root: of the checkout.
    """
    return {
        "reference/commands.md": reference_commands.page(),
        "reference/effects.md": reference_effects.page(root / "docs" / "proof"),
        **reference_python.pages(root / "equimus_ctrl" / "__init__.pyi"),
        "reference/thresholds.md": reference_thresholds.page(),
        **{f"reference/{path}": drawn for path, drawn in effect_figures.figures().items()},
    }
