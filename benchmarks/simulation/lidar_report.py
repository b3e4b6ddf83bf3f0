"""Claims and table of simulated LiDAR sweeps."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from benchmarks.common.bench import Row
from benchmarks.common.claims import Claim, claim

MOST_RANGE_ERROR_M = 0.05
LEAST_RECALL = 0.9


def lidar_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that simulated sweeps are where the held-out real ones are, and have their hits.

    Args:
        rows: see :func:`benchmarks.simulation.lidar.measure_lidar`.
    """
    sweeps = sum(row["sweeps"] for row in rows)
    places = ", ".join(f"{row['log']} chunk {row['chunk']}" for row in rows) or "no real log"
    data = f"{sweeps} held-out sweeps; {places}"
    # The worst chunk counts: a mean over chunks would hide it.
    error = max((row["median_range_error_m"] for row in rows), default=None)
    note = f"median range error within 40 m, mean over sweeps; {data}"
    yield claim("simulation.lidar_range", error, "<=", MOST_RANGE_ERROR_M, "m", note, sweeps)
    recall = min((row["hit_recall"] for row in rows), default=None)
    note = f"share of the real hits within 40 m whose ray has a simulated hit; {data}"
    yield claim("simulation.lidar_recall", recall, ">=", LEAST_RECALL, "share", note, sweeps)


def lidar_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each chunk.

    Args:
        rows: see :func:`benchmarks.simulation.lidar.measure_lidar`.
    """
    yield (
        "| log | chunk | held-out sweeps | median range error, m | Chamfer distance, m | precision of hits "
        "| recall of hits | precision, ranges agree | recall, ranges agree | s a sweep |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|"
    for row in rows:
        columns = (
            row["log"],
            str(row["chunk"]),
            str(row["sweeps"]),
            f"{row['median_range_error_m']:.3f}",
            f"{row['chamfer_m']:.3f}",
            *(f"{row[name]:.3f}" for name in ("hit_precision", "hit_recall", "precision", "recall")),
            f"{row['seconds_per_sweep']:.2f}",
        )
        yield f"| {' | '.join(columns)} |"
