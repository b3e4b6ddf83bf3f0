"""Images of many views on disk: the same values, no file left behind, and a clear error where the disk is full."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from genre_tasks import image_memory
from genre_tasks.errors import DiskFullError, ResourceError
from genre_tasks.image_memory import allocate_images, hold_images_on_disk

LARGE = (8, 1024, 1024, 3)  # 96 MiB


_MEASURE = """
import sys
from pathlib import Path
from flows.machine.resource_usage import measure_memory_mib
from genre_tasks.image_memory import allocate_images, hold_images_on_disk

shape = (8, 1024, 1024, 3)
folder = Path(sys.argv[1])
start = measure_memory_mib()
with hold_images_on_disk(folder):
    images = allocate_images(*shape)
images.fill_(0.5)
on_disk = measure_memory_mib() - start
files = len(list(folder.iterdir()))
in_memory = allocate_images(*shape).fill_(0.5)
print(on_disk, files, measure_memory_mib() - start, bool((images == in_memory).all()))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's account of the process's memory")
def test_images_on_disk_take_no_memory_and_leave_no_file(tmp_path: Path) -> None:
    # A process of its own: in this one, memory that other tests have freed could be taken again.
    command = [sys.executable, "-c", _MEASURE, str(tmp_path)]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout.split()
    assert float(out[0]) < 20 and out[1] == "0"
    # Ninety-six MiB in memory, with the same values as those on disk beyond the block.
    assert float(out[2]) > 90 and out[3] == "True"


def test_small_tensors_and_those_of_other_devices_stay_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object) -> None:
        raise AssertionError("no file is expected")

    monkeypatch.setattr(os, "posix_fallocate", refuse, raising=False)
    with hold_images_on_disk(tmp_path):
        assert allocate_images(2, 8, 8).shape == (2, 8, 8)
        assert allocate_images(*LARGE, device="meta").device.type == "meta"


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_a_full_disk_is_a_clear_error_that_is_not_retried(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    def fill_up(*arguments: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "posix_fallocate", fill_up, raising=False)
    with hold_images_on_disk(tmp_path), pytest.raises(DiskFullError, match=r"no space for 96 MiB.*Free some space"):
        allocate_images(*LARGE)
    assert list(tmp_path.iterdir()) == []


def test_other_faults_of_the_disk_may_be_retried(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run_out_of_handles(*arguments: object) -> None:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    monkeypatch.setattr(os, "posix_fallocate", run_out_of_handles, raising=False)
    with hold_images_on_disk(tmp_path), pytest.raises(ResourceError, match="96 MiB of images cannot be put") as caught:
        allocate_images(*LARGE)
    assert not isinstance(caught.value, DiskFullError)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system reserves no blocks")
def test_a_process_that_is_killed_while_blocks_are_reserved_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reserve = os.posix_fallocate
    names: list[list[Path]] = []

    def look_around(handle: int, offset: int, size: int) -> None:
        names.append(list(tmp_path.iterdir()))
        reserve(handle, offset, size)

    monkeypatch.setattr(os, "posix_fallocate", look_around)
    with hold_images_on_disk(tmp_path):
        images = allocate_images(*LARGE)
    assert names == [[]]
    # Mapped all the same: it can be written to its end.
    assert images.fill_(0.5).sum() == 0.5 * images.numel()


def test_a_folder_that_is_gone_is_a_clear_error(tmp_path: Path) -> None:
    with hold_images_on_disk(tmp_path / "gone"), pytest.raises(ResourceError, match="gone"):
        allocate_images(*LARGE)


def test_the_folder_counts_inside_the_block_alone(tmp_path: Path) -> None:
    with hold_images_on_disk(tmp_path), hold_images_on_disk(None):
        assert image_memory._scratch_folder.get() is None
    assert image_memory._scratch_folder.get() is None
