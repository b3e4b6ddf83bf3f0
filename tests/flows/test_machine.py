"""What a result says of where it was measured."""

from __future__ import annotations

import subprocess
from pathlib import Path

import torch

from flows.machine.facts import describe_environment, describe_machine, git_commit
from genre_tasks.compiled.loader import supported_instruction_sets
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
