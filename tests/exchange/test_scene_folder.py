"""Exported folders: what their document says and a file does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from genre_tasks.errors import InputError
from genre_tasks.exchange.gltf.format import GLB
from genre_tasks.exchange.gltf.splat_attributes import LINEAR
from genre_tasks.exchange.linear_light import LINEAR_LOSS
from genre_tasks.exchange.moments import is_rising
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.scene_folder import SceneDocument, describe_chunk, read_scene_folder, write_document
from genre_tasks.exchange.types import ExchangeScene
from tests.exchange.gltf_files import join_glb, split_glb
from tests.exchange.splat_clouds import make_driving_scene

EXPOSURE = "Exposure is left out."
SHUTTER = "The rolling shutter is left out."


def write_folder(folder: Path, in_file: ExchangeScene, in_document: ExchangeScene) -> None:
    """An exported folder of one chunk, whose file may be an older one than its document."""
    GLB.write(folder / "chunk-0.glb", in_file)
    entry = describe_chunk(0, in_document, {}).model_copy(update={"file": "chunk-0.glb"})
    write_document(folder, SceneDocument(format="glb", layout="scenes", chunks=(entry,)))


def test_losses_of_document_and_file_are_joined_without_repeats(tmp_path: Path) -> None:
    scene = make_driving_scene()
    write_folder(tmp_path, replace(scene, losses=(EXPOSURE,)), replace(scene, losses=(EXPOSURE, SHUTTER)))
    assert read_scene_folder(tmp_path)[0].losses == (EXPOSURE, SHUTTER)
    write_folder(tmp_path, scene, replace(scene, losses=(SHUTTER,)))
    assert read_scene_folder(tmp_path)[0].losses == (SHUTTER,)


def test_moments_that_do_not_rise_are_refused(tmp_path: Path) -> None:
    scene = make_driving_scene()
    times = scene.times_s.copy()
    times[1] = times[0]
    assert is_rising(scene.times_s) and not is_rising(times)
    write_folder(tmp_path, scene, replace(scene, times_s=times))
    with pytest.raises(InputError, match="moments of chunk 0 do not fit"):
        read_scene_folder(tmp_path)


def test_losses_of_files_of_single_nodes_are_kept(tmp_path: Path) -> None:
    scene = replace(make_driving_scene(), losses=(EXPOSURE,))
    entry = describe_chunk(0, scene, {})
    described = []
    for node, node_entry in zip(scene.nodes, entry.nodes, strict=True):
        path = tmp_path / f"{node.name}.glb"
        GLB.write(path, make_resting_scene(node.cloud))
        document, binary = split_glb(path.read_bytes())
        extensions = document["meshes"][0]["primitives"][0]["extensions"]
        extensions["KHR_gaussian_splatting"]["colorSpace"] = LINEAR
        path.write_bytes(join_glb(document, binary))
        described.append(node_entry.model_copy(update={"file": path.name}))
    entry = entry.model_copy(update={"nodes": tuple(described)})
    write_document(tmp_path, SceneDocument(format="glb", layout="nodes", chunks=(entry,)))
    # All files lose the same.
    assert read_scene_folder(tmp_path)[0].losses == (EXPOSURE, LINEAR_LOSS)


def test_links_do_not_lead_out_of_a_folder(tmp_path: Path) -> None:
    scene = make_driving_scene()
    folder = tmp_path / "out"
    (folder / "inside").mkdir(parents=True)
    (tmp_path / "outside").mkdir()
    (folder / "link").symlink_to(tmp_path / "outside")
    (folder / "link.glb").symlink_to(tmp_path / "outside" / "chunk-0.glb")
    for name in ("inside/chunk-0.glb", "link/chunk-0.glb", "link.glb"):
        GLB.write(folder / name, scene)
        entry = describe_chunk(0, scene, {}).model_copy(update={"file": name})
        write_document(folder, SceneDocument(format="glb", layout="scenes", chunks=(entry,)))
        if name.startswith("inside"):
            assert len(read_scene_folder(folder)[0].nodes) == 4
        else:
            with pytest.raises(InputError, match=f"no file '{name}'"):
                read_scene_folder(folder)
