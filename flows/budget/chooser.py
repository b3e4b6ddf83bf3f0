"""Chooses the most accurate setting that fits into the time, and chooses again before every stage."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from flows.budget.cost_table import CostPoint, CostTable
from flows.budget.deadline import Deadline
from flows.configuration import apply_settings
from flows.pipeline.definition import STAGE_BY_NAME, stages_until
from flows.pipeline.log_cache import cached_log
from genre_tasks.config import PipelineConfig

STAGE_OVERHEAD_S = 0.6
"""Seconds that a stage takes on the table's machine beyond its own: artifacts are read, hashed and written, and Prefect
keeps its states."""

SAFETY_MARGIN = 0.06
"""Safety margin, as a fraction of the predicted time."""

KEPT_MARGIN = 0.03
"""The same for the setting that was chosen last: a little delay is no reason to leave out its ENet."""

CALIBRATION_WEIGHT_S = 5.0
"""Seconds of stages that count as much as the calibration when the pace is estimated."""


@dataclass(frozen=True)
class BudgetChoice:
    """What was decided before a stage.

    Attributes:
        before: the stage that follows, or ``the end``.
        point: name of the setting that was chosen.
        predicted_s: seconds that the chunk's remaining stages would take with it.
        left_s: seconds that the chunk had left.
        pace: seconds here over the table's seconds, as far as it was known by then.
        why: the reason, one clause.
    """

    before: str
    point: str
    predicted_s: float
    left_s: float
    pace: float
    why: str

    def __str__(self) -> str:
        pace = f"{self.pace:.2f} × the table's seconds"
        return f"{self.point}: {self.predicted_s:.0f} s predicted ({pace}) of {self.left_s:.0f} s left; {self.why}"


class _Candidate(NamedTuple):
    """A setting of the table, and the user's configuration with it."""

    point: CostPoint
    config: PipelineConfig


class Chooser:
    """Chooses the setting of one chunk, stage by stage.

    The machine's speed is measured when the first stage was computed. Until then Prefect's server is starting, which
    makes a machine look up to 1.6 times as slow as it is. Nothing is lost by waiting: ingest and the plan of effects
    are the same in nearly all settings. Where both come from the store, it is measured after them.

    Args:
        table: the settings to choose from.
        base: the user's configuration, over which a setting is applied.
        deadline: the time of the run.
        image_factor: images of the chunk over images of a chunk of the table.
        measure_speed: gives this machine's calibration over the table's.
        warm_stages: stages that this process has computed before; their first calls are over.
        left_out: how many settings were left out before, as memory is too small for them; for the explanation.

    Attributes:
        deadline: the time of the run.
        choices: every choice that changed the setting, in order.
        computed_stages: stages that were computed for this chunk, and did not come from the store.
        used_s: seconds of the budget that were used when the latest choice was made.
    """

    def __init__(
        self,
        table: CostTable,
        base: PipelineConfig,
        deadline: Deadline,
        image_factor: float,
        measure_speed: Callable[[], float],
        warm_stages: Collection[str] = (),
        left_out: int = 0,
    ) -> None:
        self.deadline = deadline
        self.choices: list[BudgetChoice] = []
        self.computed_stages: set[str] = set()
        self.used_s = 0.0
        self._table = table
        self._image_factor = image_factor
        self._measure_speed = measure_speed
        self._left_out = left_out
        # More pixels take more time. Fewer do not take as much less: points and Gaussians stay as many.
        self._pixel_factor = max(1.0, base.ingest.width_px * base.ingest.height_px / table.pixels)
        self._first_call_s = {s: seconds for s, seconds in table.first_call_s.items() if s not in warm_stages}
        self._candidates = [_Candidate(point, apply_settings(base, point.changes)) for point in table.points]
        self._finished: list[str] = []
        self._current: _Candidate | None = None
        # Until the calibration this machine counts as fast as the table's.
        self._pace = 1.0
        # Seconds that stages took here, and that the table says for them; their ratio is the pace.
        self._measured_s = 0.0
        self._table_s = 0.0
        # How much of the budget may be used when the chunk ends; the first choice sets it.
        self._until_s: float | None = None

    def next_stage(self, fraction: float = 1.0) -> tuple[str, PipelineConfig] | None:
        """Chooses the setting that fits best now, and says which stage follows.

        Args:
            fraction: the part of the time left at the first call that this chunk may use.

        Returns:
            The stage to compute and its configuration; ``None`` when the chunk is done.
        """
        if self._until_s is None:
            self._until_s = self.deadline.used_s + fraction * self.deadline.left_s
        left_s = self._until_s - self.deadline.used_s
        reachable = [candidate for candidate in self._candidates if self._is_reachable(candidate)]
        # Most accurate first; of equally accurate settings the faster one.
        ranked = sorted(reachable, key=lambda c: (-c.point.accuracy, self.predict_s(c.point)))
        chosen = next((c for c in ranked if self._fits(c, left_s)), None)
        why = self._explain(ranked, chosen)
        if chosen is None:
            # The time is too short for any setting: the one that exceeds it least is the best answer there is.
            chosen = min(ranked, key=lambda c: self.predict_s(c.point))
        remaining = self._remaining(chosen.point)
        # A choice that confirms the last one is not worth a line in the record.
        if self._current is None or chosen.point is not self._current.point:
            before = remaining[0] if remaining else "the end"
            predicted_s = self.predict_s(chosen.point)
            self.choices.append(BudgetChoice(before, chosen.point.name, predicted_s, left_s, self._pace, why))
        self._current = chosen
        self.used_s = self.deadline.used_s
        return (remaining[0], chosen.config) if remaining else None

    def calibrate(self) -> None:
        """Measures this machine's speed, by which seconds are predicted from now on."""
        self._pace = self._measure_speed()
        self._measured_s = self._pace * CALIBRATION_WEIGHT_S
        # The calibration counts as that many seconds of stages, so that one odd stage does not turn the prediction
        # over.
        self._table_s = CALIBRATION_WEIGHT_S

    def record_stage(self, stage: str, seconds: float, cached: bool) -> None:
        """Notes that a stage has ended; if it was computed, later stages are predicted at its pace.

        Args:
            stage: the stage that :meth:`next_stage` named.
            seconds: wall time with everything around the stage, artifacts and Prefect's states included.
            cached: whether the stage came from the store.
        """
        assert self._current is not None
        # The initial scene's points and GNet are chosen next, and cannot be taken back: they need this machine's speed.
        if not self._table_s and (not cached or stage == "effects"):
            self.calibrate()
        if not cached:
            self.computed_stages.add(stage)
            # How long ingest takes depends on the log's reader more than on the machine, so its pace says little.
            if stage != "ingest":
                self._measured_s += seconds
                self._table_s += self._stage_s(self._current.point, stage)
            self._pace = self._measured_s / self._table_s
        self._finished.append(stage)

    def as_record(self) -> dict[str, Any]:
        """Gathers what the run's record keeps of this chunk.

        Returns:
            ``settings`` over the user's that the chunk was made with, ``end``, its last stage, and all ``choices``.
        """
        point = None if self._current is None else self._current.point
        return {
            "settings": [] if point is None else list(point.changes),
            "end": "" if point is None else point.end,
            "choices": [asdict(choice) for choice in self.choices],
        }

    def describe(self) -> str:
        """Says in one line what the chunk was made with.

        Returns:
            A line for the report.
        """
        record = self.as_record()
        return f"within a budget: {', '.join(record['settings']) or 'as configured'}; ends at {record['end']}"

    def predict_s(self, point: CostPoint, margin: float = SAFETY_MARGIN) -> float:
        """Predicts the seconds of the stages that remain with a setting, with a margin.

        Args:
            point: the setting.
            margin: fraction of the predicted time that is added.

        Returns:
            Seconds on this machine; 0 when all stages are finished.
        """
        table_s = sum(self._stage_s(point, stage) for stage in self._remaining(point))
        return (1 + margin) * self._pace * table_s

    def _fits(self, candidate: _Candidate, left_s: float) -> bool:
        is_kept = self._current is not None and candidate.point is self._current.point
        return self.predict_s(candidate.point, KEPT_MARGIN if is_kept else SAFETY_MARGIN) <= left_s

    def _stage_s(self, point: CostPoint, stage: str) -> float:
        """Seconds of a stage of this chunk on the table's machine."""
        # GNet's and ENet's time goes with their iterations, which the setting fixes; all other stages' with the images.
        factor = 1.0 if stage in ("gnet", "enet") else self._image_factor
        # A log's images are read and reduced, which depends on their own size alone.
        factor *= 1.0 if stage == "ingest" else self._pixel_factor
        return point.seconds[stage] * factor + self._first_call_s.get(stage, 0.0) + STAGE_OVERHEAD_S

    def _remaining(self, point: CostPoint) -> list[str]:
        return [stage for stage in stages_until(point.end) if stage not in self._finished]

    def _is_reachable(self, candidate: _Candidate) -> bool:
        """Whether the finished stages are those that the setting would have made.

        To stop at GNet's scene is always possible: stages that the setting does not go through do not count.
        """
        if self._current is None:
            return True
        stages = stages_until(candidate.point.end)
        sections = {STAGE_BY_NAME[stage].section for stage in self._finished if stage in stages}
        return all(getattr(candidate.config, name) == getattr(self._current.config, name) for name in sections)

    def _explain(self, ranked: Sequence[_Candidate], chosen: _Candidate | None) -> str:
        if chosen is None:
            return "nothing fits; this is the shortest"
        reason = f"the best {self._table.accuracy_label} that fits"
        if self._left_out:
            reason += f" ({self._left_out} left out for lack of memory)"
        better = ranked[: ranked.index(chosen)]
        if not better:
            return f"{reason}, and of all {len(ranked)}"
        # Of the better settings the one that came nearest to fitting: it tells how much time would have been needed.
        nearest = min(better, key=lambda c: self.predict_s(c.point)).point
        return f"{reason}; {nearest.name} would take {self.predict_s(nearest):.0f} s"


def count_images(log: str, chunk: int, config: PipelineConfig) -> int:
    """Counts the images that a chunk of a log has at most: frames times cameras.

    Args:
        log: the log's URI.
        chunk: number of the chunk.
        config: its section ``ingest`` says which cameras and how many frames a chunk has.

    Returns:
        The number of images if none is missing.

    >>> count_images("synthetic:street?seed=900&frames=25&cameras=2", 1, PipelineConfig())
    10
    """
    opened = cached_log(log)
    frames = config.ingest.chunk_frames
    cameras = config.ingest.cameras or tuple(camera.name for camera in opened.cameras)
    return len(cameras) * min(frames, opened.frame_count - chunk * frames)
