"""Reads a driving log once, front to back, and collects what is wrong with it."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import GenreError
from genre_tasks.log_checks.results import CameraCheck
from genre_tasks.logs.findings import Finding, Severity
from genre_tasks.logs.types import Camera, DrivingLog, Float64
from genre_tasks.progress import Progress

# A log with a hole in every second frame would fill the screen.
_MAX_RUNS_LISTED = 8
_CLOCK_REMEDY = "Frames keep the order of the files; effects that need time (rolling shutter, moving actors) suffer."

Value = TypeVar("Value")


class LogInspector:
    """Reads every image, sweep and pose of a log, and turns errors into findings.

    Args:
        log: the log to read.
        progress: called once an image and once a sweep.

    Attributes:
        cameras: the cameras that can be opened.
        findings: what was found so far, without repetitions.
    """

    def __init__(self, log: DrivingLog, progress: Progress) -> None:
        self.log = log
        self.findings: list[Finding] = []
        # Without a rig there is nothing to check: the reader cannot be asked for a single image.
        rig = self.try_reading(lambda: log.cameras, "fatal", "unreadable_camera") or ()
        self.cameras = tuple(camera for camera in rig if self._can_open(camera))
        self._progress = progress
        self._total_steps = log.frame_count * (len(self.cameras) + 1)

    def _can_open(self, camera: Camera) -> bool:
        # A reader opens the files of a camera when it is first asked for a time.
        first_time = self.try_reading(lambda: self.log.camera_timestamp_s(camera.name, 0), "fatal", "unreadable_camera")
        return first_time is not None

    def report(self, finding: Finding) -> None:
        """Adds a finding, unless one with the same message is there already.

        Args:
            finding: what was found.
        """
        # One broken file may be met twice, by its poses and by its timestamps.
        if all(known.message != finding.message for known in self.findings):
            self.findings.append(finding)

    def try_reading(self, read: Callable[[], Value], severity: Severity, word: str) -> Value | None:
        """Calls a function of the log, and reports its error as a finding.

        Args:
            read: what to call.
            severity: of the finding, should ``read`` raise an error.
            word: of the finding.

        Returns:
            What ``read`` returns, or ``None`` after an error.
        """
        try:
            return read()
        except GenreError as error:
            location = f" ({error.where})" if error.where else ""
            frames = () if error.frame is None else (error.frame,)
            message = f"{error.problem}{location}"
            self.report(Finding(word, severity, message, error.remedy, camera=error.camera, frames=frames))
            return None

    def check_camera(self, index: int) -> CameraCheck:
        """Decodes every image of a camera, and reads its poses.

        Args:
            index: position in ``cameras``.

        Returns:
            The frames whose image is missing, unreadable, or of another size than the lens.
        """
        camera = self.cameras[index]
        expected_size = (camera.lens.width_px, camera.lens.height_px)
        missing: list[int] = []
        unreadable: list[int] = []
        odd_size: list[int] = []
        for frame in range(self.log.frame_count):
            data = self.log.image_bytes(camera.name, frame)
            size = None if data is None else _decode_size(data)
            if data is None:
                missing.append(frame)
            elif size is None:
                unreadable.append(frame)
            elif size != expected_size:
                odd_size.append(frame)
            # A camera pose that cannot be read costs one image, not the log.
            self.try_reading(partial(self.log.world_SE3_camera, camera.name, frame), "warning", "unreadable_pose")
            done = index * self.log.frame_count + frame + 1
            self._progress(done, self._total_steps, f"{camera.name} {frame}")
        return CameraCheck(
            name=camera.name,
            width_px=camera.lens.width_px,
            height_px=camera.lens.height_px,
            missing=tuple(missing),
            unreadable=tuple(unreadable),
            odd_size=tuple(odd_size),
        )

    def read_sweeps(self) -> tuple[tuple[int, ...], tuple[int, ...], list[int]]:
        """Reads every LiDAR sweep.

        Returns:
            Frames without a sweep, frames whose sweep cannot be read, and the point counts of the rest.
        """
        missing: list[int] = []
        unreadable: list[int] = []
        point_counts: list[int] = []
        for frame in range(self.log.frame_count):
            try:
                sweep = self.log.sweep(frame)
            except GenreError as error:
                unreadable.append(frame)
                message = f"{error.problem} ({error.where})"
                self.report(Finding("unreadable_sweep", "warning", message, error.remedy, frames=(frame,)))
            else:
                if sweep is None:
                    missing.append(frame)
                else:
                    point_counts.append(len(sweep.points_world))
            done = self._total_steps - self.log.frame_count + frame + 1
            self._progress(done, self._total_steps, f"sweep {frame}")
        return tuple(missing), tuple(unreadable), point_counts

    def read_ego_positions(self) -> Float64:
        """Reads the ego vehicle's position at every frame.

        Returns:
            [F, 3] world coordinates, metres; NaN where the pose cannot be read.
        """
        positions = np.full((self.log.frame_count, 3), np.nan)
        for frame in range(self.log.frame_count):
            pose = self.try_reading(partial(self.log.world_SE3_lidar, frame), "warning", "unreadable_pose")
            if pose is not None:
                positions[frame] = pose[:3, 3]
        return positions

    def read_times(self) -> Float64:
        """Reads the times of all sweeps, and reports frames whose order they do not give.

        Returns:
            [F] seconds, of the sweeps.
        """
        times = np.array([self.log.frame_timestamp_s(frame) for frame in range(self.log.frame_count)])
        self._check_order(times)
        return times

    def _check_order(self, times: Float64) -> None:
        """Reports sweep times that are not finite, equal or decreasing."""
        # A step from or to a time that is not finite is NaN, which no comparison below counts.
        steps = np.diff(times)
        not_finite = np.flatnonzero(~np.isfinite(times))
        if not_finite.size:
            self._report_clock("missing_timestamp", "frames {} have no finite timestamp", not_finite)
        if (steps == 0).any():
            equal = np.flatnonzero(steps == 0) + 1
            self._report_clock("repeated_timestamp", "duplicated timestamps at frames {}", equal)
        if (steps < 0).any():
            backwards = np.flatnonzero(steps < 0) + 1
            self._report_clock("decreasing_timestamp", "time runs backwards at frames {}", backwards)

    def _report_clock(self, word: str, template: str, frames: NDArray[np.int64]) -> None:
        numbers = tuple(int(frame) for frame in frames)
        message = template.format(format_frames(numbers))
        self.report(Finding(word, "warning", message, _CLOCK_REMEDY, frames=numbers))


def _decode_size(data: bytes) -> tuple[int, int] | None:
    """Width and height of an encoded image, or ``None`` if it does not decode."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            size = image.size
            if image.format == "JPEG":
                # An eighth of the size needs all bytes of the file, in a fraction of the time.
                image.draft("RGB", (size[0] // 8, size[1] // 8))
                image.load()
            else:
                # A PNG has checksums, which need no decoding.
                image.verify()
            return size
    # What Pillow raises on damaged files, and on more pixels than any camera has.
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def format_frames(frames: Iterable[int]) -> str:
    """Lists frames for a message, with runs of neighbours shortened.

    Args:
        frames: increasing frame numbers.

    Returns:
        The frames, at most eight runs of them.

    >>> format_frames([3, 28, 29, 30])
    '3, 28–30'
    """
    runs: list[list[int]] = []
    for frame in frames:
        if runs and frame == runs[-1][1] + 1:
            runs[-1][1] = int(frame)
        else:
            runs.append([int(frame), int(frame)])
    texts = [str(first) if first == last else f"{first}–{last}" for first, last in runs]
    suffix = ", …" if len(texts) > _MAX_RUNS_LISTED else ""
    return ", ".join(texts[:_MAX_RUNS_LISTED]) + suffix
