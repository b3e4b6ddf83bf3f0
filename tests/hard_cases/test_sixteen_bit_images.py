"""A log of 16-bit images gives the scene that the same log of 8 bits gives: every stage decodes by the same rules."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from genre_tasks.logs.pandaset.writer import write_pandaset
from genre_tasks.logs.registry import open_log
from genre_tasks.metrics.results import Evaluation
from genre_tasks.scene.chunk import Chunk
from tests.hard_cases.test_logs_as_delivered import STREET, value, whole_run

pytestmark = pytest.mark.slow


def grey_log(folder: Path, bits: int) -> Path:
    """A synthetic street whose cameras are grey."""
    log = write_pandaset(open_log(STREET + "&cameras=1"), folder / "903")
    for file in sorted(log.glob("camera/*/*.png")):
        grey = np.asarray(Image.open(io.BytesIO(file.read_bytes())).convert("L"))
        Image.fromarray(grey if bits == 8 else grey.astype(np.uint16) * 257).save(file)
    return log


def test_a_log_of_16_bits_gives_the_scene_of_8_bits(tmp_path: Path) -> None:
    """Report: python-pillow/Pillow#5991 (16-bit images become white, and so a scene of white seems perfect)."""
    scores = {}
    colors = {}
    for bits in (8, 16):
        folder = tmp_path / str(bits)
        refs = whole_run(folder, grey_log(folder, bits))
        colors[bits] = value(folder, refs["ingest"], Chunk).static.colors
        found = value(folder, refs["evaluate/gnet"], Evaluation)
        scores[bits] = {m.name: m.value for m in found.metrics}
    assert colors[8].std() > 10 and np.array_equal(colors[16], colors[8])
    assert scores[16] == scores[8]
