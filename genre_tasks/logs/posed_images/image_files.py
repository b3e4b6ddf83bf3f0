"""Where the images of a file of poses lie, whatever folders its names begin with, and what size they have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from genre_tasks.errors import InputError
from genre_tasks.logs.image_sizes import is_resampled, measure_images
from genre_tasks.logs.types import Lens

# instant-ngp's names may lack the suffix.
_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".JPG", ".PNG")


class ImageFolder:
    """A folder of images that are asked for by the names of a file of poses.

    Args:
        folder: that exists.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._dropped_parts = 0
        self._name_of_file: dict[Path, str] = {}

    def find(self, name: str) -> Path | None:
        """Finds an image. Leading folders of a name that are not in this folder are left out.

        Args:
            name: as the file of poses writes it.

        Returns:
            The file; ``None`` if there is none.

        Raises:
            InputError: the file is that of another name already.
        """
        # Without a root and steps upwards, so that no name leads out of the folder.
        parts = [part for part in PurePosixPath(name).parts if part not in ("/", "..", ".")]
        # What fitted the last name fits most likely again.
        order = sorted(range(len(parts)), key=lambda dropped: dropped != self._dropped_parts)
        for dropped in order:
            for suffix in _SUFFIXES if PurePosixPath(name).suffix == "" else ("",):
                path = self._folder.joinpath(*parts[dropped:-1], parts[-1] + suffix)
                if path.is_file():
                    self._dropped_parts = dropped
                    self._require_one_name(path, name)
                    return path
        return None

    def _require_one_name(self, path: Path, name: str) -> None:
        """Refuses that a camera gets the images of another one, as where the folder is that of one camera alone."""
        first = self._name_of_file.setdefault(path, name)
        if first != name:
            problem = f"two images of the poses are one file: {first} and {name}"
            remedy = "Name the folder above those of the cameras with --images."
            raise InputError(problem, remedy=remedy, file=path)


def fit_lens(lens: Lens, camera: str, files: Sequence[Path]) -> Lens:
    """Scales a lens to the images that there are, by the rule that holds for logs too.

    A log whose images have another shape is read on without them, and ``choose_lens`` says so. Of images with poses
    nothing else would be left, so that they are refused.

    Args:
        lens: at the size that the file of poses states.
        camera: name of the camera, for errors.
        files: its images; the most frequent size counts.

    Returns:
        The lens at the images' size.

    Raises:
        InputError: the images have another shape, or none can be read.
    """
    sizes = measure_images(dict(enumerate(files)))
    # By majority, as one thumbnail among the images must not define the lens.
    majority = sizes.majority
    if majority is None:
        remedy = "Give images as PNG or JPEG."
        raise InputError(f"no image of {camera} can be read", remedy=remedy, file=files[0], camera=camera)
    width, height = majority
    if not is_resampled(majority, (lens.width_px, lens.height_px)):
        file = files[next(index for index, size in sizes.sizes.items() if size == majority)]
        problem = f"images of {camera} are {width}×{height}, the intrinsics are for "
        problem += f"{lens.width_px}×{lens.height_px}"
        raise InputError(problem, remedy="Give the images that the poses were made from.", file=file, camera=camera)
    return lens if majority == (lens.width_px, lens.height_px) else lens.resized(width, height)
