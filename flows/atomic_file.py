"""What commands write beside the store is written anew each time; the store's own files are written once."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def anew(path: Path) -> Iterator[Path]:
    """A place to write to, which then takes ``path``'s; after an error the old file is still there."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
