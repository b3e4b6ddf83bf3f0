"""Digests of exported files, and of the document that lists them: by these a changed file is known."""

from __future__ import annotations

import hashlib
from pathlib import Path

DOCUMENT_ENTRY = "document_sha256"
"""Entry of a document with the sha256 of its bytes, as they are with an empty text in its place."""

_BLOCK_BYTES = 1 << 20


def digest_contents(path: Path) -> str:
    """Computes a file's sha256 without reading all of it into memory.

    Args:
        path: the file.
    """
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def insert_digest(text: str) -> str:
    """Writes a document's digest into it.

    Args:
        text: the document in JSON, as ``json.dumps`` spaces it, with an empty text in ``DOCUMENT_ENTRY``.

    Returns:
        The document with its digest.

    >>> insert_digest('{"document_sha256": ""}')[:28]
    '{"document_sha256": "1c5af55'
    """
    digest = hashlib.sha256(text.encode()).hexdigest()
    # Quotes within texts are escaped in JSON, so that only the entry reads like this.
    return text.replace(f'"{DOCUMENT_ENTRY}": ""', f'"{DOCUMENT_ENTRY}": "{digest}"')


def is_edited(path: Path, digest: str) -> bool:
    """Says whether a document was changed after it was written.

    Args:
        path: the document.
        digest: in its ``DOCUMENT_ENTRY``.

    Returns:
        Whether its bytes are others; False where the digest is empty, since earlier versions wrote none.
    """
    without_digest = path.read_bytes().replace(digest.encode(), b"", 1)
    return bool(digest) and hashlib.sha256(without_digest).hexdigest() != digest
