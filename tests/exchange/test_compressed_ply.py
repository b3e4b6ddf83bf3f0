"""SuperSplat's compressed PLY, read only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.exchange.cloud_errors import CloudErrors, compare_clouds
from genre_tasks.exchange.compressed_ply import COMPRESSED_PLY
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply import PLY
from genre_tasks.exchange.types import SplatCloud
from tests.exchange.compressed_ply_encoder import write_compressed_ply
from tests.exchange.format_suite import FormatSuite
from tests.exchange.gsply_process import write_and_read_by_gsply
from tests.exchange.splat_clouds import make_cloud


class TestCompressedPly(FormatSuite):
    # Half a step of 10 bits over 1000 m and over 7, of three components of 10 bits, and of 8 bits.
    name = "compressed.ply"
    sh_degrees = (0, 1, 2, 3)
    keeps_antialiasing = False
    # Harmonics are cut to ±4 by the encoder here; a chunk's neighbours of a far one get its coarse steps.
    cut_attributes = frozenset({"sh_dc", "sh_rest"})
    tolerances = CloudErrors(
        means_m=0.51 * 1000 / 1023,
        log_scales=0.51 * 7 / 1023,
        angles_rad=0.006,
        opacities=0.51 / 255,
        colors=0.51 / 255,
        sh_rest=0.51 / 32,
    )
    relative = 0.51 * 2 / 1023

    def write(self, path: Path, cloud: SplatCloud) -> None:
        write_compressed_ply(path, cloud)

    def losses_of(self, cloud: SplatCloud) -> tuple[str, ...]:
        # The encoder cuts, and the format itself writes nothing.
        return ("cut",) * int(max(np.abs(cloud.sh_dc).max(), np.abs(cloud.sh_rest).max(initial=0)) > 100)


def test_it_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"not written.*spz"):
        COMPRESSED_PLY.write(tmp_path / "a.compressed.ply", make_resting_scene(make_cloud(1)))


def test_files_of_the_first_supersplat(tmp_path: Path) -> None:
    cloud = make_cloud(300)
    write_compressed_ply(tmp_path / "a.compressed.ply", cloud, color_ranges=False)
    found = COMPRESSED_PLY.read(tmp_path / "a.compressed.ply").nodes[0].cloud
    assert compare_clouds(cloud, found).colors <= 0.51 / 255


def test_every_component_may_be_the_largest(tmp_path: Path) -> None:
    cloud = make_cloud(8)
    quats = np.concatenate([np.eye(4), -np.eye(4)]).astype(np.float32) + np.float32(0.1)
    turned = SplatCloud(**{**vars(cloud), "quats": quats})
    write_compressed_ply(tmp_path / "a.compressed.ply", turned)
    found = COMPRESSED_PLY.read(tmp_path / "a.compressed.ply").nodes[0].cloud
    assert compare_clouds(turned, found).angles_rad < 0.004


def test_gsply_reads_the_same(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    theirs = write_and_read_by_gsply(path, make_cloud(60, 3), compressed=True)
    errors = compare_clouds(theirs, COMPRESSED_PLY.read(path).nodes[0].cloud)
    assert not errors.exceed(CloudErrors(1e-5, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)), errors


def test_too_few_chunks(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    write_compressed_ply(path, make_cloud(257))
    body = path.read_bytes().replace(b"element vertex 257", b"element vertex 513")
    path.write_bytes(body + bytes(16 * 256))
    with pytest.raises(InputError, match="513 Gaussians need 3 chunks, not 2"):
        COMPRESSED_PLY.read(path)


def test_a_plain_ply_file_is_not_one(tmp_path: Path) -> None:
    path = tmp_path / "a.compressed.ply"
    PLY.write(path, make_resting_scene(make_cloud(2)))
    with pytest.raises(InputError, match="packed_position"):
        COMPRESSED_PLY.read(path)
