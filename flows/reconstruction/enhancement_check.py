"""Whether ENet harmed a scene that another program made: said with the run, not left to who compares columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from flows.reconstruction.run_summary import StageSummary

MOST_LOSS_DB = 0.3
"""Of held-out images; views beside the path gain more than that where there is something to gain."""

_METRIC = "interpolation/psnr"


def find_harm(config: Mapping[str, Any], stages: Sequence[StageSummary]) -> str | None:
    """Compares a scene from a file with what ENet made of it, on the images that are held out.

    Args:
        config: the effective configuration, as JSON values.
        stages: of a chunk, evaluated.

    Returns:
        A warning with both numbers and what to do; ``None`` where nothing is lost, or the scene is not from a file.
    """
    if config.get("initial", {}).get("scene") is None:
        return None
    psnr = {stage.stage: stage.metrics[_METRIC] for stage in stages if _METRIC in stage.metrics}
    if "gnet" not in psnr or "enet" not in psnr or psnr["gnet"] - psnr["enet"] <= MOST_LOSS_DB:
        return None
    return (
        f"ENet made the scene worse: on held-out images PSNR fell from {psnr['gnet']:.1f} to {psnr['enet']:.1f} dB. "
        f"Use the scene as it was given, or set more of enet.iterations (now {config['enet']['iterations']})"
    )
