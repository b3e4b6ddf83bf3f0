"""Whether cameras and LiDAR share a clock, and whether it runs as the frames do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding, format_frames
from genre_tasks.logs.types import Camera, Float64

# Of the time between sweeps: a camera fires about once in it. Argoverse 2, at 10 Hz, has images 0.147 s from theirs.
_MAX_OFFSET_PERIODS = 1.5
# The same for the usual rate of 10 Hz, where a single sweep tells none.
_USUAL_MAX_OFFSET_S = 0.15
# Clocks of two epochs differ by seconds, and those of a rig by parts of one, at any rate of sweeps.
_EPOCH_TOLERANCE_S = 0.15
# Plausible time between frames; outside, the timestamps' unit is in doubt.
_FRAME_PERIOD_RANGE_S = (0.005, 2.0)
# Of the usual time between frames: more than a frame's time late is a frame that was dropped.
_DROPPED_PERIODS = 1.8
# So long a pause is no dropped frame; nothing is known of what lies between.
_MAX_GAP_S = 3.0
_MAX_GAP_PERIODS = 10.0
# Fraction of the time between frames by which the clocks of triggered sensors never vary.
_MAX_JITTER = 0.2
# Clocks count from 1970 or from a log's start. 4.1e9 s is the year 2099.
_DATE_RANGE_S = (0.0, 4.1e9)
_CLOCK_REMEDY = "Frames keep the order of the files; effects that need time (rolling shutter, moving actors) suffer."
_UNIT_REMEDY = "Check the unit of the timestamps: write seconds, or the unit that the format of the log prescribes."
# Quartz clocks differ by 1e-4 at most; more is another unit or another rate of frames.
_MAX_DRIFT = 1e-3
# More are no jumps of a clock that is right between them.
_MAX_JUMPS = 2


@dataclass(frozen=True)
class _EpochShift:
    """A constant difference between two clocks that count seconds, and where it comes from."""

    seconds: float
    reason: str


_EPOCH_SHIFTS = (
    _EpochShift(18.0, "GPS time without its leap seconds"),
    _EpochShift(19.0, "GPS time against TAI"),
    _EpochShift(37.0, "TAI"),
    _EpochShift(315_964_800.0, "seconds since 1980 (GPS) against seconds since 1970"),
    _EpochShift(315_964_782.0, "seconds since 1980 (GPS) against seconds since 1970"),
)
_UNIT_FACTORS = {1e-9: "nanoseconds", 1e-6: "microseconds", 1e-3: "milliseconds", 1e3: "1000 s", 60.0: "minutes"}


def find_clock_faults(sample: LogSample) -> Iterator[Finding]:
    """Finds times that do not fit one another; the order of frames is another matter, which both callers report.

    Args:
        sample: the frames of a chunk.

    Yields:
        ``implausible_date``, ``implausible_frame_period``, ``time_gap``, ``dropped_frames``, ``clock_jitter``, and for
        each camera ``camera_clock``.
    """
    times = sample.times_s
    finite = times[np.isfinite(times)]
    earliest, latest = _DATE_RANGE_S
    if finite.size and not earliest <= finite.min() <= finite.max() <= latest:
        message = f"the timestamps run from {finite.min():.6g} to {finite.max():.6g} s, before 1970 or after 2099"
        numbers = {"first_s": float(finite.min()), "last_s": float(finite.max()), "latest_s": latest}
        yield Finding("implausible_date", "warning", message, _UNIT_REMEDY, numbers)
    yield from _judge_periods(sample)
    for camera in sample.cameras:
        yield from _judge_camera(sample, camera)


def _judge_periods(sample: LogSample) -> Iterator[Finding]:
    """Findings about the time from frame to frame."""
    steps = np.diff(sample.times_s)
    if not (steps > 0).any():
        return
    # The median, so that one gap in the log does not hide a wrong unit.
    period = float(np.median(steps[steps > 0]))
    shortest, longest = _FRAME_PERIOD_RANGE_S
    if not shortest <= period <= longest:
        message = f"the time between frames is {period:g} s; {shortest:g} to {longest:g} s is plausible"
        numbers = {"period_s": period, "shortest_s": shortest, "longest_s": longest}
        yield Finding("implausible_frame_period", "warning", message, _UNIT_REMEDY, numbers)
        return
    gap_s = max(_MAX_GAP_S, _MAX_GAP_PERIODS * period)
    gaps = np.flatnonzero(steps > gap_s)
    if gaps.size:
        largest = float(steps[gaps].max())
        frames = tuple(sample.frames[int(step) + 1] for step in gaps)
        message = f"{largest:.4g} s pass before frames {format_frames(frames)}; the others are {period:.3g} s apart"
        remedy = "Check the timestamps, or cut the log there: a chunk must be one drive."
        numbers = {"gap_s": largest, "period_s": period, "limit_s": gap_s}
        yield Finding("time_gap", "warning", message, remedy, numbers, frames=frames)
    dropped = np.flatnonzero((steps > _DROPPED_PERIODS * period) & (steps <= gap_s))
    if dropped.size:
        frames = tuple(sample.frames[int(step) + 1] for step in dropped)
        missing = int(np.round(steps[dropped] / period - 1).sum())
        message = f"{missing} frames were dropped before frames {format_frames(frames)}"
        numbers = {"dropped": float(missing), "period_s": period}
        yield Finding("dropped_frames", "note", message, "The others are used.", numbers, frames=frames)
    regular = steps[(steps > 0) & (steps <= _DROPPED_PERIODS * period)]
    # The median deviation, which a few late frames do not change.
    jitter = float(np.median(np.abs(regular - period))) / period if regular.size > 2 else 0.0
    if jitter > _MAX_JITTER:
        message = (
            f"the time between frames varies by {100 * jitter:.0f} % of {period:.3g} s; "
            f"{100 * _MAX_JITTER:.0f} % is plausible for triggered sensors"
        )
        remedy = "Take the sensors' own times, not those at which a computer received the frames."
        numbers = {"jitter_percent": 100 * jitter, "limit_percent": 100 * _MAX_JITTER, "period_s": period}
        yield Finding("clock_jitter", "note", message, remedy, numbers)


def _judge_camera(sample: LogSample, camera: Camera) -> Iterator[Finding]:
    """A finding where images are far in time from their sweeps, with the reason where one can be told."""
    camera_times = sample.camera_times_s(camera)
    offsets = camera_times - sample.times_s
    limit_s = _limit_offsets(sample.times_s)
    # The comparison is negated so that a NaN counts as late.
    late = np.flatnonzero(~(np.abs(offsets) <= limit_s))
    if not late.size:
        return
    frames = tuple(sample.frames[int(k)] for k in late)
    if not np.isfinite(offsets[late]).any():
        message = f"{camera.name}: frames {format_frames(frames)} have no finite time, or their sweeps have none"
        yield Finding("camera_clock", "warning", message, _CLOCK_REMEDY, {}, camera.name, frames)
        return
    largest = float(np.nanmax(np.abs(offsets), initial=0.0))
    reason = _explain_offsets(sample.times_s, camera_times, min(limit_s, _EPOCH_TOLERANCE_S))
    message = (
        f"{camera.name}: frames {format_frames(frames)} are over {limit_s:.3g} s from their sweep, "
        f"up to {largest:.6g} s{reason}"
    )
    numbers = {"largest_offset_s": largest, "limit_s": limit_s}
    yield Finding("camera_clock", "warning", message, _CLOCK_REMEDY, numbers, camera.name, frames)


def _limit_offsets(sweep_times: Float64) -> float:
    """How many seconds an image may be from its sweep, by the log's rate of sweeps: key frames are at 2 Hz."""
    steps = np.diff(sweep_times)
    steps = steps[(steps > 0) & np.isfinite(steps)]
    # The median, which sweeps that were dropped do not change.
    return _MAX_OFFSET_PERIODS * float(np.median(steps)) if steps.size else _USUAL_MAX_OFFSET_S


def _explain_offsets(sweep_times: Float64, camera_times: Float64, tolerance_s: float) -> str:
    """What may be behind large offsets: a unit, an epoch, a time zone, a delay, a drift, or nothing that is known.

    Offsets that differ by ``tolerance_s`` at most count as one.
    """
    known = np.isfinite(sweep_times) & np.isfinite(camera_times)
    if known.sum() < 2:
        return ""
    sweeps = sweep_times[known]
    offsets = camera_times[known] - sweeps
    sweep_duration = float(np.ptp(sweeps))
    rate = float(np.ptp(camera_times[known])) / sweep_duration if sweep_duration > 0 else 1.0
    for factor, unit in _UNIT_FACTORS.items():
        # Its own number of the same time is larger, the smaller the unit.
        if abs(rate * factor - 1) < 0.1:
            return f": its times look like {unit} where the sweeps' are seconds"
        if abs(rate / factor - 1) < 0.1:
            return f": the sweeps' times look like {unit} where the camera's are seconds"
    shift = float(np.median(offsets))
    if float(np.abs(offsets - shift).max()) <= tolerance_s:
        return f": always by {shift:.6g} s{_explain_shift(shift)}"
    jumps = np.flatnonzero(np.abs(np.diff(offsets)) > tolerance_s)
    if 0 < jumps.size <= _MAX_JUMPS:
        frames = np.flatnonzero(known)[jumps + 1]
        sizes = ", ".join(f"{np.diff(offsets)[jump]:.6g} s" for jump in jumps)
        return f": its clock jumps by {sizes} before image {format_frames(frames)} of the chunk"
    if abs(rate - 1) > _MAX_DRIFT:
        return f": its clock runs {rate:.4g} times as fast as the sweeps'"
    return ""


def _explain_shift(shift_s: float) -> str:
    for known in _EPOCH_SHIFTS:
        if abs(abs(shift_s) - known.seconds) <= _EPOCH_TOLERANCE_S:
            return f", as {known.reason}"
    half_hours = shift_s / 1800
    if round(half_hours) and abs(half_hours - round(half_hours)) * 1800 <= _EPOCH_TOLERANCE_S and abs(shift_s) < 1e5:
        return ", as a time zone"
    return ""
