"""Reader of KITTI's raw recordings: ``kitti:PATH/2011_09_26/2011_09_26_drive_0009_sync``."""

from __future__ import annotations

import hashlib
from functools import cached_property
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.file_digest import digest_files
from genre_tasks.logs.file_reading import read_file
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.image_sizes import choose_lens, describe_no_images, measure_images, report_problems
from genre_tasks.logs.kitti.boxes import read_tracking_labels, read_tracklets
from genre_tasks.logs.kitti.drive_files import (
    CALIBRATION_FILES,
    TRACKLETS_FILE,
    find_drive_files,
    parse_numbers,
    read_calibration,
    read_text,
    read_times,
)
from genre_tasks.logs.kitti.drive_poses import project_records
from genre_tasks.logs.log_address import split_log_address
from genre_tasks.logs.recorded_log import RecordedLog
from genre_tasks.logs.timed_poses import TimedPoses
from genre_tasks.logs.types import Camera, CuboidTrack, Float64, Lens, Sweep, Truth
from genre_tasks.user_paths import expand_user_path

_OPTIONS = ("labels",)
_POINT_BYTES = 16
# KITTI counts from the centre of the first pixel.
_PIXEL_CENTRE = 0.5
# Ten times what its LiDAR measures in one turn.
_MAX_POINTS = 2_000_000
_MAX_SIDE_PX = 65_535
_COPY_REMEDY = "Copy the drive again."


def open_kitti(rest: str) -> KittiLog:
    """Opens the folder of one drive.

    Args:
        rest: ``PATH?labels=FILE``: the folder of the drive, beside the calibration of its day; FILE holds labels of the
            tracking benchmark. Without it the drive's own tracklets are read, if there are any. Special characters of
            paths are written with %, as in URLs.

    Returns:
        The log.

    Raises:
        InputError: no such drive, or its calibration, times or poses cannot be read.
        ConfigError: an option is unknown.
    """
    path, options = split_log_address(rest, _OPTIONS, "KITTI")
    labels = expand_user_path(options["labels"]) if "labels" in options else None
    return KittiLog(f"kitti:{rest}", expand_user_path(path), labels)


class KittiLog(RecordedLog):
    """A ``DrivingLog`` over a drive of KITTI; see ``DrivingLog`` for methods, units and axes.

    A frame is a turn of the LiDAR. Poses hold for the time of each image and each point, between the records of the
    inertial navigation. Images are rectified, and all rows are taken at once.

    Args:
        uri: what the user wrote.
        folder: of the drive.
        labels: of the tracking benchmark; ``None``: the drive's own tracklets.

    Raises:
        InputError: the drive's calibration, times or poses cannot be read.
    """

    dataset = "kitti"
    truth: Truth | None = None

    def __init__(self, uri: str, folder: Path, labels: Path | None) -> None:
        super().__init__(uri)
        self.name = folder.resolve().name
        self._files = find_drive_files(folder, uri)
        if labels is not None and not labels.is_file():
            raise InputError("there is no such file of labels", remedy="Correct labels=FILE.", file=labels, log=uri)
        self._labels = labels
        self._times = self._read_lidar_times()
        self.frame_count = len(self._times)
        self._poses = self._read_poses()
        self._camera_times = {name: self._read_camera_times(name) for name in self._files.cameras}
        self._read_calibration()

    def _read_lidar_times(self) -> Float64:
        path = self._files.times_file("velodyne_points")
        times = read_times(path, self.uri)
        known = np.flatnonzero(np.isfinite(times))
        # A sweep that is missing has no time, as in whole drives of KITTI; turns follow one another evenly.
        filled = np.interp(np.arange(len(times)), known, times[known]) if len(known) else times
        if not len(known) or not (np.diff(filled) > 0).all():
            problem = "the times of the LiDAR are empty, or do not increase"
            raise InputError(problem, remedy=_COPY_REMEDY, file=path, log=self.uri)
        return filled

    def _read_poses(self) -> TimedPoses:
        times = read_times(self._files.times_file("oxts"), self.uri)
        # A drive may lack records; poses between those that there are serve all sensors.
        frames = [frame for frame in sorted(self._files.poses) if frame < len(times) and np.isfinite(times[frame])]
        if len(frames) < 2:
            problem = f"{len(frames)} poses have a file and a time; two are needed"
            raise InputError(problem, remedy=_COPY_REMEDY, file=self._files.folder / "oxts", log=self.uri)
        records = []
        for frame in frames:
            path = self._files.poses[frame]
            records.append(parse_numbers(read_text(path, self.uri, frame), 6, "the pose", path, self.uri, frame))
        if not (np.diff(times[frames]) > 0).all():
            file = self._files.times_file("oxts")
            raise InputError("the times of the poses do not increase", remedy=_COPY_REMEDY, file=file, log=self.uri)
        folder = self._files.folder / "oxts"
        return project_records(times[frames], np.stack(records), file=folder, log=self.uri)

    def _read_camera_times(self, camera: str) -> Float64:
        path = self._files.times_file(camera)
        times = read_times(path, self.uri)
        if len(times) < self.frame_count:
            problem = f"{len(times)} times for {self.frame_count} frames"
            raise InputError(problem, remedy=_COPY_REMEDY, file=path, log=self.uri, camera=camera)
        # An image that is missing has no time; the LiDAR's is some milliseconds off.
        return np.where(np.isfinite(times[: self.frame_count]), times[: self.frame_count], self._times)

    def _read_calibration(self) -> None:
        cameras, velodyne, inertial = (self._files.day / name for name in CALIBRATION_FILES)
        self._projections_file = cameras
        needed = {"R_rect_00": 9} | {f"P_rect_{name[-2:]}": 12 for name in self._files.cameras}
        # Sizes of the rectified images, which some calibrations of other tools leave out.
        sizes = {f"S_rect_{name[-2:]}": 2 for name in self._files.cameras}
        numbers = read_calibration(cameras, needed, self.uri, optional=sizes)
        self._stated_sizes = {name: _read_size(numbers.get(f"S_rect_{name[-2:]}")) for name in self._files.cameras}
        self._projections = {name: numbers[f"P_rect_{name[-2:]}"].reshape(3, 4) for name in self._files.cameras}
        rigid = {"R": 9, "T": 3}
        camera_SE3_velodyne = _to_matrix(read_calibration(velodyne, rigid, self.uri))
        velodyne_SE3_imu = _to_matrix(read_calibration(inertial, rigid, self.uri))
        # The files chain from the inertial unit by the LiDAR to the first camera.
        self._imu_SE3_velodyne = np.linalg.inv(velodyne_SE3_imu)
        rectified_SE3_velodyne = _to_matrix({"R": numbers["R_rect_00"], "T": np.zeros(3)}) @ camera_SE3_velodyne
        self._imu_SE3_rectified = self._imu_SE3_velodyne @ np.linalg.inv(rectified_SE3_velodyne)

    @cached_property
    def cameras(self) -> tuple[Camera, ...]:
        """The colour cameras; the grey ones where there is no other."""
        cameras = []
        for name, files in self._files.cameras.items():
            measured = measure_images({frame: path for frame, path in files.items() if frame < self.frame_count})
            self._report(*report_problems(measured, name))
            if measured.majority is None:
                self._report(describe_no_images(measured, name))
                continue
            width_px, height_px = self._stated_sizes[name] or measured.majority
            # Rectified images have neither distortion nor skew.
            matrix = self._projections[name]
            fx_px, fy_px = float(matrix[0, 0]), float(matrix[1, 1])
            cx_px, cy_px = float(matrix[0, 2]) + _PIXEL_CENTRE, float(matrix[1, 2]) + _PIXEL_CENTRE
            if not (fx_px > 0 and fy_px > 0):
                problem = "a focal length of the calibration is not positive"
                file = self._projections_file
                raise InputError(problem, remedy=_COPY_REMEDY, file=file, log=self.uri, camera=name)
            lens, findings = choose_lens(Lens(fx_px, fy_px, cx_px, cy_px, width_px, height_px), measured, name)
            self._report(*findings)
            cameras.append(Camera(name, lens))
        return tuple(cameras)

    def frame_timestamp_s(self, frame: int) -> float:
        """See ``DrivingLog``: the middle of the LiDAR's turn, when it looks ahead."""
        return float(self._times[self._check_frame(frame)])

    def world_SE3_lidar(self, frame: int) -> Float64:
        """See ``DrivingLog``."""
        pose: Float64 = self._poses.matrix_at(self.frame_timestamp_s(frame), frame) @ self._imu_SE3_velodyne
        return pose

    def world_SE3_camera(self, camera: str, frame: int) -> Float64:
        """See ``DrivingLog``."""
        rectified_SE3_camera = np.eye(4)
        matrix = self._projections[self._check_camera(camera, frame)]
        # The last column holds the way from the first camera, in pixels.
        rectified_SE3_camera[:3, 3] = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
        pose: Float64 = self._world_SE3_rectified(camera, frame) @ rectified_SE3_camera
        return pose

    def _world_SE3_rectified(self, camera: str, frame: int) -> Float64:
        time_s = self.camera_timestamp_s(camera, frame)
        pose: Float64 = self._poses.matrix_at(time_s, frame) @ self._imu_SE3_rectified
        return pose

    def camera_timestamp_s(self, camera: str, frame: int) -> float:
        """See ``DrivingLog``."""
        return float(self._camera_times[self._check_camera(camera, frame)][self._check_frame(frame)])

    def image_bytes(self, camera: str, frame: int) -> bytes | None:
        """See ``DrivingLog``."""
        self._check_camera(camera, frame)
        path = self._files.cameras[camera].get(self._check_frame(frame))
        return None if path is None else read_file(path, log=self.uri, camera=camera, frame=frame)

    def sweep(self, frame: int) -> Sweep | None:
        """See ``DrivingLog``; every point is placed by the pose of its own time.

        Raises:
            InputError: no such frame, or a sweep that cannot be read.
        """
        path = self._files.sweeps.get(self._check_frame(frame))
        if path is None:
            return None
        rows = self._read_points(path, frame)
        times = self._point_times(rows, frame)
        # Within a turn the vehicle goes a metre and more.
        rotations, positions = self._poses.at(times, frame)
        in_imu = rows[:, :3].astype(np.float64) @ self._imu_SE3_velodyne[:3, :3].T + self._imu_SE3_velodyne[:3, 3]
        return Sweep(
            points_world=rotations.apply(in_imu) + positions,
            intensity=np.clip(self._fill_intensities(rows[:, 3], frame), 0.0, 1.0).astype(np.float32),
            timestamps_s=times,
        )

    def _read_points(self, path: Path, frame: int) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
        """[N, 4] finite x, y, z in the axes of the LiDAR, and intensity as the file has it."""
        # Before it is read: the file may be anything. A link may lead nowhere, which reading says.
        size = path.stat().st_size if path.exists() else 0
        if size % _POINT_BYTES or size > _MAX_POINTS * _POINT_BYTES:
            problem = f"the sweep has {size} bytes, which are not up to {_MAX_POINTS} points of {_POINT_BYTES}"
            raise InputError(problem, remedy=_COPY_REMEDY, file=path, log=self.uri, frame=frame)
        rows = np.frombuffer(read_file(path, log=self.uri, frame=frame), dtype="<f4").reshape(-1, 4)
        placed = self._find_placed(rows[:, :3], frame)
        return rows if placed.all() else rows[placed]

    @cached_property
    def _turns(self) -> tuple[Float64, Float64] | None:
        """[F] seconds at which the LiDAR's turns begin and end; ``None`` where the drive does not say so."""
        paths = [self._files.times_file("velodyne_points", f"timestamps_{name}.txt") for name in ("start", "end")]
        if not all(path.is_file() for path in paths):
            return None
        begin, end = (read_times(path, self.uri) for path in paths)
        return (begin, end) if len(begin) >= self.frame_count and len(end) >= self.frame_count else None

    def _point_times(self, rows: np.ndarray[tuple[int, int], np.dtype[np.float32]], frame: int) -> Float64:
        # Without the times of turns there is nothing to undo.
        if self._turns is None:
            return np.full(len(rows), self.frame_timestamp_s(frame))
        begin, end = (float(times[frame]) for times in self._turns)
        if not np.isfinite(end - begin):
            return np.full(len(rows), self.frame_timestamp_s(frame))
        # A turn begins behind the vehicle, and runs clockwise as seen from above.
        part = 0.5 - np.arctan2(rows[:, 1], rows[:, 0]).astype(np.float64) / (2 * np.pi)
        return begin + part * (end - begin)

    def tracks(self) -> tuple[CuboidTrack, ...]:
        """See ``DrivingLog``.

        Raises:
            InputError: there are labels, and they cannot be read, or all are bad.
        """
        return self._tracks

    @cached_property
    def _tracks(self) -> tuple[CuboidTrack, ...]:
        if self._labels is not None:
            boxes, findings = read_tracking_labels(self._labels, self.frame_count, self.uri)
            self._report(*findings)
            # Labels of the benchmark were drawn into the images of the left colour camera.
            camera = next(iter(self._camera_times))
            return self._build_tracks(boxes, lambda frame: self._world_SE3_rectified(camera, frame))
        path = self._files.folder / TRACKLETS_FILE
        if not path.is_file():
            return ()
        boxes, findings = read_tracklets(path, self.frame_count, self.uri)
        self._report(*findings)
        return self._build_tracks(boxes, self.world_SE3_lidar)

    def findings(self) -> tuple[Finding, ...]:
        """What was left out so far, for ``genre check``."""
        found = self._findings_after(self.cameras)
        if self._labels is None and not (self._files.folder / TRACKLETS_FILE).is_file():
            message = f"there are no boxes: neither {TRACKLETS_FILE} nor labels=FILE"
            remedy = "Without boxes, whatever moves is smeared over its path."
            found += (Finding("no_labels", "note", message, remedy),)
        return found

    def digest(self) -> str:
        """Identifies all files that are read."""
        parts = [digest_files(self._files.day, self._files.list_read_files(), ())]
        if self._labels is not None:
            parts.append(digest_files(self._labels.parent, [self._labels], ()))
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _check_camera(self, camera: str, frame: int) -> str:
        return self._check_camera_among(self._projections, camera, frame)


def _to_matrix(numbers: dict[str, Float64]) -> Float64:
    """[4, 4] from R and T of a calibration, whose rotation is rounded to a few digits."""
    matrix = np.eye(4)
    u, _, v = np.linalg.svd(numbers["R"].reshape(3, 3))
    matrix[:3, :3] = u @ v
    matrix[:3, 3] = numbers["T"]
    return matrix


def _read_size(numbers: Float64 | None) -> tuple[int, int] | None:
    """Width and height of a calibration; ``None`` where it states none, or numbers that are no size."""
    if numbers is None or not ((numbers >= 1) & (numbers <= _MAX_SIDE_PX)).all():
        return None
    width_px, height_px = (round(float(number)) for number in numbers)
    return width_px, height_px
