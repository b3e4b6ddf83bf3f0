"""What a rollout leaves in its folder while it is rendered: films, EXR and PNG images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Protocol

from flows.simulation.film import FilmWriter, count_repeats
from genre_tasks.logs.types import Float64
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.rollout.rig import RigCamera
from storage.codecs.exr import write_channels, write_exr
from storage.codecs.png import to_pixels, write_png

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

    def list_warnings(self) -> tuple[str, ...]:
        """Says what limits the files, for the manifest, once all poses are written."""
        ...


class Films:
    """One film for each camera, ``CAMERA.mp4``.

    Args:
        folder: where to write.
        rig: the cameras.
        times_s: [F] of the poses. Over a pause the films stand still.
        pose_s: seconds for which the films show a pose.
    """

    def __init__(self, folder: Path, rig: Sequence[RigCamera], times_s: Float64, pose_s: float) -> None:
        self._repeats = count_repeats(times_s, pose_s)
        self._writers: list[FilmWriter] = []
        try:
            for camera in rig:
                path = folder / f"{camera.name}.mp4"
                self._writers.append(FilmWriter(path, camera.lens.width_px, camera.lens.height_px, 1 / pose_s))
        except BaseException:
            self.abort()
            raise

    def write(self, images: RolloutImages) -> None:
        """Appends an image to each film."""
        for writer, pixels in zip(self._writers, to_pixels(images.color), strict=True):
            for _ in range(self._repeats[images.index]):
                writer.write(pixels)

    def close(self) -> None:
        """Completes the films."""
        for writer in self._writers:
            writer.close()

    def abort(self) -> None:
        """Ends the encoders at once."""
        for writer in self._writers:
            writer.abort()

    def list_warnings(self) -> tuple[str, ...]:
        """Nothing limits them."""
        return ()


class ImageFiles:
    """A file for each image, ``CAMERA/000012.exr`` or ``.png``.

    Args:
        folder: where to write; it is made if it does not exist.
        rig: the cameras.
        suffix: of the files.
        write_image: called with the path of a file, the images of a pose, and the index of the camera.
    """

    def __init__(
        self,
        folder: Path,
        rig: Sequence[RigCamera],
        suffix: str,
        write_image: Callable[[Path, RolloutImages, int], None],
    ) -> None:
        self._folder = folder
        self._suffix = suffix
        self._write_image = write_image
        make_camera_folders(folder, rig)

    def write(self, images: RolloutImages) -> None:
        """Writes a file for each camera."""
        for c, view in enumerate(images.views):
            self._write_image(image_path(self._folder, view.camera, images.index, self._suffix), images, c)

    def close(self) -> None:
        """Nothing is left to do: every file is complete."""

    def abort(self) -> None:
        """Nothing is under way between two poses."""

    def list_warnings(self) -> tuple[str, ...]:
        """Nothing limits them."""
        return ()


def write_linear_image(path: Path, images: RolloutImages, camera: int) -> None:
    """Writes one image as scene-linear EXR with opacity and depth.

    Args:
        path: the file.
        images: of a pose.
        camera: its index.
    """
    write_exr(path, images.color[camera].numpy(), images.alpha[camera].numpy(), images.depth[camera].numpy())


def write_depth(path: Path, images: RolloutImages, camera: int) -> None:
    """Writes the depth of one image as EXR with a channel Z in metres, 0 where nothing is.

    Args:
        path: the file.
        images: of a pose.
        camera: its index.
    """
    write_channels(path, {"Z": images.depth[camera].numpy()})


def write_display_image(path: Path, images: RolloutImages, camera: int) -> None:
    """Writes one image as PNG.

    Args:
        path: the file.
        images: of a pose.
        camera: its index.
    """
    write_png(path, to_pixels(images.color[camera]))


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
        (folder / camera.name).mkdir(parents=True, exist_ok=True)


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
