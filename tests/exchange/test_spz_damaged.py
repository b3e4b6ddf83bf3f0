"""SPZ files of older versions, and those that are damaged or claim more than they have."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from genre_tasks.errors import InputError
from genre_tasks.exchange.spz.format import SPZ
from genre_tasks.exchange.types import ExchangeScene
from tests.exchange.splat_clouds import make_cloud
from tests.exchange.test_spz import write

COUNT = 3
# Positions in SPZ's axes that half floats and 24 bits both hold exactly.
POSITIONS = np.array([[1.5, -2.25, 8.0], [0.0, 0.125, -64.0], [-3.0, 2.0, 0.5]])
IN_SCENE = np.array([[-8.0, -1.5, -2.25], [64.0, 0.0, 0.125], [-0.5, 3.0, 2.0]])
REST = bytes([51, 128, 204, *range(100, 109), *[160] * 9])


def build_old_file(version: int, flags: int = 0, extra: bytes = b"", count: int = COUNT) -> bytes:
    """A file of version 1 to 3 by its layout alone: three Gaussians of degree 0 with known rotations."""
    if version == 1:
        positions = POSITIONS.astype("<f2").tobytes()
    else:
        fixed = (POSITIONS * 4096).astype(int).ravel().tolist()
        positions = b"".join(value.to_bytes(3, "little", signed=True) for value in fixed)
    if version < 3:
        # Half a turn about x, none, and a quarter about z.
        rotations = bytes([255, 128, 128, 128, 128, 128, 128, 128, 218])
    else:
        # The largest part is w, which is number 3; the last of the others has the lowest bits.
        quarter = (3 << 30) | 511
        rotations = struct.pack("<III", 0, 3 << 30, quarter)
    header = struct.pack("<4sIIBBBx", b"NGSP", version, count, 0, 12, flags)
    return header + positions + REST + rotations + extra


def read_bytes(folder: Path, data: bytes) -> ExchangeScene:
    path = folder / "file.spz"
    path.write_bytes(data)
    return SPZ.read(path)


def assert_refused(folder: Path, data: bytes, problem: str) -> None:
    with pytest.raises(InputError, match=problem) as caught:
        read_bytes(folder, data)
    assert caught.value.file == str(folder / "file.spz")


@pytest.mark.parametrize("version", [1, 2, 3])
def test_older_versions(tmp_path: Path, version: int) -> None:
    scene = read_bytes(tmp_path, gzip.compress(build_old_file(version)))
    cloud = scene.nodes[0].cloud
    np.testing.assert_array_equal(cloud.means, IN_SCENE)
    np.testing.assert_allclose(1 / (1 + np.exp(-cloud.logit_opacities)), [0.2, 128 / 255, 0.8], atol=1e-6)
    np.testing.assert_array_equal(cloud.log_scales, np.zeros((COUNT, 3)))
    np.testing.assert_allclose(cloud.sh_dc[0], (np.arange(100, 103) / 255 - 0.5) / 0.15, atol=1e-6)
    # About SPZ's x, to the right: that is minus our y. About its z, backwards: minus our x.
    half = [0, 0, -1, 0]
    quarter = [np.sqrt(0.5), -np.sqrt(0.5), 0, 0]
    expected = np.array([half, [1, 0, 0, 0], quarter])
    alignment = np.abs((cloud.quats * expected).sum(1)) / np.linalg.norm(cloud.quats, axis=1)
    assert alignment.min() > 1 - 2e-4
    assert scene.losses == ()


def test_half_floats_that_are_not_finite(tmp_path: Path) -> None:
    data = bytearray(build_old_file(1))
    data[16:18] = np.array(np.inf, "<f2").tobytes()
    assert_refused(tmp_path, gzip.compress(bytes(data)), "position is not finite in 1 Gaussians")


def test_extensions_are_losses_and_other_axes_are_refused(tmp_path: Path) -> None:
    orbit = struct.pack("<IIfff", 0xADBE0002, 12, 0.0, 1.0, 2.0)
    right_up_back = struct.pack("<III", 0xADBE0003, 4, 4)
    found = read_bytes(tmp_path, gzip.compress(build_old_file(3, flags=2, extra=orbit + right_up_back)))
    assert found.losses == ("The extension 0xadbe0002 is not read.",)
    other = struct.pack("<III", 0xADBE0003, 4, 6)
    assert_refused(tmp_path, gzip.compress(build_old_file(3, flags=2, extra=other)), "axes of its own")
    for cut in (3, 10):
        cut_off = gzip.compress(build_old_file(3, flags=2, extra=orbit[:cut]))
        assert_refused(tmp_path, cut_off, "extension of the file is cut off")
    # Version 4 has its records between header and table.
    data = bytearray(write(tmp_path / "scene.spz", make_cloud(4)).read_bytes())
    data[14] = 2
    data[16:20] = struct.pack("<I", 32 + len(orbit))
    assert read_bytes(tmp_path, bytes(data[:32]) + orbit + bytes(data[32:])).losses == found.losses


def test_unknown_flags_are_a_loss(tmp_path: Path) -> None:
    losses = read_bytes(tmp_path, gzip.compress(build_old_file(2, flags=0x80))).losses
    assert losses == ("The meaning of the flags 0x80 is not known.",)


# --- damage


Change = Callable[[bytearray], None]


def put(place: int, layout: str, *values: int) -> Change:
    def change(data: bytearray) -> None:
        struct.pack_into(layout, data, place, *values)

    return change


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (put(4, "<I", 5), "version 5"),
        (put(4, "<I", 3), "version 3 without compression"),
        (put(8, "<I", 2**32 - 1), "claims 4294967295 Gaussians"),
        (put(8, "<I", 5), "has not the size it claims"),
        (put(12, "<B", 5), "degree 5"),
        (put(12, "<B", 2), "table of contents"),
        (put(13, "<B", 24), "24 fractional bits"),
        (put(15, "<B", 6), "table of contents"),
        (put(15, "<B", 255), "table of contents"),
        (put(16, "<I", 0), "table of contents"),
        (put(16, "<I", 2**32 - 1), "table of contents"),
        (put(32, "<Q", 2**64 - 1), "stream 0"),
        (put(40, "<Q", 2**63), "stream 0"),
        (lambda data: data.extend(b"more"), "4 bytes follow"),
    ],
)
def test_claims_that_do_not_fit(tmp_path: Path, change: Change, problem: str) -> None:
    data = bytearray(write(tmp_path / "scene.spz", make_cloud(4)).read_bytes())
    change(data)
    assert_refused(tmp_path, bytes(data), problem)


def build_new_file(count: int, streams: list[bytes], raw_sizes: list[int]) -> bytes:
    table = b"".join(struct.pack("<QQ", len(part), size) for part, size in zip(streams, raw_sizes, strict=True))
    return struct.pack("<4sIIBBBBI12x", b"NGSP", 4, count, 0, 12, 0, 5, 32) + table + b"".join(streams)


def refuse_within(folder: Path, data: bytes, problem: str, most_bytes: int) -> None:
    """Refused, and without more memory than that on the way."""
    (folder / "file.spz").write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=problem):
            SPZ.read(folder / "file.spz")
        assert tracemalloc.get_traced_memory()[1] < most_bytes
    finally:
        tracemalloc.stop()


def test_bombs_of_zstandard(tmp_path: Path) -> None:
    zeros = bytes(32 << 20)
    sizes = [9, 1, 3, 3, 4]
    sound = [zstandard.compress(bytes(size)) for size in sizes]
    known = zstandard.compress(zeros)
    silent = zstandard.ZstdCompressor(write_content_size=False).compress(zeros)
    assert len(known) < 10_000 and len(silent) < 10_000
    for bomb, problem in ((known, "claims 33554432 bytes instead of 9"), (silent, "cannot be unpacked")):
        refuse_within(tmp_path, build_new_file(1, [bomb, *sound[1:]], sizes), problem, 1 << 20)
    # As many Gaussians as the streams unpack to, in a file that is far too small for them.
    count = 30_000_000
    many = build_new_file(count, [known, *sound[1:]], [size * count for size in sizes])
    refuse_within(tmp_path, many, "claims 30000000 Gaussians", 1 << 20)


def test_bombs_of_gzip(tmp_path: Path) -> None:
    longer = gzip.compress(build_old_file(3) + bytes(32 << 20))
    assert len(longer) < 100_000
    refuse_within(tmp_path, longer, "unpacks to more than its 3 Gaussians", 1 << 20)
    refuse_within(tmp_path, gzip.compress(build_old_file(3, count=30_000_000)), "claims 30000000", 1 << 20)
    with_extensions = gzip.compress(build_old_file(3, flags=2, extra=bytes(32 << 20)))
    refuse_within(tmp_path, with_extensions, "unpacks to more", 4 << 20)
    assert_refused(tmp_path, gzip.compress(b"no splats"), "holds no SPZ")
    assert_refused(tmp_path, gzip.compress(build_old_file(3))[:-30], "cut off")
    assert_refused(tmp_path, gzip.compress(build_old_file(4)), "version 4 as gzip")
    damaged = bytearray(gzip.compress(build_old_file(3)))
    damaged[12:16] = b"\xff\xff\xff\xff"
    with pytest.raises(zlib.error):
        zlib.decompress(bytes(damaged), 31)
    assert_refused(tmp_path, bytes(damaged), "cannot be unpacked|cut off|no SPZ")
