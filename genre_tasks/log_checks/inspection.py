"""Reads a driving log once, front to back, and collects what is wrong with it."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import GenreError
from genre_tasks.log_checks.results import CameraCheck
from genre_tasks.logs.findings import Finding, Severity, format_frames
from genre_tasks.logs.types import Camera, DrivingLog, Float64
from genre_tasks.progress import Progress

# A camera of a 10 Hz rig fires within one period of its sweep.
_MAX_CAMERA_OFFSET_S = 0.15
# Plausible time between frames; outside, the timestamps' unit is in doubt.
_FRAME_PERIOD_RANGE_S = (0.005, 2.0)
_CLOCK_REMEDY = "Frames keep the order of the files; effects that need time (rolling shutter, moving actors) suffer."
_UNIT_REMEDY = "Check the unit of the timestamps: seconds, milliseconds and microseconds since 1970 are understood."

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
            try:
                data = self.log.image_bytes(camera.name, frame)
            except GenreError as error:
                data = b""
                message = f"{error.problem} ({error.where})"
                self.report(Finding("unreadable_image", "warning", message, error.remedy, {}, camera.name, (frame,)))
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
        """Reads the times of all sweeps and images, and reports what is wrong with their clocks.

        Returns:
            [F] seconds, of the sweeps.
        """
        times = np.array([self.log.frame_timestamp_s(frame) for frame in range(self.log.frame_count)])
        self._check_order(times)
        for camera in self.cameras:
            camera_times = [self.log.camera_timestamp_s(camera.name, frame) for frame in range(len(times))]
            offsets = np.array(camera_times) - times
            # The comparison is negated so that a NaN counts as late.
            late = np.flatnonzero(~(np.abs(offsets) <= _MAX_CAMERA_OFFSET_S))
            if late.size:
                frames = tuple(int(frame) for frame in late)
                listed = format_frames(frames)
                message = f"{camera.name}: frames {listed} are over {_MAX_CAMERA_OFFSET_S} s from their sweep"
                numbers = {"largest_offset_s": float(np.nanmax(np.abs(offsets), initial=0.0))}
                finding = Finding("camera_clock", "warning", message, _CLOCK_REMEDY, numbers, camera.name, frames)
                self.report(finding)
        return times

    def _check_order(self, times: Float64) -> None:
        """Reports sweep times that are not finite, equal, decreasing or implausibly far apart."""
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
        # The median, so that one gap in the log does not hide a wrong unit.
        period = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.nan
        shortest, longest = _FRAME_PERIOD_RANGE_S
        if steps.size and not shortest <= period <= longest:
            message = f"the time between frames is {period:g} s"
            numbers = {"period_s": period, "shortest_s": shortest, "longest_s": longest}
            self.report(Finding("implausible_frame_period", "warning", message, _UNIT_REMEDY, numbers))

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
