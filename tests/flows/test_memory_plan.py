"""Memory is predicted before a stage starts; what does not fit lies on disk, and no result depends on it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from flows.configuration import load_configuration
from flows.pipeline import memory_limit, memory_plan, stage_inputs
from flows.pipeline.definition import PIPELINE, STAGE_BY_NAME
from flows.pipeline.memory_plan import (
    ChunkSize,
    StageMemory,
    choose_threads,
    estimate_chunk_size,
    grow_until,
    needs_disk,
    predict_memory,
    shrink_batch,
)
from flows.pipeline.stage_runner import Job, run_stage
from flows.preflight import machine_checks
from genre_tasks import image_memory
from genre_tasks.config import LimitsConfig, PipelineConfig
from genre_tasks.errors import ResourceError
from genre_tasks.losses.ssim import KEPT_PIXELS
from storage.opening import open_store
from tests.fakes import FakeLog
from tests.faults.small_run import LOG, SETTINGS

HD = ChunkSize(6, 30, 60, 1280, 720, 1920 * 1080, 310_000)


def test_small_images_are_predicted_at_their_size() -> None:
    log = FakeLog(width_px=128, height_px=72)
    size = estimate_chunk_size(log, log.cameras, load_configuration("hd"))
    assert (size.width_px, size.height_px) == (128, 72)


def test_novel_views_that_take_turns_are_half_as_many() -> None:
    log = FakeLog()
    sizes = [
        estimate_chunk_size(log, log.cameras, load_configuration("small", settings=[f"novel_views.every={n}"]))
        for n in (1, 2)
    ]
    # One frame more where the number of source frames is odd.
    frames = sizes[0].source_views // len(log.cameras)
    assert [size.novel_views for size in sizes] == [2 * len(log.cameras) * n for n in (frames, (frames + 1) // 2)]
    assert sizes[0].source_views == sizes[1].source_views


def limited(memory_gib: float | None, preset: str = "hd") -> PipelineConfig:
    return load_configuration(preset, settings=[f"limits.memory_gib={json.dumps(memory_gib)}"])


@pytest.mark.parametrize(
    ("limit_gib", "expected"), [(4.0, True), (5.0, False)], ids=["below what it takes", "above what it takes"]
)
def test_images_lie_on_disk_where_they_do_not_fit(limit_gib: float, expected: bool) -> None:
    memory = StageMemory(working_mib=2048, images_mib=2048, reuse=1.25)
    assert needs_disk("enet", memory, limited(limit_gib)) is expected


def test_without_a_limit_it_is_the_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = StageMemory(working_mib=2048, images_mib=2048)
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 64.0)
    assert not needs_disk("enet", memory, limited(None))
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 4.0)
    assert needs_disk("enet", memory, limited(None))
    # A machine that is too small is tried: the prediction may be too high.
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 1.0)
    assert needs_disk("enet", memory, limited(None))


def test_a_limit_above_the_machines_does_not_switch_its_guard_off(monkeypatch: pytest.MonkeyPatch) -> None:
    memory = StageMemory(working_mib=2048, images_mib=2048)
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 4.0)
    assert needs_disk("enet", memory, limited(64.0))
    # The user allows as much: that the machine has less is no error.
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 1.0)
    assert needs_disk("enet", memory, limited(64.0))


def test_a_limit_above_the_machines_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_checks, "memory_limit_gib", lambda: 7.5)
    names = [spec.name for spec in PIPELINE]
    assert machine_checks.assess_memory(HD, limited(7.0), names) is None
    warning = machine_checks.assess_memory(HD, limited(8.0), names)
    assert warning is not None and "the limit on memory is 8.0 GiB, and this process may use 7.5 GiB" in warning
    # What the run needs is the more important thing to say.
    monkeypatch.setattr(machine_checks, "memory_limit_gib", lambda: 1.0)
    warning = machine_checks.assess_memory(HD, limited(8.0), names)
    assert warning is not None and "the run needs about" in warning


def test_a_limit_that_is_too_low_is_an_error_before_the_stage() -> None:
    with pytest.raises(ResourceError, match=r"enet needs about 2\.0 GiB.*may use 1\.0 GiB.*--memory"):
        needs_disk("enet", StageMemory(2048, 10), limited(1.0))


def test_a_scene_from_a_file_has_a_remedy_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The setting for the number of LiDAR points does nothing there."""
    from_file = load_configuration("hd", settings=[f"initial.scene={tmp_path / 'a.ply'}", "limits.memory_gib=1"])
    monkeypatch.setattr(machine_checks, "memory_limit_gib", lambda: 1.0)
    names = [spec.name for spec in PIPELINE]
    for config, fewer in (
        (from_file, "remove Gaussians from the file."),
        (limited(1.0), "smaller ingest.width_px or initial.max_points."),
    ):
        with pytest.raises(ResourceError) as caught:
            machine_checks.assess_memory(HD, config, names)
        assert caught.value.remedy.startswith("Allow more (--memory)") and caught.value.remedy.endswith(fewer)
    warnings = [
        machine_checks.assess_memory(HD, config.model_copy(update={"limits": LimitsConfig()}), names) or ""
        for config in (from_file, limited(1.0))
    ]
    assert ["initial.max_points" in warning for warning in warnings] == [False, True]
    assert "fewer Gaussians in the file" in warnings[0]


def test_a_budget_chooses_what_fits_so_that_the_limit_is_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [spec.name for spec in PIPELINE]
    monkeypatch.setattr(machine_checks, "memory_limit_gib", lambda: 64.0)
    assert machine_checks.assess_memory(HD, limited(1.0), names, has_budget=True) is None
    monkeypatch.setattr(machine_checks, "memory_limit_gib", lambda: 1.0)
    warning = machine_checks.assess_memory(HD, limited(None), names, has_budget=True)
    assert warning is not None and "the budget chooses among its table's settings that need less" in warning


def test_under_a_limit_freed_memory_goes_back(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    # A heap that one stage has grown stays, and the next one takes it: a limit has to hold from the first stage on.
    for config, factor in ((limited(None), 1.29), (limited(8.0), 1.0)):
        assert predict_memory("gnet", HD, config, 2).reuse == factor
    called: list[str] = []
    for name in ("reuse_freed_memory", "return_freed_memory"):
        monkeypatch.setattr(stage_inputs, name, lambda name=name: called.append(name))
    for settings in ([], ["limits.memory_gib=8"]):
        config = load_configuration("demo", settings=[*SETTINGS, *settings])
        run_stage("ingest", Job(LOG, 0, str(tmp_path / f"{len(called)}"), config.model_dump(mode="json")), {})
    assert called == ["reuse_freed_memory", "return_freed_memory"]


def test_memory_grows_with_what_a_stage_works_on() -> None:
    config = limited(None)
    for spec in PIPELINE:
        before = predict_memory(spec.name, HD, config, 2)
        larger = predict_memory(
            spec.name, replace(HD, width_px=1920, height_px=1080, native_px=2 * HD.native_px), config, 2
        )
        # The initial scene is made from points alone.
        assert larger.in_memory_mib > before.in_memory_mib or spec.name == "initial"
        # Stages that hold no images of many views have nothing to put on disk.
        assert before.with_images_on_disk_mib == pytest.approx(before.in_memory_mib - before.images_mib)
        # More views take disk alone.
        longer = predict_memory(spec.name, replace(HD, source_views=300, novel_views=600), config, 2)
        assert longer.working_mib == before.working_mib


def test_small_images_are_those_whose_statistics_are_kept() -> None:
    assert memory_plan._LARGEST_WITH_STATISTICS_PX == KEPT_PIXELS


def test_gaussians_are_split_before_later_stages() -> None:
    config = load_configuration("hd", settings=["gnet.refine.split_fraction=0.3", "enet.split_fraction=0.5"])
    counts = {name: grow_until(name, HD, config).gaussians for name in ("gnet", "enet", "evaluate/enet")}
    assert counts == {"gnet": 310_000, "enet": 403_000, "evaluate/enet": 604_500}


def test_a_stage_works_with_as_many_threads_as_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 64.0)
    size = replace(HD, gaussians=600_000)
    chosen = {gib: choose_threads("evaluate/enet", size, limited(gib), 16) for gib in (1.0, 3.725, 5.0, 100.0, None)}
    assert chosen[1.0] == 1 < chosen[3.725] < chosen[5.0] < chosen[100.0] == chosen[None] == 16
    for gib in (3.725, 5.0):
        fits = [predict_memory("evaluate/enet", size, limited(gib), chosen[gib] + more).working_mib for more in (0, 1)]
        assert fits[0] <= 1024 * gib < fits[1]
    # The machine's memory bounds them as well, with a larger limit or with none.
    monkeypatch.setattr(memory_limit, "memory_limit_gib", lambda: 4.0)
    bounded = {gib: choose_threads("evaluate/enet", size, limited(gib), 16) for gib in (3.4, 100.0, None)}
    assert set(bounded.values()) == {chosen[3.725]}
    # GNet's memory does not go with threads: it keeps them where it may be too large.
    assert predict_memory("gnet", size, limited(None), 1).working_mib > 3.4 * 1024
    assert choose_threads("gnet", size, limited(None), 16) == 16


def test_many_cores_do_not_pass_a_limit_that_two_keep(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine_checks, "count_cores", lambda: 64)
    for module in (machine_checks, memory_limit):
        monkeypatch.setattr(module, "memory_limit_gib", lambda: 64.0)
    names = [spec.name for spec in PIPELINE]
    assert machine_checks.assess_memory(HD, limited(4e9 / 2**30), names) is None


PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nend_header\n" + bytes(3 * 4)


@pytest.mark.parametrize(
    ("name", "content"),
    [("scene.ply", PLY), ("scene.compressed.ply", PLY), ("scene.SPLAT", bytes(3 * 32))],
    ids=["PLY", "compressed PLY", "splat"],
)
def test_a_scene_of_a_file_is_as_large_as_the_file(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    splits = ["gnet.split_fraction=1", "enet.split_fraction=1"]
    settings = [f"initial.scene={tmp_path / name}", "gnet.method=none", *splits]
    config = load_configuration("demo", settings=settings)
    log = FakeLog()
    size = estimate_chunk_size(log, log.cameras, config)
    # GNet hands it on as it is.
    counts = {stage: grow_until(stage, size, config).gaussians for stage in ("initial", "enet", "evaluate/enet")}
    assert counts == {"initial": 3, "enet": 3, "evaluate/enet": 6}


def test_a_large_scene_of_a_file_takes_memory_and_disk(tmp_path: Path) -> None:
    gaussians = 2_000_000
    file = tmp_path / "scene.splat"
    with file.open("wb") as stream:
        stream.truncate(32 * gaussians)
    log = FakeLog()
    preset = load_configuration("demo")
    config = load_configuration("demo", settings=[f"initial.scene={file}"])
    added_mib = [machine_checks.estimate_disk_mib(log, log.cameras, c, 1) for c in (preset, config)]
    assert added_mib[1] - added_mib[0] > gaussians * 100 / 2**20
    chunk = SimpleNamespace(views_with_role=lambda _: [], camera_names=["front"], width_px=64, height_px=36)
    memory, _ = stage_inputs._predict(STAGE_BY_NAME["initial"], LOG, config, {"ingest": chunk})
    assert memory.working_mib > gaussians * 1000 / 2**20


@pytest.mark.parametrize("name", ["scene.spz", "gone.ply"])
def test_a_scene_that_does_not_tell_its_size_is_taken_to_be_the_presets(tmp_path: Path, name: str) -> None:
    (tmp_path / "scene.spz").write_bytes(bytes(100))
    config = load_configuration("demo", settings=[f"initial.scene={tmp_path / name}"])
    log = FakeLog()
    size = estimate_chunk_size(log, log.cameras, config)
    assert size.gaussians == config.initial.max_points + config.initial.distant_count


def test_a_batch_is_halved_for_each_attempt_that_ran_out_of_memory() -> None:
    section = PipelineConfig().fnet
    assert [shrink_batch(STAGE_BY_NAME["fnet"], section, k).batch_views for k in range(4)] == [4, 2, 1, 1]
    gnet = PipelineConfig().gnet
    assert shrink_batch(STAGE_BY_NAME["gnet"], gnet, 3) is gnet


def test_images_on_disk_give_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A street's images are small: every stack goes to disk all the same.
    monkeypatch.setattr(image_memory, "_MIN_BYTES", 0)
    held: list[int] = []
    map_file = image_memory._map_file

    def count(folder: Path, size: int) -> torch.Tensor:
        held.append(size)
        return map_file(folder, size)

    monkeypatch.setattr(image_memory, "_map_file", count)
    digests: dict[bool, dict[str, str]] = {}
    for on_disk in (False, True):
        monkeypatch.setattr(stage_inputs, "needs_disk", lambda *_, answer=on_disk: answer)
        store = tmp_path / f"store-{on_disk}"
        job = Job(LOG, 0, str(store), load_configuration("demo", settings=SETTINGS).model_dump(mode="json"))
        refs: dict[str, Any] = {}
        for spec in PIPELINE:
            refs[spec.name] = run_stage(spec.name, job, {name: refs[name] for name in spec.inputs})
        digests[on_disk] = {name: ref.payload_digest for name, ref in refs.items()}
        assert bool(held) is on_disk
        for artifact in open_store(str(store)).artifacts():
            assert artifact.manifest.measurements["predicted_mib"] > 0
    assert digests[True] == digests[False]
