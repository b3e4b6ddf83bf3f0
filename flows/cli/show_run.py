"""``genre show RUN``: one finished run, in tables that stay readable with a hundred chunks."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

_MOST_CHUNKS = 4
"""A run of more chunks shows means over chunks first; ``--chunk`` shows one of them."""
_HEADLINE = ("interpolation/psnr", "shift_3m/psnr", "shift_3m/kernel")


def print_run_record(record: Mapping[str, Any], chunk: int | None) -> None:
    """Prints the record of a run: what it was made with, its stages and its metrics.

    Args:
        record: as ``list_runs`` returns it.
        chunk: number of the chunk whose stages and metrics are printed; ``None`` for all chunks.

    Raises:
        InputError: the run has no such chunk.
    """
    from flows.cli.printing import make_console, print_fields
    from flows.error_record import describe_record
    from genre_tasks.errors import InputError

    chunks = [c for c in record["chunks"] if chunk in (None, c["chunk"])]
    if chunk is not None and not chunks:
        known = ", ".join(str(c["chunk"]) for c in record["chunks"])
        raise InputError(f"the run has no chunk {chunk}", remedy=f"It has {known}.", log=record["log"])
    fields = {field: record[field] for field in ("log", "preset", "report", "differs", "config")}
    # Records of earlier versions do not have it.
    left_out = {f"chunk {entry['chunk']}": describe_record(entry) for entry in record.get("left_out", ())}
    print_fields(f"run {record['run']}", fields | ({"left_out": left_out} if left_out else {}))
    if len(chunks) <= _MOST_CHUNKS:
        for one in chunks:
            _print_chunk(one)
        return
    _print_overview(chunks)
    make_console().print("--chunk N shows the stages and all metrics of one chunk.")


def tabulate_metrics(stages: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Arranges metrics with a row for each and a column for each stage.

    Args:
        stages: of a run's record, with ``stage`` and ``metrics``.

    Returns:
        Rows with ``metric`` and the names of the stages that have any; a stage without the metric has an empty text.

    >>> tabulate_metrics([{"stage": "gnet", "metrics": {"a/psnr": 20.0}}, {"stage": "ingest", "metrics": {}}])
    [{'metric': 'a/psnr', 'gnet': 20.0}]
    """
    scored = [stage for stage in stages if stage["metrics"]]
    names = dict.fromkeys(name for stage in scored for name in stage["metrics"])
    # Counts go last within their group; they are read after the numbers that they are of.
    order = sorted(names, key=lambda name: (name.rpartition("/")[0], name.endswith("/n")))
    return [{"metric": name} | {s["stage"]: s["metrics"].get(name, "") for s in scored} for name in order]


def _print_chunk(chunk: Mapping[str, Any]) -> None:
    from flows.cli.printing import print_rows

    number = chunk["chunk"]
    print_rows(
        f"chunk {number}  stages",
        [
            {
                "stage": stage["stage"],
                "key": stage["key"][:12],
                "served": "cache" if stage["cached"] else "computed",
                "seconds": stage["seconds"],
            }
            for stage in chunk["stages"]
        ],
    )
    print_rows(f"chunk {number}  metrics", tabulate_metrics(chunk["stages"]))


def _print_overview(chunks: Sequence[Mapping[str, Any]]) -> None:
    from flows.cli.printing import print_rows

    means = [
        {"stage": name, "metrics": _mean_metrics([_find_metrics(chunk, name) for chunk in chunks])}
        for name in dict.fromkeys(stage["stage"] for chunk in chunks for stage in chunk["stages"])
    ]
    print_rows(f"means of {len(chunks)} chunks", tabulate_metrics(means))
    print_rows("chunks", [_chunk_row(chunk) for chunk in chunks])


def _chunk_row(chunk: Mapping[str, Any]) -> dict[str, Any]:
    scored = [stage for stage in chunk["stages"] if stage["metrics"]]
    last: Mapping[str, Any] = scored[-1] if scored else {"stage": "", "metrics": {}}
    row = {
        "chunk": chunk["chunk"],
        "computed": sum(not stage["cached"] for stage in chunk["stages"]),
        "seconds": sum(stage["seconds"] for stage in chunk["stages"]),
        "after": last["stage"],
    }
    return row | {name: last["metrics"].get(name, "") for name in _HEADLINE}


def _find_metrics(chunk: Mapping[str, Any], stage: str) -> Mapping[str, float]:
    return next((s["metrics"] for s in chunk["stages"] if s["stage"] == stage), {})


def _mean_metrics(found: Sequence[Mapping[str, float]]) -> dict[str, float]:
    names = dict.fromkeys(name for metrics in found for name in metrics)
    return {name: statistics.fmean(m[name] for m in found if name in m) for name in names}
