"""Lists of logs: the names of a text file stand for logs, in their order and with the options of the address."""

from __future__ import annotations

from pathlib import Path

import pytest

from flows.configuration import load_configuration
from flows.experiments.log_chunks import LogChunk, select_log_chunks
from flows.pipeline.log_cache import expand_logs
from flows.pipeline.log_lists import expand_log_list
from genre_tasks.errors import InputError
from genre_tasks.logs.log_address import split_log_address


def test_names_of_a_file_stand_for_logs(tmp_path: Path) -> None:
    (tmp_path / "val.txt").write_text("# validation\nscene-0103\n\n  scene-0003  \n", encoding="utf-8-sig")
    expected = [f"nuscenes:{tmp_path}/{name}?rate=2" for name in ("scene-0103", "scene-0003")]
    assert expand_logs([f"nuscenes:{tmp_path}/@val.txt?rate=2"]) == expected
    assert expand_logs([f"nuscenes:{tmp_path}/@{tmp_path}/val.txt?rate=2"]) == expected
    assert expand_logs(["pandaset:a", f"kitti:x/@{tmp_path}/val.txt"]) == [
        "pandaset:a",
        "kitti:x/scene-0103",
        "kitti:x/scene-0003",
    ]


def test_stars_in_a_list(tmp_path: Path) -> None:
    for name in ("001", "002", "010"):
        (tmp_path / name).mkdir()
    (tmp_path / "some.txt").write_text("00*\n010\n")
    found = expand_logs([f"pandaset:{tmp_path}/@some.txt"])
    assert found == [f"pandaset:{tmp_path}/{name}" for name in ("001", "002", "010")]


def test_a_folder_that_begins_with_the_sign(tmp_path: Path) -> None:
    (tmp_path / "@val").mkdir()
    assert expand_log_list(f"pandaset:{tmp_path}/@val") is None
    assert expand_log_list("pandaset:a@b/002") is None
    # A folder above the logs may as well, also with a star, with options, or where a log is no folder.
    for uri in (f"pandaset:{tmp_path}/@val/*", f"kitti:{tmp_path}/@val/drive?labels=x", f"nuscenes:{tmp_path}/@val/a"):
        assert expand_log_list(uri) is None
    (tmp_path / "@val" / "002").mkdir()
    assert expand_logs([f"pandaset:{tmp_path}/@val/*"]) == [f"pandaset:{tmp_path}/@val/002"]
    # A list in another folder is still one.
    (tmp_path / "lists").mkdir()
    (tmp_path / "lists" / "few.txt").write_text("@val/002\n")
    assert expand_logs([f"pandaset:{tmp_path}/@lists/few.txt"]) == [f"pandaset:{tmp_path}/@val/002"]


def test_several_stars_in_a_row_mean_one(tmp_path: Path) -> None:
    for name in ("001", "002"):
        (tmp_path / name / "part").mkdir(parents=True)
    assert expand_logs([f"pandaset:{tmp_path}/0**"]) == [f"pandaset:{tmp_path}/{name}" for name in ("001", "002")]
    below = expand_logs([f"pandaset:{tmp_path}/**/part"])
    assert below == [f"pandaset:{tmp_path}/{name}/part" for name in ("001", "002")]


def test_stars_in_paths_that_are_written_with_percent_signs(tmp_path: Path) -> None:
    for name in ("50% a", "b?"):
        (tmp_path / "100% done" / name).mkdir(parents=True)
    folder = f"{tmp_path}/100%25 done"
    assert expand_logs([f"kitti:{folder}/*?labels=x"]) == [
        f"kitti:{folder}/50%25 a?labels=x",
        f"kitti:{folder}/b%3F?labels=x",
    ]
    # What such a reader is given opens the folder that was found.
    (one,) = expand_logs([f"kitti:{folder}/b*"])
    assert Path(split_log_address(one.partition(":")[2], (), "KITTI")[0]) == tmp_path / "100% done" / "b?"
    # Other readers take a path as it is.
    assert expand_logs([f"pandaset:{tmp_path}/100% done/b*"]) == [f"pandaset:{tmp_path}/100% done/b?"]


@pytest.mark.parametrize(
    ("content", "problem"),
    [(None, "cannot be read"), (b"# nothing\n", "names no logs"), (b"\xff\xfe\xff", "cannot be read")],
)
def test_lists_that_cannot_be_read(tmp_path: Path, content: bytes | None, problem: str) -> None:
    if content is not None:
        (tmp_path / "val.txt").write_bytes(content)
    with pytest.raises(InputError, match=problem) as caught:
        expand_logs([f"pandaset:{tmp_path}/@val.txt"])
    assert caught.value.file == f"{tmp_path}/val.txt"


def test_a_list_that_is_too_long(tmp_path: Path) -> None:
    (tmp_path / "val.txt").write_bytes(b"x\n" * (1 << 22))
    with pytest.raises(InputError, match="more than"):
        expand_logs([f"pandaset:{tmp_path}/@val.txt"])


def test_a_log_named_twice_counts_once() -> None:
    log = "synthetic:street?seed=1"
    chunks = select_log_chunks([log, log], [0], load_configuration("demo"))
    assert chunks == [LogChunk(log, 0)]
