"""Whatever happens to a file, its reader reads it or refuses it by an error that names the file and a remedy."""

from __future__ import annotations

from pathlib import Path
from random import Random

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks.fuzz.fuzz_formats import list_targets
from benchmarks.fuzz.fuzz_mutations import BYTES
from benchmarks.fuzz.fuzz_target import FuzzTarget
from genre_tasks.errors import GenreError

# Processes of their own and bombs are left to the engine, which bounds time and memory.
TARGETS = [target for target in list_targets() if not target.starts_process and target.share > 1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: f"{target.format}-{target.reader}-{target.file}")
def test_damaged_files_are_read_or_refused(target: FuzzTarget, folder: Path) -> None:
    room = folder / "".join(c if c.isalnum() else "_" for c in f"{target.format} {target.reader} {target.file}")
    room.mkdir()
    samples = target.prepare(room)
    path = room / target.file

    @settings(max_examples=8, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None)
    @given(random=st.randoms(use_true_random=False), damages=st.lists(st.sampled_from(BYTES), min_size=1, max_size=2))
    def read(random: Random, damages: list) -> None:
        data = samples[0]
        for damage in damages:
            data = damage(random, data, samples)
        path.write_bytes(data)
        try:
            target.read(path)
        except GenreError as error:
            assert error.problem
            assert error.remedy
            is_image = path.suffix in (".jpg", ".png")
            assert is_image or path.stem in str(error) or str(room) in str(error), error

    read()
    # The valid file is read: otherwise nothing above was tested.
    for sample in samples:
        path.write_bytes(sample)
        target.read(path)
