"""Two finished runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from flows.comparison.artifact_comparison import read_scores
from flows.comparison.comparison import Comparison
from flows.comparison.gaussian_differences import compare_gaussians
from flows.comparison.metric_differences import Score, average_scores, compare_common_means, compare_scores
from flows.comparison.picture_pairs import pair_pictures
from flows.comparison.setting_differences import list_differences
from flows.reconstruction.chunk_configuration import read_chunk_config
from flows.reconstruction.stored_values import SCENE_STAGES
from genre_tasks.errors import ConfigError, InputError

if TYPE_CHECKING:
    from storage.store import Artifact, Store

_EVALUATE = "evaluate/"
MOST_CHUNKS = 4
"""Runs with more common chunks are compared by means; one chunk can be asked for."""


@dataclass(frozen=True)
class RunSide:
    """One of the two runs.

    Attributes:
        record: as ``run.json`` holds it.
        store: that it is in.
        artifacts: by key, as far as the store still has them.
    """

    record: Mapping[str, Any]
    store: Store
    artifacts: Mapping[str, Artifact]

    def stages(self, chunk: int) -> dict[str, Mapping[str, Any]]:
        """The record's entries of one chunk, by the stage's name."""
        return {s["stage"]: s for c in self.record["chunks"] if c["chunk"] == chunk for s in c["stages"]}

    def find(self, chunk: int, stage: str) -> Artifact | None:
        """The artifact of a stage, if the run has the stage and the store the artifact."""
        entry = self.stages(chunk).get(stage)
        return None if entry is None else self.artifacts.get(entry["key"])

    @property
    def chunks(self) -> list[int]:
        """Numbers of the chunks."""
        return [chunk["chunk"] for chunk in self.record["chunks"]]


def open_side(store: Store, record: Mapping[str, Any]) -> RunSide:
    """Finds the artifacts of a run.

    Args:
        store: that the run is in.
        record: as ``run.json`` holds it.

    Returns:
        The run with its artifacts.
    """
    wanted = {stage["key"] for chunk in record["chunks"] for stage in chunk["stages"]}
    return RunSide(record, store, {a.manifest.key: a for a in store.artifacts() if a.manifest.key in wanted})


def compare_runs(a: RunSide, b: RunSide, chunk: int | None = None) -> Comparison:
    """Compares two runs: settings, and for every common chunk digests, metrics, Gaussians and pictures.

    Args:
        a: the first run.
        b: the second run; of another log, only settings and mean metrics are compared.
        chunk: number of the only chunk to compare; ``None`` for all.

    Returns:
        The comparison.

    Raises:
        ConfigError: a chunk is asked for, and the runs are of different logs.
        InputError: either run lacks the chunk.
        ArtifactCorruptError: an artifact that is compared is damaged.
    """
    comparison = Comparison(a=_name(a), b=_name(b))
    facts = ("run", "log", "preset")
    comparison.add_table("runs", [{"": f, "A": a.record[f], "B": b.record[f]} for f in facts])
    settings = list_differences(a.record["config"], b.record["config"])
    has_budget = "budget" in a.record or "budget" in b.record
    which = "that were asked for " if has_budget else ""
    comparison.add_table("settings", settings, if_empty=f"The settings {which}are the same.")
    chunks = _choose_chunks(comparison, a, b, chunk)
    if not chunks or len(chunks) > MOST_CHUNKS:
        _add_means(comparison, a, b, chunks)
        return comparison
    for number in chunks:
        _add_chunk(comparison, a, b, number)
    return comparison


def _choose_chunks(comparison: Comparison, a: RunSide, b: RunSide, chunk: int | None) -> list[int]:
    if a.record["log"] != b.record["log"]:
        if chunk is not None:
            raise ConfigError("chunks of different logs are not compared", remedy="Leave out --chunk.")
        comparison.notes.append("The runs are of different logs: only settings and mean metrics are compared.")
        return []
    common = [number for number in a.chunks if number in b.chunks]
    if chunk is not None:
        if chunk not in common:
            raise InputError(f"the runs do not both have chunk {chunk}", remedy=f"Both have {common or 'none'}.")
        return [chunk]
    for name, some, others in (("A", a.chunks, b.chunks), ("B", b.chunks, a.chunks)):
        alone = [number for number in some if number not in others]
        if alone:
            comparison.notes.append(f"Only {name} has these chunks: {', '.join(map(str, alone))}.")
    return common


def _add_means(comparison: Comparison, a: RunSide, b: RunSide, chunks: Sequence[int]) -> None:
    """Mean metrics of each stage, over the common chunks where there are any."""
    sides = ((a, chunks or a.chunks), (b, chunks or b.chunks))
    for stage in dict.fromkeys(s for side, numbers in sides for n in numbers for s in side.stages(n)):
        scores = [[_find_scores(side, n, stage) for n in numbers] for side, numbers in sides]
        if not chunks:
            counts = f"of A's {len(a.chunks)} and B's {len(b.chunks)} chunks"
            rows = compare_scores(average_scores(scores[0]), average_scores(scores[1]))
            comparison.add_table(f"{stage}: mean metrics {counts}", rows)
            continue
        # A budget may end runs of one log at other stages, chunk by chunk.
        rows = compare_common_means(list(zip(scores[0], scores[1], strict=True)))
        lacking = f"No chunk has metrics after {stage} in both runs." if any(map(any, scores)) else ""
        comparison.add_table(f"{stage}: mean metrics", rows, if_empty=lacking)
    if chunks:
        comparison.notes.append(f"The runs have {len(chunks)} common chunks; --chunk N compares one of them in detail.")
        equal = sum(_are_same(a, b, number) for number in chunks)
        comparison.notes.append(f"All payloads are the same in {equal} of them.")


def _add_chunk(comparison: Comparison, a: RunSide, b: RunSide, number: int) -> None:
    if "budget" in a.record or "budget" in b.record:
        used = [read_chunk_config(side.record, number).model_dump(mode="json") for side in (a, b)]
        same = f"Chunk {number} was made with the same settings."
        comparison.add_table(f"chunk {number} settings within a budget", list_differences(*used), if_empty=same)
    stages = dict.fromkeys([*a.stages(number), *b.stages(number)])
    comparison.add_table(f"chunk {number} stages", [_stage_row(a, b, number, stage) for stage in stages])
    equal = []
    for stage in stages:
        scores = (_find_scores(a, number, stage), _find_scores(b, number, stage))
        if scores[0] == scores[1]:
            equal += [stage] if scores[0] else []
            continue
        comparison.add_table(f"chunk {number} metrics after {stage}", compare_scores(*scores))
    if equal:
        comparison.notes.append(f"Chunk {number} has the same metrics in both after {', '.join(equal)}.")
    scenes = [(stage, a.find(number, stage), b.find(number, stage)) for stage in SCENE_STAGES]
    for stage, one, other in reversed(scenes):
        if one is not None and other is not None:
            _verify((a, one), (b, other))
            comparison.add_table(f"chunk {number} Gaussians after {stage}", compare_gaussians(one.path, other.path))
            break
    for stage in stages:
        if not stage.startswith(_EVALUATE):
            continue
        one, other = a.find(number, stage), b.find(number, stage)
        if one is None or other is None or one.manifest.payload_digest == other.manifest.payload_digest:
            continue
        _verify((a, one), (b, other))
        comparison.pairs += pair_pictures(one, other, f"chunk {number} after {stage.removeprefix(_EVALUATE)}")


def _verify(*found: tuple[RunSide, Artifact]) -> None:
    for side, artifact in found:
        side.store.verify(artifact)
        side.store.fetch(artifact)


def _stage_row(a: RunSide, b: RunSide, number: int, stage: str) -> dict[str, Any]:
    entries = (a.stages(number).get(stage), b.stages(number).get(stage))
    found = (a.find(number, stage), b.find(number, stage))
    if entries[0] is None or entries[1] is None:
        payload = f"only in {'B' if entries[0] is None else 'A'}"
    elif found[0] is None or found[1] is None:
        payload = "gone from the store"
    else:
        payload = "same" if found[0].manifest.payload_digest == found[1].manifest.payload_digest else "differs"
    return {
        "stage": stage,
        "key A": "" if entries[0] is None else entries[0]["key"][:12],
        "key B": "" if entries[1] is None else entries[1]["key"][:12],
        "payload": payload,
        "seconds A": "" if entries[0] is None else entries[0]["seconds"],
        "seconds B": "" if entries[1] is None else entries[1]["seconds"],
    }


def _find_scores(side: RunSide, number: int, stage: str) -> dict[str, Score]:
    """Of the evaluation of a stage; without intervals where the store has it no more."""
    entry = side.stages(number).get(stage)
    if entry is None or not entry["metrics"]:
        return {}
    evaluation = side.find(number, f"{_EVALUATE}{stage}")
    if evaluation is None:
        return {name: Score(float(value)) for name, value in entry["metrics"].items()}
    _verify((side, evaluation))
    return read_scores(evaluation)


def _are_same(a: RunSide, b: RunSide, number: int) -> bool:
    stages = dict.fromkeys([*a.stages(number), *b.stages(number)])
    return all(_stage_row(a, b, number, stage)["payload"] == "same" for stage in stages)


def _name(side: RunSide) -> str:
    return f"run {side.record['run']}"
