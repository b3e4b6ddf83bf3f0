"""Images of many views on disk: the same values, no file left behind, and a clear error where the disk is full."""

from __future__ import annotations

import errno
import gc
import os
import sys
from pathlib import Path

import pytest
import torch

from flows.machine.resource_usage import measure_memory_mib
from genre_tasks import image_memory
from genre_tasks.errors import ResourceError
from genre_tasks.image_memory import allocate_images, hold_images_on_disk

LARGE = (8, 1024, 1024, 3)  # 96 MiB


@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's account of the process's memory")
def test_images_on_disk_take_no_memory_and_leave_no_file(tmp_path: Path) -> None:
    gc.collect()
    before_mib = measure_memory_mib()
    with hold_images_on_disk(tmp_path):
        images = allocate_images(*LARGE)
    images.fill_(0.5)
    assert measure_memory_mib() - before_mib < 20
    assert list(tmp_path.iterdir()) == []
    # Values last beyond the block, as long as the tensor.
    assert images.shape == LARGE and float(images.double().mean()) == 0.5
    in_memory = allocate_images(*LARGE).fill_(0.5)
    assert measure_memory_mib() - before_mib > 90
    assert torch.equal(images, in_memory)


def test_small_tensors_and_those_of_other_devices_stay_where_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object) -> None:
        raise AssertionError("no file is expected")

    monkeypatch.setattr(os, "posix_fallocate", refuse, raising=False)
    with hold_images_on_disk(tmp_path):
        assert allocate_images(2, 8, 8).shape == (2, 8, 8)
        assert allocate_images(*LARGE, device="meta").device.type == "meta"


def test_a_full_disk_is_a_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fill_up(*arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", fill_up, raising=False)
    with hold_images_on_disk(tmp_path), pytest.raises(ResourceError, match=r"no space for 96 MiB.*Free some space"):
        allocate_images(*LARGE)
    assert list(tmp_path.iterdir()) == []


def test_the_folder_counts_inside_the_block_alone(tmp_path: Path) -> None:
    with hold_images_on_disk(tmp_path), hold_images_on_disk(None):
        assert image_memory._scratch_folder.get() is None
    assert image_memory._scratch_folder.get() is None
