"""What a result says of where it was measured."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

import pytest
import torch

from flows.cli import main
from flows.machine import cgroups
from flows.machine.facts import count_cores, describe_environment, describe_machine, git_commit
from flows.machine.memory import memory_limit_gib
from flows.machine.state_folder import find_state_folder
from genre_tasks.compiled.loader import supported_instruction_sets
from genre_tasks.errors import ConfigError
from genre_tasks.threads import torch_threads


def test_machine_names_cores_instruction_set_and_torch() -> None:
    model, *rest = describe_machine().split(", ")
    assert len(model) > 2
    assert rest[0].split()[1] == "cores" and int(rest[0].split()[0]) >= 1
    assert rest[1:3] == [supported_instruction_sets()[0], f"torch {torch.__version__}"]


def test_a_manifest_names_the_threads_that_were_at_work() -> None:
    found = [describe_environment()["threads"]]
    with torch_threads(1):
        found.append(describe_environment()["threads"])
    assert found == [str(torch.get_num_threads()), "1"]


def test_commit_says_whether_the_tree_was_changed(tmp_path: Path) -> None:
    def git(*arguments: str) -> str:
        identity = ("-c", "user.name=a", "-c", "user.email=a@example.org", "-c", "commit.gpgsign=false")
        done = subprocess.run(["git", *identity, *arguments], cwd=tmp_path, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert git_commit(tmp_path) == "unknown"
    git("init", "-q")
    (tmp_path / "file").write_text("a")
    git("add", "file")
    git("commit", "-qm", "a")
    assert git_commit(tmp_path.resolve()) == git("rev-parse", "HEAD")
    (tmp_path / "file").write_text("b")
    assert git_commit(tmp_path.resolve()) == git("rev-parse", "HEAD") + "+changes"
    below = tmp_path / "below"
    below.mkdir()
    assert git_commit(below.resolve()) == "unknown"


@pytest.mark.parametrize(
    ("line", "files", "gib", "cores"),
    [
        # A job of a batch system: its limit is above the process's own cgroup and below the root.
        ("0::/slurm/job_7/step", {"slurm/job_7/memory.max": "1073741824", "slurm/memory.max": "max"}, 1.0, None),
        # A container that sees its cgroup as the root, while its path is the machine's.
        ("0::/docker/x", {"memory.max": "536870912", "cpu.max": "50000 100000"}, 0.5, 1),
        ("3:memory:/job\n2:cpu,cpuacct:/job", {"memory/job/memory.limit_in_bytes": "1073741824"}, 1.0, None),
        ("2:cpu,cpuacct:/a", {"cpu/a/cpu.cfs_quota_us": "100000", "cpu/a/cpu.cfs_period_us": "100000"}, None, 1),
        ("2:cpu,cpuacct:/a", {"cpu/a/cpu.cfs_quota_us": "-1", "cpu/a/cpu.cfs_period_us": "100000"}, None, None),
    ],
)
def test_limits_of_the_processs_own_cgroup_count(
    line: str,
    files: dict[str, str],
    gib: float | None,
    cores: int | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(cgroups, "CGROUP_ROOT", tmp_path / "cgroup")
    monkeypatch.setattr(cgroups, "CGROUPS_OF_PROCESS", tmp_path / "own")
    (tmp_path / "own").write_text("")
    without = (memory_limit_gib(), count_cores())
    (tmp_path / "own").write_text(line + "\n")
    for name, text in files.items():
        (tmp_path / "cgroup" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "cgroup" / name).write_text(text + "\n")
    assert (memory_limit_gib(), count_cores()) == (gib or without[0], cores or without[1])


@pytest.mark.parametrize(
    "error",
    [
        FileNotFoundError("No usable temporary directory found"),
        ConfigError("the folder belongs to another user", remedy="Set XDG_STATE_HOME to a folder of yours."),
    ],
    ids=["nowhere to write", "another user's folder"],
)
def test_help_needs_no_folder_to_write_to(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere() -> Path:
        raise error

    variables: dict[str, str] = {}
    monkeypatch.setattr(os, "environ", variables)
    monkeypatch.setattr(main, "find_state_folder", nowhere)
    main.prepare_environment(debug=True)
    assert variables["DO_NOT_TRACK"] == "1" and "PREFECT_HOME" not in variables
    monkeypatch.setattr(main, "find_state_folder", lambda: Path("/state"))
    main.prepare_environment(debug=True)
    assert variables["PREFECT_HOME"] == "/state/prefect"


def test_a_state_folder_of_somebody_else_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "file" / "home")
    (tmp_path / "file").write_text("no folder")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = find_state_folder()
    assert folder == tmp_path / f"genre-{os.getuid()}" and folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o777)
    with pytest.raises(ConfigError, match="XDG_STATE_HOME"):
        find_state_folder()
    folder.rmdir()
    folder.symlink_to(tmp_path)
    with pytest.raises(ConfigError, match="belongs to another user"):
        find_state_folder()
