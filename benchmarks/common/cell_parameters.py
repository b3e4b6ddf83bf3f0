"""What a cell's row depends on beyond its name and the code: settings as they are resolved, and weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from flows.configuration import load_configuration
from flows.pipeline.definition import PIPELINE, digest_stage_weights
from genre_tasks.config import PipelineConfig


def describe_preset(preset: str, settings: Sequence[str] = ()) -> dict[str, Any]:
    """Describes what stages do under a preset.

    Args:
        preset: of the configuration.
        settings: ``section.key=value`` over it.

    Returns:
        See :func:`describe_configuration`.
    """
    return describe_configuration(load_configuration(preset, settings=settings))


def describe_configuration(config: PipelineConfig) -> dict[str, Any]:
    """Describes what stages do under a configuration.

    Args:
        config: of the pipeline.

    Returns:
        JSON values: ``configuration``, and the digest of the ``weights`` of every stage that loads some.
    """
    # Names of presets and paths of weights would let a cached row outlive a change of what they stand for.
    weights = {spec.name: digest_stage_weights(spec, config) for spec in PIPELINE if spec.weights}
    return {"configuration": config.model_dump(mode="json"), "weights": weights}
