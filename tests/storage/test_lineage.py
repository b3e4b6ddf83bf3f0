"""Ancestors, descriptions and pictures."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from flows.plots.artifact_pictures import contact_sheet, draw_artifact, draw_from_above, spread_indices
from genre_tasks.errors import ArtifactCorruptError
from storage.lineage import find_ancestors, summarise_files
from storage.local import LocalStore, Provenance
from tests.contracts.store_suite import address
from tests.storage.artifact_values import MAKERS, make


@pytest.fixture
def store(tmp_path: Path) -> LocalStore:
    return LocalStore(tmp_path)


def png(color: tuple[int, int, int], size: tuple[int, int] = (64, 32)) -> bytes:
    sink = io.BytesIO()
    Image.new("RGB", size, color).save(sink, "PNG")
    return sink.getvalue()


def test_ancestors_nearest_first_each_once(store: LocalStore) -> None:
    value = make("evaluation")
    keys = {"ingest": "1" * 64, "initial": "2" * 64, "gnet": "3" * 64, "evaluate/gnet": "4" * 64}
    inputs = {
        "ingest": {"log": "9" * 64},
        "initial": {"ingest": keys["ingest"]},
        "gnet": {"initial": keys["initial"], "ingest": keys["ingest"]},
        "evaluate/gnet": {"gnet": keys["gnet"], "ingest": keys["ingest"]},
    }
    made = {s: store.commit(address(s, k), "evaluation", value, Provenance(inputs[s])) for s, k in keys.items()}
    store.commit(address("gnet", keys["gnet"], chunk=1), "evaluation", value)
    found = [(a.address.stage, a.address.chunk) for a in find_ancestors(store, made["evaluate/gnet"])]
    assert found == [("gnet", 0), ("ingest", 0), ("initial", 0)]
    store.discard(made["initial"])
    assert [a.address.stage for a in find_ancestors(store, made["gnet"])] == ["ingest"]
    assert find_ancestors(store, made["ingest"]) == []


def test_description_of_gaussians(store: LocalStore) -> None:
    value = make("reconstruction")
    artifact = store.commit(address(), "reconstruction", value)
    tables = {t.name: t.rows for t in summarise_files(store, artifact)}
    rows = {r["column"]: r for r in tables["gaussians.parquet: 13 rows"]}
    x = value.scene.gaussians.means[:, 0].double()
    assert rows["x"]["min"] == x.min().item() and rows["x"]["max"] == x.max().item()
    assert abs(rows["x"]["mean"] - x.mean().item()) < 1e-9 and rows["x"]["note"] == "metres"
    assert rows["node"]["max"] == int(value.scene.nodes.max()) and rows["node"]["type"] == "int64"


@pytest.mark.parametrize("kind", MAKERS)
def test_every_kind_can_be_described(store: LocalStore, kind: str) -> None:
    tables = summarise_files(store, store.commit(address(), kind, make(kind)))
    assert tables
    for table in tables:
        assert table.rows and len({tuple(r) for r in table.rows}) == 1, table.name


def test_images_are_pooled(store: LocalStore) -> None:
    value = make("novel_views")
    tables = {t.name: t.rows for t in summarise_files(store, store.commit(address(), "novel_views", value))}
    rows = {r["column"]: r for r in tables["views/*.exr: 2 images"]}
    assert rows["Z"]["max"] == value.depth.max().item() and rows["Z"]["type"] == "float32 5x7"
    assert abs(rows["lidar.A"]["mean"] - value.lidar_alpha.double().mean().item()) < 1e-9


def test_pictures_of_every_kind(store: LocalStore) -> None:
    chunk = make("chunk")
    chunk = replace(chunk, views=tuple(replace(v, image=png((200, 0, 0))) for v in chunk.views))
    for kind in MAKERS:
        image = draw_artifact(store, store.commit(address(kind), kind, chunk if kind == "chunk" else make(kind)))
        assert image is not None and image.dtype == np.uint8 and image.ndim == 3 and image.shape[2] == 3
        if kind == "chunk":  # two source frames of two cameras
            assert image.shape == (244, 484, 3) and (image[5, 5] == [200, 0, 0]).all()


def test_nothing_to_show_is_none(store: LocalStore) -> None:
    empty = replace(make("evaluation"), pictures={})
    assert draw_artifact(store, store.commit(address(), "evaluation", empty)) is None
    assert contact_sheet([], 3) is None and draw_from_above(np.zeros((0, 3)), np.zeros((0, 3))) is None
    scene = MAKERS["reconstruction"](np.random.default_rng(0), 0)
    assert draw_artifact(store, store.commit(address("initial"), "reconstruction", scene)) is None


def test_corrupt_is_not_described(store: LocalStore) -> None:
    artifact = store.commit(address(), "evaluation", make("evaluation"))
    (artifact.path / "curve.parquet").write_bytes(b"")
    for look in (summarise_files, draw_artifact):
        with pytest.raises(ArtifactCorruptError, match=r"curve\.parquet"):
            look(store, artifact)


def test_from_above_puts_the_highest_in_front_and_left_is_up() -> None:
    grid = torch.cartesian_prod(torch.linspace(0, 20, 41), torch.linspace(0, 10, 21))
    low = torch.cat([grid, torch.zeros(len(grid), 1)], 1)
    points = torch.cat([low + torch.tensor([0, 0, 1.0]), low]).numpy()
    colors = np.repeat([[1.0, 0, 0], [0, 1.0, 0]], len(low), 0).astype(np.float32)
    image = draw_from_above(points, colors)
    assert image is not None and image.shape[1] > 1.8 * image.shape[0]
    drawn = image[(image != 24).any(2)]
    assert (drawn == [255, 0, 0]).all() and len(drawn) > 500
    corner = draw_from_above(
        np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [4, 4, 0]] * 60, np.float32), np.ones((240, 3), np.float32)
    )
    assert corner is not None and (corner[0, 0] == 255).all()


def test_evenly() -> None:
    assert spread_indices(0, 3) == [] and spread_indices(2, 5) == [0, 1] and spread_indices(10, 3) == [0, 4, 9]
