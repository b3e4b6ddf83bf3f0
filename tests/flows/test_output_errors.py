"""Errors of files that are written under hidden names: they name the path and the option that the user knows."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from flows.cli.last_resort import run_guarded
from flows.output_errors import name_output
from flows.simulation.film import FilmWriter
from flows.simulation.rollout_folder import write_rollout
from genre_tasks.atomic_path import atomic_path
from genre_tasks.errors import DiskFullError, GenreError, InputError, ResourceError
from genre_tasks.temporary_names import describe_owner


def refused(file: Path) -> OSError:
    return OSError(errno.EROFS, "Read-only file system", str(file))


def disk_full(file: Path) -> OSError:
    """As writing to an open file raises it, without a name."""
    return OSError(errno.ENOSPC, "No space left on device")


def film_failed(file: Path) -> GenreError:
    return ResourceError("ffmpeg could not write the film", remedy="Look at the disk.", file=file)


def find_file(error: BaseException) -> str | None:
    return error.file if isinstance(error, GenreError) else getattr(error, "filename", None)


# --- files


@pytest.mark.parametrize("make_error", [refused, disk_full, film_failed])
def test_an_error_of_a_file_names_the_one_that_was_asked_for(
    tmp_path: Path, make_error: Callable[[Path], Exception]
) -> None:
    with pytest.raises((OSError, GenreError)) as caught, atomic_path(tmp_path / "out.png") as part:
        part.touch()
        raise make_error(part)
    assert find_file(caught.value) == str(tmp_path / "out.png")
    assert not list(tmp_path.iterdir())


def test_an_error_of_a_copy_names_what_was_asked_for(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space") as caught, atomic_path(tmp_path / "out.png") as part:
        raise OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "in.png"), None, str(part))
    assert caught.value.filename == str(tmp_path / "out.png") and "in.png" not in str(caught.value)


def test_an_error_of_another_file_stays(tmp_path: Path) -> None:
    for make_error in (refused, film_failed):
        with pytest.raises((OSError, GenreError)) as caught, atomic_path(tmp_path / "out.png"):
            raise make_error(tmp_path / "in.png")
        assert find_file(caught.value) == str(tmp_path / "in.png")


def test_a_file_that_cannot_be_removed_hides_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a disk that has become read-only every call fails, and the last one is not the cause."""

    def refuse(self: Path, missing_ok: bool = False) -> None:
        raise refused(self)

    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OSError, match="No space") as caught, atomic_path(tmp_path / "out.png") as part:
        raise disk_full(part)
    assert caught.value.filename == str(tmp_path / "out.png")


# --- folders


@pytest.mark.parametrize(
    ("make_error", "kind"), [(refused, InputError), (disk_full, DiskFullError), (film_failed, ResourceError)]
)
def test_an_error_of_a_rollout_names_its_folder(
    tmp_path: Path, make_error: Callable[[Path], Exception], kind: type[GenreError]
) -> None:
    out = tmp_path / "out"
    with pytest.raises(kind) as caught, write_rollout(out, lambda files: pytest.fail("it is complete")) as folder:
        raise make_error(folder / "front_camera.mp4")
    assert caught.value.file == str(out) and describe_owner() not in str(caught.value)
    assert "--store" not in caught.value.remedy and ("--out" in caught.value.remedy) == (make_error is not film_failed)
    assert not list(tmp_path.iterdir())


def test_an_error_of_what_is_read_meanwhile_names_that(tmp_path: Path) -> None:
    read = tmp_path / "elsewhere" / "weights"
    with pytest.raises(InputError) as caught, name_output(tmp_path / "deep" / "out"):
        raise refused(read)
    assert caught.value.file == str(read) and "nothing is half-written" not in caught.value.remedy
    assert "--out" not in caught.value.remedy


def test_an_error_of_no_file_is_not_blamed_on_the_output(tmp_path: Path) -> None:
    with pytest.raises(GenreError) as caught, name_output(tmp_path / "out"):
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")
    assert "--out" not in caught.value.remedy and "Free space" not in caught.value.remedy


def test_memory_that_runs_out_has_its_own_remedy(tmp_path: Path) -> None:
    with pytest.raises(ResourceError) as caught, name_output(tmp_path / "out"):
        raise OSError(errno.EMFILE, "Too many open files")
    assert "ulimit" in caught.value.remedy


def test_the_encoders_message_has_no_hidden_name(tmp_path: Path) -> None:
    path = tmp_path / "nowhere" / f".film.{describe_owner()}.part.mp4"
    film = FilmWriter(path, 16, 16, 10.0)
    with pytest.raises(ResourceError) as caught:
        film.close()
    film.abort()
    assert "No such file" in caught.value.problem and describe_owner() not in caught.value.problem


# --- options


@pytest.mark.parametrize(
    ("words", "file", "place"),
    [
        ("figure recon log --out /data/x.png", "/data/x.png", "choose another place with --out"),
        ("effects log --out=/data", "/data/own/0.png", "choose another place with --out"),
        ("run log --store /data/store", "/data/store/runs", "choose another place with --store"),
        ("run log --store /data/store", "/other/file", "name another place"),
        ("convert log /data/out", "/data/out/log.json", "name another place"),
        ("render run --out ~nobody-of-this-name/x.png", "/data/x.png", "name another place"),
        ("render run --out", "/data/x.png", "name another place"),
    ],
)
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS, errno.ENOTDIR])
def test_the_remedy_names_the_option_of_the_place(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: str,
    file: str,
    place: str,
    code: int,
) -> None:
    def fail() -> None:
        raise OSError(code, "refused", file)

    monkeypatch.setattr(sys, "argv", ["genre", *words.split()])
    assert run_guarded(fail, debug=True) in (1, 2)
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("error: ") and f"(file {file})" in line and place in line
    assert ("--store" in line) == place.endswith("--store")


def test_a_full_disk_without_a_name_has_no_option(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise disk_full(Path())

    monkeypatch.setattr(sys, "argv", ["genre", "run", "log", "--store", "/data"])
    assert run_guarded(fail, debug=True) == 1
    assert "name another place" in capsys.readouterr().err
