"""What a rollout leaves in its folder while it is rendered: films, EXR and PNG images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from flows.simulation.film import FilmWriter
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.rollout.rig import RigCamera
from storage.codecs.exr import write_channels, write_exr
from storage.codecs.png import write_png

DEPTH_FOLDER = "depth"


class RolloutOutput(Protocol):
    """Something that is written pose by pose."""

    def write(self, images: RolloutImages) -> None:
        """Writes what belongs to one pose.

        Args:
            images: of all cameras.
        """
        ...

    def close(self) -> None:
        """Completes the files."""
        ...

    def abort(self) -> None:
        """Ends what is under way after an error; nothing happens after :meth:`close`."""
        ...


class Films:
    """One film for each camera, ``CAMERA.mp4``.

    Args:
        folder: where to write.
        rig: the cameras.
        images_per_s: how fast the films play.
    """

    def __init__(self, folder: Path, rig: Sequence[RigCamera], images_per_s: float) -> None:
        self._writers: list[FilmWriter] = []
        try:
            for camera in rig:
                path = folder / f"{camera.name}.mp4"
                self._writers.append(FilmWriter(path, camera.lens.width_px, camera.lens.height_px, images_per_s))
        except BaseException:
            self.abort()
            raise

    def write(self, images: RolloutImages) -> None:
        """Appends an image to each film."""
        for writer, pixels in zip(self._writers, to_pixels(images), strict=True):
            writer.write(pixels)

    def close(self) -> None:
        """Completes the films."""
        for writer in self._writers:
            writer.close()

    def abort(self) -> None:
        """Ends the encoders at once."""
        for writer in self._writers:
            writer.abort()


class ExrImages:
    """Scene-linear images with opacity and depth, ``CAMERA/000012.exr``.

    Args:
        folder: where to write.
        rig: the cameras.
    """

    def __init__(self, folder: Path, rig: Sequence[RigCamera]) -> None:
        self._folder = folder
        make_camera_folders(folder, rig)

    def write(self, images: RolloutImages) -> None:
        """Writes a file for each camera."""
        for view, color, alpha, depth in zip(images.views, images.color, images.alpha, images.depth, strict=True):
            path = image_path(self._folder, view.camera, images.index, ".exr")
            write_exr(path, color.numpy(), alpha.numpy(), depth.numpy())

    def close(self) -> None:
        """Nothing is left to do: every file is complete."""

    def abort(self) -> None:
        """Nothing is under way between two poses."""


class DepthImages:
    """Depth alone, ``depth/CAMERA/000012.exr`` with a channel Z in metres, 0 where nothing is.

    Args:
        folder: of the rollout.
        rig: the cameras.
    """

    def __init__(self, folder: Path, rig: Sequence[RigCamera]) -> None:
        self._folder = folder / DEPTH_FOLDER
        self._folder.mkdir()
        make_camera_folders(self._folder, rig)

    def write(self, images: RolloutImages) -> None:
        """Writes a file for each camera."""
        for view, depth in zip(images.views, images.depth, strict=True):
            write_channels(image_path(self._folder, view.camera, images.index, ".exr"), {"Z": depth.numpy()})

    def close(self) -> None:
        """Nothing is left to do: every file is complete."""

    def abort(self) -> None:
        """Nothing is under way between two poses."""


class PngImages:
    """Display-referred images, ``CAMERA/000012.png``.

    Args:
        folder: where to write.
        rig: the cameras.
    """

    def __init__(self, folder: Path, rig: Sequence[RigCamera]) -> None:
        self._folder = folder
        make_camera_folders(folder, rig)

    def write(self, images: RolloutImages) -> None:
        """Writes a file for each camera."""
        for view, pixels in zip(images.views, to_pixels(images), strict=True):
            write_png(image_path(self._folder, view.camera, images.index, ".png"), pixels)

    def close(self) -> None:
        """Nothing is left to do: every file is complete."""

    def abort(self) -> None:
        """Nothing is under way between two poses."""


@contextmanager
def open_outputs(outputs: Sequence[RolloutOutput]) -> Iterator[Sequence[RolloutOutput]]:
    """Completes outputs when a block ends, or ends them at once where it fails.

    Args:
        outputs: to be written to in the block.

    Yields:
        ``outputs``.

    Raises:
        ResourceError: an output could not be completed.
    """
    with ExitStack() as stack:
        for output in outputs:
            # Also after a close: it does nothing then, and another output's may have failed.
            stack.callback(output.abort)
        yield outputs
        for output in outputs:
            output.close()


def make_camera_folders(folder: Path, rig: Sequence[RigCamera]) -> None:
    """Makes a folder for the images of each camera.

    Args:
        folder: of the rollout.
        rig: the cameras.
    """
    for camera in rig:
        (folder / camera.name).mkdir(exist_ok=True)


def image_path(folder: Path, camera: str, index: int, suffix: str) -> Path:
    """Names the file of one image.

    Args:
        folder: of the rollout.
        camera: name of the camera.
        index: of the pose, from 0.
        suffix: such as ``.png``.

    Returns:
        The path.

    >>> image_path(Path("out"), "front_camera", 12, ".exr").as_posix()
    'out/front_camera/000012.exr'
    """
    return folder / camera / f"{index:06d}{suffix}"


def to_pixels(images: RolloutImages) -> NDArray[np.uint8]:
    """Rounds colours to bytes.

    Args:
        images: of C cameras.

    Returns:
        [C, H, W, 3] sRGB.
    """
    pixels: NDArray[np.uint8] = (images.color * 255).round().byte().numpy()
    return pixels
