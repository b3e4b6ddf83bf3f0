"""One chunk's section of the report: everything that the template shows, in the form in which it shows it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from flows.reconstruction.report.accuracy_curve import Curve, accuracy_curve
from flows.reconstruction.report.lineage_graph import LineageGraph, LineageRow, build_lineage_rows, draw_lineage
from flows.reconstruction.report.metric_table import SCORED_STAGES, MetricRow, build_headline, build_metric_rows
from flows.reconstruction.report.range_plot import RangePlot, describe_range, plot_range_curve
from flows.reconstruction.report.viewpoints import Viewpoint, build_viewpoints
from flows.reconstruction.run_summary import ChunkSummary, StageSummary

if TYPE_CHECKING:
    from genre_tasks.effects.types import Decision

STAGE_LABELS = {
    "ingest": "Ingest",
    "effects": "Effects",
    "initial": "Initial",
    "gnet": "GNet",
    "novel_views": "Novel views",
    "fnet": "FNet",
    "enet": "ENet",
}
_CHOICE_LABELS = {"on": "on", "off": "off", "mark": "reported only"}
_EVALUATE = "evaluate/"
_SCENE_STAGES = ("enet", "gnet", "initial")


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
class EffectLine:
    """A line in the table of effects.

    Attributes:
        name: the effect's name for readers.
        choice: ``on``, ``off`` or ``mark``.
        label: the choice for readers.
        measured: the measured value and its threshold; empty where nothing was measured.
        reason: why.
        cost: what enabling costs.
        is_set: whether the configuration decided, and not the log.
    """

    name: str
    choice: str
    label: str
    measured: str
    reason: str
    cost: str
    is_set: bool


@dataclass(frozen=True)
class ChunkPage:
    """One chunk's section of the report.

    Attributes:
        number: number of the chunk.
        log_facts: (name, value) of what was reconstructed.
        scene_facts: the same of the last scene.
        warnings: sentences for the user.
        headline: (label, value, comparison) of the few numbers that come first.
        viewpoints: pictures, with errors where there is a truth.
        rows: the table of metrics.
        curve: the plot of accuracy; ``None`` without enough points.
        effects: the plan of effects.
        range_words: how far the scene can be trusted, in words; empty where it was not measured.
        range_stage: the stage whose scene was looked at.
        range_plot: its curve.
        stages: the table of stages.
        lineage: what was made from what.
        graph: the same as a graph.
        seconds: wall time of all stages without evaluation.
        evaluation_seconds: wall time of evaluation.
        from_cache: how many stages came from the store.
        stage_count: how many stages there are, evaluation stages among them.
    """

    number: int
    log_facts: list[tuple[str, str]]
    scene_facts: list[tuple[str, str]]
    warnings: tuple[str, ...]
    headline: list[tuple[str, str, str]]
    viewpoints: list[Viewpoint]
    rows: list[MetricRow]
    curve: Curve | None
    effects: list[EffectLine]
    range_words: str
    range_stage: str
    range_plot: RangePlot | None
    stages: list[StageLine]
    lineage: list[LineageRow]
    graph: LineageGraph | None
    seconds: float
    evaluation_seconds: float
    from_cache: int
    stage_count: int

    @property
    def has_errors(self) -> bool:
        """Whether any picture has a map of errors."""
        return any(picture.error for viewpoint in self.viewpoints for picture in viewpoint.pictures)


def build_chunk_page(chunk: ChunkSummary) -> ChunkPage:
    """Arranges what the template shows of one chunk.

    Args:
        chunk: the chunk's summary.

    Returns:
        The chunk's section.
    """
    working = [stage for stage in chunk.stages if not stage.stage.startswith(_EVALUATE)]
    evaluations = {s.stage.removeprefix(_EVALUATE): s for s in chunk.stages if s.stage.startswith(_EVALUATE)}
    # The longest stage's bar is 100 % wide; a chunk without any time has bars of no width.
    longest_s = max((stage.seconds for stage in working), default=0.0) or 1.0
    stage_warnings = [f"{_stage_label(stage)}: {warning}" for stage in chunk.stages for warning in stage.warnings]
    lines = [
        StageLine(_stage_label(stage), stage, 100 * stage.seconds / longest_s, evaluations.get(stage.stage))
        for stage in working
    ]
    found = chunk.reliable_range
    return ChunkPage(
        number=chunk.chunk,
        log_facts=_format_facts(_contents(chunk, "ingest")),
        scene_facts=_list_scene_facts(chunk),
        warnings=(*chunk.warnings, *stage_warnings),
        headline=build_headline(chunk),
        viewpoints=build_viewpoints(chunk),
        rows=build_metric_rows({stage.stage: stage for stage in working if stage.stage in SCORED_STAGES}),
        curve=accuracy_curve(chunk),
        effects=[_describe_effect(decision) for decision in chunk.effects],
        range_words="" if found is None else describe_range(found),
        range_stage="" if found is None else STAGE_LABELS.get(found.stage, found.stage),
        range_plot=None if found is None else plot_range_curve(found),
        stages=lines,
        lineage=build_lineage_rows(chunk.stages),
        graph=draw_lineage(chunk.stages),
        seconds=sum(stage.seconds for stage in working),
        evaluation_seconds=sum(stage.seconds for stage in evaluations.values()),
        from_cache=sum(stage.cached for stage in chunk.stages),
        stage_count=len(chunk.stages),
    )


def _stage_label(stage: StageSummary) -> str:
    return STAGE_LABELS.get(stage.stage, stage.stage)


def _list_scene_facts(chunk: ChunkSummary) -> list[tuple[str, str]]:
    """Of the last stage that made a scene."""
    last = next((name for name in _SCENE_STAGES if _contents(chunk, name)), None)
    if last is None:
        return []
    scene = _contents(chunk, last)
    shown = {f"{name} after {STAGE_LABELS[last]}" if name == "Gaussians" else name: v for name, v in scene.items()}
    # The scene has the actors of the log, which are among the log's facts; the other two are of the stage.
    return _format_facts({n: v for n, v in shown.items() if n not in ("actors", "iterations", "snapshots")})


def _contents(chunk: ChunkSummary, name: str) -> Mapping[str, Any]:
    stage = chunk.stage(name)
    return {} if stage is None else stage.contents


def _format_facts(contents: Mapping[str, Any]) -> list[tuple[str, str]]:
    return [(name, f"{value:,}" if isinstance(value, int) else str(value)) for name, value in contents.items()]


def _describe_effect(decision: Decision) -> EffectLine:
    is_measured = math.isfinite(decision.value)
    measured = f"{decision.value:.3g} {decision.unit}" if is_measured else ""
    if is_measured and math.isfinite(decision.threshold):
        measured += f" (threshold {decision.threshold:.3g})"
    return EffectLine(
        name=decision.name.replace("_", " "),
        choice=decision.choice,
        label=_CHOICE_LABELS[decision.choice],
        measured=measured,
        reason=decision.reason,
        cost=decision.cost,
        is_set=decision.setting != "auto",
    )
