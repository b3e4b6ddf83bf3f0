"""Runs stages on a tiny log before anything is timed: imports, weights and first calls take seconds."""

from __future__ import annotations

from collections.abc import Sequence

from flows.experiments.stages import read_stage_costs, run_stages
from flows.pipeline.stage_runner import Job, run_stage
from genre_tasks.config import PipelineConfig
from genre_tasks.temporary_names import temporary_folder

_TINY_FRAMES = 8
# Seed 900 is for tuning, so that no training or test street is touched.
TINY_LOG = f"synthetic:street?seed=900&frames={_TINY_FRAMES}&cameras=1"

EFFECTS_OF_STATED_TIMES = ("rolling_shutter", "motion_blur")
"""Effects that are possible only where a log states readout or exposure times, which the tiny one does not."""


def run_on_tiny_log(config: PipelineConfig, names: Sequence[str]) -> dict[str, float]:
    """Runs stages on a tiny synthetic log in a store that is deleted afterwards.

    Args:
        config: what the stages run with. What it says of the user's log is left out, such as names of its cameras, and
            what the tiny log does not support.
        names: stages in the pipeline's order.

    Returns:
        Wall seconds by stage.
    """
    # A store of its own: from the user's, the stages could come without running.
    with temporary_folder() as store:
        job = Job(TINY_LOG, 0, str(store), _without_users_log(config).model_dump(mode="json"))
        refs = run_stages(names, job, run_stage)
        return dict(read_stage_costs(job, refs).seconds)


def _without_users_log(config: PipelineConfig) -> PipelineConfig:
    """The configuration with cameras, points, scenes, frames and effects as the tiny log has them."""
    of_log = {"ingest": ("cameras", "points", "scene", "placement"), "initial": ("scene", "placement")}
    sections = {}
    for name, fields in of_log.items():
        section = getattr(config, name)
        defaults = {field: type(section).model_fields[field].get_default(call_default_factory=True) for field in fields}
        sections[name] = section.model_copy(update=defaults)
    # A chunk needs two source frames.
    source_every = min(config.ingest.source_every, _TINY_FRAMES // 2)
    frames = {"chunk_frames": _TINY_FRAMES, "source_every": source_every}
    sections["ingest"] = sections["ingest"].model_copy(update=frames)
    # Others stay on, so that their first calls are in no cell's seconds.
    impossible = {name: "auto" for name in EFFECTS_OF_STATED_TIMES if getattr(config.effects, name) == "on"}
    return config.model_copy(update={**sections, "effects": config.effects.model_copy(update=impossible)})
