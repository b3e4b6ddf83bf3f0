"""An object that is read in pieces, and goes on where it broke off."""

from __future__ import annotations

import hashlib
from typing import BinaryIO

from storage.objects.client import open_client

# What of a piece has arrived is lost when the line breaks.
_PIECE_BYTES = 1 << 20


class Download:
    """The bytes of an object that have arrived so far.

    A large object over a slow line takes longer than one request may. A second request goes on after the first one's
    last byte, unless the object was replaced meanwhile.

    Args:
        uri: of the store.
        name: of the object.
        out: where the bytes go; ``None`` to digest them only.

    Attributes:
        size: bytes that have arrived.
    """

    def __init__(self, uri: str, name: str, out: BinaryIO | None) -> None:
        self._uri = uri
        self._name = name
        self._out = out
        self._e_tag = ""
        self.size = 0
        self._digest = hashlib.sha256()

    def run(self) -> str:
        """Reads what has not arrived yet.

        Returns:
            The sha256 of the object.

        Raises:
            OSError: the file cannot be written.
            BaseError: as the client raises it; what has arrived stays.
        """
        import obstore
        from obstore.exceptions import PreconditionError

        client = open_client(self._uri)
        try:
            # Without an ETag nobody knows whether it is still the same object.
            if not self.size or not self._e_tag:
                self._start_again()
                result = obstore.get(client, self._name)
            else:
                result = obstore.get(
                    client, self._name, options={"range": {"offset": self.size}, "if_match": self._e_tag}
                )
        except PreconditionError:
            self._start_again()
            result = obstore.get(client, self._name)
        self._e_tag = result.meta["e_tag"] or ""
        for piece in result.stream(min_chunk_size=_PIECE_BYTES):
            self._digest.update(piece)
            if self._out is not None:
                self._out.write(piece)
            self.size += len(piece)
        return self._digest.hexdigest()

    def _start_again(self) -> None:
        self.size = 0
        self._digest = hashlib.sha256()
        if self._out is not None:
            self._out.seek(0)
            self._out.truncate()
