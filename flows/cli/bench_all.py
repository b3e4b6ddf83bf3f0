"""``genre bench all``: every benchmark one after the other, so that all documents state numbers of one version."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import typer

ALL = "all"


def list_benches(names: Sequence[str], load: Callable[[str], Any], quick: bool, fresh: bool) -> list[dict[str, Any]]:
    """Says what each benchmark would measure and how long that would take.

    Args:
        names: of the benchmarks.
        load: imports one.
        quick: whether they measure less.
        fresh: whether what an earlier run has measured is measured again.

    Returns:
        A line for each: its name, how many cells are measured and how many are there already, and minutes.

    Raises:
        ConfigError: a benchmark cannot be imported.
    """
    runner = importlib.import_module("benchmarks.common.runner")
    lines = []
    for name in names:
        benchmark = load(name)
        options = runner.parse_options(benchmark, ())
        cells = runner.list_cells(runner.find_cached_rows(benchmark, options, quick, fresh))
        cached = sum(cell["cached"] for cell in cells)
        minutes = sum(cell["seconds"] for cell in cells) / 60
        lines.append({"benchmark": name, "measure": len(cells) - cached, "cached": cached, "minutes": round(minutes)})
    return lines


def run_benches(names: Sequence[str], folder: Path, flags: Sequence[str]) -> list[str]:
    """Runs benchmarks, each in a process of its own: what one of them loads would count as another one's memory.

    Args:
        names: of the benchmarks.
        folder: for ``NAME.json`` of each.
        flags: further arguments of ``genre bench``.

    Returns:
        The names of those that ended with an error; the others went on.
    """
    failed = []
    for number, name in enumerate(names, 1):
        typer.echo(f"benchmark {number} of {len(names)}: {name}", err=True)
        code = "import sys; from flows.cli.entry import main; sys.exit(main())"
        command = [sys.executable, "-c", code, "bench", name, "--json", str(folder / f"{name}.json"), *flags]
        # A benchmark that fails is no reason to measure none of the others, which take hours.
        if subprocess.run(command, check=False).returncode != 0:
            failed.append(name)
    return failed
