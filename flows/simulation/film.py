"""Films that are encoded while they are rendered: one image at a time, by ffmpeg in a process of its own."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import ResourceError
from genre_tasks.logs.types import Float64

_MAX_MESSAGE_LENGTH = 200
# Twice as quick as the default, for files a fifth larger.
_PRESET = "veryfast"
# Hardly to be told from the images; the default, 23, blurs a road's texture.
_QUALITY = 18
# Longer nobody wants to look at an image that stands still.
_MAX_PAUSE_S = 3.0


def count_repeats(times_s: Sequence[float] | Float64, image_s: float) -> list[int]:
    """Counts how often a film writes each image: a film has even steps, and a log has pauses.

    Args:
        times_s: [F] when the images were taken, rising.
        image_s: seconds for which the film shows an image.

    Returns:
        [F] counts of 1 or more. Pauses of more than 3 seconds are shortened to these.

    >>> count_repeats([0.0, 0.1, 0.5, 60.5], 0.1)
    [1, 4, 30, 1]
    """
    steps_s = np.minimum(np.diff(times_s), _MAX_PAUSE_S)
    counts = np.maximum(np.rint(steps_s / image_s), 1).astype(int)
    return [*counts.tolist(), 1]


class FilmWriter:
    """Writes an H.264 film, image by image; encoding overlaps with what the caller does.

    Args:
        path: the new file, ``….mp4``.
        width_px: of the images. H.264 needs even sizes, so an odd last column is left out.
        height_px: of the images; the same for an odd last row.
        images_per_s: how fast the film plays.
    """

    def __init__(self, path: Path, width_px: int, height_px: int, images_per_s: float) -> None:
        from imageio_ffmpeg import get_ffmpeg_exe

        self._path = path
        self._width_px = width_px // 2 * 2
        self._height_px = height_px // 2 * 2
        size = f"{self._width_px}x{self._height_px}"
        # A file and no pipe, which could fill up and stop the encoder; it closes with this object.
        self._messages = tempfile.TemporaryFile()  # noqa: SIM115
        self._process = subprocess.Popen(
            [
                *(get_ffmpeg_exe(), "-v", "error", "-y"),
                *("-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{images_per_s:.6g}", "-i", "-"),
                # Stated in the file, because players guess the colours of small films otherwise.
                *("-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709"),
                *("-color_primaries", "bt709", "-color_trc", "iec61966-2-1", "-color_range", "tv"),
                *("-c:v", "libx264", "-preset", _PRESET, "-crf", str(_QUALITY), "-pix_fmt", "yuv420p"),
                # One thread for each camera's film, and no version in the file: equal images give equal bytes.
                *("-threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact"),
                # Marked as a file, since ffmpeg takes what stands before a colon for a protocol.
                *("-movflags", "+faststart", f"file:{path}"),
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._messages,
        )

    def write(self, pixels: NDArray[np.uint8]) -> None:
        """Appends an image.

        Args:
            pixels: [H, W, 3] sRGB.

        Raises:
            ResourceError: ffmpeg has ended, for instance because the disk is full.
        """
        even = np.ascontiguousarray(pixels[: self._height_px, : self._width_px])
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(even.data)
        except BrokenPipeError as error:
            raise self._describe_failure() from error

    def close(self) -> None:
        """Ends the film and waits until it is on the disk.

        Raises:
            ResourceError: ffmpeg could not write it.
        """
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):
            self._process.stdin.close()
        if self._process.wait() != 0:
            raise self._describe_failure()
        self._messages.close()

    def abort(self) -> None:
        """Ends ffmpeg at once; what it has written is of no use. Nothing happens after :meth:`close`."""
        self._process.kill()
        with suppress(OSError):
            assert self._process.stdin is not None
            self._process.stdin.close()
        self._process.wait()
        self._messages.close()

    def _describe_failure(self) -> ResourceError:
        self._process.wait()
        self._messages.seek(0)
        text = " ".join(self._messages.read().decode(errors="replace").split())
        # The error names the file, which has another name once it is complete.
        text = text.replace(f"file:{self._path}", "the file").replace(str(self._path), "the file")[:_MAX_MESSAGE_LENGTH]
        return ResourceError(
            f"ffmpeg could not write the film ({text or 'no message'})",
            remedy="Look whether the disk is full, or name another --out.",
            file=self._path,
        )
