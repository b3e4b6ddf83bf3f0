"""What a comparison found, as tables and pairs of pictures."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from storage.lineage import TableSummary


@dataclass(frozen=True)
class PicturePair:
    """The same viewpoint in both.

    Attributes:
        name: fit for a file's name, such as ``chunk-0-after-enet-3m_left_front_camera_04``.
        label: what it shows, for readers.
        a: [H, W, 3] sRGB uint8 of the first.
        b: [H, W, 3] of the second.
        truth: what both should show; ``None`` where it is not known.
    """

    name: str
    label: str
    a: NDArray[np.uint8]
    b: NDArray[np.uint8]
    truth: NDArray[np.uint8] | None = None


@dataclass
class Comparison:
    """What differs between A and B.

    Attributes:
        a: what the first one is.
        b: what the second one is.
        notes: sentences for the reader, such as what could not be compared.
        tables: in the order to show them.
        pairs: pictures of both.
    """

    a: str
    b: str
    notes: list[str] = field(default_factory=list)
    tables: list[TableSummary] = field(default_factory=list)
    pairs: list[PicturePair] = field(default_factory=list)

    def add_table(self, name: str, rows: list[dict[str, Any]], if_empty: str = "") -> None:
        """Adds a table, or a sentence in place of an empty one.

        Args:
            name: the table's heading.
            rows: dictionaries with the same keys.
            if_empty: a note for the case that there are no rows; empty for none.
        """
        from storage.lineage import TableSummary

        if rows:
            self.tables.append(TableSummary(name, rows))
        elif if_empty:
            self.notes.append(if_empty)
