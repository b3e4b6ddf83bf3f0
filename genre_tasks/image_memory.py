"""Where the images of many views are held: in memory, or in files that the system can take back from it.

At 1280×720 the renders, maps and repairs of a chunk take more than all else together, and each is needed for a moment.
Where memory is short, they lie in files that are mapped into the process: what is not in use costs disk, not memory.
The values are the same.
"""

from __future__ import annotations

import errno
import math
import mmap
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import torch
from torch import Tensor

from genre_tasks.errors import DiskFullError, ResourceError

_MIN_BYTES = 2**24
"""Smaller tensors stay in memory: each file takes a mapping and whole pages."""
_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

_scratch_folder: ContextVar[Path | None] = ContextVar("scratch_folder", default=None)


@contextmanager
def hold_images_on_disk(folder: Path | None) -> Iterator[None]:
    """Lets :func:`allocate_images` use files while a block runs.

    Args:
        folder: for the files, on a disk; ``None``: images stay in memory.

    >>> with hold_images_on_disk(Path(tempfile.gettempdir())):
    ...     allocate_images(2, 1024, 1024, 3).shape
    torch.Size([2, 1024, 1024, 3])
    """
    token = _scratch_folder.set(folder)
    try:
        yield
    finally:
        _scratch_folder.reset(token)


def allocate_images(*shape: int, device: torch.device | str = "cpu") -> Tensor:
    """Makes a tensor for the images of many views, to be filled.

    The file of a tensor on disk has no name any more: it goes with the tensor, even when the process is killed.

    Args:
        shape: of the tensor.
        device: of the tensor; files hold images of the CPU alone.

    Returns:
        float32, not initialised.

    Raises:
        DiskFullError: the disk has no space for it, or a quota or a limit of file sizes is reached.
        ResourceError: the file cannot be made or mapped.
    """
    folder = _scratch_folder.get()
    count = math.prod(shape)
    size = 4 * count
    # Other systems can neither reserve a file's blocks nor remove a file that is mapped.
    can_map = hasattr(os, "posix_fallocate") and torch.device(device).type == "cpu"
    if folder is None or size < _MIN_BYTES or not can_map:
        return torch.empty(shape, device=device)
    try:
        return _map_file(folder, count).view(shape)
    except OSError as error:
        what = f"{size / 2**20:.0f} MiB of images"
        remedy = "Free some space, or let the run use more memory (--memory)."
        # A kind that is not retried: the next try would reserve as much.
        if error.errno in _DISK_FULL:
            problem = f"the disk of {folder} has no space for {what} ({error.strerror})"
            raise DiskFullError(problem, remedy=remedy) from error
        raise ResourceError(f"{what} cannot be put into {folder} ({error.strerror})", remedy=remedy) from error


def _map_file(folder: Path, count: int) -> Tensor:
    """[count] float32 in a new file of a folder, which has lost its name already."""
    # Without a name before its blocks are reserved, which takes long: a process may be killed meanwhile.
    with tempfile.TemporaryFile(prefix=".genre-images-", dir=folder) as file:
        # Without its blocks a full disk would kill the process, at the first write to a page.
        os.posix_fallocate(file.fileno(), 0, 4 * count)
        # The mapping keeps the file.
        return torch.frombuffer(mmap.mmap(file.fileno(), 4 * count), dtype=torch.float32)
