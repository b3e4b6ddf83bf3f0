"""The table of the fault matrix, from the JSON that ``tests/faults/matrix`` writes."""

from __future__ import annotations

import statistics
from collections.abc import Mapping
from typing import Any

from docs.result_tables import number, result, table

_HEAD = (
    "fault",
    "injected",
    "datasets complete",
    "artifacts identical",
    "computed twice",
    "cut short",
    "failed and tried again",
    "slots, leases, temporary files left",
    "seconds to recovery: median, longest",
)


def matrix() -> str:
    """Every fault: how often, what became of the datasets, and what was left behind."""
    return table(_HEAD, [_row(row) for row in result("tests/faults")["rows"]]) + "\n" + _provenance()


def injections() -> str:
    """How every fault is injected."""
    rows = result("tests/faults")["rows"]
    return table(("fault", "store", "how it is injected"), [(row["fault"], row["store"], row["how"]) for row in rows])


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    seconds = row["recovery_s"]
    return (
        row["fault"],
        str(row["injected"]),
        f"{row['complete']} of {row['runs']}",
        f"{row['identical']} of {row['artifacts']}",
        str(row["twice"]),
        str(row["cut_short"]),
        str(row["failed"]),
        f"{row['slots']}, {row['leases']}, {row['temporaries']}",
        f"{number(statistics.median(seconds))}, {number(max(seconds))}" if seconds else "–",
    )


def _provenance() -> str:
    rows = result("tests/faults")["rows"]
    machines = " and ".join(sorted({row["machine"] for row in rows}))
    commits = ", ".join(f"`{commit[:12]}`" for commit in sorted({row["commit"] for row in rows}))
    return (
        f"Measured on {machines} at commit {commits} by "
        "`python -m pytest -m fault tests/faults/matrix --write-fault-table`.\n"
    )
