"""Reads a driving log once, front to back, and collects what is wrong with it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import GenreError
from genre_tasks.log_checks.images import BLANK, LEFT_OUT, ODD_SIZE, UNREADABLE, find_unfit, read_image
from genre_tasks.log_checks.repeated_images import ImageRecord
from genre_tasks.log_checks.results import CameraCheck
from genre_tasks.logs.findings import Finding, Severity, format_frames
from genre_tasks.logs.types import Camera, DrivingLog, Float64
from genre_tasks.progress import Progress
from genre_tasks.scene.image_decoding import inspect_image

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
        image_findings: camera → frame and finding of the images that were checked, for a summary of each camera.
    """

    def __init__(self, log: DrivingLog, progress: Progress) -> None:
        self.log = log
        self.findings: list[Finding] = []
        self.image_findings: dict[str, list[tuple[int, Finding]]] = {}
        # Without a rig there is nothing to check: the reader cannot be asked for a single image.
        rig = self.try_reading(lambda: log.cameras, "fatal", "unreadable_camera") or ()
        self.cameras = tuple(camera for camera in rig if self._can_open(camera))
        self._progress = progress
        self._total_steps = log.frame_count * (len(self.cameras) + 1)

    def _can_open(self, camera: Camera) -> bool:
        # A reader opens the files of a camera when it is first asked for a time. One frame may be broken by itself.
        last = self.log.frame_count - 1
        if last > 0 and _read_or_note(partial(self.log.camera_timestamp_s, camera.name, last), []) is not None:
            return True
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
            The frames whose image is missing, unreadable, of another size than the lens, or blank.
        """
        camera = self.cameras[index]
        missing: list[int] = []
        pose_errors: list[GenreError] = []
        found = self.image_findings[camera.name] = []
        record = ImageRecord(camera.name)
        for frame in range(self.log.frame_count):
            read = partial(self.log.image_bytes, camera.name, frame)
            image, problem = read_image(read, lambda data: (inspect_image(data), data), GenreError)
            facts, data = image or (None, b"")
            if facts is not None:
                problem = find_unfit(camera.lens, facts)
            if problem is not None:
                found.append((frame, problem))
            elif facts is None:
                missing.append(frame)
            else:
                found.extend((frame, finding) for finding in facts.findings)
            # A camera pose that cannot be read costs one image, not the log.
            pose = _read_or_note(partial(self.log.world_SE3_camera, camera.name, frame), pose_errors)
            # Images that are left out for another reason, such as black ones, are reported by that.
            if facts is not None and problem is None and pose is not None:
                record.add(frame, data, pose)
            done = index * self.log.frame_count + frame + 1
            self._progress(done, self._total_steps, f"{camera.name} {frame}")
        self._report_errors("unreadable_pose", pose_errors)
        repeated = record.find_repeated()
        if repeated is not None:
            self.report(repeated)
        frames = {word: tuple(n for n, finding in found if finding.word == word) for word in LEFT_OUT}
        return CameraCheck(
            name=camera.name,
            width_px=camera.lens.width_px,
            height_px=camera.lens.height_px,
            missing=tuple(missing),
            unreadable=frames[UNREADABLE],
            odd_size=frames[ODD_SIZE],
            blank=frames[BLANK],
        )

    def read_sweeps(self) -> tuple[tuple[int, ...], tuple[int, ...], dict[int, int]]:
        """Reads every LiDAR sweep.

        Returns:
            Frames without a sweep, frames whose sweep cannot be read, and frame → point count of the rest.
        """
        missing: list[int] = []
        unreadable: list[int] = []
        errors: list[GenreError] = []
        point_counts: dict[int, int] = {}
        for frame in range(self.log.frame_count):
            try:
                sweep = self.log.sweep(frame)
            except GenreError as error:
                unreadable.append(frame)
                errors.append(error)
            else:
                if sweep is None:
                    missing.append(frame)
                else:
                    point_counts[frame] = len(sweep.points_world)
            done = self._total_steps - self.log.frame_count + frame + 1
            self._progress(done, self._total_steps, f"sweep {frame}")
        self._report_errors("unreadable_sweep", errors)
        return tuple(missing), tuple(unreadable), point_counts

    def read_ego_positions(self) -> Float64:
        """Reads the ego vehicle's position at every frame.

        Returns:
            [F, 3] world coordinates, metres; NaN where the pose cannot be read.
        """
        positions = np.full((self.log.frame_count, 3), np.nan)
        errors: list[GenreError] = []
        for frame in range(self.log.frame_count):
            pose = _read_or_note(partial(self.log.world_SE3_lidar, frame), errors)
            if pose is not None:
                positions[frame] = pose[:3, 3]
        self._report_errors("unreadable_pose", errors)
        return positions

    def read_times(self) -> Float64:
        """Reads the times of all sweeps, and reports frames whose order they do not give.

        Returns:
            [F] seconds, of the sweeps; NaN where the time cannot be read.
        """
        times = np.full(self.log.frame_count, np.nan)
        errors: list[GenreError] = []
        unreadable: list[int] = []
        for frame in range(self.log.frame_count):
            time_s = _read_or_note(partial(self.log.frame_timestamp_s, frame), errors)
            if time_s is None:
                unreadable.append(frame)
            else:
                times[frame] = time_s
        if errors:
            self._report_unreadable_times(unreadable, errors[0])
        self._check_order(times, unreadable)
        return times

    def _report_unreadable_times(self, frames: list[int], first: GenreError) -> None:
        """Reports times that the reader refuses; one finding, though each of them is an error of its frame."""
        location = f" ({first.where})" if first.where else ""
        message = f"frames {format_frames(frames)} have no time that can be read: {first.problem}{location}; "
        message += "their chunks cannot be reconstructed"
        self.report(Finding("missing_timestamp", "warning", message, first.remedy, frames=tuple(frames)))

    def _report_errors(self, word: str, errors: list[GenreError]) -> None:
        """Reports what could not be read of single frames; one finding for all frames with the same problem."""
        groups: dict[str, list[GenreError]] = {}
        for error in errors:
            groups.setdefault(error.problem, []).append(error)
        for problem, group in groups.items():
            first = group[0]
            frames = tuple(sorted({error.frame for error in group if error.frame is not None}))
            others = f"; frames {format_frames(frames)} alike" if len(frames) > 1 else ""
            location = f" ({first.where}{others})" if first.where else ""
            message = f"{problem}{location}"
            self.report(Finding(word, "warning", message, first.remedy, camera=first.camera, frames=frames))

    def _check_order(self, times: Float64, unreadable: list[int]) -> None:
        """Reports sweep times that are not finite, but for the unreadable ones, equal or decreasing."""
        # A step from or to a time that is not finite is NaN, which no comparison below counts.
        steps = np.diff(times)
        not_finite = np.setdiff1d(np.flatnonzero(~np.isfinite(times)), unreadable)
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


def _read_or_note(read: Callable[[], Value], errors: list[GenreError]) -> Value | None:
    """Calls a function of the log; its error is added to ``errors``."""
    try:
        return read()
    except GenreError as error:
        errors.append(error)
        return None
