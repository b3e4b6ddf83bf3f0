"""The tables of the report: a row for each log or chunk, with metrics and with the seconds of stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flows.dataset.dataset_summary import DatasetSummary, LogSummary
from flows.reconstruction.report.metric_table import METRIC_FORMATS

_STAGES = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet", "evaluate")


@dataclass(frozen=True)
class Column:
    """A column of numbers.

    Attributes:
        title: heading.
        decimals: digits after the point.
        read: gives a log's number; ``None`` where it has none.
    """

    title: str
    decimals: int
    read: Callable[[LogSummary], float | None]


@dataclass(frozen=True)
class Cell:
    """A number of a log.

    Attributes:
        text: as it is shown; a dash where there is none.
        sort_key: as it is sorted; empty where there is none.
    """

    text: str
    sort_key: str


@dataclass(frozen=True)
class LogRow:
    """A row.

    Attributes:
        log: the log's URI, and the chunk's number where the row is about one chunk.
        status: for readers.
        link: to the report of its run, relative to the dataset's report; empty where there is none.
        cells: one for each column.
    """

    log: str
    status: str
    link: str
    cells: tuple[Cell, ...]


def list_metric_columns(summary: DatasetSummary) -> list[Column]:
    """Lists the columns of the table of metrics that any log has a number for.

    Args:
        summary: of the dataset.

    Returns:
        Held-out metrics, kernel distances by shift, range, chunks and seconds.
    """
    names = {name for log in summary.logs for name in log.metrics}
    columns = []
    for metric in ("psnr", "ssim", "perceptual"):
        if f"interpolation/{metric}" in names:
            columns.append(_metric_column(f"interpolation/{metric}", METRIC_FORMATS[metric].label, metric))
    for name in sorted((name for name in names if name.endswith("/kernel")), key=_shift_of):
        shift = f"{_shift_of(name):g}"
        columns.append(_metric_column(name, f"Kernel, {shift} m" if shift != "0" else "Kernel, on the path", "kernel"))
    if any(log.range_m is not None for log in summary.logs):
        columns.append(Column("Range, m", 2, lambda log: log.range_m))
    columns.append(Column("Chunks", 0, lambda log: float(log.chunks)))
    columns.append(Column("Seconds", 1, lambda log: log.seconds if log.seconds else None))
    columns.append(Column("Cached", 0, lambda log: float(log.cached_stages) if log.stages else None))
    return columns


def list_stage_columns(summary: DatasetSummary) -> list[Column]:
    """Lists the columns of the table of seconds.

    Args:
        summary: of the dataset.

    Returns:
        A column for each stage that any log has, in the order in which they run.
    """
    names = {name for log in summary.logs for name in log.stage_seconds}
    ordered = [name for name in _STAGES if name in names] + sorted(names - set(_STAGES))
    return [_stage_column(name) for name in ordered]


def build_log_rows(logs: Sequence[LogSummary], columns: Sequence[Column]) -> list[LogRow]:
    """Builds the rows of a table.

    Args:
        logs: of the dataset.
        columns: of the table.

    Returns:
        One row for each entry of ``logs``.
    """
    return [
        LogRow(
            log=log.log if log.chunk is None else f"{log.log} · chunk {log.chunk}",
            status=describe_status(log.status),
            link=f"../../runs/{log.run}/report.html" if log.run else "",
            cells=tuple(_make_cell(column, log) for column in columns),
        )
        for log in logs
    ]


def describe_status(status: str) -> str:
    """Writes a status for readers.

    Args:
        status: such as ``partly_done``.

    Returns:
        Words.

    >>> describe_status("partly_done")
    'partly done'
    """
    return status.replace("_", " ")


def _make_cell(column: Column, log: LogSummary) -> Cell:
    value = column.read(log)
    if value is None:
        return Cell("–", "")
    # A minus sign is as wide as a digit.
    return Cell(f"{value:.{column.decimals}f}".replace("-", "−"), f"{value:.6g}")


def _metric_column(name: str, title: str, metric: str) -> Column:
    return Column(title, METRIC_FORMATS[metric].decimals, lambda log: log.metrics.get(name))


def _stage_column(name: str) -> Column:
    return Column(name.replace("_", " "), 2, lambda log: log.stage_seconds.get(name))


def _shift_of(name: str) -> float:
    shift = name.partition("/")[0].removeprefix("shift_").removesuffix("m")
    return float(shift) if shift.replace(".", "", 1).isdigit() else float("inf")
