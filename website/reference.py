"""Reference pages made from the code: commands, Python, effects, thresholds."""

from __future__ import annotations

from pathlib import Path

import reference_commands
import reference_effects
import reference_python
import reference_thresholds


def pages(root: Path) -> dict[str, str]:
    """Path on the site → Markdown.

    Args:
        root: of the checkout.
    """
    return {
        "reference/commands.md": reference_commands.page(),
        "reference/effects.md": reference_effects.page(root / "docs" / "proof"),
        "reference/python.md": reference_python.page(root / "equimus_ctrl" / "__init__.pyi"),
        "reference/thresholds.md": reference_thresholds.page(),
    }
