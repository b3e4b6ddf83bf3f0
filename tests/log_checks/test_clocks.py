"""Clocks of cameras and LiDAR that do not fit, and those that do."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from genre_tasks.config import IngestConfig
from genre_tasks.log_checks.check_log import check_log
from genre_tasks.logs.findings import Finding
from genre_tasks.stages.ingest import ingest
from tests.log_checks.edited_log import EditedLog, assess, is_complete, street

START_S = 1.7e9


def with_camera_clock(change: Callable[[float], float], start_s: float = START_S) -> dict[str, Finding]:
    """What is found where cameras have another clock; what their poses say is another finding."""
    times = tuple(start_s + 0.1 * k for k in range(8))
    log = street(timestamps_s=times, without_tracks=True, no_lidar=True, speed_mps=0.0)
    return assess(EditedLog(log, camera_timestamp_s=lambda camera, frame: change(times[frame])))


def with_offset(times: tuple[float, ...], offset_s: float) -> dict[str, Finding]:
    """What is found where cameras fire so long after their sweeps."""
    log = street(timestamps_s=times, without_tracks=True, no_lidar=True, speed_mps=0.0, frame_count=len(times))
    return assess(EditedLog(log, camera_timestamp_s=lambda camera, frame: times[frame] + offset_s))


def with_times(*times: float) -> dict[str, Finding]:
    log = street(timestamps_s=times, without_tracks=True, no_lidar=True, speed_mps=0.0, frame_count=len(times))
    return assess(log)


def test_the_remedy_of_a_wrong_unit_holds_for_every_reader() -> None:
    """Most readers take seconds alone; milliseconds are understood in PandaSet's folders only."""
    found = with_times(*(1e3 * (START_S + 0.1 * k) for k in range(8)))
    for word in ("implausible_date", "implausible_frame_period"):
        assert "write seconds" in found[word].remedy and "milliseconds" not in found[word].remedy


@pytest.mark.parametrize("delay_s", [-0.1, -0.0812, 0.0, 0.03, 0.147])
def test_cameras_fire_within_a_frame(delay_s: float) -> None:
    """Report: argoverse/av2-api#112 has an image 147 ms from its sweep."""
    assert with_camera_clock(lambda time: time + delay_s) == {}


@pytest.mark.parametrize(
    ("period_s", "plausible_s", "late_s"),
    [(0.05, 0.07, 0.078125), (0.1, 0.147, 0.15625), (0.5, 0.7, 0.78125), (1.0, 1.45, 1.5625)],
)
def test_how_far_images_may_be_follows_the_rate_of_sweeps(period_s: float, plausible_s: float, late_s: float) -> None:
    """Key frames are at 2 Hz, and some LiDARs turn at 20 Hz. No report."""
    # Lateness is in binary fractions, which times since 1970 keep to the last digit.
    times = tuple(START_S + period_s * k for k in range(8))
    assert with_offset(times, plausible_s) == with_offset(times, -plausible_s) == {}
    found = with_offset(times, late_s)
    assert set(found) == {"camera_clock"} and f"always by {late_s:g} s" in found["camera_clock"].message
    assert found["camera_clock"].numbers["limit_s"] == pytest.approx(1.5 * period_s, rel=1e-4)
    assert f"over {1.5 * period_s:.3g} s from their sweep" in found["camera_clock"].message


def test_dropped_sweeps_do_not_change_how_far_images_may_be() -> None:
    """Report: tier4/tier4_perception_dataset#58 (dropped LiDAR frames)."""
    times = tuple(START_S + 0.1 * k for k in (0, 1, 2, 5, 6, 7, 8, 12))
    assert set(with_offset(times, 0.14)) == {"dropped_frames"}
    assert set(with_offset(times, 0.2)) == {"dropped_frames", "camera_clock"}


def test_a_single_sweep_has_the_limit_of_the_usual_rate() -> None:
    assert "camera_clock" not in with_offset((START_S,), 0.14)
    assert with_offset((START_S,), 0.2)["camera_clock"].numbers["limit_s"] == 0.15


@pytest.mark.parametrize(
    ("shift_s", "reason"),
    [
        (0.3, "always by 0.3 s"),
        (-2.0, "always by -2 s"),
        (18.0, "GPS time without its leap seconds"),
        (37.0, "TAI"),
        (-315_964_800.0, "since 1980"),
        (7200.0, "a time zone"),
        (-19800.0, "a time zone"),
        (-START_S, "always by"),
    ],
)
def test_clocks_with_another_origin(shift_s: float, reason: str) -> None:
    """Report: utiasASRL/pyboreas#92 (a constant offset), xuankuzcr/LIV_handhold#22 (images whose time is 0)."""
    found = with_camera_clock(lambda time: time + shift_s)
    assert set(found) == {"camera_clock"} and reason in found["camera_clock"].message
    assert is_complete(found["camera_clock"]) and found["camera_clock"].frames == tuple(range(8))


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")])
def test_cameras_that_count_in_another_unit(factor: float, unit: str) -> None:
    """Report: none found; case 6 of the list of odd logs."""
    found = with_camera_clock(lambda time: time * factor, start_s=0.0)
    assert set(found) == {"camera_clock"} and f"its times look like {unit}" in found["camera_clock"].message
    slow = with_camera_clock(lambda time: time / factor, start_s=100.0)
    assert "the sweeps' times look like" in slow["camera_clock"].message


def test_a_clock_that_drifts() -> None:
    """Report: none found; case 6 of the list of odd logs."""
    found = with_camera_clock(lambda time: START_S + 1.7 * (time - START_S))
    assert "runs 1.7 times as fast" in found["camera_clock"].message
    assert with_camera_clock(lambda time: START_S + 1.05 * (time - START_S)) == {}


def test_single_images_without_time() -> None:
    """Report: xuankuzcr/LIV_handhold#22 (the time of an image is 0)."""
    found = with_camera_clock(lambda time: 0.0 if time == START_S else time)
    assert found["camera_clock"].frames == (0,)
    found = with_camera_clock(lambda time: float("nan") if time == START_S else time)
    assert found["camera_clock"].frames == (0,)


@pytest.mark.parametrize("period", [0.01, 0.05, 0.1, 0.5, 1.9])
def test_rates_of_frames(period: float) -> None:
    assert with_times(*(period * np.arange(8))) == {}


@pytest.mark.parametrize("period", [1e-6, 1e-4, 3.0, 100.0, 1e5])
def test_periods_of_another_unit(period: float) -> None:
    """Report: none found; case 6 of the list of odd logs."""
    found = with_times(*(period * np.arange(8)))
    assert set(found) == {"implausible_frame_period"} and is_complete(found["implausible_frame_period"])


def test_dropped_frames_and_pauses() -> None:
    """Report: tier4/tier4_perception_dataset#58 (dropped LiDAR frames)."""
    dropped = with_times(0.0, 0.1, 0.2, 0.5, 0.6, 0.7)
    assert set(dropped) == {"dropped_frames"} and dropped["dropped_frames"].numbers["dropped"] == 2
    assert dropped["dropped_frames"].severity == "note" and dropped["dropped_frames"].frames == (3,)
    pause = with_times(0.0, 0.1, 0.2, 60.0, 60.1, 60.2)
    assert set(pause) == {"time_gap"} and pause["time_gap"].severity == "warning" and is_complete(pause["time_gap"])


def test_jitter() -> None:
    """Report: none found; clocks in case 6 of the list of odd logs."""
    assert with_times(0.0, 0.1, 0.203, 0.299, 0.4, 0.5) == {}
    found = with_times(0.0, 0.06, 0.2, 0.27, 0.4, 0.45, 0.6)
    assert set(found) == {"clock_jitter"} and found["clock_jitter"].severity == "note"


@pytest.mark.parametrize("start_s", [-1e9, -1.0, 5e9])
def test_dates_before_1970_and_after_2099(start_s: float) -> None:
    """Report: xuankuzcr/LIV_handhold#22."""
    found = with_times(*(start_s + 0.1 * np.arange(8)))
    assert set(found) == {"implausible_date"} and is_complete(found["implausible_date"])
    # Argoverse 2 counts from 1980.
    assert with_times(*(315_966_265.0 + 0.1 * np.arange(8))) == {}


def test_check_and_run_report_the_same_clock() -> None:
    times = tuple(START_S + 0.1 * k for k in range(8))
    log = EditedLog(street(timestamps_s=times), camera_timestamp_s=lambda camera, frame: times[frame] + 18.0)
    in_check = [finding.message for finding in check_log(log).findings if finding.word == "camera_clock"]
    issues = ingest(IngestConfig(width_px=48, height_px=32), log, 0).log_issues
    in_run = [issue.detail for issue in issues if issue.kind == "camera_clock"]
    assert len(in_check) == len(in_run) == 2
    assert all(detail.startswith(message) for detail, message in zip(in_run, in_check, strict=True))


def test_a_camera_clock_that_jumps() -> None:
    """Report: none found; case 6 of the list of odd logs."""
    found = with_camera_clock(lambda time: time + 3600.0 * (time > START_S + 0.35))
    assert "its clock jumps by 3600 s before image 4" in found["camera_clock"].message


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_a_camera_without_times(value: float) -> None:
    """Report: none found; case 6 of the list of odd logs."""
    message = with_camera_clock(lambda time: value)["camera_clock"].message
    assert "frames 0–7 have no finite time" in message
