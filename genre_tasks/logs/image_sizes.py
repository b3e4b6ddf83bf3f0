"""How large the images of a camera are: by majority, so that one odd image does not define the lens."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from genre_tasks.logs.file_kinds import describe_non_image
from genre_tasks.logs.file_reading import describe_os_error
from genre_tasks.logs.findings import Finding, format_frames
from genre_tasks.logs.types import Lens

Size = tuple[int, int]

# Others start programs, or have no signature that tells them from noise.
_FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "DIB", "PPM", "JPEG2000", "GIF", "AVIF")
_SNIFFED_BYTES = 1024
# Resampled images are rounded to whole pixels, up or down, on both sides.
_ROUNDING_PX = 2


@dataclass(frozen=True)
class ImageSizes:
    """Sizes of the images of a camera, from their headers.

    Attributes:
        sizes: frame → width and height, of every image with a readable header.
        problems: frame → what is wrong with the file, of the others.
    """

    sizes: Mapping[int, Size]
    problems: Mapping[int, str]

    @property
    def majority(self) -> Size | None:
        """The most frequent size; of two that are as frequent, the larger one, since the other may be a thumbnail."""
        counts = Counter(self.sizes.values())
        return max(counts, key=lambda size: (counts[size], size[0] * size[1]), default=None)


def measure_images(files: Mapping[int, Path]) -> ImageSizes:
    """Reads the headers of a camera's images; pixels are not decoded.

    A header takes 0.1 ms, so that all images of a sequence take less time than decoding one.

    Args:
        files: frame → image.

    Returns:
        Sizes, and what is wrong with the files that have none.
    """
    sizes: dict[int, Size] = {}
    problems: dict[int, str] = {}
    for frame, path in files.items():
        size, problem = _read_size(path)
        if size is not None:
            sizes[frame] = size
        else:
            problems[frame] = problem
    return ImageSizes(sizes, problems)


def _read_size(path: Path) -> tuple[Size | None, str]:
    """Size of an image, or what is wrong with it."""
    from PIL import Image

    try:
        with path.open("rb") as file, warnings.catch_warnings():
            # Whoever decodes the image judges whether it is too large.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            kind = describe_non_image(file.read(_SNIFFED_BYTES))
            if kind is not None:
                return None, f"the file is {kind}"
            file.seek(0)
            with Image.open(file, formats=_FORMATS) as image:
                return image.size, ""
    except OSError as error:
        return None, describe_os_error(error) if error.errno is not None else "the file is no image"
    # Damaged headers raise whatever the decoder of their format stumbles over.
    except Exception as error:
        return None, f"the file is a damaged image ({type(error).__name__})"


def is_resampled(size: Size, stated: Size) -> bool:
    """Tells whether images are those of a lens at another size, as all readers judge it: resampled, and not cropped.

    Counted in pixels, and not as a fraction: a video encoder adds eight rows to 1080, which is less than one percent.

    Args:
        size: width and height of the images.
        stated: width and height that the intrinsics are for.

    Returns:
        Whether the shorter side is as long as the longer one lets expect, but for rounding at the smaller size.

    >>> is_resampled((960, 540), (1920, 1081)), is_resampled((124, 37), (1242, 375)), is_resampled((64, 36), (64, 36))
    (True, True, True)
    >>> is_resampled((1920, 1088), (1920, 1080)), is_resampled((1080, 1920), (1920, 1080))
    (False, False)
    """
    return abs(size[0] * stated[1] - size[1] * stated[0]) <= _ROUNDING_PX * max(*size, *stated)


def choose_lens(lens: Lens, measured: ImageSizes, camera: str) -> tuple[Lens, list[Finding]]:
    """Fits a lens to the images that there are, and names the images of another size, which are left out.

    Args:
        lens: of the size that the intrinsics state, or of the majority of images where they state none.
        measured: the images.
        camera: name of the camera.

    Returns:
        The lens: scaled where all images were resampled, which shows as another size of the same shape. And findings
        ``resampled_images`` and ``odd_image_size``.
    """
    findings = []
    majority = measured.majority
    stated = (lens.width_px, lens.height_px)
    if majority is not None and majority != stated and is_resampled(majority, stated):
        lens = lens.resized(*majority)
        message = f"{camera}: the images are {_format_size(majority)}, the intrinsics are for {_format_size(stated)}"
        numbers = {"width_px": majority[0], "stated_width_px": stated[0]}
        remedy = "The intrinsics are scaled to the images."
        findings.append(Finding("resampled_images", "note", message, remedy, numbers, camera))
    expected = (lens.width_px, lens.height_px)
    odd = tuple(frame for frame, size in measured.sizes.items() if size != expected)
    if odd:
        message = f"{camera}: frames {format_frames(odd)} are not {_format_size(expected)}"
        remedy = "Export them at the size of the intrinsics; they are left out."
        numbers = {"images": len(odd), "width_px": expected[0], "height_px": expected[1]}
        findings.append(Finding("odd_image_size", "warning", message, remedy, numbers, camera, odd))
    return lens, findings


def _format_size(size: Size) -> str:
    return f"{size[0]}×{size[1]}"


def report_problems(measured: ImageSizes, camera: str) -> list[Finding]:
    """Names files that are no images, one finding for each kind of thing that they are.

    Args:
        measured: the images.
        camera: name of the camera.

    Returns:
        Findings ``unreadable_image``.
    """
    by_problem: dict[str, list[int]] = {}
    for frame, problem in measured.problems.items():
        by_problem.setdefault(problem, []).append(frame)
    return [
        Finding(
            "unreadable_image",
            "warning",
            f"{camera}: frames {format_frames(frames)} have no readable image: {problem}",
            "Put the images themselves there, or remove the files.",
            {"images": len(frames)},
            camera,
            tuple(frames),
        )
        for problem, frames in by_problem.items()
    ]


def describe_no_images(measured: ImageSizes, camera: str) -> Finding:
    """Names a camera that is left out, since none of its images says how large they are.

    Args:
        measured: the images.
        camera: name of the camera.

    Returns:
        Finding ``camera_without_images``.
    """
    problems = sorted(set(measured.problems.values()))
    reason = f": {problems[0]}" if problems else ""
    message = f"{camera} has no readable image and is left out{reason}"
    remedy = "Copy the camera's folder again, or remove it."
    return Finding("camera_without_images", "warning", message, remedy, camera=camera)
