"""How long detectors take for three cameras of a chunk."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.timing import Quartiles
from benchmarks.perception.scenes import list_detectors
from genre_tasks.detection.detector import open_detector

IMAGES = 60
"""Three cameras × 20 frames."""
SIZE_PX = (640, 360)
ROUNDS = 3
MOST_S = 20.0


def measure_speed(folder: str, detectors: tuple[str, ...]) -> Row:
    """Measures the seconds that each detector takes for 60 images.

    Args:
        folder: that holds the detectors.
        detectors: names of their files.

    Returns:
        ``seconds``: those of each round, by detector.

    Raises:
        NotMeasuredError: a detector is missing.
    """
    # Noise: what a detector takes hardly depends on what is in the image.
    random = np.random.default_rng(0)
    image = random.integers(0, 256, (SIZE_PX[1], SIZE_PX[0], 3), dtype=np.uint8)
    seconds = {}
    for name, path in list_detectors(folder, detectors).items():
        detector = open_detector(str(path))
        # The first call allocates what later ones reuse.
        detector.detect(image)
        seconds[name] = [_time_images(detector.detect, image) for _ in range(ROUNDS)]
    return {"kind": "speed", "images": IMAGES, "threads": torch.get_num_threads(), "seconds": seconds}


def _time_images(detect: object, image: np.ndarray) -> float:
    start = time.perf_counter()
    for _ in range(IMAGES):
        detect(image)  # type: ignore[operator]  # a bound method
    return time.perf_counter() - start


def speed_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that three cameras × 20 frames take less than 20 s.

    Args:
        rows: see :func:`measure_speed`.
    """
    if not rows:
        yield claim("perception.speed_s", None, "<", MOST_S, "s", "not measured")
    for row in rows:
        for name, seconds in row["seconds"].items():
            quartiles = Quartiles.from_values(seconds)
            note = f"{name}, {row['images']} images of 640×360, {row['threads']} threads"
            yield claim("perception.speed_s", quartiles.median, "<", MOST_S, "s", note, len(seconds), quartiles.spread)
