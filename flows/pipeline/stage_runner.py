"""One stage of one chunk: key, look-up, verification, computation, commit. Without Prefect."""

from __future__ import annotations

import functools
import gc
import hashlib
import importlib
import platform
import time
from collections.abc import Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flows.pipeline.definition import BY_NAME, StageSpec, section_of, stage_key, stage_weights
from flows.pipeline.log_cache import opened_log
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ArtifactCorruptError, ResourceError
from genre_tasks.progress import Progress, silent
from storage.address import Address
from storage.code_digest import code_digest
from storage.local import Artifact, open_store

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from genre_tasks.scene.chunk import Mark
    from storage.store import Store


@dataclass(frozen=True)
class Job:
    """What to reconstruct: a log, a chunk of it, with which configuration, into which store. Plain values only."""

    log: str
    chunk: int
    store: str
    config: dict[str, Any] = field(hash=False)


@dataclass(frozen=True)
class ArtifactRef:
    """A reference that tasks exchange in place of values: where the artifact lies and what its payload's digest is."""

    stage: str
    key: str
    payload_digest: str
    path: str
    cached: bool
    note: str = ""


def key_of(spec: StageSpec, job: Job, inputs: Mapping[str, ArtifactRef]) -> tuple[str, str | None]:
    """The stage's key and the digest of its weights."""
    config = PipelineConfig.model_validate(job.config)
    digests = {name: inputs[name].payload_digest for name in spec.inputs}
    if spec.needs_log:
        digests["log"] = opened_log(job.log).digest()
        digests["chunk"] = str(job.chunk)
    weights = stage_weights(spec, config)
    return stage_key(spec, config, digests, weights, reader_of(spec, job)), weights


def reader_of(spec: StageSpec, job: Job) -> tuple[str, ...]:
    """The module that reads the log, for a stage that does."""
    return (type(opened_log(job.log)).__module__,) if spec.needs_log else ()


def address_of(stage: str, job: Job, key: str) -> Address:
    """Where the artifact lies in the store."""
    log = opened_log(job.log)
    return Address(dataset=log.dataset, log=log.name, chunk=job.chunk, stage=stage, key=key)


def look_up(
    spec: StageSpec, job: Job, inputs: Mapping[str, ArtifactRef], repair: bool = True
) -> tuple[Address, ArtifactRef | None, str]:
    """The stage's address, its verified artifact if there is one, and a note if the one there is corrupt.

    With ``repair`` a corrupt artifact is removed, so that it can be computed anew.
    """
    store = open_store(job.store)
    key, _ = key_of(spec, job, inputs)
    address = address_of(spec.name, job, key)
    artifact = None
    note = ""
    try:
        artifact = store.find(address)
        if artifact is not None:
            store.verify(artifact)
    except ArtifactCorruptError as error:
        note = f"{error.problem} ({error.file}): computed again"
        artifact = None
        if repair:
            store.discard(address)
    return address, None if artifact is None else _ref(artifact, cached=True), note


def produce(
    stage: str,
    job: Job,
    inputs: Mapping[str, ArtifactRef],
    attempt: int = 0,
    progress: Progress = silent,
) -> ArtifactRef:
    """The stage's artifact: from the store if a verified one is there, else computed and committed.

    ``attempt`` counts the tries before this one that ran out of memory: the stage's ``splits`` setting is halved that
    often, which does not change the payload. Inputs are read back from the store and verified there.

    Raises:
        ResourceError: memory or disk does not suffice. Other ``GenreError``: as the stage raises them.
    """
    spec = BY_NAME[stage]
    address, hit, note = look_up(spec, job, inputs)
    if hit is not None:
        return hit
    store = open_store(job.store)
    values = {name: store.read(_artifact(store, inputs[name], job)) for name in spec.inputs}
    values |= _specials(spec, job)
    section = _smaller(spec, section_of(spec, PipelineConfig.model_validate(job.config)), attempt)
    module, _, name = spec.function.partition(":")
    with measured() as usage:
        function = getattr(importlib.import_module(module), name)
        value = function(section, *(values[a] for a in spec.arguments), progress=progress)
    config = PipelineConfig.model_validate(job.config)
    artifact = store.commit(
        address,
        spec.kind,
        value,
        inputs={name: inputs[name].key for name in spec.inputs},
        configuration=section_of(spec, config).model_dump(mode="json"),
        code_digest=code_digest(spec.module, also=(*spec.lazy, *reader_of(spec, job))),
        weights_digest=stage_weights(spec, config),
        seconds=usage.seconds,
        peak_mib=usage.peak_mib,
        environment=environment(),
        measurements={"cpu_seconds": usage.cpu_seconds, "marks": _grouped_marks(getattr(value, "marks", ()))},
        warnings=(note,) if note else (),
    )
    return _ref(artifact, cached=False, note=note)


@dataclass
class Usage:
    """Seconds of wall time and of all threads on the CPU, and the process's peak of resident memory meanwhile, MiB."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    peak_mib: float = 0.0


@contextmanager
def measured() -> Iterator[Usage]:
    """Times a block and takes its memory peak; out-of-memory of any kind becomes a ``ResourceError``."""
    usage = Usage()
    gc.collect()
    _reset_peak()
    start, begun = time.perf_counter(), time.process_time()
    try:
        yield usage
    except (MemoryError, RuntimeError) as error:
        text = str(error)
        if isinstance(error, MemoryError) or "alloc" in text or "out of memory" in text.lower():
            raise ResourceError(
                f"memory ran out: {text[:200]}", remedy="Choose a smaller ingest.width_px or fewer cameras."
            ) from error
        raise
    finally:
        usage.seconds, usage.cpu_seconds = time.perf_counter() - start, time.process_time() - begun
        usage.peak_mib = _peak_mib()


def _reset_peak() -> None:
    try:  # Linux: 5 resets the high-water mark of resident memory
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def _peak_mib() -> float:
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) / 1024
    import psutil

    return psutil.Process().memory_info().rss / 2**20


@functools.lru_cache(maxsize=1)
def environment() -> dict[str, str]:
    """What the numbers were measured on."""
    import torch

    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": platform.machine(),
        "threads": str(torch.get_num_threads()),
        **{name: version(name) for name in ("torch", "numpy", "genre")},
    }


def _specials(spec: StageSpec, job: Job) -> dict[str, Any]:
    values: dict[str, Any] = {"chunk_index": job.chunk, "stage_name": spec.name.removeprefix("evaluate/")}
    if spec.needs_log:
        log = opened_log(job.log)
        values |= {"log": log, "truth": log.truth}
    return values


def _grouped_marks(marks: Iterable[Mark]) -> list[str]:
    """What the chunk's log lacks, a line a kind: the first detail, and how many more there are."""
    kinds: dict[str, list[str]] = {}
    for mark in marks:
        kinds.setdefault(mark.kind.replace("_", " "), []).append(mark.detail)
    return [
        f"{kind}: {details[0]}" + f" (and {len(details) - 1} more)" * (len(details) > 1)
        for kind, details in kinds.items()
    ]


def _smaller(spec: StageSpec, section: Any, attempt: int) -> Any:
    if spec.splits is None or attempt == 0:
        return section
    return section.model_copy(update={spec.splits: max(1, getattr(section, spec.splits) >> attempt)})


def artifact_of(job: Job, ref: ArtifactRef) -> Artifact:
    """The artifact behind a reference of this job. Raises ``ArtifactCorruptError`` where it is gone."""
    return _artifact(open_store(job.store), ref, job)


def value_of(job: Job, ref: ArtifactRef) -> Any:
    """Its value, verified while it is read."""
    return open_store(job.store).read(artifact_of(job, ref))


def _artifact(store: Store, ref: ArtifactRef, job: Job) -> Artifact:
    artifact = store.find(address_of(ref.stage, job, ref.key))
    if artifact is None:
        raise ArtifactCorruptError(
            f"the artifact of {ref.stage} vanished while the run was going on",
            remedy="Run again: it is computed anew.",
            file=ref.path,
        )
    return artifact


def _ref(artifact: Artifact, cached: bool, note: str = "") -> ArtifactRef:
    manifest = artifact.manifest
    return ArtifactRef(manifest.stage, manifest.key, manifest.payload_digest, str(artifact.path), cached, note)


def run_id(uri: str, preset: str, keys: Mapping[str, str]) -> str:
    """A name for a run that is the same when everything it made is the same."""
    text = "\n".join([uri, preset, *(f"{k}={v}" for k, v in sorted(keys.items()))])
    return hashlib.sha256(text.encode()).hexdigest()[:12]
