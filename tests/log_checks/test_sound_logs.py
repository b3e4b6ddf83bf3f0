"""No plausibility check fires on a sound log: streets of a hundred seeds, and a real sequence."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from genre_tasks.log_checks import plausibility
from genre_tasks.log_checks.log_sample import LogSample
from genre_tasks.log_checks.plausibility import assess_plausibility
from genre_tasks.logs.registry import open_log

REAL = Path(__file__).resolve().parents[3] / "shared/data/pandaset/002"
SMALL = "frames=8&cameras=2&width=32&height=18&samples=1&lidar_beams=32&lidar_azimuths=300"


def find_words(uri: str, frames: range) -> list[str]:
    log = open_log(uri)
    return [f"{finding.word}: {finding.message}" for finding in assess_plausibility(log, tuple(frames), log.cameras)]


def test_a_street() -> None:
    assert find_words(f"synthetic:street?seed=7&{SMALL}", range(8)) == []


@pytest.mark.slow
@pytest.mark.parametrize("first", range(0, 100, 10))
def test_streets_of_a_hundred_seeds(first: int) -> None:
    for seed in range(first, first + 10):
        assert find_words(f"synthetic:street?seed={seed}&{SMALL}", range(8)) == [], seed


@pytest.mark.slow
@pytest.mark.parametrize(
    "more",
    [
        "standstill=1",
        "standstill=1&moving=12&pedestrians=20&exposure_jitter=0.3",
        "distortion=-0.08&rolling_shutter_s=0.05",
        "distortion=0.5",
        "origin_m=5000000",
        "cuboids=0",
        "lidar=0",
    ],
)
def test_streets_with_effects(more: str) -> None:
    small = "&".join(part for part in SMALL.split("&") if part.split("=")[0] not in more)
    assert find_words(f"synthetic:street?seed=11&{small}&{more}", range(8)) == []


def test_stretched_images_are_named_even_where_the_lens_was_stretched_too() -> None:
    """From the numbers alone they cannot be told from an error in fx or fy."""
    (found,) = find_words("synthetic:street?seed=7&frames=2&cameras=1&width=64&height=48&lidar=0", range(2))
    assert found.startswith("odd_pixel_aspect")


@pytest.mark.real
@pytest.mark.skipif(not REAL.is_dir(), reason=f"no PandaSet sequence next to the checkout ({REAL})")
class TestRealSequence:
    @pytest.mark.parametrize("chunk_frames", [8, 20, 32])
    def test_nothing_fires(self, chunk_frames: int) -> None:
        for start in range(0, 32, chunk_frames):
            assert find_words(f"pandaset:{REAL}", range(start, min(start + chunk_frames, 32))) == []

    def test_judging_costs_little(self) -> None:
        """Everything but reading cuboids takes under two seconds a chunk, of which LiDAR and images take most."""
        log = open_log(f"pandaset:{REAL}")
        find_words(f"pandaset:{REAL}", range(2))
        log.tracks()
        sample = LogSample(log, tuple(range(20)), log.cameras)
        sample.sweep(19)
        start = time.process_time()
        assert [finding for check in plausibility._CHECKS for finding in check(sample)] == []
        assert time.process_time() - start < 2.0
