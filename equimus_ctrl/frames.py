"""Results as data frames, for those who work with pandas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from equimus_ctrl.errors import needs

if TYPE_CHECKING:
    from pandas import DataFrame


def dataframe(rows: Sequence[Mapping[str, Any]] | Mapping[str, Any], index: str | None = None) -> DataFrame:
    """Rows or columns as a data frame.

    Args:
        rows: a mapping for each row, or one of columns.
        index: the column that becomes the index; a number for each row by default.

    Raises:
        NotAvailable: where pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise needs("pandas", "pandas", "a data frame") from None
    frame = pd.DataFrame(rows if isinstance(rows, Mapping) else list(rows))
    return frame if index is None else frame.set_index(index)
