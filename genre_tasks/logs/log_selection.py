"""Which frames and cameras of a log a run uses; no image and no sweep is read for that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from genre_tasks.config import IngestConfig
from genre_tasks.errors import ConfigError
from genre_tasks.logs.types import Camera, DrivingLog

# Sizes that differ by less are of one shape: a rounded height is never exactly in proportion.
_MAX_SHAPE_ERROR = 0.02
_SIDE_STEP_PX = 2


def chunk_count(config: IngestConfig, log: DrivingLog) -> int:
    """Counts the chunks of a log; the last one may be short.

    Args:
        config: with the frames of a chunk.
        log: to divide.

    Returns:
        Number of chunks; 0 for a log without frames.

    >>> from types import SimpleNamespace
    >>> chunk_count(IngestConfig(chunk_frames=20), SimpleNamespace(frame_count=41))
    3
    """
    return -(-log.frame_count // config.chunk_frames)


def select_frames(config: IngestConfig, log: DrivingLog, chunk_index: int) -> tuple[int, ...]:
    """Selects the frames of a chunk; chunks do not overlap, and the last one may be short.

    Args:
        config: with the frames of a chunk.
        log: to divide.
        chunk_index: from 0.

    Returns:
        The frames, in order.

    Raises:
        ConfigError: the log has no such chunk.

    >>> from types import SimpleNamespace
    >>> select_frames(IngestConfig(chunk_frames=20), SimpleNamespace(frame_count=22, name="002"), 1)
    (20, 21)
    """
    count = chunk_count(config, log)
    if not 0 <= chunk_index < count:
        known = "it has none" if count == 0 else f"it has 0 to {count - 1}"
        raise ConfigError(
            f"the log has no chunk {chunk_index}",
            remedy=f"Choose from its chunks with --chunks: {known}.",
            log=log.name,
        )
    start = chunk_index * config.chunk_frames
    return tuple(range(start, min(start + config.chunk_frames, log.frame_count)))


def has_short_tail(config: IngestConfig, log: DrivingLog) -> bool:
    """Tells whether a log ends with frames that are too few for a chunk, which needs two source frames.

    Args:
        config: with the frames of a chunk and the distance of source frames.
        log: to divide.

    Returns:
        Whether its last chunk is too short; a log of one chunk has no tail.

    >>> from types import SimpleNamespace
    >>> [has_short_tail(IngestConfig(), SimpleNamespace(frame_count=count)) for count in (3, 20, 41, 45)]
    [False, False, True, False]
    """
    tail = log.frame_count % config.chunk_frames
    return log.frame_count > config.chunk_frames and 0 < tail <= config.source_every


def select_cameras(config: IngestConfig, log: DrivingLog) -> tuple[Camera, ...]:
    """Selects the cameras to use.

    Args:
        config: names them, or none for all.
        log: with its rig.

    Returns:
        The cameras in the order of the rig.

    Raises:
        ConfigError: the log has no camera of a name.
    """
    if config.cameras is None:
        return log.cameras
    known = {camera.name for camera in log.cameras}
    unknown = [name for name in config.cameras if name not in known]
    if unknown or not config.cameras:
        raise ConfigError(
            f"unknown cameras {', '.join(unknown)}" if unknown else "no camera is chosen",
            remedy=f"Choose ingest.cameras from {', '.join(camera.name for camera in log.cameras)}.",
            log=log.name,
        )
    # In the order of the rig, whatever the order in the configuration: the result must not depend on it.
    return tuple(camera for camera in log.cameras if camera.name in config.cameras)


class SourceSchedule:
    """Which frames of a chunk have source views: every n-th one, or the next one that has an image in its place.

    Args:
        source_every: distance of source frames, from 1.

    >>> schedule = SourceSchedule(4)
    >>> schedule.is_due(0), schedule.is_due(1)
    (True, True)
    >>> schedule.take(1)
    >>> schedule.is_due(3), schedule.is_due(4)
    (False, True)
    """

    def __init__(self, source_every: int) -> None:
        self._source_every = source_every
        self._next = 0

    def is_due(self, index: int) -> bool:
        """Tells whether a frame becomes a source frame if it has an image.

        Args:
            index: of the frame in its chunk, from 0.
        """
        return index >= self._next

    def take(self, index: int) -> None:
        """Makes a frame a source frame.

        Args:
            index: of the frame in its chunk, from 0.
        """
        self._next = (index // self._source_every + 1) * self._source_every


def select_source_frames(source_every: int, has_images: Mapping[str, Sequence[bool]]) -> dict[str, tuple[int, ...]]:
    """Selects the frames of a chunk at which each camera has a source view.

    Cameras share their source frames. One whose images all lie between them, as where two cameras take turns, has every
    n-th of its images, since no scene would be fitted to it otherwise.

    Args:
        source_every: distance of source frames, from 1.
        has_images: for each camera and frame of the chunk, whether its image can be used.

    Returns:
        Indices of frames in the chunk, by camera; none for a camera with a single image between the others' frames.

    >>> select_source_frames(2, {"front": [True, False, True, False], "left": [False, True, False, True]})
    {'front': (0, 2), 'left': (1,)}
    """
    schedule = SourceSchedule(source_every)
    shared: list[int] = []
    for index, is_there in enumerate(zip(*has_images.values(), strict=True)):
        if any(is_there) and schedule.is_due(index):
            schedule.take(index)
            shared.append(index)
    selected = {}
    for camera, has_image in has_images.items():
        selected[camera] = tuple(index for index in shared if has_image[index])
        present = [index for index, is_there in enumerate(has_image) if is_there]
        # Of two images one stays to be compared with.
        if not selected[camera] and len(present) > 1:
            selected[camera] = tuple(present[::source_every])
    return selected


def count_source_frames(source_every: int, has_images: Mapping[str, Sequence[bool]]) -> int:
    """Counts the source frames of a chunk.

    Args:
        source_every: distance of source frames, from 1.
        has_images: for each camera and frame of the chunk, whether its image can be used.

    Returns:
        The count over all cameras; a chunk needs two.

    >>> count_source_frames(4, {"front": [False] + [True] * 4}), count_source_frames(4, {"front": [True] * 3})
    (2, 1)
    """
    selected = select_source_frames(source_every, has_images)
    return len({index for frames in selected.values() for index in frames})


def choose_working_size(config: IngestConfig, cameras: Sequence[Camera]) -> tuple[int, int]:
    """Chooses the size at which a log's images are used: as many pixels as configured, in the images' own shape.

    Images are not enlarged: that would add time and memory but no detail, and mislead what measures sharpness.

    Args:
        config: with width and height.
        cameras: those that are used.

    Returns:
        Width and height in pixels. They have the configured shape where the cameras differ in theirs, and no more
        pixels than the largest image.

    >>> from genre_tasks.logs.types import Lens
    >>> wide = Camera("image_02", Lens(721.5, 721.5, 609.6, 172.9, 1242, 375))
    >>> choose_working_size(IngestConfig(width_px=320, height_px=180), [wide])
    (436, 132)
    """
    configured = config.width_px, config.height_px
    if not cameras:
        return configured
    configured_shape = config.width_px / config.height_px
    shapes = [camera.lens.width_px / camera.lens.height_px for camera in cameras]
    # One size holds for all images of a chunk: some are stretched where portrait and landscape cameras meet.
    is_shared = max(shapes) <= (1 + _MAX_SHAPE_ERROR) * min(shapes)
    has_configured_shape = not is_shared or abs(shapes[0] / configured_shape - 1) < _MAX_SHAPE_ERROR
    largest_px = max(camera.lens.width_px * camera.lens.height_px for camera in cameras)
    if has_configured_shape and config.width_px * config.height_px <= largest_px:
        return configured
    shape = shapes[0] if is_shared else configured_shape
    area = min(config.width_px * config.height_px, largest_px)
    width = max(_SIDE_STEP_PX, round((area * shape) ** 0.5 / _SIDE_STEP_PX) * _SIDE_STEP_PX)
    return width, max(_SIDE_STEP_PX, round(width / shape / _SIDE_STEP_PX) * _SIDE_STEP_PX)
