"""The table of faults as JSON: a row for each fault, replaced when the fault was injected again."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from flows.machine.facts import describe_machine
from genre_tasks.atomic_path import atomic_path

TABLE = Path(__file__).resolve().parents[3] / "docs/results/data/tests/faults.json"


@dataclass(frozen=True)
class FaultRow:
    """What a fault did to datasets.

    Attributes:
        fault: the fault, in words.
        how: how it was injected.
        store: where the artifacts were: ``folder`` or ``S3``.
        injected: how often.
        runs: datasets that it hit.
        complete: of those, how many ended with every log done.
        artifacts: artifacts of the undisturbed runs of the same datasets.
        identical: of those, how many were there with the same key and the same bytes.
        twice: stages that were computed to the end more than once.
        cut_short: computations that were killed.
        failed: computations that ended in an error and were tried again.
        slots: concurrency slots that were taken at the end, and flow runs that were left active.
        leases: leases that were left.
        temporaries: half-written files that were left after cleaning.
        recovery_s: seconds from every injection until a stage of the logs that it hit was done.
    """

    fault: str
    how: str
    store: str
    injected: int
    runs: int
    complete: int
    artifacts: int
    identical: int
    twice: int
    cut_short: int
    failed: int
    slots: int
    leases: int
    temporaries: int
    recovery_s: list[float]


def find_faults(row: FaultRow, times: int) -> list[str]:
    """Says what of the promise a row breaks; nothing if it holds."""
    wrong = []
    if row.injected < times:
        wrong.append(f"injected {row.injected} times of {times}")
    if row.complete != row.runs:
        wrong.append(f"{row.complete} of {row.runs} datasets are complete")
    if row.identical != row.artifacts:
        wrong.append(f"{row.identical} of {row.artifacts} artifacts are identical")
    for name in ("twice", "slots", "leases", "temporaries"):
        if getattr(row, name):
            wrong.append(f"{name}: {getattr(row, name)}")
    return wrong


def merge_row(path: Path, row: FaultRow, commit: str) -> None:
    """Writes a row into the table; the rows of other faults stay, in the order of their names.

    Args:
        path: the JSON file.
        row: the row; the machine is added.
        commit: of the code.
    """
    rows = json.loads(path.read_text(encoding="utf-8"))["rows"] if path.exists() else []
    new = asdict(row) | {"machine": describe_machine(), "commit": commit}
    others = [other for other in rows if other["fault"] != row.fault]
    merged = sorted([*others, new], key=lambda one: str(one["fault"]))
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(json.dumps({"rows": merged}, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
