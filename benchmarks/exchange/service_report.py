"""Claims and tables of services, which need none of the packages that services and their clients need."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.context import THREADS

CAMERAS = 3
"""How many a rollout of AlpaSim's protocol asks for."""

IMAGE_PX = (512, 320)
"""Width and height of AlpaSim's default camera."""

MOST_MS = 150.0
MOST_OVERHEAD_MS = 30.0
MOST_DIFFERENCE = 1
LEAST_STEPS_PER_S = 2.0


def service_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that no call fails, that an image is there in time, and that it is the library's.

    Args:
        rows: see :func:`benchmarks.exchange.service.measure_service`.
    """
    runs = ", ".join(f"{row['log']}, {row['steps']} steps, {_describe_rig(row)}" for row in rows) or "no run"
    data = f"{runs}; {THREADS} threads"
    images = sum(int(row["images"]) for row in rows)
    # Images of batches have no time of their own.
    timed = sum(int(row["alone_ms"]["n"]) for row in rows)
    failed = [float(row["failed"]) for row in rows]
    slowest = max((float(row["alone_ms"]["p95"]) for row in rows), default=None)
    difference = max((float(row["max_difference"]) for row in rows), default=None)
    yield claim("exchange.service_failed", sum(failed) if rows else None, "<=", 0, "calls", data, n=images)
    note = f"95 of 100 images that are asked for alone; {data}"
    yield claim("exchange.service_p95", slowest, "<=", MOST_MS, "ms", note, n=timed)
    note = f"against the library's render at recorded poses, of 255; {runs}"
    yield claim("exchange.service_difference", difference, "<=", MOST_DIFFERENCE, "levels", note, n=len(rows))


def _describe_rig(row: Row) -> str:
    width_px, height_px = row.get("size_px", IMAGE_PX)
    return f"{row['cameras']} cameras of {width_px}×{height_px}"


def service_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each run.

    Args:
        rows: see :func:`benchmarks.exchange.service.measure_service`.
    """
    times = "ms an image, median | 95 of 100 | in batches, median | 95 of 100"
    yield f"| log | images | failed calls | {times} | difference |"
    yield "|---|---|---|---|---|---|---|---|"
    for row in rows:
        alone = row["alone_ms"]
        batch = row["batch_ms"]
        times = " | ".join(f"{value:.0f}" for value in (alone["median"], alone["p95"], batch["median"], batch["p95"]))
        yield f"| {row['log']} | {row['images']} | {row['failed']} | {times} | {row['max_difference']} of 255 |"


def http_service_claims(rows: Sequence[Row], driving: Sequence[Row]) -> Iterator[Claim]:
    """Claims that HTTP adds little to an image and changes nothing of it, and that a drive is bearable.

    Args:
        rows: see :func:`benchmarks.exchange.http_service.measure_http_service`.
        driving: see :func:`benchmarks.exchange.http_service.measure_driving`.
    """
    note = ", ".join(f"{row['images']} images of {row['size_px'][0]}×{row['size_px'][1]}" for row in rows) or "no run"
    count = sum(int(row["images"]) for row in rows)
    added = [float(row["http_ms"]["median"] - row["library_ms"]["median"]) for row in rows]
    yield claim("exchange.http_overhead", max(added, default=None), "<=", MOST_OVERHEAD_MS, "ms", note, count)
    differences = [float(row["max_difference"]) for row in rows]
    most = max(differences, default=None)
    yield claim("exchange.http_difference", most, "<=", MOST_DIFFERENCE, "of 255", note, count)
    slowest = min((float(row["steps_per_s"]["median"]) for row in driving), default=None)
    note = ", ".join(f"{row['cameras']} cameras, {THREADS} threads" for row in driving) or "no run"
    n = sum(int(row["steps_per_s"]["n"]) for row in driving)
    yield claim("exchange.driving_steps", slowest, ">=", LEAST_STEPS_PER_S, "steps/s", note, n)


def http_service_table(rows: Sequence[Row], driving: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each run.

    Args:
        rows: see :func:`benchmarks.exchange.http_service.measure_http_service`.
        driving: see :func:`benchmarks.exchange.http_service.measure_driving`.
    """
    yield "| run | images | by HTTP, ms | by the library, ms | largest difference of 255 |"
    yield "|---|---|---|---|---|"
    for row in rows:
        size = f"{row['images']} of {row['size_px'][0]}×{row['size_px'][1]}"
        times = [_show(row[name]) for name in ("http_ms", "library_ms")]
        yield f"| {row['run']} | {size} | {times[0]} | {times[1]} | {row['max_difference']} |"
    for row in driving:
        rate = _show(row["steps_per_s"])
        yield f"\nThe driving environment makes {rate} steps a second with {row['cameras']} cameras."


def _show(quartiles: Row) -> str:
    return f"{quartiles['median']:.1f} ({quartiles['low']:.1f}–{quartiles['high']:.1f})"
