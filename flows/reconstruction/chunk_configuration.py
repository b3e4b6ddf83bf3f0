"""The settings that a chunk of a finished run was made with, which a budget may have chosen."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from flows.configuration import apply_settings, validate_config
from genre_tasks.config import PipelineConfig


def read_chunk_config(record: Mapping[str, Any], chunk: int) -> PipelineConfig:
    """Gives the configuration of one chunk of a run.

    Args:
        record: of the run, as ``run.json`` holds it.
        chunk: number of the chunk.

    Returns:
        What was asked for; within a budget, with the settings over it that were chosen for this chunk.

    Raises:
        ConfigError: another version wrote the record, with settings that this one does not know.
    """
    config = validate_config(record["config"], f"the record of run {record['run']}")
    # Each chunk has its own choices, so the record's configuration is what was asked for and no more.
    chosen = {entry["chunk"]: entry["settings"] for entry in record.get("budget", {}).get("chunks", ())}
    return apply_settings(config, chosen.get(chunk, ()))
