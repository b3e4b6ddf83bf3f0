"""What the written tables of experiments have in common: facts of the machine, and files that appear whole."""

from __future__ import annotations

import time
from pathlib import Path

from flows.machine.facts import describe_machine, git_commit
from genre_tasks.atomic_path import atomic_path
from storage.files import write_file


def machine_facts() -> dict[str, str]:
    """Gives what a reader needs to judge times: the machine, the commit and the date (UTC)."""
    return {
        "machine": describe_machine(),
        "commit": git_commit(),
        # In UTC, so that files of two machines can be ordered.
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
    }


def write_text(path: Path, text: str) -> None:
    """Writes a text file that appears whole or not at all, in UTF-8.

    Args:
        path: the file to write or replace; its folder exists.
        text: the whole content.
    """
    with atomic_path(path) as part:
        write_file(part, text.encode())
