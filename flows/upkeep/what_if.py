"""Which stages of a run would be computed again if a setting, code, weights, a package or the log changed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flows.configuration.loading import apply_settings
from flows.pipeline.definition import PIPELINE, StageSpec, digest_stage_weights, find_weights_file, stage_key
from flows.pipeline.stage_runner import Job, reading_modules
from flows.reconstruction.chunk_configuration import read_chunk_config
from genre_tasks.code_closure import find_module_file, import_closure
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError
from genre_tasks.weights import resolve_weights
from storage.code_digest import NUMERIC_PACKAGES

_ROOT = Path(__file__).resolve().parents[2]
_FORMS = (
    "Write a setting as gnet.iterations=96, a module as code:genre_tasks.stages.gnet, weights as weights:fnet, a "
    "package as package:torch, or log."
)


@dataclass(frozen=True)
class Recomputation:
    """A stage that would be computed again.

    Attributes:
        chunk: number of the chunk.
        stage: the stage's name.
        seconds: what it took the last time.
        reason: its own change, or the stages that it reads.
    """

    chunk: int
    stage: str
    seconds: float
    reason: str


def find_recomputations(record: Mapping[str, Any], change: str) -> list[Recomputation]:
    """Finds what of a run would be computed again after a change, by the same keys that decide about the cache.

    A stage that reads a changed one counts, although it would be served from the store if the changed one came out the
    same to the byte.

    Args:
        record: of the run, as ``run.json`` holds it.
        change: ``section.key=value``, ``code:MODULE``, ``weights:NETWORK``, ``package:NAME`` or ``log``.

    Returns:
        The stages in the order of the pipeline, chunk by chunk.

    Raises:
        ConfigError: the change is none of these, or its setting is wrong.
        InputError: the log or the weights are gone.
    """
    _check_change(change)
    found: list[Recomputation] = []
    reasons_of: dict[str, dict[str, str]] = {}
    for chunk in record["chunks"]:
        config = read_chunk_config(record, int(chunk["chunk"]))
        values = config.model_dump(mode="json")
        # Chunks share code and, but for a budget's choices, settings: what changes in one changes in all like it.
        if (settings := json.dumps(values, sort_keys=True)) not in reasons_of:
            job = Job(record["log"], 0, record["store"], values)
            reasons_of[settings] = {spec.name: _explain(spec, job, config, change) for spec in PIPELINE}
        reasons = reasons_of[settings]
        seconds = {stage["stage"]: float(stage["seconds"]) for stage in chunk["stages"]}
        changed: set[str] = set()
        for spec in PIPELINE:
            read = [name for name in spec.inputs if name in changed]
            reason = reasons[spec.name] or (f"reads {', '.join(read)}" if read else "")
            if reason and spec.name in seconds:
                changed.add(spec.name)
                found.append(Recomputation(int(chunk["chunk"]), spec.name, seconds[spec.name], reason))
    return found


def _explain(spec: StageSpec, job: Job, config: PipelineConfig, change: str) -> str:
    """Why the stage itself is concerned; empty if it is not."""
    kind, _, name = change.partition(":")
    if change == "log":
        return "reads the log" if spec.needs_log else ""
    if "=" in change and kind not in ("code", "weights", "package"):
        other = apply_settings(config, [change])
        keys = [
            stage_key(spec, c, {}, digest_stage_weights(spec, c), reading_modules(spec, job)) for c in (config, other)
        ]
        return "" if keys[0] == keys[1] else "its setting"
    if kind == "weights":
        return "its weights" if _loads_weights(spec, config, name) else ""
    if kind in ("code", "package"):
        modules = (*spec.lazy_modules, *reading_modules(spec, job))
        closure = import_closure(spec.module, modules, _ROOT)
        found = closure.modules if kind == "code" else closure.packages
        return f"its {'code' if kind == 'code' else 'packages'}" if name in found else ""
    return ""


def _loads_weights(spec: StageSpec, config: PipelineConfig, network: str) -> bool:
    """Whether a stage loads weights for a network, or the ones that ship for it, as GNet's refinement does ENet's."""
    file = find_weights_file(spec, config)
    files = [] if file is None else [file]
    refinement = getattr(getattr(config, spec.section), "refinement", None)
    if refinement is not None:
        files.append(resolve_weights("gnet", refinement.weights, "gnet.refine.weights"))
    return (file is not None and spec.weights == network) or resolve_weights(network, "builtin") in files


def _check_change(change: str) -> None:
    """Refuses what no key depends on: a typing error must not look like a change without consequences."""
    kind, _, name = change.partition(":")
    is_known = {
        "code": lambda: find_module_file(name, _ROOT) is not None,
        "weights": lambda: name in {spec.weights for spec in PIPELINE if spec.weights},
        # The versions of others are no part of a key.
        "package": lambda: name in NUMERIC_PACKAGES,
    }
    if kind in is_known and name:
        is_sound = is_known[kind]()
    else:
        is_sound = change == "log" or ("=" in change and "." in change.partition("=")[0])
    if not is_sound:
        raise ConfigError(f"{change!r} is no change that keys know", remedy=_FORMS)
