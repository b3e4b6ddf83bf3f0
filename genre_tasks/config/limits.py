"""Section of the machine's limits: it is part of no stage's key, as no result depends on it."""

from __future__ import annotations

from pydantic import Field

from genre_tasks.config.section import Section


class LimitsConfig(Section):
    """What a run may take of the machine; no result depends on it."""

    memory_gib: float | None = Field(
        None,
        ge=0.25,
        le=1e5,
        description="GiB of memory for the process, as `--memory` sets it. What does not fit is worked on in parts, "
        "with images on disk; a stage that cannot do with so little does not start. null: what the machine has.",
    )
