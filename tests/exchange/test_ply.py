"""PLY files of 3D Gaussians."""

from __future__ import annotations

import tempfile
import tracemalloc
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from genre_tasks.errors import InputError
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply import PLY
from genre_tasks.exchange.types import SplatCloud
from tests.exchange.compressed_ply_encoder import write_compressed_ply
from tests.exchange.foreign_scenes import make_garden, needs_garden, write_inria_ply
from tests.exchange.format_suite import FormatSuite
from tests.exchange.gsply_process import write_and_read_by_gsply
from tests.exchange.splat_clouds import make_cloud, same_bits

MOST_BYTES = 20_000_000
"""More than reading any of the small files here may take, and far less than what they claim."""


class TestPly(FormatSuite):
    name = "ply"
    keeps_bits = True


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.ply"


def read(path: Path) -> SplatCloud:
    return PLY.read(path).nodes[0].cloud


def write(path: Path, cloud: SplatCloud) -> bytes:
    PLY.write(path, make_resting_scene(cloud))
    return path.read_bytes()


# --- other people's files


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_files_with_normals(path: Path, degree: int) -> None:
    cloud = make_cloud(70, degree)
    write_inria_ply(path, cloud)
    scene = PLY.read(path)
    assert same_bits(scene.nodes[0].cloud, cloud)
    assert scene.losses == ()


def test_properties_in_any_order(path: Path) -> None:
    cloud = make_cloud(20, 2)
    write(path, cloud)
    data = PlyData.read(path, mmap=False)["vertex"].data
    names = np.random.default_rng(3).permutation(list(data.dtype.names))
    shuffled = np.empty(len(data), [(name, "<f4") for name in names])
    for name in names:
        shuffled[name] = data[name]
    PlyData([PlyElement.describe(shuffled, "vertex")], byte_order="<").write(path)
    assert same_bits(read(path), cloud)


def test_other_properties_and_elements_are_losses(path: Path) -> None:
    write(path, make_cloud(5))
    data = PlyData.read(path, mmap=False)["vertex"].data
    more = np.zeros(5, [*data.dtype.descr, ("segment", "u1")])
    for name in data.dtype.names:
        more[name] = data[name]
    cameras = np.zeros(2, [("focal", "<f4")])
    # The other element comes first, so that the vertices are not where the header ends.
    elements = [PlyElement.describe(cameras, "camera"), PlyElement.describe(more, "vertex")]
    PlyData(elements, byte_order="<").write(path)
    scene = PLY.read(path)
    assert same_bits(scene.nodes[0].cloud, make_cloud(5))
    assert scene.losses == ("The file also has segment, all of camera, which is not read.",)


@pytest.mark.parametrize(
    ("comments", "expected"),
    [
        (["SplatRenderMode: mip"], True),
        (["splatrendermode:DEFAULT"], False),
        (["antialiased 1"], True),
        (["Antialiased 0"], False),
        (["antialiased 0", "SplatRenderMode: mip"], True),
        (["SplatRenderMode: mip", "antialiased 0"], False),
        (["2dgs", "made by a tool that is not antialiased 1"], None),
        (["SplatRenderMode: 2dgs", "SplatRenderMode: default"], False),
        ([], None),
    ],
)
def test_anti_aliasing_of_other_tools(path: Path, comments: list[str], expected: bool | None) -> None:
    text = write(path, make_cloud(2))
    lines = b"".join(f"comment {comment}\n".encode() for comment in comments)
    for place in (b"element vertex", b"end_header"):
        path.write_bytes(text.replace(place, lines + place, 1))
        assert read(path).antialiased is expected


def test_both_tools_find_their_sign(path: Path) -> None:
    text = write(path, replace(make_cloud(1), antialiased=True))
    assert b"comment SplatRenderMode: mip\n" in text and b"comment antialiased 1\n" in text


def test_big_endian_and_double(path: Path) -> None:
    cloud = make_cloud(9, 1)
    write(path, cloud)
    element = PlyData.read(path, mmap=False)["vertex"]
    PlyData([element], byte_order=">").write(path)
    assert same_bits(read(path), cloud)
    wide = element.data.astype([(name, "<f8") for name in element.data.dtype.names])
    PlyData([PlyElement.describe(wide, "vertex")], byte_order="<").write(path)
    assert same_bits(read(path), cloud)
    wide["rot_1"][3] = 1e300
    PlyData([PlyElement.describe(wide, "vertex")], byte_order="<").write(path)
    with warnings.catch_warnings(), pytest.raises(InputError, match="quats is not finite in 1"):
        warnings.simplefilter("error")
        read(path)


def test_line_ends_and_comments_of_any_kind(path: Path) -> None:
    text = write(path, make_cloud(3))
    end = text.index(b"end_header\n") + len(b"end_header\n")
    header = text[:end].replace(b"element", "comment Straße, 通り\nelement".encode(), 1)
    path.write_bytes(header.replace(b"\n", b"\r\n") + text[end:])
    assert same_bits(read(path), make_cloud(3))


def test_plyfile_reads_ours(path: Path) -> None:
    cloud = replace(make_cloud(30, 3), antialiased=False)
    write(path, cloud)
    vertices = PlyData.read(path, mmap=False)["vertex"]
    assert np.array_equal(np.stack([vertices[name] for name in ("x", "y", "z")], 1), cloud.means)
    # The second green coefficient comes after all reds.
    assert np.array_equal(vertices["f_rest_16"], cloud.sh_rest[:, 1, 1])
    assert np.array_equal(vertices["rot_0"], cloud.quats[:, 0])


def test_gsply_reads_ours_and_we_read_theirs(path: Path) -> None:
    cloud = make_cloud(30, 3)
    write(path, cloud)
    assert same_bits(write_and_read_by_gsply(path, None), cloud)
    write_and_read_by_gsply(path, cloud)
    assert same_bits(read(path), cloud)


@needs_garden
def test_a_garden_with_the_layout_of_inria(path: Path) -> None:
    cloud = make_garden().cloud
    write_inria_ply(path, cloud)
    assert same_bits(read(path), cloud)


# --- files that are refused


def _rename(old: bytes, new: bytes) -> Callable[[bytes], bytes]:
    return lambda text: text.replace(old, new)


HOSTILE = {
    "a count of 10^12": (_rename(b"vertex 20", b"vertex 1000000000000"), "1000000000000 rows of vertex need"),
    "a count that overflows": (_rename(b"vertex 20", b"vertex " + b"9" * 19), "need"),
    "a count of a million digits": (_rename(b"vertex 20", b"vertex " + b"9" * 100_000), "is no count"),
    "a negative count": (_rename(b"vertex 20", b"vertex -1"), "'-1' is no count"),
    "one row too many": (_rename(b"vertex 20", b"vertex 21"), "cut off"),
    "ASCII": (_rename(b"binary_little_endian", b"ascii"), "ASCII"),
    "an unknown format": (_rename(b"binary_little_endian", b"binary_middle_endian"), "binary_middle_endian"),
    "no vertices": (_rename(b"element vertex", b"element face"), "no vertices"),
    "lists": (_rename(b"end_header", b"element face 1000000000\nproperty list uchar int v\nend_header"), "lists"),
    "another element of 10^15": (
        _rename(b"element vertex", b"element a 1000000000000000\nproperty double b\nelement vertex"),
        "1000000000000000 rows of a need",
    ),
    "integers": (_rename(b"float scale_1", b"int scale_1"), "scale_1 is int32"),
    "an unknown type": (_rename(b"float scale_1", b"half scale_1"), "half"),
    "no positions": (_rename(b"float x", b"float px"), "no x"),
    "no Gaussians": (lambda text: _drop(text, "f_dc", "opacity", "scale", "rot"), "no f_dc_0.*and others"),
    "2DGS without a third scale": (lambda text: _drop(text, "scale_2"), "2DGS"),
    "2DGS by its comment": (_rename(b"element v", b"comment SplatRenderMode: 2DGS\nelement v"), "2DGS"),
    "ten harmonics": (_rename(b"float f_rest_8", b"float f_rest_9"), "9 properties"),
    "eight harmonics": (_rename(b"float f_rest_8", b"float other"), "8 properties"),
    "one name twice": (_rename(b"float rot_1", b"float rot_0"), "same name"),
    "no end of the header": (_rename(b"end_header\n", b"end_of_header\n"), "cut off"),
    "a header of megabytes": (_rename(b"element v", b"comment " + b"x" * 1_000_000 + b"\nelement v"), "cut off"),
    "another kind of file": (lambda text: b"glTF" + text, "no PLY file"),
    "nothing": (lambda text: b"", "no PLY file"),
}


def _drop(text: bytes, *starts: str) -> bytes:
    end = text.index(b"end_header")
    dropped = [line for line in text[:end].splitlines() if any(f"float {s}".encode() in line for s in starts)]
    header = b"".join(line + b"\n" for line in text[:end].splitlines() if line not in dropped)
    return header + text[end:]


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files(path: Path, name: str) -> None:
    damage, words = HOSTILE[name]
    path.write_bytes(damage(write(path, make_cloud(20, 1))))
    tracemalloc.start()
    with pytest.raises(InputError, match=words) as caught:
        PLY.read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert caught.value.file == str(path)
    assert caught.value.remedy.endswith(".")
    assert peak < MOST_BYTES


def test_headers_with_lines_in_disorder() -> None:
    # Structured damage gets further than flipped bytes: each header here still looks like one.
    words = st.sampled_from(["0", "-1", "21", "99999999999", "float", "uchar", "list", "vertex", "x", "end_header"])
    changes = st.lists(st.tuples(st.integers(0, 40), st.sampled_from(["drop", "repeat", "swap", "word"]), words))

    @settings(max_examples=60, deadline=None)
    @given(changes=changes)
    def search(changes: list[tuple[int, str, str]]) -> None:
        lines = header.split(b"\n")
        for place, kind, word in changes:
            k = place % len(lines)
            if kind == "drop" and len(lines) > 1:
                del lines[k]
            elif kind == "repeat":
                lines.insert(k, lines[k])
            elif kind == "swap":
                lines[k], lines[k - 1] = lines[k - 1], lines[k]
            elif kind == "word":
                lines[k] = b" ".join([*lines[k].split()[:-1], word.encode()])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "scene.ply"
            path.write_bytes(b"\n".join(lines) + body)
            TestPly().assert_read_or_refused(path)

    with tempfile.TemporaryDirectory() as folder:
        text = write(Path(folder) / "scene.ply", make_cloud(20, 1))
    end = text.index(b"end_header\n") + len(b"end_header\n")
    header = text[:end]
    body = text[end:]
    search()


@pytest.mark.parametrize(
    ("column", "attribute"),
    [
        (1, "means"),
        (5, "sh_dc"),
        (6, "sh_rest"),
        (14, "sh_rest"),
        (18, "log_scales"),
        (22, "quats"),
    ],
)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_named(path: Path, column: int, attribute: str, value: float) -> None:
    # Beyond the rows that are read at once, so that the count of rows before them matters.
    text = write(path, make_cloud(20_000, 1))
    start = text.index(b"end_header\n") + len(b"end_header\n")
    values = np.frombuffer(bytearray(text[start:]), "<f4").reshape(20_000, 23).copy()
    values[[17_001, 17_500], column] = value
    path.write_bytes(text[:start] + values.tobytes())
    with pytest.raises(InputError, match=f"{attribute} is not finite in 2 Gaussians, the first is number 17001 "):
        PLY.read(path)


def test_opacities_of_zero_and_one_are_bounded_and_nan_is_refused(path: Path) -> None:
    text = write(path, make_cloud(5))
    start = text.index(b"end_header\n") + len(b"end_header\n")
    values = np.frombuffer(bytearray(text[start:]), "<f4").reshape(5, 14).copy()
    values[1:3, 6] = (np.inf, -np.inf)
    path.write_bytes(text[:start] + values.tobytes())
    scene = PLY.read(path)
    assert scene.losses == ("Infinite opacities of 2 Gaussians become those of 1 and 0, less 1e-06.",)
    assert scene.nodes[0].cloud.logit_opacities[1:3] == pytest.approx([13.8155, -13.8155], abs=1e-3)
    values[4, 6] = np.nan
    path.write_bytes(text[:start] + values.tobytes())
    with pytest.raises(InputError, match="logit_opacities is not finite in 1 Gaussians"):
        PLY.read(path)


def test_a_compressed_file_with_a_plain_name(path: Path) -> None:
    write_compressed_ply(path, make_cloud(3))
    with pytest.raises(InputError, match=r"\.compressed\.ply"):
        PLY.read(path)
