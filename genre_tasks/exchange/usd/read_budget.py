"""How much memory the arrays of a file may take: fields of a layer may share theirs, and count them many times."""

from __future__ import annotations

from genre_tasks.errors import InputError

_BYTES_PER_BYTE = 8
"""Half precision takes twice its bytes in memory, and files may repeat a part a few times."""

_SMALLEST_BYTES = 64 << 20


class ReadBudget:
    """Counts what the arrays of one file take in memory.

    Args:
        file_bytes: size of the file.
    """

    def __init__(self, file_bytes: int) -> None:
        self._left = max(_SMALLEST_BYTES, _BYTES_PER_BYTE * file_bytes)

    def spend(self, size: int) -> None:
        """Counts an array.

        Args:
            size: its bytes.

        Raises:
            InputError: all arrays together take more than the file's size allows.
        """
        self._left -= size
        if self._left < 0:
            raise InputError(
                "the file repeats its Gaussians more often than its size allows",
                remedy="Give a file that holds each of them once.",
            )
