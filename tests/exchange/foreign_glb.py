"""How tests read GLB files of other tools, and check that unsound ones are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from genre_tasks.errors import InputError
from genre_tasks.exchange.gltf.format import GLB
from genre_tasks.exchange.types import ExchangeScene
from tests.exchange.gltf_files import join_glb


def read_foreign(folder: Path, document: dict[str, Any] | bytes, binary: bytes = b"") -> ExchangeScene:
    path = folder / "foreign.glb"
    path.write_bytes(join_glb(document, binary))
    return GLB.read(path)


def check_refused(folder: Path, document: dict[str, Any] | bytes, binary: bytes, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        read_foreign(folder, document, binary)
    assert caught.value.file == str(folder / "foreign.glb")
