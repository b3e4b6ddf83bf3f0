"""Runs stages on a tiny log before anything is timed: imports, weights and first calls take seconds."""

from __future__ import annotations

from collections.abc import Sequence

from flows.experiments.stages import read_stage_costs, run_stages
from flows.pipeline.stage_runner import Job, run_stage
from genre_tasks.config import PipelineConfig
from genre_tasks.temporary_names import temporary_folder

# Seed 900 is for tuning, so that no training or test street is touched.
TINY_LOG = "synthetic:street?seed=900&frames=8&cameras=1"


def run_on_tiny_log(config: PipelineConfig, names: Sequence[str]) -> dict[str, float]:
    """Runs stages on a tiny synthetic log in a store that is deleted afterwards.

    Args:
        config: what the stages run with; what it says of the user's log, such as names of its cameras, is left out.
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
    """Cameras, points and scenes are of the user's log, and the tiny log has others."""
    of_log = {"ingest": ("cameras", "points", "scene", "placement"), "initial": ("scene", "placement")}
    sections = {}
    for name, fields in of_log.items():
        section = getattr(config, name)
        defaults = {field: type(section).model_fields[field].get_default(call_default_factory=True) for field in fields}
        sections[name] = section.model_copy(update=defaults)
    return config.model_copy(update=sections)
