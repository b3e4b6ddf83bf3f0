"""What a run's report and tables show: plain values, no torch and no files."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from genre_tasks.effects.types import Decision
    from genre_tasks.metrics.results import Metric


@dataclass(frozen=True)
class Origin:
    """Where an artifact came from.

    Attributes:
        inputs: name → key of each input artifact (or digest of the log).
        payload_digest: digest of its files.
        size_bytes: of all its files.
        made_at: time of the commit, ISO 8601.
        code_digest: digest of the stage's code.
        weights_digest: digest of the network's weights; ``None`` without a network.
    """

    inputs: Mapping[str, str]
    payload_digest: str
    size_bytes: int
    made_at: str
    code_digest: str
    weights_digest: str | None = None


@dataclass(frozen=True)
class RangeSummary:
    """How far to the sides of the path a chunk's scene can be trusted.

    Attributes:
        stage: the stage that made the scene.
        left_m: metres to the left.
        right_m: metres to the right.
        farthest_m: the largest shift that was looked at; a range of so many metres may be larger.
        limit_db: the estimate below which a shift does not hold, dB; ``None`` where only the metres are known.
        points: (metres to the left, estimated PSNR in dB, whether all guards hold), from the right to the left.
    """

    stage: str
    left_m: float
    right_m: float
    farthest_m: float
    limit_db: float | None = None
    points: tuple[tuple[float, float, bool], ...] = ()


@dataclass(frozen=True)
class StageSummary:
    """One stage of one chunk.

    Attributes:
        stage: the stage's name.
        key: the artifact's key.
        cached: whether the artifact was in the store already.
        seconds: wall time of the computation, also if it was done by an earlier run.
        peak_mib: largest memory of the process during the computation, MiB.
        metrics: value by name, such as ``interpolation/psnr`` or ``shift_3m/kernel``; ``…/n`` is a number of images.
        pictures: PNG bytes by name, such as ``3m_left_front_camera_04``; ``.truth`` follows the name for a true image.
        curve: (seconds of iterations so far in this stage, held-out PSNR in dB).
        warnings: sentences for the user.
        intervals: 95 % interval of some metrics, by their name.
        origin: where the artifact came from; ``None`` where it is not known.
        contents: counts of what the artifact holds, by name.
    """

    stage: str
    key: str
    cached: bool
    seconds: float
    peak_mib: float
    metrics: Mapping[str, float] = field(default_factory=dict)
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    curve: tuple[tuple[float, float], ...] = ()
    warnings: tuple[str, ...] = ()
    intervals: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    origin: Origin | None = None
    contents: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class ChunkSummary:
    """One chunk of a run.

    Attributes:
        chunk: number of the chunk.
        stages: its stages, in the order in which they ran.
        warnings: what its log lacks, and what it was made with if that is not what the user asked for.
        effects: the decisions of the effects' plan.
        reliable_range: of the last scene; ``None`` where it was not measured.
    """

    chunk: int
    stages: tuple[StageSummary, ...]
    warnings: tuple[str, ...] = ()
    effects: tuple[Decision, ...] = ()
    reliable_range: RangeSummary | None = None

    def stage(self, name: str) -> StageSummary | None:
        """Finds a stage by its name.

        Args:
            name: such as ``gnet`` or ``evaluate/gnet``.

        Returns:
            The stage, or ``None`` if the chunk does not have it.

        >>> ChunkSummary(0, (StageSummary("gnet", "5f41", False, 4.0, 900.0),)).stage("gnet").seconds
        4.0
        """
        return next((stage for stage in self.stages if stage.stage == name), None)


@dataclass(frozen=True)
class RunSummary:
    """A finished run.

    Attributes:
        run: the run's name.
        log: the log's URI.
        preset: the preset that the run started from.
        store: folder (or URI) of the store.
        chunks: the chunks that were reconstructed.
        differs: (the preset's value, the value used) of each ``section.key`` that was set otherwise.
        left_out: a sentence for each chunk that could not be reconstructed.
        environment: versions and machine that the last scene was made with.
    """

    run: str
    log: str
    preset: str
    store: str
    chunks: tuple[ChunkSummary, ...]
    differs: Mapping[str, tuple[Any, Any]] = field(default_factory=dict)
    left_out: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)


def add_counts(metrics: Sequence[Metric]) -> dict[str, float]:
    """Arranges metrics by name, with the number of images of each group.

    Args:
        metrics: of one stage.

    Returns:
        Value by name, and for each group of them the number of images as ``…/n``.
    """
    values = {metric.name: metric.value for metric in metrics}
    return values | {metric.name.rpartition("/")[0] + "/n": float(metric.n) for metric in metrics}


def place_over_seconds(
    curve: Iterable[tuple[int, float]], seconds_per_iteration: Iterable[float]
) -> tuple[tuple[float, float], ...]:
    """Places an accuracy curve over the seconds that its iterations took.

    Args:
        curve: (iteration, held-out PSNR in dB).
        seconds_per_iteration: of every iteration; fewer where an artifact of an earlier version lacks them.

    Returns:
        (seconds so far, PSNR in dB) of the points whose time is known.

    >>> place_over_seconds([(0, 20.0), (2, 24.0)], [0.5, 0.25])
    ((0.0, 20.0), (0.75, 24.0))
    """
    spent_s = [0.0, *itertools.accumulate(seconds_per_iteration)]
    # An artifact of an earlier version may have kept the curve without the seconds.
    return tuple((spent_s[iteration], psnr) for iteration, psnr in curve if iteration < len(spent_s))
