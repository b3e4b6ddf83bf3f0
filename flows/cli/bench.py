"""``genre bench``: measures a set of claims and writes them down, those that fail too.

Benchmarks are named, not imported: nothing in the product depends on them.
"""

from __future__ import annotations

import difflib
import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer


@dataclass(frozen=True)
class BenchEntry:
    """Where a benchmark lives (``module:NAME``), and what it measures."""

    target: str
    about: str


_BENCHES: dict[str, BenchEntry] = {
    "effects": BenchEntry("benchmarks.effects:EFFECTS", "what each effect brings where a log calls for it"),
    "evaluation": BenchEntry("benchmarks.evaluation:EVALUATION", "whether budgets are kept, and what guards tell"),
    "facades": BenchEntry(
        "benchmarks.optimiser.ablation:FACADES", "what completing façades above the LiDAR's view brings"
    ),
    "fixer": BenchEntry("benchmarks.fixer:BENCH", "what FNet brings beside the path, and what it costs"),
    "ground": BenchEntry("benchmarks.optimiser.ablation:GROUND", "what holding the ground in its plane brings"),
    "main_job": BenchEntry("benchmarks.pipeline:BENCH", "the pipeline on claim seeds and a real chunk"),
    "optimiser": BenchEntry(
        "benchmarks.optimiser:BENCH", "GNet's seconds and renders beside per-scene 3DGS and tuned Adam"
    ),
    "raster": BenchEntry("benchmarks.raster:BENCH", "the renderer beside gsplat's torch reference and the machine"),
}


def register(name: str, target: str, about: str = "") -> None:
    """Adds a benchmark: ``target`` is ``"module:NAME"`` of a :class:`benchmarks.common.bench.Bench`."""
    if name in _BENCHES and _BENCHES[name].target != target:
        raise ValueError(f"the benchmark {name!r} exists already, at {_BENCHES[name].target}")
    _BENCHES[name] = BenchEntry(target, about)


def load(name: str) -> Any:
    """The benchmark of that name. Raises ``ConfigError`` where there is none, or it cannot be imported."""
    from genre_tasks.errors import ConfigError

    if name not in _BENCHES:
        close = difflib.get_close_matches(name, _BENCHES, n=1)
        question = f"Did you mean {close[0]!r}? " if close else ""
        known = "; ".join(f"{n}: {entry.about}" for n, entry in sorted(_BENCHES.items()))
        raise ConfigError(f"unknown benchmark {name!r}", remedy=f"{question}Known: {known}.")
    module, _, attribute = _BENCHES[name].target.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ImportError as error:
        raise ConfigError(
            f"the benchmark {name!r} cannot be loaded ({error})", remedy="Run `pip install -e '.[bench]'`."
        ) from error


def bench(
    name: Annotated[str, typer.Argument(help=f"One of {', '.join(_BENCHES)}.")],
    json_file: Annotated[Path | None, typer.Option("--json", help="File to write rows and claims to.")] = None,
    quick: Annotated[bool, typer.Option(help="Fewer runs; ends within 20 minutes.")] = False,
    dry_run: Annotated[bool, typer.Option(help="List the cells with predicted seconds, measure nothing.")] = False,
    fresh: Annotated[bool, typer.Option(help="Measure again what is in the cache.")] = False,
    settings: Annotated[list[str] | None, typer.Option("--set", help="An option of the benchmark, NAME=VALUE.")] = None,
) -> None:
    """Measure a set of claims, write them as JSON, and print a table; exits 0 when written, also if claims fail."""
    from genre_tasks.errors import ConfigError

    chosen = load(name)
    runner = importlib.import_module("benchmarks.common.runner")
    options = runner.options_of(chosen, tuple(settings or ()))
    if dry_run:
        from flows.cli.printing import print_rows

        listed = runner.dry_run(runner.plan(chosen, options, quick, fresh))
        print_rows(f"genre bench {name} (dry run)", listed)
        typer.echo(f"about {sum(line['seconds'] for line in listed):.0f} s to measure")
        return
    if json_file is None:
        raise ConfigError("there is no file to write to", remedy="Add --json FILE, or --dry-run.")
    try:
        runner.run_bench(chosen, json_file, options, quick, fresh)
    except KeyboardInterrupt:
        typer.echo("stopped; measured cells are kept: run the same command again to go on", err=True)
        raise typer.Exit(130) from None
