"""Ports and secrets in files survive full disks and kills, and starts at once agree on them."""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterator
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import pytest

from flows.operations import ObjectServer
from flows.operations import object_server as object_module
from flows.operations.service import keep_port, keep_secret
from flows.operations.stack import Stack, stop_stack
from genre_tasks.errors import ConfigError


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[bool]]:
    """A list whose only entry says whether files of this process can be synchronised with the disk."""
    is_full = [True]
    fsync = os.fsync

    def refuse(handle: int) -> None:
        if is_full[0]:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", refuse)
    yield is_full


def list_names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_secret_that_a_full_disk_refused_is_made_at_the_next_start(tmp_path: Path, full_disk: list[bool]) -> None:
    file = tmp_path / "password"
    with pytest.raises(OSError, match="No space left"):
        keep_secret(file)
    assert not file.exists() or file.read_text() == ""
    full_disk[0] = False
    secret = keep_secret(file)
    assert len(secret) >= 32 and keep_secret(file) == file.read_text() == secret
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert list_names(tmp_path) == ["password"]


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_folder_without_locks_is_an_error_that_names_it(
    tmp_path: Path, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of NFS without a lock service."""

    def refuse(file: object, operation: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("fcntl.flock", refuse)
    for act in (Stack(tmp_path).start, lambda: stop_stack(tmp_path), lambda: keep_secret(tmp_path / "password")):
        with pytest.raises(ConfigError, match=os.strerror(code)) as caught:
            act()
        assert caught.value.file == str(tmp_path)
        assert caught.value.remedy == "Name a folder on a local disk with --folder."


@pytest.mark.parametrize("content", ["", "\n"])
def test_an_empty_secret_counts_as_missing(tmp_path: Path, content: str) -> None:
    file = tmp_path / "password"
    file.write_text(content)
    file.chmod(0o644)
    assert len(keep_secret(file)) >= 32
    assert stat.S_IMODE(file.stat().st_mode) == 0o600


def test_a_secret_that_is_there_needs_no_space(tmp_path: Path, full_disk: list[bool]) -> None:
    (tmp_path / "password").write_text("of before\n")
    assert keep_secret(tmp_path / "password") == "of before"


@pytest.mark.parametrize("is_empty", [False, True], ids=["missing", "empty"])
def test_starts_at_once_agree_on_one_secret(tmp_path: Path, is_empty: bool) -> None:
    files = [tmp_path / f"{number}/password" for number in range(50)]
    if is_empty:
        for file in files:
            file.parent.mkdir()
            file.write_text("")
    # A fork would take along what other tests started here.
    context = get_context("spawn")
    barrier = context.Barrier(3)
    found = context.Queue()
    processes = [context.Process(target=_keep_all, args=(files, barrier, found)) for _ in range(3)]
    for process in processes:
        process.start()
    by_process = [found.get(timeout=120) for _ in processes]
    for process in processes:
        process.join(20)
    secrets = [file.read_text() for file in files]
    assert by_process == [secrets] * 3
    assert len(set(secrets)) == len(files)


def _keep_all(files: list[Path], barrier: Any, found: Any) -> None:
    barrier.wait(100)
    found.put([keep_secret(file) for file in files])


@pytest.mark.parametrize("content", [b"", b"\n", b"many", b"\xff\xfe", b"0", b"70000", b"-1"])
def test_a_file_without_a_port_counts_as_missing(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "port"
    file.write_bytes(content)
    port = keep_port(file)
    assert 0 < port < 65536 and int(file.read_text()) == port
    assert keep_port(file) == port


def test_a_full_disk_costs_no_port_of_before(tmp_path: Path, full_disk: list[bool]) -> None:
    file = tmp_path / "port"
    full_disk[0] = False
    port = keep_port(file)
    full_disk[0] = True
    # Unchanged, and therefore not written.
    assert keep_port(file) == port
    with pytest.raises(OSError, match="No space left"):
        keep_port(file, wanted=port + 1 if port < 65535 else port - 1)
    assert keep_port(file) == port
    assert list_names(tmp_path) == ["port"]


@pytest.mark.parametrize("content", ["", "{", "[]", "{}", '{"master": 1}', "null", "all zero"])
def test_ports_of_parts_that_cannot_be_read_are_chosen_again(
    tmp_path: Path, content: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_module, "find_weed", lambda: "weed")
    if content == "all zero":
        content = json.dumps(dict.fromkeys(object_module._ALL_PORTS, 0))
    (tmp_path / "ports.json").write_text(content)
    words = _prepare(tmp_path)
    known = json.loads((tmp_path / "ports.json").read_text())
    assert set(known) == set(object_module._ALL_PORTS) and len(set(known.values())) == len(known)
    assert f"-master.port={known['master']}" in words
    assert _prepare(tmp_path) == words


def test_ports_of_parts_are_written_only_where_they_change(
    tmp_path: Path, full_disk: list[bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(object_module, "find_weed", lambda: "weed")
    full_disk[0] = False
    words = _prepare(tmp_path)
    full_disk[0] = True
    assert _prepare(tmp_path) == words


def _prepare(folder: Path) -> list[Any]:
    server = ObjectServer(folder)
    server.prepare()
    return server.command()
