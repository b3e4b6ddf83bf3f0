"""PLY point clouds: values, and errors that name file and line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.scene.ply_reader import read_ply

ASCII = """ply
format ascii 1.0
comment made by hand
element vertex 2
property double x
property double y
property double z
property uchar red
property uchar green
property uchar blue
element face 1
property list uchar int vertex_indices
end_header
1.5 -2 3 255 0 7
4000000.125 5 6 1 2 3
3 0 1 0
"""


def _write(folder: Path, data: str | bytes) -> Path:
    path = folder / "points.ply"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    return path


def test_ascii_with_colours_and_faces(tmp_path: Path) -> None:
    positions, colors = read_ply(_write(tmp_path, ASCII))
    assert positions.dtype == np.float64 and positions.tolist() == [[1.5, -2, 3], [4000000.125, 5, 6]]
    assert colors is not None and colors.tolist() == [[255, 0, 7], [1, 2, 3]]


def test_binary_without_colours(tmp_path: Path) -> None:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    header += "property float z\nproperty int extra\nend_header\n"
    table = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("extra", "<i4")])
    table["y"] = [1, 2, 3]
    positions, colors = read_ply(_write(tmp_path, header.encode() + table.tobytes()))
    assert positions[:, 1].tolist() == [1, 2, 3] and colors is None
    with pytest.raises(InputError, match="ends after 2 of 3 vertices"):
        read_ply(_write(tmp_path, header.encode() + table.tobytes()[:-1]))


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ("ply\n", "png\n", "no PLY"),
        ("ascii 1.0", "binary_big_endian 1.0", "line 2: format binary_big_endian"),
        ("property double z", "property double w", "no z"),
        ("vertex 2", "vertex 9", "ends after"),
        ("1.5 -2 3 255 0 7", "1.5 -2 3 255 0", "line 14: "),
        ("4000000.125 5", "nan 5", "1 vertices are not finite, the first is 1"),
        ("property double x", "property list uchar int x", "line 5: cannot read"),
        ("vertex 2", "vertex many", "line 4: 'many'"),
    ],
)
def test_errors_name_file_and_line(tmp_path: Path, old: str, new: str, match: str) -> None:
    assert old in ASCII
    path = _write(tmp_path, ASCII.replace(old, new, 1))
    with pytest.raises(InputError, match=match) as caught:
        read_ply(path)
    assert caught.value.file == str(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read the point file"):
        read_ply(tmp_path / "none.ply")


def _write_colors(folder: Path, kind: str, values: list[tuple[object, ...]]) -> Path:
    lines = "\n".join(f"0 0 0 {' '.join(map(str, value))}" for value in values)
    header = ASCII.partition("1.5")[0].replace("property uchar", f"property {kind}")
    return _write(folder, header.replace("vertex 2", f"vertex {len(values)}") + lines + "\n")


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("ushort", [(65535, 32896, 0), (257, 128, 514)], [[255, 128, 0], [1, 0, 2]]),
        ("int", [(65535, 32896, 0), (257, -1, 514)], [[255, 128, 0], [1, 0, 2]]),
        # Bytes that were written in a wide column.
        ("ushort", [(255, 128, 0)], [[255, 128, 0]]),
        ("float", [(1.0, 0.5, 0.0)], [[255, 128, 0]]),
        # A little above 1 is still a colour in [0, 1].
        ("float", [(1.02, 0.5, -0.1)], [[255, 128, 0]]),
        ("double", [(255, 127.6, 0), (1, 2, 3)], [[255, 128, 0], [1, 2, 3]]),
    ],
)
def test_the_range_of_colours_follows_from_the_largest(
    tmp_path: Path, kind: str, values: list[tuple[object, ...]], expected: list[list[int]]
) -> None:
    _, colors = read_ply(_write_colors(tmp_path, kind, values))
    assert colors is not None and colors.dtype == np.uint8 and colors.tolist() == expected


@pytest.mark.parametrize(
    ("kind", "largest", "match"),
    [
        ("float", 65535.0, r"a colour is 65535, .*Write colours as uchar from 0 to 255"),
        ("uint", 70000, r"a colour is 70000, .*Write colours as uchar"),
        ("float", "nan", "colours of vertices are not finite"),
    ],
)
def test_colours_in_no_known_range_are_refused(tmp_path: Path, kind: str, largest: object, match: str) -> None:
    with pytest.raises(InputError, match=match) as caught:
        read_ply(_write_colors(tmp_path, kind, [(0, largest, 0)]))
    assert caught.value.file is not None
