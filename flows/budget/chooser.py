"""Chooses the most accurate setting that fits, and chooses again at every border between stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from flows.budget.cost_table import Point, Table
from flows.budget.deadline import Clock
from flows.configuration import with_settings
from flows.pipeline.definition import BY_NAME, reconstructing_until
from flows.pipeline.log_cache import opened_log
from genre_tasks.config import PipelineConfig

BORDER_S = 0.6
"""Of a stage beyond its own seconds on the table's machine: artifacts read, hashed and written, Prefect's states."""

SPARE = 0.06
"""Of the predicted time, kept for what no table knows."""

TOLD_BY_CALIBRATION_S = 5.0
"""So many seconds of stages weigh as much as the calibration does. Ingest is not among them: its time tells of the
log's reader."""


@dataclass(frozen=True)
class Choice:
    """What a border decided: ``before`` which stage, the point's name, seconds predicted and left, and why.

    ``pace``: seconds here over the table's, as far as was known by then.
    """

    before: str
    point: str
    predicted_s: float
    left_s: float
    pace: float
    why: str

    def __str__(self) -> str:
        at = f"{self.pace:.2f} × the table's seconds"
        return f"{self.point}: {self.predicted_s:.0f} s predicted ({at}) of {self.left_s:.0f} s left; {self.why}"


class Chooser:
    """For one chunk.

    ``base`` is the user's configuration, over which a setting of the table is applied. ``work`` is the chunk's images
    over the table's, ``speed`` says this machine's calibration over the table's, ``cold`` whether no stage has run in
    this process.

    Speed is asked for once the first stage was computed: until then Prefect's server is starting beside it, which
    makes a machine look up to 1.6 times as slow as it is. Nothing is lost: that is ingest, the same in all points.
    """

    def __init__(
        self,
        table: Table,
        base: PipelineConfig,
        clock: Clock,
        work: float,
        speed: Callable[[], float],
        cold: bool = True,
    ) -> None:
        self.clock, self.choices = clock, list[Choice]()
        self._table, self._work, self._speed, self._pace = table, work, speed, 1.0
        self._taken = self._foreseen = 0.0
        self._cold = table.cold if cold else {}
        self._points = [(p, with_settings(base, p.changes)) for p in table.points]
        self._finished: list[str] = []
        self._now: tuple[Point, PipelineConfig] | None = None
        self.used_s = 0.0  # of the budget at the latest border
        self._until_s: float | None = None  # of the budget, the chunk may have used by its end

    def next(self, share: float = 1.0) -> tuple[str, PipelineConfig] | None:
        """The stage to compute next and its configuration, ``None`` where the chunk is done.

        ``share`` of the time left when it is first asked is this chunk's.
        """
        if self._until_s is None:
            self._until_s = self.clock.used_s + share * self.clock.left_s
        left = self._until_s - self.clock.used_s
        possible = [(p, c) for p, c in self._points if self._reachable(p, c)]
        ranked = sorted(possible, key=lambda pc: (-pc[0].accuracy, self.predicted_s(pc[0])))
        chosen = next((pc for pc in ranked if self.predicted_s(pc[0]) <= left), None)
        why = self._why(ranked, chosen)
        if chosen is None:
            chosen = min(ranked, key=lambda pc: self.predicted_s(pc[0]))
        todo = self._todo(chosen[0])
        if self._now is None or chosen[0] is not self._now[0]:
            before = todo[0] if todo else "the end"
            self.choices.append(Choice(before, chosen[0].name, self.predicted_s(chosen[0]), left, self._pace, why))
        self._now, self.used_s = chosen, self.clock.used_s
        return (todo[0], chosen[1]) if todo else None

    def calibrate(self) -> None:
        """Begins to predict at this machine's speed."""
        self._pace = self._speed()
        self._taken, self._foreseen = self._pace * TOLD_BY_CALIBRATION_S, TOLD_BY_CALIBRATION_S

    def done(self, stage: str, seconds: float, cached: bool) -> None:
        """Takes note of what a stage took from border to border: where it was computed, others will go at its pace."""
        assert self._now is not None
        if not cached:
            if not self._foreseen:
                self.calibrate()
            if stage != "ingest":
                self._taken += seconds
                self._foreseen += self._of(self._now[0], stage)
            self._pace = self._taken / self._foreseen
        self._finished.append(stage)

    def record(self) -> dict[str, Any]:
        """The settings over the user's that the chunk was made with, the stage it ends at, and all choices."""
        settings, end = ([], "") if self._now is None else (list(self._now[0].changes), self._now[0].end)
        return {"settings": settings, "end": end, "choices": [asdict(c) for c in self.choices]}

    def told(self) -> str:
        """What the chunk was made with, a line."""
        made = self.record()
        return f"within a budget: {', '.join(made['settings']) or 'as configured'}; ends at {made['end']}"

    def predicted_s(self, point: Point) -> float:
        """Of the stages that are not finished, with what is kept for surprises."""
        return (1 + SPARE) * self._pace * sum(self._of(point, stage) for stage in self._todo(point))

    def _of(self, point: Point, stage: str) -> float:
        """Seconds on the table's machine. GNet's and ENet's go with their iterations, all others' with the images."""
        work = 1.0 if stage in ("gnet", "enet") else self._work
        return point.seconds[stage] * work + self._cold.get(stage, 0.0) + BORDER_S

    def _todo(self, point: Point) -> list[str]:
        return [s for s in reconstructing_until(point.end) if s not in self._finished]

    def _reachable(self, point: Point, config: PipelineConfig) -> bool:
        """Whether what is finished is what the point would have made; to stop at GNet's scene is always possible."""
        if self._now is None:
            return True
        sections = {BY_NAME[s].section for s in self._finished if s in reconstructing_until(point.end)}
        return all(getattr(config, name) == getattr(self._now[1], name) for name in sections)

    def _why(self, ranked: Sequence[tuple[Point, PipelineConfig]], chosen: tuple[Point, PipelineConfig] | None) -> str:
        if chosen is None:
            return "nothing fits; this is the shortest"
        what, better = f"the best {self._table.judged} that fits", ranked[: ranked.index(chosen)]
        if not better:
            return f"{what}, and of all {len(ranked)}"
        nearest = min(better, key=lambda pc: self.predicted_s(pc[0]))[0]
        return f"{what}; {nearest.name} would take {self.predicted_s(nearest):.0f} s"


def images_of(log: str, chunk: int, config: PipelineConfig) -> int:
    """How many images a chunk of a log has at most: frames times cameras."""
    opened, frames = opened_log(log), config.ingest.chunk_frames
    cameras = config.ingest.cameras or tuple(c.name for c in opened.cameras)
    return len(cameras) * min(frames, opened.frame_count - chunk * frames)
