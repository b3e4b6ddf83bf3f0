"""The HTML report of a run: one self-contained file, no network, readable without torch and without Prefect."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from flows.reconstruction.report_curve import Curve, accuracy_curve
from flows.reconstruction.report_metrics import SCORED_STAGES, MetricRow, build_headline, build_metric_rows
from flows.reconstruction.report_pictures import Picture, build_picture_rows
from flows.reconstruction.run_summary import ChunkSummary, RunSummary, StageSummary
from genre_tasks.atomic_path import atomic_path

STAGE_LABELS = {
    "ingest": "Ingest",
    "initial": "Initial",
    "gnet": "GNet",
    "novel_views": "Novel views",
    "fnet": "FNet",
    "enet": "ENet",
}


@dataclass(frozen=True)
class StageLine:
    """A line in the table of stages.

    Attributes:
        label: the stage's name for readers.
        stage: its summary.
        percent: its seconds as a percentage of those of the longest stage, for the bar.
        evaluation: the summary of its evaluation, if it has one.
    """

    label: str
    stage: StageSummary
    percent: float
    evaluation: StageSummary | None


@dataclass(frozen=True)
class ChunkPage:
    """One chunk's section of the report.

    Attributes:
        number: number of the chunk.
        warnings: sentences for the user.
        headline: (label, value, comparison) of the few numbers that come first.
        views: (viewpoint, pictures).
        rows: the table of metrics.
        curve: the plot of accuracy; ``None`` without enough points.
        stages: the table of stages.
        seconds: wall time of all stages without evaluation.
        evaluation_seconds: wall time of evaluation.
        from_cache: how many stages came from the store.
        stage_count: how many stages there are, evaluation stages among them.
    """

    number: int
    warnings: tuple[str, ...]
    headline: list[tuple[str, str, str]]
    views: list[tuple[str, list[Picture]]]
    rows: list[MetricRow]
    curve: Curve | None
    stages: list[StageLine]
    seconds: float
    evaluation_seconds: float
    from_cache: int
    stage_count: int


def write_report(path: Path, run: RunSummary) -> Path:
    """Writes the report of a run as one HTML file that appears whole or not at all.

    Args:
        path: the file to write; its folder is made if it does not exist.
        run: what the report shows.

    Returns:
        ``path``.

    Raises:
        OSError: the file cannot be written.

    Example::

        write_report(Path("report.html"), summarise_run(run))
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        # The template is beside this file, also in an installed package.
        loader=FileSystemLoader(Path(__file__).parent),
        # Names of logs and messages may hold any character.
        autoescape=True,
        # A field that was renamed here and not in the template fails, instead of showing nothing.
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    template = environment.get_template("report.html.jinja")
    # Everything is in the one file, pictures too: a report can be mailed, and opens without a network.
    html = template.render(
        run=run,
        chunks=[build_chunk_page(chunk) for chunk in run.chunks],
        columns=[STAGE_LABELS[stage] for stage in SCORED_STAGES],
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        part.write_text(html, encoding="utf-8")
    return path


def build_chunk_page(chunk: ChunkSummary) -> ChunkPage:
    """Arranges what the template shows of one chunk.

    Args:
        chunk: the chunk's summary.

    Returns:
        The chunk's section.
    """
    working = [stage for stage in chunk.stages if not stage.stage.startswith("evaluate/")]
    evaluations = {s.stage.removeprefix("evaluate/"): s for s in chunk.stages if s.stage.startswith("evaluate/")}
    # The longest stage's bar is 100 % wide; a chunk without any time has bars of no width.
    longest_s = max((stage.seconds for stage in working), default=0.0) or 1.0
    stage_warnings = [f"{_stage_label(stage)}: {warning}" for stage in chunk.stages for warning in stage.warnings]
    lines = [
        StageLine(_stage_label(stage), stage, 100 * stage.seconds / longest_s, evaluations.get(stage.stage))
        for stage in working
    ]
    return ChunkPage(
        number=chunk.chunk,
        warnings=(*chunk.warnings, *stage_warnings),
        headline=build_headline(chunk),
        views=build_picture_rows(chunk),
        rows=build_metric_rows({stage.stage: stage for stage in working if stage.stage in SCORED_STAGES}),
        curve=accuracy_curve(chunk),
        stages=lines,
        seconds=sum(stage.seconds for stage in working),
        evaluation_seconds=sum(stage.seconds for stage in evaluations.values()),
        from_cache=sum(stage.cached for stage in chunk.stages),
        stage_count=len(chunk.stages),
    )


def _stage_label(stage: StageSummary) -> str:
    return STAGE_LABELS.get(stage.stage, stage.stage)
