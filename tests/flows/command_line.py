"""The real command in a process of its own, for tests of streams, exit statuses and outcomes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GENRE = [sys.executable, "-m", "flows.cli.main"]
FAULTY = """
import sys
from typing import Annotated

import typer

from flows.cli.main import app, main


def faulty(as_json: Annotated[bool, typer.Option("--json")] = False) -> None:
    {statement}


app.command(name="faulty")(faulty)
main()
"""
"""A program whose command ``faulty`` executes a statement."""


def environment(**more: str) -> dict[str, str]:
    """The caller's environment without what would change the output."""
    left_out = ("PYTHONIOENCODING", "PYTHONUNBUFFERED", "PYTHONUTF8", "COLUMNS", "LC_ALL")
    return {k: v for k, v in os.environ.items() if k not in left_out} | {"PYTHONPATH": str(ROOT)} | more


def genre(folder: Path, *words: str, **more: str) -> subprocess.CompletedProcess[bytes]:
    """``genre …`` to its end, with variables of the environment as keywords."""
    return subprocess.run([*GENRE, *words], cwd=folder, env=environment(**more), capture_output=True, check=False)


def faulty(folder: Path, statement: str, *words: str) -> subprocess.CompletedProcess[str]:
    """A command that executes a statement, with the words after its name."""
    command = [sys.executable, "-c", FAULTY.format(statement=statement), "faulty", *words]
    env = environment(XDG_STATE_HOME=str(folder / "state"))
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)


def shell(folder: Path, script: str, **more: str) -> subprocess.CompletedProcess[str]:
    """A script of bash in which ``$GENRE`` is the command; a pipe's status is that of its first failure."""
    env = environment(GENRE=" ".join(GENRE), **more)
    return subprocess.run(
        ["bash", "-o", "pipefail", "-c", script], cwd=folder, env=env, capture_output=True, text=True, check=False
    )
