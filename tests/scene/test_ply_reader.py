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
