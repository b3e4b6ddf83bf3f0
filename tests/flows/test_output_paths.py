"""Output paths are checked before any work, by one rule for all commands; and other words of the command line."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.cli.output_paths import check_new_folder, check_output_file, check_output_folder
from flows.cli.parsing import check_number, parse_duration, parse_numbers, parse_path
from flows.pipeline.log_cache import expand_logs
from genre_tasks.atomic_path import replace_folder
from genre_tasks.errors import ConfigError, GenreError, InputError
from genre_tasks.logs.registry import open_log
from storage.local import LocalStore
from tests.contracts.store_suite import address
from tests.ordinary_user import as_ordinary_user
from tests.storage.artifact_values import make

STREET = "synthetic:street?seed=900&frames=8"


def refusal(*words: str) -> GenreError:
    """The error that a command ends with, before it has opened a log or a store."""
    done = CliRunner().invoke(app, list(words))
    assert isinstance(done.exception, GenreError), (done.exception, done.output)
    return done.exception


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("folder", "is a folder"),
        ("file/x.png", "lies under a file"),
        ("file/deep/x.png", "lies under a file"),
        ("x.gif", "ends with '.gif'"),
        ("x", "has no ending"),
        ("dangling.png", "link to nothing"),
        ("dangling.png/x.png", "link to nothing"),
        ("pipe.png", "no regular file"),
        (f"{'x' * 240}.png", "too long"),
        (f"{'x' * 300}/x.png", "File name too long"),
    ],
)
def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path, name: str, text: str) -> None:
    """Reports: Computer-Aided-Validation-Laboratory/pyvale#212, faressoft/terminalizer#12, jliljebl/flowblade#832."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    (tmp_path / "dangling.png").symlink_to(tmp_path / "nowhere" / "x.png")
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(InputError, match=text) as caught:
        check_output_file(tmp_path / name, "--out", (".png", ".mp4"))
    assert caught.value.file is not None and caught.value.remedy and "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [".", "..", "x/.."])
def test_a_folder_without_a_name_cannot_be_written_as_a_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="names no folder"):
        check_new_folder(Path(name), "--out")
    for words in (["simulate", "4b1c"], ["export", "4b1c", "--format", "ply"], ["augment", "4b1c", "--format", "own"]):
        assert "names no folder" in str(refusal(*words, "--out", name))
    assert "names no folder" in str(refusal("convert", STREET, f"genre:{name}"))
    check_new_folder(Path("new"), "--out")


def test_a_link_and_a_mount_cannot_be_replaced_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "disk"
    folder.mkdir()
    link = tmp_path / "link"
    link.symlink_to(folder)
    with pytest.raises(InputError, match=r"is a link, .*link/out"):
        check_new_folder(link, "--out")
    check_new_folder(link / "out", "--out")
    monkeypatch.setattr("os.path.ismount", lambda path: Path(path) == folder)
    with pytest.raises(InputError, match="where a file system is mounted"):
        check_new_folder(folder, "--out")


def test_what_appeared_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    complete, folder = tmp_path / "complete", tmp_path / "out"
    for made in (complete, folder):
        made.mkdir()
        (made / "file").write_text(made.name)
    with pytest.raises(ConfigError, match="filled meanwhile"):
        replace_folder(folder, complete, held_files=False)
    assert (folder / "file").read_text() == "out" and (complete / "file").is_file()
    replace_folder(folder, complete, held_files=True)
    assert (folder / "file").read_text() == "complete" and not complete.exists()


def test_a_file_that_can_be_written_is_not_touched(tmp_path: Path) -> None:
    """Report: AOMediaCodec/libavif#144."""
    (tmp_path / "old.png").write_text("old")
    (tmp_path / "link.png").symlink_to("old.png")
    for name in ("new.PNG", "a b/ü %#/x.Png", "old.png", "link.png"):
        check_output_file(tmp_path / name, "--out", (".png",))
    check_output_folder(tmp_path / "new folder" / "below", "--out", ("x.png",))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link.png", "old.png"]
    assert (tmp_path / "old.png").read_text() == "old"


def test_a_folder_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    """Report: Computer-Aided-Validation-Laboratory/pyvale#212."""
    (tmp_path / "file").touch()
    (tmp_path / "out" / "cost.png").mkdir(parents=True)
    with pytest.raises(InputError, match="--out is a file"):
        check_output_folder(tmp_path / "file", "--out")
    with pytest.raises(InputError, match=r"cost.png in --out is a folder"):
        check_output_folder(tmp_path / "out", "--out", ("cost.png",))
    # Nobody can make files there, whatever its permissions say.
    with pytest.raises(InputError, match="cannot be written"):
        check_output_folder(Path("/proc/out"), "--out")


def test_permissions_are_respected(tmp_path: Path) -> None:
    """Report: jliljebl/flowblade#832."""
    check_output_file(tmp_path / "new" / "x.png", "--out")
    with as_ordinary_user() as folder:
        (folder / "x.png").touch(mode=0o444)
        with pytest.raises(InputError, match="write-protected"):
            check_output_file(folder / "x.png", "--out")
        (folder / "closed").mkdir(mode=0o555)
        with pytest.raises(InputError, match="cannot be written"):
            check_output_file(folder / "closed" / "new" / "x.png", "--out")


@pytest.mark.parametrize(
    "words",
    [
        ("render", "4b1c", "--out", "FILE/x.png"),
        ("show", "4b1c", "--picture", "FILE/x.png"),
        ("effects", STREET, "--out", "FILE"),
        ("figure", "recon", STREET, "--out", "FILE/x.png"),
        ("table", "4", STREET, "--out", "FILE"),
        ("table", "4", STREET, "--into", "FILE/page.md"),
        ("cost", STREET, "--out", "FILE"),
        ("range", "4b1c", "--out", "FILE"),
        ("perceive", "4b1c", "--detector", "x.onnx", "--out", "FILE"),
        ("bench", "nothing", "--json", "FILE/x.json"),
        ("train", "pairs", "--folder", "FILE"),
        ("train", "gnet", "--folder", "FILE/below"),
    ],
)
def test_every_command_checks_its_output_first(tmp_path: Path, words: tuple[str, ...]) -> None:
    """Report: hellothisistim/bgNukes#8."""
    (tmp_path / "file").touch()
    error = refusal(*(word.replace("FILE", str(tmp_path / "file")) for word in words))
    assert error.file == str(tmp_path / "file") and words[-2] in error.problem


def test_an_option_that_would_be_ignored_is_refused(tmp_path: Path) -> None:
    """Report: none found; case 26 of the list of odd logs."""
    picture = str(tmp_path / "x.png")
    assert "has no picture" in refusal("show", "runs", "--picture", picture).problem
    assert "has no picture" in refusal("show", "config", "--picture", picture).problem
    film = refusal("render", "4b1c", "--out", str(tmp_path / "x.MP4"), "--frame", "3")
    assert "--frame 3" in film.problem and "x.png" in film.remedy
    # An unset variable of a script's is no name.
    assert "0 runs" in refusal("show", "", "--store", str(tmp_path)).problem
    assert "knob" in refusal("cost", STREET, "--knobs", "", "--dry-run").problem
    assert "0 runs" in refusal("render", "", "--out", picture, "--store", str(tmp_path)).problem
    for what in ("runs", "stages", "config", "actors"):
        assert f"--chunk has no meaning for '{what}'" in refusal("show", what, "--chunk", "3").problem
    assert "--preset has no meaning for '4b1c'" in refusal("show", "4b1c", "--preset", "hd").problem
    artifact = LocalStore(tmp_path / "store").commit(address(), "effects", make("effects"))
    by_key = refusal("show", artifact.manifest.key[:8], "--chunk", "3", "--store", str(tmp_path / "store"))
    by_folder = refusal("show", str(artifact.path), "--chunk", "3")
    assert "for an artifact" in by_key.problem and "for a folder" in by_folder.problem
    for option in (["--port", "9000"], ["--host", "0.0.0.0"], ["--open"]):
        error = refusal("view", "4b1c", "--html", str(tmp_path / "x.html"), *option)
        assert f"no use for {option[0]}" in error.problem and "--html" in error.remedy
    assert "no use for --note" in refusal("pin", "--list", "--note", "why", "--store", str(tmp_path)).problem


def test_a_mistyped_store_is_no_empty_store(tmp_path: Path) -> None:
    """Report: none found; case 25 of the list of odd logs."""
    (tmp_path / "file").touch()
    for words in (["show"], ["show", "stages"], ["show", "4b1c"], ["verify"], ["render", "4b1c"], ["range", "4b1c"]):
        out = ["--out", str(tmp_path / "x.png")] if words[0] in ("render", "range") else []
        for store in ("nowhere", "file"):
            error = refusal(*words, *out, "--store", str(tmp_path / store))
            assert error.problem == "there is no store" and error.file == str(tmp_path / store)


@pytest.mark.parametrize("text", ["", " ", "1-", "2..0", "0,", "-1", "0,0", "1_0", "٣", "1.5", "9" * 5000, "nan"])
def test_a_list_of_numbers_is_digits_and_commas(text: str) -> None:
    """Report: none found; case 26 of the list of odd logs."""
    with pytest.raises(ConfigError, match="--chunks"):
        parse_numbers(text, "--chunks")


@pytest.mark.parametrize("text", ["", "nan", "inf", "-5", "0", "0s", "1e3", "5 weeks", "9" * 400, "٣s"])
def test_a_time_is_a_number_above_zero_with_a_unit(text: str) -> None:
    """Report: pallets/click#3347."""
    with pytest.raises(ConfigError, match="--budget"):
        parse_duration(text, "--budget")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1000.5])
def test_a_number_out_of_range_is_refused(value: float, tmp_path: Path) -> None:
    """Reports: pallets/click#3347, qarmin/czkawka#2038."""
    with pytest.raises(ConfigError, match="out of range"):
        check_number(value, "--shift", -1000, 1000)
    assert "--shift" in refusal("render", "4b1c", "--out", str(tmp_path / "x.png"), "--shift", str(value)).problem


def test_home_folders_are_found_where_no_shell_does_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports: unioslo/zabbix-cli#304, cockroachdb/cockroach#14435."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert parse_path("~/film.mp4") == tmp_path / "film.mp4"
    with pytest.raises(ConfigError, match="empty"):
        parse_path("")
    for uri in ("pandaset:~nobody-of-this-name/002", "pandaset:~nobody-of-this-name/*"):
        with pytest.raises(InputError, match="no home folder"):
            expand_logs([uri])
        with pytest.raises(InputError, match="no home folder"):
            open_log(uri)
    for name in ("logs/#2 %2F [x]", "logs/001", "logs/.hidden"):
        (tmp_path / name).mkdir(parents=True)
    found = [f"pandaset:{tmp_path}/logs/#2 %2F [x]", f"pandaset:{tmp_path}/logs/001"]
    assert expand_logs(["pandaset:~/logs/*"]) == expand_logs(["pandaset:~/logs/*/"]) == found
    monkeypatch.chdir(tmp_path / "logs" / "001")
    assert expand_logs(["pandaset:../*[x]"]) == ["pandaset:../#2 %2F [x]"]


def test_a_folder_alone_gets_the_reader_suggested(tmp_path: Path) -> None:
    """Report: none found; case 26 of the list of odd logs."""
    folder = tmp_path / "with:colon"
    folder.mkdir()
    for path in (tmp_path, folder):
        with pytest.raises(InputError) as caught:
            open_log(str(path))
        assert f"Did you mean 'pandaset:{path}'?" in caught.value.remedy
    with pytest.raises(InputError, match="no such sequence folder") as caught:
        open_log(f"pandaset:{tmp_path}/*")
    assert "a star stands" in caught.value.remedy
