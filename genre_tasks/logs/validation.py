"""What a log has and lacks, before hours are spent on it: every image is decoded (coarsely), every sweep is read."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, TypeVar

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Camera, DrivingLog, Float64, ReportsProblems
from genre_tasks.progress import Progress, silent

STANDSTILL_M = 0.5  # a chunk with less travel has next to no parallax: its geometry comes from the LiDAR alone
_MIN_CHUNK_FRAMES = 2
_MAX_CAMERA_OFFSET_S = 0.15  # a camera of a 10 Hz rig fires within one period of its sweep
_PERIOD_S = (0.005, 2.0)  # a plausible time between frames; outside, the unit of the timestamps is in doubt
_LOW_POINTS = 1000

Verdict = Literal["good", "usable", "unusable"]
Value = TypeVar("Value")


@dataclass(frozen=True)
class Finding:
    """One thing to know: ``fatal`` (the log cannot be reconstructed), ``warning`` or ``note``; and what to do."""

    severity: Literal["fatal", "warning", "note"]
    message: str
    remedy: str = ""


@dataclass(frozen=True)
class CameraCheck:
    """One camera: its native size, and the frames whose image is missing, unreadable, or of another size."""

    name: str
    width_px: int
    height_px: int
    missing: tuple[int, ...]
    unreadable: tuple[int, ...]
    odd_size: tuple[int, ...]


@dataclass(frozen=True)
class LogCheck:
    """What ``check_log`` found.

    ``points`` is (least, median, most) of the readable sweeps; ``travel_m`` the length of the ego path;
    ``chunk_travel_m`` one value a chunk; ``invalid`` counts what the reader left out, by kind.
    """

    uri: str
    frames: int
    duration_s: float
    cameras: tuple[CameraCheck, ...]
    missing_sweeps: tuple[int, ...]
    unreadable_sweeps: tuple[int, ...]
    points: tuple[int, int, int]
    tracks_moving: int
    tracks_static: int
    invalid: tuple[tuple[str, int], ...]
    travel_m: float
    chunk_travel_m: tuple[float, ...]
    findings: tuple[Finding, ...]

    @property
    def chunk_count(self) -> int:
        return len(self.chunk_travel_m)

    @property
    def standstill_chunks(self) -> tuple[int, ...]:
        """The chunks in which the ego vehicle moves less than ``STANDSTILL_M``."""
        return tuple(k for k, travel in enumerate(self.chunk_travel_m) if travel < STANDSTILL_M)

    @property
    def verdict(self) -> Verdict:
        """``unusable`` if anything is fatal, ``usable`` with warnings, else ``good``."""
        severities = {finding.severity for finding in self.findings}
        return "unusable" if "fatal" in severities else "usable" if "warning" in severities else "good"


class _Inspection:
    """Collects findings while the log is read once, front to back."""

    def __init__(self, log: DrivingLog, progress: Progress) -> None:
        self.log = log
        self.progress = progress
        self.findings: list[Finding] = []
        rig = self.attempt(lambda: log.cameras, "fatal") or ()
        self.cameras = tuple(c for c in rig if self._opens(c))
        self.total = log.frame_count * (len(self.cameras) + 1)

    def _opens(self, camera: Camera) -> bool:
        return self.attempt(lambda: self.log.camera_timestamp_s(camera.name, 0), "fatal") is not None

    def add(self, severity: Literal["fatal", "warning", "note"], message: str, remedy: str = "") -> None:
        finding = Finding(severity, message, remedy)
        if finding not in self.findings:  # one broken file may be met twice
            self.findings.append(finding)

    def attempt(self, read: Callable[[], Value], severity: Literal["fatal", "warning"]) -> Value | None:
        """What ``read`` returns; an ``InputError`` becomes a finding, and ``None``."""
        try:
            return read()
        except InputError as error:
            where = f" ({error.where})" if error.where else ""
            self.add(severity, f"{error.problem}{where}", error.remedy)
            return None

    def camera(self, at: int, camera: Camera) -> CameraCheck:
        missing, unreadable, odd = [], [], []
        for frame in range(self.log.frame_count):
            data = self.log.image_bytes(camera.name, frame)
            size = None if data is None else _decoded_size(data)
            if data is None:
                missing.append(frame)
            elif size is None:
                unreadable.append(frame)
            elif size != (camera.lens.width_px, camera.lens.height_px):
                odd.append(frame)
            self.attempt(lambda f=frame: self.log.world_SE3_camera(camera.name, f), "warning")  # type: ignore[misc]
            self.progress(at * self.log.frame_count + frame + 1, self.total, f"{camera.name} {frame}")
        return CameraCheck(
            camera.name, camera.lens.width_px, camera.lens.height_px, tuple(missing), tuple(unreadable), tuple(odd)
        )

    def sweeps(self) -> tuple[tuple[int, ...], tuple[int, ...], list[int]]:
        """Missing frames, unreadable frames, and the point counts of the rest."""
        missing, unreadable, counts = [], [], []
        for frame in range(self.log.frame_count):
            try:
                sweep = self.log.sweep(frame)
            except InputError as error:
                unreadable.append(frame)
                self.add("warning", f"{error.problem} ({error.where})", error.remedy)
            else:
                if sweep is None:
                    missing.append(frame)
                else:
                    counts.append(len(sweep.points_world))
            self.progress(self.total - self.log.frame_count + frame + 1, self.total, f"sweep {frame}")
        return tuple(missing), tuple(unreadable), counts

    def positions(self) -> Float64:
        """[F, 3] of the ego vehicle; NaN where the pose cannot be read."""
        rows = np.full((self.log.frame_count, 3), np.nan)
        for frame in range(self.log.frame_count):
            pose = self.attempt(lambda f=frame: self.log.world_SE3_lidar(f), "warning")  # type: ignore[misc]
            if pose is not None:
                rows[frame] = pose[:3, 3]
        return rows

    def times(self) -> Float64:
        """[F]; reports what is wrong with the clock of the sweeps and of the cameras."""
        times = np.array([self.log.frame_timestamp_s(f) for f in range(self.log.frame_count)])
        steps = np.diff(times)
        keep = "Frames keep the order of the files; effects that need time (rolling shutter, moving actors) suffer."
        if not np.isfinite(times).all():
            self.add("warning", f"frames {_frames(np.flatnonzero(~np.isfinite(times)))} have no finite timestamp", keep)
        if (steps == 0).any():
            self.add("warning", f"duplicated timestamps at frames {_frames(np.flatnonzero(steps == 0) + 1)}", keep)
        if (steps < 0).any():
            self.add("warning", f"time runs backwards at frames {_frames(np.flatnonzero(steps < 0) + 1)}", keep)
        period = float(np.median(steps[steps > 0])) if (steps > 0).any() else math.nan
        if steps.size and not _PERIOD_S[0] <= period <= _PERIOD_S[1]:
            remedy = (
                "Check the unit of the timestamps: seconds, milliseconds and microseconds since 1970 are understood."
            )
            self.add("warning", f"the time between frames is {period:g} s", remedy)
        for camera in self.cameras:
            offsets = np.array([self.log.camera_timestamp_s(camera.name, f) for f in range(len(times))]) - times
            late = np.flatnonzero(~(np.abs(offsets) <= _MAX_CAMERA_OFFSET_S))
            if late.size:
                message = f"{camera.name}: frames {_frames(late)} are over {_MAX_CAMERA_OFFSET_S} s from their sweep"
                self.add("warning", message, keep)
        return times


def check_log(log: DrivingLog, chunk_frames: int = 20, progress: Progress = silent) -> LogCheck:
    """Reads the whole log once and says what it has and lacks; never raises on what the log holds.

    Args:
        chunk_frames: frames of a chunk, as in ``ingest.chunk_frames``; the last chunk may be shorter.
        progress: called once an image and once a sweep.
    """
    look = _Inspection(log, progress)
    positions, times = look.positions(), look.times()
    cameras = tuple(look.camera(at, camera) for at, camera in enumerate(look.cameras))
    missing, unreadable, counts = look.sweeps()
    tracks = look.attempt(log.tracks, "warning") or ()
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    starts = range(0, log.frame_count, chunk_frames)
    finite = times[np.isfinite(times)]
    check = LogCheck(
        uri=log.uri,
        frames=log.frame_count,
        duration_s=float(np.ptp(finite)) if finite.size else 0.0,
        cameras=cameras,
        missing_sweeps=missing,
        unreadable_sweeps=unreadable,
        points=(min(counts), int(np.median(counts)), max(counts)) if counts else (0, 0, 0),
        tracks_moving=sum(track.moving for track in tracks),
        tracks_static=sum(not track.moving for track in tracks),
        invalid=_invalid(log, look),
        travel_m=float(np.nansum(steps)),
        chunk_travel_m=tuple(float(np.nansum(steps[s : s + chunk_frames - 1])) for s in starts),
        findings=(),
    )
    _judge(check, look, chunk_frames)
    return replace(check, findings=tuple(look.findings))


def _invalid(log: DrivingLog, look: _Inspection) -> tuple[tuple[str, int], ...]:
    if not isinstance(log, ReportsProblems):
        return ()
    kinds = [problem.kind for problem in look.attempt(log.problems, "warning") or ()]
    return tuple((kind, kinds.count(kind)) for kind in sorted(set(kinds)))


def _judge(check: LogCheck, look: _Inspection, chunk_frames: int) -> None:
    _judge_cameras(check, look)
    _judge_lidar(check, look)
    for kind, count in check.invalid:
        look.add(
            "warning", f"the reader left out {count} × {kind.replace('_', ' ')}", "They are not used; see the log."
        )
    if not check.tracks_moving and not check.tracks_static:
        look.add("note", "no cuboids: everything is taken as static", "Moving objects will smear.")
    for chunk in check.standstill_chunks:
        message = f"chunk {chunk}: the ego vehicle stands still ({check.chunk_travel_m[chunk]:.2f} m), no parallax"
        look.add("warning", message, "Novel views rest on the LiDAR alone there; leave it out with --chunks.")
    last = check.frames - (check.chunk_count - 1) * chunk_frames
    if last < _MIN_CHUNK_FRAMES:
        look.add("warning", f"the last chunk has {last} frame", "Leave it out with --chunks.")
    elif last < chunk_frames:
        look.add("note", f"the last chunk is short: {last} of {chunk_frames} frames")


def _judge_cameras(check: LogCheck, look: _Inspection) -> None:
    if not check.cameras:
        look.add("fatal", "no camera has an image", "Copy the camera folders of the sequence.")
    elif len(check.cameras) == 1:
        look.add("note", "one camera only", "Shifted views see more that no camera saw.")
    images = 0
    for camera in check.cameras:
        images += check.frames - len(camera.missing) - len(camera.unreadable)
        if camera.missing:
            look.add("warning", f"{camera.name}: no image at frames {_frames(camera.missing)}", "They are left out.")
        if camera.unreadable:
            message = f"{camera.name}: unreadable images at frames {_frames(camera.unreadable)}"
            look.add("warning", message, "Copy them again; they are left out, or stop the run under --strict.")
        if camera.odd_size:
            message = f"{camera.name}: frames {_frames(camera.odd_size)} are not {camera.width_px}×{camera.height_px}"
            look.add("warning", message, "Export them at the size of the intrinsics.")
    if check.cameras and not images:
        look.add("fatal", "no image can be read", "Copy the camera folders of the sequence again.")


def _judge_lidar(check: LogCheck, look: _Inspection) -> None:
    read = check.frames - len(check.missing_sweeps) - len(check.unreadable_sweeps)
    if not read:
        look.add("fatal", "no LiDAR sweep can be read", "Give points by ingest.points=FILE.ply.")
    elif check.missing_sweeps:
        look.add("warning", f"no LiDAR sweep at frames {_frames(check.missing_sweeps)}", "The other sweeps are used.")
    if read and check.points[0] < _LOW_POINTS:
        look.add("warning", f"a sweep has only {check.points[0]} points", "Look at the LiDAR files of the sequence.")


def _decoded_size(data: bytes) -> tuple[int, int] | None:
    """Width and height, or ``None`` if it does not decode. JPEG is decoded at an eighth: all its bytes are read."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(data)) as image:
            size = image.size
            if image.format == "JPEG":
                image.draft("RGB", (size[0] // 8, size[1] // 8))
                image.load()
            else:
                image.verify()
            return size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def _frames(frames: object) -> str:
    """``3, 28–30``: runs of frames, shortened."""
    numbers = [int(f) for f in np.atleast_1d(np.asarray(frames))]
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    texts = [str(a) if a == b else f"{a}–{b}" for a, b in runs]
    return ", ".join(texts[:8]) + (", …" if len(texts) > 8 else "")
