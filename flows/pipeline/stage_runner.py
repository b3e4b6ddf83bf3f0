"""One stage of one chunk: key, look-up, verification, computation, commit. Without Prefect."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from flows.machine.facts import describe_environment
from flows.machine.memory_reuse import trim_memory
from flows.machine.resource_usage import measure_usage, memory_errors_translated
from flows.observability.stage_observation import count_read, count_written, measure_lease_wait, note_key, observed
from flows.pipeline.damaged_artifacts import discard_damaged_inputs
from flows.pipeline.definition import (
    STAGE_BY_NAME,
    StageSpec,
    config_section,
    digest_stage_weights,
    find_scene_modules,
    stage_key,
)
from flows.pipeline.issue_lines import group_issues
from flows.pipeline.log_cache import cached_log
from flows.pipeline.memory_plan import shrink_batch
from flows.pipeline.stage_inputs import open_inputs
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ArtifactCorruptError
from genre_tasks.progress import Progress, silent
from storage.address import Address
from storage.code_digest import code_digest
from storage.opening import open_store
from storage.store import Artifact, Provenance, Store


@dataclass(frozen=True)
class Job:
    """What to reconstruct, as plain values that a process can be given.

    Attributes:
        log: the log's URI, such as ``pandaset:PATH/002``.
        chunk: number of the chunk in the log, from 0.
        store: folder (or URI) of the store.
        config: the whole effective configuration, as JSON values.
    """

    log: str
    chunk: int
    store: str
    config: dict[str, Any] = field(hash=False)


@dataclass(frozen=True)
class ArtifactRef:
    """A reference that tasks exchange in place of an artifact's value.

    Attributes:
        stage: the stage that made the artifact.
        key: the artifact's key.
        payload_digest: digest of its files; later keys depend on it.
        address: where it is in the store.
        cached: whether it was in the store already.
        note: a warning for the user, such as that a damaged artifact was computed again.
    """

    stage: str
    key: str
    payload_digest: str
    address: Address
    cached: bool
    note: str = ""


class FoundArtifact(NamedTuple):
    """What the store holds for a stage.

    Attributes:
        address: where the artifact is, or will be.
        ref: the verified artifact; ``None`` if there is none.
        note: why an artifact that is there cannot be used; empty if there is nothing to say.
    """

    address: Address
    ref: ArtifactRef | None
    note: str


def compute_key(spec: StageSpec, job: Job, inputs: Mapping[str, ArtifactRef]) -> tuple[str, str | None]:
    """Computes the key of a stage's artifact from everything that its payload depends on.

    Args:
        spec: the stage.
        job: log, chunk, store and configuration.
        inputs: references of at least the stage's inputs, by stage name.

    Returns:
        The key, and the digest of the weights that the stage loads (``None`` without weights).

    Raises:
        InputError: the log or the weights do not exist.
        KeyError: an input is missing.
    """
    config = PipelineConfig.model_validate(job.config)
    # Payload digests and not keys: an input that was computed again, but came out the same, changes no later key.
    digests = {name: inputs[name].payload_digest for name in spec.inputs}
    if spec.needs_log:
        log = cached_log(job.log)
        # By the log's content, so that one that was moved keeps its keys; and by its names, which the payload has.
        digests |= {"log": log.digest(), "name": f"{log.dataset}/{log.name}", "chunk": str(job.chunk)}
    weights = digest_stage_weights(spec, config)
    return stage_key(spec, config, digests, weights, reading_modules(spec, job)), weights


def reading_modules(spec: StageSpec, job: Job) -> tuple[str, ...]:
    """Names the modules that read the log and files of Gaussians, whose code is part of the stage's code.

    Args:
        spec: the stage.
        job: says which log and files are read.

    Returns:
        Module names; nothing for a stage that reads neither.
    """
    reader = (type(cached_log(job.log)).__module__,) if spec.needs_log else ()
    return (*reader, *find_scene_modules(spec, PipelineConfig.model_validate(job.config)))


def artifact_address(stage: str, job: Job, key: str) -> Address:
    """Builds the address in the store of one stage's artifact.

    Args:
        stage: the stage's name.
        job: says which log and chunk.
        key: the artifact's key.

    Returns:
        The address, whether there is an artifact or not.
    """
    log = cached_log(job.log)
    return Address(dataset=log.dataset, log=log.name, chunk=job.chunk, stage=stage, key=key)


def find_artifact(spec: StageSpec, job: Job, inputs: Mapping[str, ArtifactRef], repair: bool = False) -> FoundArtifact:
    """Looks in the store for a stage's artifact and verifies it.

    Args:
        spec: the stage.
        job: log, chunk, store and configuration.
        inputs: references of at least the stage's inputs, by stage name.
        repair: whether a damaged artifact is removed, so that it can be computed again; under its lease alone.

    Returns:
        The artifact's address, its reference if a sound one is there, and a note if a damaged one is there.

    Raises:
        InputError: the log or the weights do not exist.
    """
    store = open_store(job.store)
    key, _ = compute_key(spec, job, inputs)
    address = artifact_address(spec.name, job, key)
    artifact = None
    try:
        if (artifact := store.find(address)) is not None:
            store.verify(artifact)
    except ArtifactCorruptError as error:
        # Damage is no error of the run: the artifact is computed again, and the note says so.
        if repair:
            # Just the one that was found: at its address there may be a sound one by now.
            store.discard(artifact or address)
        return FoundArtifact(address, None, f"{error.problem} ({error.file}): computed again")
    return FoundArtifact(address, None if artifact is None else _reference(artifact, cached=True), "")


@observed
def run_stage(
    stage: str,
    job: Job,
    inputs: Mapping[str, ArtifactRef],
    attempt: int = 0,
    progress: Progress = silent,
    slot: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> ArtifactRef:
    """Makes a stage's artifact: takes it from the store if a sound one is there, else computes and commits it.

    Inputs are read back from the store and verified there, so a stage never works on what only memory holds.

    Args:
        stage: the stage's name in :data:`flows.pipeline.definition.PIPELINE`.
        job: log, chunk, store and configuration.
        inputs: references of at least the stage's inputs, by stage name.
        attempt: how many tries before this one ran out of memory. The stage's ``batch_setting`` is halved that often,
            which changes the payload by rounding at most.
        progress: called with how far the computation is.
        slot: makes the context that the computation runs in, such as one that waits for a GPU.

    Returns:
        The reference of the artifact.

    Raises:
        ArtifactCorruptError: an input is damaged; where its bytes are, the next run computes it again.
        ResourceError: memory or disk does not suffice.
        GenreError: any other kind, as the stage raises it.

    Example::

        job = Job("synthetic:street?seed=1000", 0, "genre-store", load_configuration("demo").model_dump(mode="json"))
        ingested = run_stage("ingest", job, {})
        planned = run_stage("effects", job, {"ingest": ingested})
    """
    spec = STAGE_BY_NAME[stage]
    address, ref, note = find_artifact(spec, job, inputs)
    note_key(address.key)
    if ref is not None:
        return ref
    store = open_store(job.store)
    try:
        with store.lease(address, measure_lease_wait(progress)):
            # The process that had the lease before has probably committed the artifact, or replaced a damaged one.
            _, ref, damage = find_artifact(spec, job, inputs, repair=True)
            if ref is not None:
                return ref
            note = damage or note
            # Only here, as what comes from the store needs no slot.
            with slot():
                artifact = _compute_artifact(spec, job, inputs, store, address, note, attempt, progress)
            trim_memory()  # only now, as the stage's values are gone
    except ArtifactCorruptError:
        # Outside of lease and slot, for which a process may wait that has the input's lease.
        addresses = [artifact_address(inputs[name].stage, job, inputs[name].key) for name in spec.inputs]
        discard_damaged_inputs(store, addresses, progress)
        raise
    return _reference(artifact, cached=False, note=note)


@memory_errors_translated()
def _compute_artifact(
    spec: StageSpec,
    job: Job,
    inputs: Mapping[str, ArtifactRef],
    store: Store,
    address: Address,
    note: str,
    attempt: int,
    progress: Progress,
) -> Artifact:
    config = PipelineConfig.model_validate(job.config)
    configured = config_section(spec, config)
    module, _, name = spec.function.partition(":")
    # Read here and not before the look-up: a hit reads the manifests alone. It may take as much memory as the stage.
    artifacts = {name: _find_input(store, inputs[name], job) for name in spec.inputs}
    with open_inputs(spec, job.log, config, store, artifacts, is_retry=attempt > 0) as opened:
        values = opened.values | _special_arguments(spec, job)
        # The import counts: a first run's seconds include loading torch, as a user's clock does.
        with measure_usage() as usage:
            function = getattr(importlib.import_module(module), name)
            section = shrink_batch(spec, configured, attempt)
            value = function(section, *(values[argument] for argument in spec.arguments), progress=progress)
        # Large images of the inputs need not be there while the result is written.
        values.clear()
        opened.values.clear()
        provenance = Provenance(
            inputs={name: inputs[name].key for name in spec.inputs},
            # As configured, not with the smaller batch of a retry, which is no part of the result.
            configuration=configured.model_dump(mode="json"),
            code_digest=code_digest(spec.module, lazy_modules=(*spec.lazy_modules, *reading_modules(spec, job))),
            weights_digest=digest_stage_weights(spec, config),
            seconds=usage.seconds,
            peak_mib=usage.peak_mib,
            environment=describe_environment(),
            measurements={
                "cpu_seconds": usage.cpu_seconds,
                "predicted_mib": opened.predicted_mib,
                "marks": group_issues(getattr(value, "log_issues", ())),
            },
            warnings=(note,) if note else (),
        )
        # The first writer wins: if another process has committed this key meanwhile, its artifact is the result.
        return store.commit(address, spec.kind, value, provenance)


def open_artifact(job: Job, ref: ArtifactRef) -> Artifact:
    """Opens the artifact behind a reference: its folder and its manifest.

    Args:
        job: the job that the reference comes from.
        ref: the reference.

    Returns:
        The artifact; its files are not verified.

    Raises:
        ArtifactCorruptError: the artifact is gone, or its manifest cannot be trusted.
    """
    return _find_input(open_store(job.store), ref, job)


def read_artifact(job: Job, ref: ArtifactRef) -> Any:
    """Reads the value behind a reference.

    Args:
        job: the job that the reference comes from.
        ref: the reference.

    Returns:
        The stage's result, such as a ``Chunk`` or a ``Reconstruction``.

    Raises:
        ArtifactCorruptError: the artifact is gone or damaged; files are verified before they are read.
    """
    return open_store(job.store).read(open_artifact(job, ref))


def _special_arguments(spec: StageSpec, job: Job) -> dict[str, Any]:
    values: dict[str, Any] = {"chunk_index": job.chunk, "stage_name": spec.name.removeprefix("evaluate/")}
    if spec.needs_log:
        log = cached_log(job.log)
        values |= {"log": log, "truth": log.truth}
    return values


def _find_input(store: Store, ref: ArtifactRef, job: Job) -> Artifact:
    artifact = store.find(artifact_address(ref.stage, job, ref.key))
    # Another process may have discarded the artifact since its key was computed.
    if artifact is None:
        raise ArtifactCorruptError(
            f"the artifact of {ref.stage} vanished while the run was going on",
            remedy="Run again: it is computed again.",
            file=str(ref.address),
        )
    count_read(artifact.manifest.files)
    return artifact


def _reference(artifact: Artifact, cached: bool, note: str = "") -> ArtifactRef:
    manifest = artifact.manifest
    if not cached:
        count_written(manifest.files)
    return ArtifactRef(manifest.stage, manifest.key, manifest.payload_digest, artifact.address, cached, note)
