"""Writes the report of a dataset: one HTML file with its pictures in it, readable without anything else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flows.dataset.dataset_summary import DatasetSummary, LogFailure
from flows.dataset.report.histograms import HEIGHT, WIDTH, Histogram, draw_histogram
from flows.dataset.report.log_table import (
    Column,
    build_log_rows,
    describe_status,
    list_metric_columns,
    list_stage_columns,
)
from flows.dataset.worst_views import WorstView
from flows.reconstruction.report.photos import EmbeddedImage, embed_photo
from flows.reconstruction.report.viewpoints import describe_viewpoint
from genre_tasks.atomic_path import atomic_path

MAX_BYTES = 15_000_000
"""Bound of a report of a thousand logs. Pictures that would go over it are left out, the mildest first."""

_STATUSES = ("done", "partly_done", "failed", "running", "waiting")
# A table of many logs needs most of the room.
_PICTURE_BYTES = 6_000_000


@dataclass(frozen=True)
class ViewCard:
    """A worst view as the page shows it.

    Attributes:
        title: log and chunk.
        words: where the picture was taken, and its accuracy.
        link: to the report of its run.
        picture: the picture.
        truth: what it should show.
    """

    title: str
    words: str
    link: str
    picture: EmbeddedImage
    truth: EmbeddedImage


@dataclass(frozen=True)
class FailureGroup:
    """Failures of one reason and remedy.

    Attributes:
        reason: what is wrong.
        remedy: what can be done; empty where the reason says it.
        failures: those that it is the reason of.
    """

    reason: str
    remedy: str
    failures: tuple[LogFailure, ...]


def write_dataset_report(path: Path, summary: DatasetSummary) -> Path:
    """Writes the report as one HTML file that appears as a complete file or not at all.

    Args:
        path: the file to write, in a folder such as ``datasets/NAME`` of the store's records, from which its links to
            the runs' reports lead.
        summary: what the report shows.

    Returns:
        ``path``.

    Raises:
        OSError: the file cannot be written.

    Example::

        write_dataset_report(Path("report.html"), summarise_dataset("genre-store", "small", outcomes))
    """
    metric_columns = list_metric_columns(summary)
    stage_columns = list_stage_columns(summary)
    html = _render(
        summary=summary,
        entries=_name_entries(summary),
        totals=_list_totals(summary),
        metric_columns=metric_columns,
        metric_rows=build_log_rows(summary.logs, metric_columns),
        stage_columns=stage_columns,
        stage_rows=build_log_rows([log for log in summary.logs if log.stage_seconds], stage_columns),
        histograms=_draw_histograms(summary, metric_columns, stage_columns),
        views=_make_cards(summary.worst_views),
        groups=_group_failures(summary.failures),
        width=WIDTH,
        height=HEIGHT,
        describe_status=describe_status,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(html, encoding="utf-8")
    return path


def _render(**values: object) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    import flows.reconstruction.report as run_report

    environment = Environment(
        # The second folder has the style of a run's report: both pages are to be of one kind.
        loader=FileSystemLoader([Path(__file__).parent, *run_report.__path__]),
        # Names of logs and messages may hold any character.
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("dataset.html.jinja").render(**values)


def _name_entries(summary: DatasetSummary) -> str:
    return "runs" if summary.is_by_chunk else "logs"


def _list_totals(summary: DatasetSummary) -> list[tuple[str, str, str]]:
    """(label, value, remark) of each tile."""
    count = len(summary.logs)
    remark = f"of {count} {_name_entries(summary)}"
    totals = [("Logs", str(summary.log_count), "")]
    if summary.is_by_chunk:
        totals.append(("Runs", str(count), "one a chunk"))
    known = {log.status for log in summary.logs}
    for status in (*_STATUSES, *sorted(known - set(_STATUSES))):
        # Zero failures are news, zero waiting logs of a finished dataset are not.
        if status in known or status in _STATUSES[:3]:
            totals.append((describe_status(status).capitalize(), str(summary.count(status)), remark))
    seconds = sum(log.seconds for log in summary.logs)
    totals.append(("Time of all logs", describe_duration(seconds), f"{seconds:.0f} s"))
    stages = sum(log.stages for log in summary.logs)
    cached = sum(log.cached_stages for log in summary.logs)
    if stages:
        totals.append(("Stages from the cache", f"{100 * cached / stages:.0f} %", f"{cached} of {stages}"))
    return totals


def describe_duration(seconds: float) -> str:
    """Writes a time in its largest units.

    Args:
        seconds: at least 0.

    Returns:
        Hours and minutes, minutes and seconds, or seconds.

    >>> describe_duration(7380), describe_duration(75), describe_duration(3.21)
    ('2 h 3 min', '1 min 15 s', '3.2 s')
    """
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s"


def _draw_histograms(
    summary: DatasetSummary, metric_columns: Sequence[Column], stage_columns: Sequence[Column]
) -> list[Histogram]:
    drawn = []
    for column in metric_columns:
        if column.title not in ("Chunks", "Cached"):
            drawn.append(draw_histogram(column.title, _list_values(summary, column), column.decimals))
    for column in stage_columns:
        drawn.append(draw_histogram(f"Seconds of {column.title}", _list_values(summary, column), column.decimals))
    return [histogram for histogram in drawn if histogram is not None]


def _list_values(summary: DatasetSummary, column: Column) -> list[float]:
    return [value for value in map(column.read, summary.logs) if value is not None]


def _make_cards(views: Sequence[WorstView]) -> list[ViewCard]:
    cards = []
    size = 0
    for view in views:
        picture = embed_photo(view.picture)
        truth = embed_photo(view.truth)
        size += len(picture.url) + len(truth.url)
        # The worst come first, so that what is left out is the least of them.
        if size > _PICTURE_BYTES:
            break
        words = f"{describe_viewpoint(view.name)} · {view.psnr:.1f} dB"
        link = f"../../runs/{view.run}/report.html#chunk-{view.chunk}"
        cards.append(ViewCard(f"{view.log} · chunk {view.chunk}", words, link, picture, truth))
    return cards


def _group_failures(failures: Sequence[LogFailure]) -> list[FailureGroup]:
    """Failures by reason, the most frequent first: a hundred logs often fail for one."""
    groups: dict[tuple[str, str], list[LogFailure]] = {}
    for failure in failures:
        groups.setdefault((failure.reason, failure.remedy), []).append(failure)
    ordered = sorted(groups.items(), key=lambda item: -len(item[1]))
    return [FailureGroup(reason, remedy, tuple(members)) for (reason, remedy), members in ordered]
