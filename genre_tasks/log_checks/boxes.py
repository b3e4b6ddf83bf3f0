"""Whether annotated boxes have the sizes, headings and speeds of what they are said to be."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.logs.findings import Finding, Severity
from genre_tasks.logs.types import CuboidTrack, Float64

_SIZE_NAMES = ("length", "width", "height")


@dataclass(frozen=True)
class _SizeClass:
    """The sizes of a class of objects.

    Attributes:
        name: for messages.
        label: matches labels of the class, in lower case.
        other: matches labels that only look like it.
        typical_m: length, width, height of most.
        range_m: least and most of the three; the median of several objects never leaves them.
    """

    name: str
    label: re.Pattern[str]
    other: re.Pattern[str]
    typical_m: tuple[float, float, float]
    range_m: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


# PandaSet's cars are 3.1 to 5.3 m long, Argoverse's regular vehicles 4.0 to 6.2 m; a two-seater has 2.5 m.
_CLASSES = (
    _SizeClass(
        "cars",
        re.compile(r"\b(car|cars|sedan|suv|taxi|vehicle)\b"),
        re.compile(r"other|construction|truck|bus|trailer|tram|train|bicycle|cycle|emergency|rail"),
        (4.5, 1.9, 1.6),
        ((2.4, 7.5), (1.2, 3.2), (0.9, 3.5)),
    ),
    _SizeClass(
        "pedestrians",
        re.compile(r"\b(pedestrian|pedestrians|person|human|adult)\b"),
        re.compile(r"with|rider|group|wheelchair|child|sitting|stroller|personal"),
        (0.7, 0.7, 1.75),
        ((0.2, 2.2), (0.2, 2.2), (1.0, 2.5)),
    ),
)
# The longest trams have 75 m; the thinnest signs a centimetre.
_ANY_RANGE_M = (0.01, 80.0)
# Factors between the numbers of another convention and those of full sizes in metres.
_UNITS = {
    0.5: "half sizes",
    2.0: "twice the sizes",
    3.281: "feet",
    39.37: "inches",
    100.0: "centimetres",
    1000.0: "millimetres",
    0.01: "metres read as centimetres",
    0.001: "metres read as millimetres",
}
_UNIT_TOLERANCE = 1.2
# Sizes that are all off by the same factor are of another unit, not of another object.
_MAX_FACTOR_RATIO = 1.6
# In real logs most objects stay for a second and more.
_MIN_ANNOTATED_FRAMES = 3
_MIN_SINGLE_FRACTION = 0.9
_MAX_SPEED_M_S = 70.0
# Pedestrians turn on the spot and walk backwards; nothing without wheels is so fast.
_MIN_DRIVING_M_S = 3.0
_MIN_TRAVEL_M = 2.0
# Cars of a real log drive within 13° of their boxes' x axis.
_MAX_HEADING_DEG = 45.0
# Annotators move the box of a parked car by 0.1 or 0.2 m when another side of it comes into view.
_MAX_STATIC_TRAVEL_M = 2.0
_SIZE_REMEDY = "Boxes need full sizes in metres, in the order length, width, height of their x, y and z axes."
_HEADING_REMEDY = (
    "Check yaw (radians, counter-clockwise about z) and axes: a box's length lies along x, which is ahead."
)


def find_implausible_boxes(sample: LogSample) -> Iterator[Finding]:
    """Finds boxes whose numbers are in another unit, order or frame.

    Args:
        sample: the frames of a chunk.

    Yields:
        ``brief_tracks``, ``odd_box_size``, ``implausible_track_speed``, ``odd_box_heading`` or ``moving_static_boxes``.
    """
    tracks = [track for track in sample.tracks if np.isin(track.frames, sample.frames).any()]
    yield from _judge_lengths(tracks, sample)
    yield from _judge_sizes(tracks)
    paths = [_TrackPath.from_track(track, sample) for track in tracks]
    yield from _judge_speeds(paths)
    yield from _judge_headings(paths)
    yield from _judge_static(paths)


def _judge_lengths(tracks: list[CuboidTrack], sample: LogSample) -> Iterator[Finding]:
    """A finding where nearly every object is in one frame alone, though many frames have boxes."""
    counts = [int(np.isin(track.frames, sample.frames).sum()) for track in tracks]
    annotated = len({int(frame) for track in tracks for frame in track.frames[np.isin(track.frames, sample.frames)]})
    single = counts.count(1)
    if annotated < _MIN_ANNOTATED_FRAMES or single < _MIN_SINGLE_FRACTION * len(tracks):
        return
    message = f"{single} of {len(tracks)} objects are in one frame alone, though {annotated} frames have boxes"
    remedy = "Give an object the same id in all frames: nothing else says what moves where."
    numbers = {"single": float(single), "tracks": float(len(tracks)), "limit_fraction": _MIN_SINGLE_FRACTION}
    yield Finding("brief_tracks", "warning", message, remedy, numbers)


@dataclass(frozen=True)
class _TrackPath:
    """A track in the frames of the chunk in which it is annotated.

    Attributes:
        track: the track.
        world_SE3_box: [N, 4, 4].
        speeds_m_s: [N - 1] from each box to the next; NaN where time does not advance.
    """

    track: CuboidTrack
    world_SE3_box: Float64
    speeds_m_s: Float64

    @staticmethod
    def from_track(track: CuboidTrack, sample: LogSample) -> _TrackPath:
        inside = np.isin(track.frames, sample.frames)
        boxes = track.world_SE3_box[inside]
        times = sample.times_s[np.searchsorted(sample.frames, track.frames[inside])]
        periods = np.diff(times)
        lengths = np.linalg.norm(np.diff(boxes[:, :3, 3], axis=0), axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return _TrackPath(track, boxes, np.where(periods > 0, lengths / periods, np.nan))

    @property
    def travel(self) -> Float64:
        """[3] metres from the first box to the last."""
        vector: Float64 = self.world_SE3_box[-1, :3, 3] - self.world_SE3_box[0, :3, 3]
        return vector


def _judge_sizes(tracks: list[CuboidTrack]) -> Iterator[Finding]:
    """One finding: the class whose sizes are odd, or else single boxes."""
    for size_class in _CLASSES:
        labels = {track.label: re.sub(r"[^a-z]+", " ", track.label.lower()) for track in tracks}
        matching = [
            track.size_m
            for track in tracks
            if size_class.label.search(labels[track.label]) and not size_class.other.search(labels[track.label])
        ]
        sizes = np.array([size for size in matching if np.isfinite(size).all() and min(size) > 0])
        if not sizes.size:
            continue
        median = np.median(sizes, axis=0)
        odd = [not low <= size <= high for size, (low, high) in zip(median, size_class.range_m, strict=True)]
        if any(odd):
            listed = " × ".join(f"{size:.3g}" for size in median)
            limits = ", ".join(
                f"{name} {low:g} to {high:g} m"
                for name, (low, high) in zip(_SIZE_NAMES, size_class.range_m, strict=True)
            )
            message = f"{len(sizes)} {size_class.name} have a median size of {listed} m; plausible are {limits}"
            numbers = {f"{name}_m": float(size) for name, size in zip(_SIZE_NAMES, median, strict=True)}
            remedy = f"{_explain_size(median, size_class)}{_SIZE_REMEDY}"
            yield Finding("odd_box_size", "warning", message, remedy, numbers)
            return
    smallest, largest = _ANY_RANGE_M
    odd_tracks = [track for track in tracks if max(track.size_m) > largest or 0 < min(track.size_m) < smallest]
    if odd_tracks:
        worst = odd_tracks[0]
        listed = " × ".join(f"{size:.3g}" for size in worst.size_m)
        message = f"{len(odd_tracks)} boxes have odd sizes, such as {worst.label} {worst.track_id} with {listed} m"
        numbers = {"boxes": float(len(odd_tracks)), "smallest_m": smallest, "largest_m": largest}
        yield Finding("odd_box_size", "warning", message, _SIZE_REMEDY, numbers)


def _explain_size(median: Float64, size_class: _SizeClass) -> str:
    """What the numbers of a class look like, with a blank behind it; empty where they look like nothing known."""
    factors = median / np.array(size_class.typical_m)
    if factors.max() <= _MAX_FACTOR_RATIO * factors.min():
        factor = float(np.exp(np.log(factors).mean()))
        nearest = min(_UNITS, key=lambda unit: abs(np.log(factor / unit)))
        is_near = abs(np.log(factor / nearest)) < np.log(_UNIT_TOLERANCE)
        return f"The numbers look like {_UNITS[nearest]}. " if is_near else ""
    swapped = median[[1, 0, 2]]
    fits = all(low <= size <= high for size, (low, high) in zip(swapped, size_class.range_m, strict=True))
    return "Length and width look swapped. " if fits else ""


def _judge_speeds(paths: list[_TrackPath]) -> Iterator[Finding]:
    fastest = {path.track.track_id: float(np.nanmax(path.speeds_m_s, initial=0.0)) for path in paths}
    fast = {track: speed for track, speed in fastest.items() if speed > _MAX_SPEED_M_S}
    if fast:
        worst = max(fast, key=lambda track: fast[track])
        message = (
            f"{len(fast)} of {len(paths)} tracks are too fast: {worst} moves at {fast[worst]:.0f} m/s; "
            f"{_MAX_SPEED_M_S:.0f} m/s is plausible at most"
        )
        remedy = "Check that an id stands for one object, and the units of positions (metres) and times."
        numbers = {"speed_m_s": fast[worst], "limit_m_s": _MAX_SPEED_M_S, "tracks": float(len(fast))}
        yield Finding("implausible_track_speed", "warning", message, remedy, numbers)


def _judge_headings(paths: list[_TrackPath]) -> Iterator[Finding]:
    """A finding where most of what drives does not drive along its box's x axis."""
    angles = [angle for path in paths for angle in _heading_errors(path)]
    if not angles:
        return
    angle = float(np.median(angles))
    if angle <= _MAX_HEADING_DEG:
        return
    # A box that is turned by half covers the same points: nothing but the name of its front is wrong.
    severity: Severity = "note" if angle > 180 - _MAX_HEADING_DEG else "warning"
    if severity == "note":
        reason = "they face backwards"
    elif all(abs(error - 90) < _MAX_HEADING_DEG / 2 for error in angles):
        reason = "length and width, or the axes, are swapped"
    else:
        reason = "yaw may be in degrees, or turn clockwise"
    message = (
        f"{len(angles)} driving boxes move {angle:.0f}° off their x axis; "
        f"{_MAX_HEADING_DEG:.0f}° are plausible: {reason}"
    )
    numbers = {"angle_deg": angle, "limit_deg": _MAX_HEADING_DEG, "tracks": float(len(angles))}
    yield Finding("odd_box_heading", severity, message, _HEADING_REMEDY, numbers)


def _heading_errors(path: _TrackPath) -> Iterator[float]:
    """The median angle in degrees between the x axis of a box and its way, of a track that drives."""
    steps = np.diff(path.world_SE3_box[:, :3, 3], axis=0)
    driving = path.speeds_m_s > _MIN_DRIVING_M_S
    is_usable = driving.any() and np.linalg.norm(path.travel) > _MIN_TRAVEL_M
    if not is_usable or float(np.nanmax(path.speeds_m_s)) > _MAX_SPEED_M_S:
        return
    headings = path.world_SE3_box[:-1, :3, 0][driving]
    along = (headings * steps[driving]).sum(axis=1) / np.linalg.norm(steps[driving], axis=1)
    yield float(np.median(np.degrees(np.arccos(np.clip(along, -1, 1)))))


def _judge_static(paths: list[_TrackPath]) -> Iterator[Finding]:
    """A finding where most of what is annotated as resting moves."""
    travels = np.array([np.linalg.norm(path.travel) for path in paths if not path.track.moving])
    moving = travels > _MAX_STATIC_TRAVEL_M
    if moving.sum() < 2 or moving.mean() <= 0.5:
        return
    median = float(np.median(travels))
    message = (
        f"{moving.sum()} of {len(travels)} boxes that are annotated as resting move, by {median:.1f} m; "
        f"{_MAX_STATIC_TRAVEL_M:g} m are plausible"
    )
    remedy = "The boxes look as if given in the frame of the vehicle: convert them to the world frame."
    numbers = {"travel_m": median, "limit_m": _MAX_STATIC_TRAVEL_M, "tracks": float(moving.sum())}
    yield Finding("moving_static_boxes", "warning", message, remedy, numbers)
