"""Images that a detector of boxes is trained and tested on: recorded ones, renders beside the path, and the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flows.experiments.log_chunks import LogChunk
from flows.experiments.stages import StageRunner, run_stages
from flows.pipeline.definition import stages_until
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import ArtifactRef, Job, read_artifact

if TYPE_CHECKING:
    from flows.paper_tables.methods import Method
    from genre_tasks.scene.chunk import Chunk
    from genre_tasks.training_sets.labelled_images import LabelledImage


@dataclass(frozen=True)
class RenderSource:
    """Where the images of one chunk come from.

    Attributes:
        job: of the chunk; its configuration decides the working resolution, and how scenes are made.
        end: the stage whose scene is rendered; ``None``: no scene is needed.
    """

    job: Job
    end: str | None

    def run(self, runner: StageRunner) -> dict[str, ArtifactRef]:
        """Runs the stages that the images need.

        Args:
            runner: runs one stage.
        """
        return run_stages(("ingest",) if self.end is None else stages_until(self.end), self.job, runner)


def build_source(where: LogChunk, method: Method, settings: Sequence[str], preset: str, store: str) -> RenderSource:
    """Builds the source of a chunk's renders by a method.

    Args:
        where: the chunk.
        method: that reconstructs it.
        settings: ``section.key=value`` over the preset.
        preset: its name.
        store: folder of the store.

    Raises:
        ConfigError: a setting is unknown or out of range.
    """
    # Values and not the configuration itself: jobs go to workers.
    config = method.configuration(preset, tuple(settings)).model_dump(mode="json")
    return RenderSource(Job(where.log, where.chunk, store, config), method.end)


def label_recorded(job: Job, ref: ArtifactRef, every: int = 1) -> list[LabelledImage]:
    """Labels the recorded images of a chunk, source and held out.

    Args:
        job: of the chunk.
        ref: its ``ingest``.
        every: every n-th frame.

    Raises:
        InputError: the log has no annotations, or an image cannot be read.
    """
    from genre_tasks.training_sets.label_boxes import labeller_of

    chunk: Chunk = read_artifact(job, ref)
    labeller = labeller_of(cached_log(job.log))
    # Source and held-out frames alike: a detector may learn from all that was recorded.
    frames = chunk.frames[::every]
    return [labeller.label_recorded_image(chunk, view) for view in chunk.views if view.frame in frames]


def render_shifted(
    source: RenderSource, refs: dict[str, ArtifactRef], shifts_m: Sequence[float]
) -> list[LabelledImage]:
    """Renders a scene at the recorded poses, moved by each shift, with the boxes of its log.

    Args:
        source: of the scene.
        refs: its stages.
        shifts_m: metres to the left.

    Raises:
        InputError: the log has no annotations.
        NonFiniteError: an image is not finite.
    """
    from flows.perception.labelled_renders import render_labelled_images
    from genre_tasks.config import PipelineConfig
    from genre_tasks.effects.apply_plan import apply_plan

    job = source.job
    # Poses and lenses are those that the scene was fitted with.
    chunk = apply_plan(read_artifact(job, refs["ingest"]), read_artifact(job, refs["effects"]))
    scene = read_artifact(job, refs[str(source.end)]).scene
    ingest = PipelineConfig.model_validate(job.config).ingest
    return list(render_labelled_images(cached_log(job.log), chunk, scene, shifts_m, recorded=False, ingest=ingest))


def label_truth(job: Job, ref: ArtifactRef, shifts_m: Sequence[float], every: int) -> list[LabelledImage]:
    """Labels what cameras beside the path would have recorded, where the log can tell it.

    Args:
        job: of the chunk.
        ref: its ``ingest``.
        shifts_m: metres to the left.
        every: every n-th frame.

    Returns:
        The images; none of a recorded log.

    Raises:
        InputError: the log has no annotations.
    """
    from genre_tasks.metrics.scoring import truth_image
    from genre_tasks.scene.novel_poses import place_novel_views
    from genre_tasks.training_sets.label_boxes import labeller_of

    log = cached_log(job.log)
    # Nobody recorded what is beside the path of a real log.
    if log.truth is None:
        return []
    chunk: Chunk = read_artifact(job, ref)
    labeller = labeller_of(log)
    views = place_novel_views(chunk, shifts_m, chunk.frames[::every])
    return [
        labeller.label_view(
            chunk, view, truth_image(chunk, log.truth, view), shift_m=view.shift_m, rendered=False, depth=None
        )
        for view in views
    ]
