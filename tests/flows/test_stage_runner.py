"""Keys, hits and repairs of the stages, without Prefect."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from flows.configuration import load_configuration
from flows.machine.resource_usage import measure_usage
from flows.pipeline import stage_runner as room
from flows.pipeline.definition import PIPELINE, STAGE_BY_NAME, stage_key
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import ArtifactRef, Job, compute_key, run_stage
from genre_tasks.code_closure import import_closure
from genre_tasks.config import EffectsConfig, EvaluateConfig, PipelineConfig
from genre_tasks.errors import ArtifactCorruptError, InputError, ResourceError
from storage.local import LocalStore
from storage.store import Artifact
from tests.faults.small_run import LOG, SETTINGS

EARLY = ("ingest", "effects", "initial")


def job(store: Path, *settings: str, log: str = LOG) -> Job:
    config = load_configuration("demo", settings=[*SETTINGS, *settings])
    return Job(log, 0, str(store), config.model_dump(mode="json"))


def run(work: Job, *stages: str) -> dict[str, ArtifactRef]:
    refs: dict[str, ArtifactRef] = {}
    for stage in stages:
        refs[stage] = run_stage(stage, work, {name: refs[name] for name in STAGE_BY_NAME[stage].inputs})
    return refs


@pytest.mark.parametrize("where", ["open_inputs", "describe_environment"])
def test_memory_that_runs_out_beside_the_computation_is_retried_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Inputs are read before a stage, and its result is written after it."""

    def no_memory(*args: object, **options: object) -> object:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory")

    monkeypatch.setattr(room, where, no_memory)
    with pytest.raises(ResourceError, match="memory ran out"):
        run(job(tmp_path / "store"), "ingest")


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = tmp_path_factory.mktemp("filled") / "store"
    run(job(store), *EARLY)
    return store


@pytest.fixture
def store(filled: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(filled, tmp_path / "store"))  # moved, too: every hit below is one of a moved store


def cached(refs: dict[str, ArtifactRef]) -> dict[str, bool]:
    return {name: ref.cached for name, ref in refs.items()}


def test_the_pipeline_is_in_order() -> None:
    seen: set[str] = set()
    for spec in PIPELINE:
        assert set(spec.inputs) <= seen
        seen.add(spec.name)


def test_a_second_run_is_served_from_the_store(store: Path) -> None:
    assert cached(run(job(store), *EARLY)) == {"ingest": True, "effects": True, "initial": True}


def test_an_unrelated_setting_keeps_the_key_and_a_related_one_changes_it(store: Path) -> None:
    other = run(job(store, "gnet.iterations=3", "evaluate.every=2"), *EARLY)
    assert cached(other) == {"ingest": True, "effects": True, "initial": True}
    changed = run(job(store, "initial.opacity=0.5"), *EARLY)
    assert cached(changed) == {"ingest": True, "effects": True, "initial": False}


def test_a_plan_of_effects_is_part_of_later_keys(store: Path) -> None:
    other = run(job(store, "effects.lidar_depth=off"), *EARLY)
    assert cached(other) == {"ingest": True, "effects": False, "initial": False}
    spec, config = STAGE_BY_NAME["gnet"], load_configuration("demo")
    keys = {stage_key(spec, config, {"ingest": "a", "initial": "b", "effects": e}, "w") for e in "cd"}
    assert len(keys) == 2


def test_the_effects_code_is_part_of_the_plans_key() -> None:
    spec, root = STAGE_BY_NAME["effects"], Path(room.__file__).parents[2]
    files = import_closure(spec.module, spec.lazy_modules, root).modules
    assert {f"genre_tasks.effects.{name}" for name in EffectsConfig.model_fields} <= set(files)
    assert "genre_tasks.effects.exposure" not in import_closure(spec.module, (), root).modules  # why it has to be said


def test_a_setting_that_only_bounds_memory_keeps_the_key(store: Path) -> None:
    spec = STAGE_BY_NAME["fnet"]
    inputs = {"ingest": "a", "novel_views": "b"}
    keys = {
        stage_key(spec, load_configuration("demo", settings=[f"fnet.batch_views={n}"]), inputs, "w") for n in (1, 4)
    }
    assert len(keys) == 1


def test_inputs_weights_and_reader_are_part_of_the_key() -> None:
    spec, config = STAGE_BY_NAME["gnet"], load_configuration("demo")
    base = stage_key(spec, config, {"ingest": "a", "initial": "b"}, "w")
    assert base != stage_key(spec, config, {"ingest": "a", "initial": "c"}, "w")
    assert base != stage_key(spec, config, {"ingest": "a", "initial": "b"}, "v")
    ingest = STAGE_BY_NAME["ingest"]
    readers = {
        stage_key(ingest, config, {"log": "x"}, None, (f"genre_tasks.logs.{m}",))
        for m in ("pandaset.reader", "synthetic.log")
    }
    assert len(readers) == 2


def test_the_key_follows_the_logs_content_and_the_chunk(store: Path) -> None:
    spec = STAGE_BY_NAME["ingest"]
    here, _ = compute_key(spec, job(store), {})
    other, _ = compute_key(spec, job(store, log=LOG.replace("seed=900", "seed=901")), {})
    assert here != other


def test_the_key_follows_the_logs_name(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = STAGE_BY_NAME["ingest"]
    here, _ = compute_key(spec, job(store), {})
    monkeypatch.setattr(type(cached_log(LOG)), "name", "renamed")
    # The name is in the payload, so that a renamed log's artifact is another one.
    assert compute_key(spec, job(store), {})[0] != here


def test_deleting_an_artifact_computes_it_again_and_nothing_else(store: Path) -> None:
    refs = run(job(store), *EARLY)
    shutil.rmtree(store / str(refs["ingest"].address))
    again = run(job(store), *EARLY)
    assert cached(again) == {"ingest": False, "effects": True, "initial": True}
    assert again["ingest"].payload_digest == refs["ingest"].payload_digest


@pytest.mark.parametrize("damage", ["flip", "truncate", "remove", "add"])
def test_a_damaged_file_is_found_named_and_computed_again(store: Path, damage: str) -> None:
    refs = run(job(store), *EARLY)
    file = sorted((store / str(refs["initial"].address)).glob("*.parquet"))[0]
    data = bytearray(file.read_bytes())
    if damage == "flip":
        data[len(data) // 2] ^= 4
        file.write_bytes(data)
    elif damage == "truncate":
        file.write_bytes(data[: len(data) // 2])
    elif damage == "remove":
        file.unlink()
    else:
        (file.parent / "stray.bin").write_bytes(b"x")
    again = run(job(store), *EARLY)
    assert cached(again) == {"ingest": True, "effects": True, "initial": False}
    assert ("stray.bin" if damage == "add" else file.name) in again["initial"].note
    assert again["initial"].payload_digest == refs["initial"].payload_digest


def test_a_repair_leaves_what_another_process_has_computed_meanwhile(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ref = run(job(store), *EARLY)["initial"]
    sorted((store / str(ref.address)).glob("*.parquet"))[0].write_bytes(b"else")
    verify = LocalStore.verify
    replaced: list[ArtifactRef] = []

    def verify_slowly(opened: LocalStore, artifact: Artifact) -> None:
        try:
            verify(opened, artifact)
        except ArtifactCorruptError:
            # After this one found the damage, and before it does anything, another one has repaired it.
            monkeypatch.setattr(LocalStore, "verify", verify)
            replaced.append(run(job(store), *EARLY)["initial"])
            raise

    monkeypatch.setattr(LocalStore, "verify", verify_slowly)
    again = run(job(store), *EARLY)["initial"]
    assert [made.cached for made in replaced] == [False] and again.cached
    assert replaced[0].note and not again.note


def test_an_input_that_only_its_bytes_show_to_be_damaged_is_removed(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A bucket's listing shows nothing of a damaged disk, and look-ups trust the listing."""
    verify, read = LocalStore.verify, LocalStore.read

    def trust_listing(opened: LocalStore, artifact: Artifact, reads_all: bool = False) -> None:
        if reads_all:
            verify(opened, artifact)

    def read_all(opened: LocalStore, artifact: Artifact) -> object:
        verify(opened, artifact)
        return read(opened, artifact)

    work = job(store, "initial.opacity=0.5")
    early = run(work, "ingest", "effects")
    sorted((store / str(early["ingest"].address)).glob("*.parquet"))[0].write_bytes(b"else")
    monkeypatch.setattr(LocalStore, "verify", trust_listing)
    monkeypatch.setattr(LocalStore, "read", read_all)
    with pytest.raises(ArtifactCorruptError, match="Run again"):
        run(work, *EARLY)
    opened = LocalStore(store)
    assert [opened.find(early[name].address) is None for name in ("ingest", "effects")] == [True, False]
    assert cached(run(work, *EARLY)) == {"ingest": False, "effects": True, "initial": False}


def test_what_comes_from_the_store_waits_for_no_slot(store: Path) -> None:
    taken: list[str] = []

    @contextmanager
    def slot() -> Iterator[None]:
        taken.append("taken")
        yield

    refs = run(job(store), *EARLY)
    assert run_stage("initial", job(store), refs, slot=slot).cached and taken == []
    assert not run_stage("initial", job(store, "initial.opacity=0.25"), refs, slot=slot).cached
    assert taken == ["taken"]


def test_out_of_memory_becomes_a_resource_error() -> None:
    with pytest.raises(ResourceError, match="memory ran out"), measure_usage():
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 9 bytes")
    with pytest.raises(RuntimeError, match="shapes"), measure_usage():
        raise RuntimeError("shapes do not fit")


def test_an_impossible_chunk_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        # Frame 0 alone is a source frame, and two are needed.
        run(job(tmp_path / "store", "ingest.source_every=8", log=LOG.replace("frames=8", "frames=4")), "ingest")
    assert not [p for p in (tmp_path / "store").rglob("*") if p.is_file()]


def test_the_bytes_of_a_network_are_part_of_an_evaluations_key_and_its_name_is_not(tmp_path: Path) -> None:
    spec = STAGE_BY_NAME["evaluate/gnet"]
    inputs = dict.fromkeys((*spec.inputs, "log", "chunk"), "x")

    def key(file: Path) -> str:
        return stage_key(spec, PipelineConfig(evaluate=EvaluateConfig(inception=str(file))), inputs, None)

    one, same, other = (tmp_path / name for name in ("one.pt", "same.pt", "other.pt"))
    for file, data in ((one, b"a"), (same, b"a"), (other, b"b")):
        file.write_bytes(data)
    assert key(one) == key(same) != key(other)
