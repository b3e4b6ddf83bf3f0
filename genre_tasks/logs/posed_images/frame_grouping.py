"""Which images were taken together: by labels and times of the file, by folders with equal file names, or by labels
within folders that are moments.

Cameras of a rig need not fire at once: by times, an image belongs to the nearest one of the camera with most images.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from genre_tasks.errors import InputError
from genre_tasks.logs.camera_names import require_camera_names
from genre_tasks.logs.nearest_images import find_nearest_images
from genre_tasks.logs.posed_images.posed_image import PosedImage

ONE_CAMERA = "camera"
_REMEDY = (
    "Keep the images of each camera in a folder of its own, with equal file names for images of one moment, or write "
    "`camera` and `time` into every frame of transforms.json."
)
_LABEL_REMEDY = (
    "Write the label `camera` into every frame of transforms.json, or keep the images of each camera in a folder of "
    "its own, with equal file names for images of one moment."
)
_TIME_REMEDY = "Write times of one clock in seconds; images of one moment are less than half a frame apart."
_LENS_REMEDY = "Give each camera a folder of its own; COLMAP then needs --ImageReader.single_camera_per_folder 1."
# Of the frames of the camera that has fewer, so many must have a partner; else the names say nothing.
_MIN_SHARED = 0.5
_TICKS_PER_S = 1_000_000
# Of a camera with one image.
_ASSUMED_PERIOD_S = 0.1
# Thirty years: one of the times is unset, or of another unit.
_MOST_SPAN_S = 1e9


@dataclass(frozen=True)
class FrameGroups:
    """Images of a log by frame and camera.

    Attributes:
        cameras: names, in order.
        frames: for each frame the images by camera; a camera may lack some.
        times_s: of each frame, ``None`` where the file has no times; images have times of their own.
    """

    cameras: tuple[str, ...]
    frames: tuple[dict[str, PosedImage], ...]
    times_s: tuple[float, ...] | None


def group_frames(images: Sequence[PosedImage], file: Path) -> FrameGroups:
    """Groups images into frames of a rig.

    Args:
        images: at least one.
        file: that they are from, for errors.

    Returns:
        Frames in the order of their times, or of their names without times.

    Raises:
        InputError: names of several folders do not agree, or are those of moments without labels of cameras; two
            images claim one place, a camera has two lenses, its name would lead out of a folder, or some images have a
            time and others have none.
    """
    _require_times_of_all(images, file)
    has_times = all(image.time_s is not None for image in images)
    has_moment_folders = not has_times and _has_moment_folders(images)
    if not has_times and not has_moment_folders:
        _refuse_unlabelled_moments(images, file)
    cameras = [str(image.camera) for image in images] if has_moment_folders else _name_cameras(images)
    names = sorted(set(cameras), key=_natural_key)
    require_camera_names(names, file=file)
    keys: Sequence[float | str]
    if has_times:
        keys = _match_times(images, cameras, names, file)
    elif has_moment_folders:
        keys = [_name_folder(image) for image in images]
    else:
        keys = [PurePosixPath(image.name).stem for image in images]
    frames: dict[float | str, dict[str, PosedImage]] = {}
    for image, camera, key in zip(images, cameras, keys, strict=True):
        frame = frames.setdefault(key, {})
        if camera in frame:
            problem = f"{image.name} and {frame[camera].name} are of one camera and one moment"
            raise InputError(problem, remedy=_REMEDY, file=file)
        frame[camera] = image
    if len(names) > 1:
        if has_times:
            _require_shared_frames(frames.values(), names, file, partner="near their time", remedy=_TIME_REMEDY)
        else:
            partner = "in their folder" if has_moment_folders else "of the same name in the folders of other cameras"
            _require_shared_frames(frames.values(), names, file, partner=partner, remedy=_REMEDY)
    order = sorted(frames) if has_times else sorted(map(str, frames), key=_natural_key)
    _require_one_lens(images, cameras, file)
    groups = tuple(frames[key] for key in order)
    return FrameGroups(tuple(names), groups, tuple(map(float, order)) if has_times else None)


def _match_times(images: Sequence[PosedImage], cameras: Sequence[str], names: Sequence[str], file: Path) -> list[float]:
    """[N] for each image the time of its frame: that of the leading camera's image next to it, or its own."""
    times = [float(image.time_s or 0.0) for image in images]
    images_of: dict[str, list[int]] = {name: [] for name in names}
    for index, camera in enumerate(cameras):
        images_of[camera].append(index)
    leader = max(names, key=lambda name: len(images_of[name]))
    moments = sorted({times[index] for index in images_of[leader]})
    start = min(times)
    if max(times) - start > _MOST_SPAN_S:
        problem = f"the times of the images span {max(times) - start:.3g} s"
        raise InputError(problem, remedy=_TIME_REMEDY, file=file)
    ticks = [round((moment - start) * _TICKS_PER_S) for moment in moments]
    matched = list(times)
    for indices in images_of.values():
        image_ticks = [round((times[index] - start) * _TICKS_PER_S) for index in indices]
        nearest = find_nearest_images(ticks, image_ticks, round(_ASSUMED_PERIOD_S * _TICKS_PER_S))
        for moment, place in zip(moments, nearest, strict=True):
            if place is not None:
                matched[indices[place]] = moment
    return matched


def _require_times_of_all(images: Sequence[PosedImage], file: Path) -> None:
    """Raises where some images lack a time: without them the others' times would say nothing of the order."""
    missing = [image.name for image in images if image.time_s is None]
    if 0 < len(missing) < len(images):
        problem = f"{len(missing)} of {len(images)} images have no time, the first one is {missing[0]}"
        remedy = "Write `time` in seconds into every frame, or into none."
        raise InputError(problem, remedy=remedy, file=file)


def _has_moment_folders(images: Sequence[PosedImage]) -> bool:
    """Whether labels name the cameras and folders the moments: a folder has several of the few labels."""
    labels_of: dict[str, set[str | None]] = {}
    for image in images:
        labels_of.setdefault(_name_folder(image), set()).add(image.camera)
    labels = {label for found in labels_of.values() for label in found}
    # COLMAP numbers a camera for every image unless it is asked not to: such labels are more than folders.
    return None not in labels and len(labels) < len(labels_of) and any(len(found) > 1 for found in labels_of.values())


def _refuse_unlabelled_moments(images: Sequence[PosedImage], file: Path) -> None:
    """Raises where folders are numbered like moments and files named like cameras, which would swap the two."""
    folders = {_name_folder(image) for image in images}
    stems = {PurePosixPath(image.name).stem for image in images}
    # Frames have numbers. Names without any in more folders than there are names can only be those of cameras.
    is_numbered = all(PurePosixPath(folder).name.isdecimal() for folder in folders)
    if is_numbered and 1 < len(stems) < len(folders) and not any(re.search(r"\d", stem) for stem in stems):
        problem = f"{len(folders)} numbered folders have images such as {', '.join(sorted(stems)[:3])}: one a moment"
        raise InputError(problem, remedy=_LABEL_REMEDY, file=file)


def _name_folder(image: PosedImage) -> str:
    return PurePosixPath(image.name).parent.as_posix()


def _name_cameras(images: Sequence[PosedImage]) -> list[str]:
    """The camera of each image: by its label, or by its folder where labels do not say what was taken together."""
    folders = [_name_folder(image) for image in images]
    labelled = all(image.camera is not None for image in images)
    # A model's number of a camera alone does not say which images were taken together; folders do.
    if labelled and (len(set(folders)) == 1 or all(image.time_s is not None for image in images)):
        labels = [str(image.camera) for image in images]
        # COLMAP numbers a camera for every image unless it is asked not to.
        is_one = len({image.lens for image in images}) == 1 and all(image.time_s is None for image in images)
        return [ONE_CAMERA] * len(images) if is_one or len(set(labels)) == 1 else labels
    if len(set(folders)) == 1:
        return [ONE_CAMERA] * len(images)
    # The part that all share, such as ``images/``, names no camera.
    shared = len(_shared_parts(folders))
    return ["_".join(PurePosixPath(folder).parts[shared:]) or ONE_CAMERA for folder in folders]


def _shared_parts(folders: Sequence[str]) -> tuple[str, ...]:
    parts = [PurePosixPath(folder).parts for folder in set(folders)]
    shared = 0
    while all(len(p) > shared and p[shared] == parts[0][shared] for p in parts):
        shared += 1
    return parts[0][:shared]


def _require_shared_frames(
    frames: Collection[Mapping[str, PosedImage]], names: Sequence[str], file: Path, *, partner: str, remedy: str
) -> None:
    counts = Counter(name for frame in frames for name in frame)
    together = Counter(name for frame in frames if len(frame) > 1 for name in frame)
    for name in names:
        if together[name] < _MIN_SHARED * counts[name]:
            problem = f"{counts[name] - together[name]} of {counts[name]} images of {name} have no partner {partner}"
            raise InputError(problem, remedy=remedy, file=file)


def _require_one_lens(images: Sequence[PosedImage], cameras: Sequence[str], file: Path) -> None:
    lenses = {camera: image.lens for image, camera in zip(images, cameras, strict=True)}
    for image, camera in zip(images, cameras, strict=True):
        if image.lens != lenses[camera]:
            problem = f"the images of {camera} have more than one set of intrinsics, {image.name} another than the last"
            raise InputError(problem, remedy=_LENS_REMEDY, file=file)


def _natural_key(name: str) -> list[tuple[int, str]]:
    """Numbers within names count as numbers, so that 10 comes after 9."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]
