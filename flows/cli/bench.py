"""``genre bench``: measures a set of claims and writes them down, those that fail too.

Benchmarks are named, not imported: nothing in the product depends on them.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flows.cli.bench_all import ALL, list_benches, run_benches
from flows.cli.parsing import parse_path

if TYPE_CHECKING:
    from collections.abc import Mapping


@dataclass(frozen=True)
class BenchEntry:
    """A known benchmark.

    Attributes:
        target: where it lives, as ``module:NAME``.
        about: what it measures, a few words.
    """

    target: str
    about: str


_BENCHES: dict[str, BenchEntry] = {
    "effects": BenchEntry("benchmarks.effects:EFFECTS", "what each effect gains where a log calls for it"),
    "evaluation": BenchEntry(
        "benchmarks.evaluation:EVALUATION", "whether runs keep their budget, and how well guards predict quality"
    ),
    "exchange": BenchEntry(
        "benchmarks.exchange:BENCH", "formats, foreign scenes enhanced, pages in a browser, and simulators' requests"
    ),
    "facades": BenchEntry(
        "benchmarks.optimiser.ablation:FACADES", "what completing façades above the LiDAR's view gains"
    ),
    "fixer": BenchEntry("benchmarks.fixer:BENCH", "what FNet gains beside the path, and what it costs"),
    "full_size": BenchEntry("benchmarks.full_size:BENCH", "seconds, memory and images of the preset hd"),
    "ground": BenchEntry("benchmarks.optimiser.ablation:GROUND", "what constraining the ground to its plane gains"),
    "log_faults": BenchEntry(
        "benchmarks.log_faults:BENCH", "from which strength faults of logs are found, and false alarms on sound logs"
    ),
    "optimiser": BenchEntry(
        "benchmarks.optimiser:BENCH", "GNet's seconds and renders against per-scene 3DGS and tuned Adam"
    ),
    "perception": BenchEntry(
        "benchmarks.perception:BENCH",
        "how far detectors agree on recorded and rendered images, and train on these",
    ),
    "pipeline": BenchEntry("benchmarks.pipeline:BENCH", "the pipeline on synthetic streets and a real chunk"),
    "raster": BenchEntry(
        "benchmarks.raster:BENCH", "the renderer's speed against gsplat's torch reference and the machine's limits"
    ),
    "real_logs": BenchEntry(
        "benchmarks.real_logs:BENCH", "what stereo, refined poses and exposure gain on real logs and streets that err"
    ),
    "scale": BenchEntry(
        "benchmarks.scale:BENCH", "workers, orchestration, the store on S3, a simulated cluster, and damaged files"
    ),
    "simulation": BenchEntry(
        "benchmarks.simulation:BENCH", "other behaviours and edited traffic against the truth; speed and hand-over"
    ),
    "start_up": BenchEntry("benchmarks.start_up:BENCH", "seconds before anything is computed"),
}


def register_bench(name: str, target: str, about: str = "") -> None:
    """Makes a benchmark known to ``genre bench``.

    Args:
        name: the benchmark's name on the command line.
        target: ``module:NAME`` of a :class:`benchmarks.common.bench.Bench`.
        about: what it measures, a few words.

    Raises:
        ValueError: another benchmark has this name.
    """
    if name in _BENCHES and _BENCHES[name].target != target:
        raise ValueError(f"the benchmark {name!r} exists already, at {_BENCHES[name].target}")
    _BENCHES[name] = BenchEntry(target, about)


def load_bench(name: str) -> Any:
    """Imports a benchmark.

    Args:
        name: the benchmark's name on the command line.

    Returns:
        A :class:`benchmarks.common.bench.Bench`.

    Raises:
        ConfigError: there is no such benchmark, or it cannot be imported.

    >>> load_bench("rasta")
    Traceback (most recent call last):
    genre_tasks.errors.ConfigError: unknown benchmark 'rasta'. Did you mean 'raster'? …
    """
    from genre_tasks.errors import ConfigError
    from genre_tasks.suggestions import did_you_mean

    if name not in _BENCHES:
        known = "; ".join(f"{bench_name}: {entry.about}" for bench_name, entry in sorted(_BENCHES.items()))
        raise ConfigError(f"unknown benchmark {name!r}", remedy=f"{did_you_mean(name, _BENCHES)}Known: {known}.")
    # Imported by name: an installation without the benchmarks has all other commands.
    module, _, attribute = _BENCHES[name].target.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except ImportError as error:
        raise ConfigError(
            f"the benchmark {name!r} cannot be loaded ({error})", remedy="Run `pip install -e '.[bench]'`."
        ) from error


def bench(
    name: Annotated[
        str,
        typer.Argument(
            help="The benchmark: "
            + ", ".join(f"{name} ({entry.about})" for name, entry in _BENCHES.items())
            + "; or all of them: all."
        ),
    ],
    json_file: Annotated[
        Path | None,
        typer.Option(
            "--json",
            parser=parse_path,
            metavar="PATH",
            help="The JSON file to write, over an existing one; for all benchmarks their folder. Required, except for "
            "a dry run.",
        ),
    ] = None,
    quick: Annotated[bool, typer.Option(help="Measure less, so that it ends within 20 minutes.")] = False,
    dry_run: Annotated[
        bool, typer.Option(help="List what would be measured and how long it would take, then stop.")
    ] = False,
    fresh: Annotated[bool, typer.Option(help="Measure again what an earlier run has measured.")] = False,
    only: Annotated[str, typer.Option(help="Measure only cells whose names contain this text.")] = "",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Change one option of the benchmark, as NAME=VALUE. May be given several times."),
    ] = None,
) -> None:
    """Run a benchmark and write its claims as JSON.

    A benchmark measures cells, such as one log with one seed, and checks claims on them. The claims go into the JSON
    file with all measurements, and a table is printed. The exit status is 0 even if a claim fails.

    Measured cells are kept in .genre/bench, so a benchmark that was stopped goes on where it was.

    Example:

    \b
        genre bench pipeline --json pipeline.json --set seeds=1001
        genre bench all --dry-run
    """
    try:
        if name == ALL:
            _bench_all(json_file, quick, dry_run, fresh, is_one=bool(only or settings))
        else:
            _bench_one(name, json_file, quick, dry_run, fresh, only, settings or [])
    except KeyboardInterrupt:
        typer.echo("stopped; measured cells are kept: run the same command again to go on", err=True)
        raise typer.Exit(130) from None


def _bench_one(
    name: str, json_file: Path | None, quick: bool, dry_run: bool, fresh: bool, only: str, settings: list[str]
) -> None:
    from flows.cli.output_paths import check_output_file
    from genre_tasks.errors import ConfigError

    # Before the benchmark is imported, which takes seconds.
    if json_file is not None:
        check_output_file(json_file, "--json")
    benchmark = load_bench(name)
    runner = importlib.import_module("benchmarks.common.runner")
    # The options are read before anything is measured, so that a mistyped one costs nothing.
    options = runner.parse_options(benchmark, settings)
    if dry_run:
        _print_cells(name, runner.list_cells(runner.find_cached_rows(benchmark, options, quick, fresh), only))
        return
    if json_file is None:
        raise ConfigError("there is no file to write to", remedy="Add --json FILE, or --dry-run.")
    runner.run_bench(benchmark, json_file, options, quick, fresh, only=only)
    # On stderr, as stdout is the table alone and may go into a document.
    typer.echo(f"wrote {json_file}", err=True)


def _bench_all(folder: Path | None, quick: bool, dry_run: bool, fresh: bool, is_one: bool) -> None:
    from flows.cli.printing import print_rows
    from genre_tasks.errors import ConfigError

    if is_one:
        raise ConfigError("--only and --set belong to one benchmark", remedy="Name the benchmark, or leave them out.")
    if dry_run:
        lines = list_benches(sorted(_BENCHES), load_bench, quick, fresh)
        print_rows("genre bench all (dry run)", lines)
        typer.echo(f"about {sum(line['minutes'] for line in lines) / 60:.1f} hours to measure")
        return
    if folder is None or not folder.is_dir():
        problem = "there is no folder to write to" if folder is None else f"there is no folder {folder}"
        raise ConfigError(problem, remedy="Add --json FOLDER.")
    flags = [flag for flag, is_set in (("--quick", quick), ("--fresh", fresh)) if is_set]
    failed = run_benches(sorted(_BENCHES), folder, flags)
    if failed:
        typer.echo(f"ended with an error: {', '.join(failed)}", err=True)
        raise typer.Exit(1)


def _print_cells(name: str, cells: list[Mapping[str, Any]]) -> None:
    from flows.cli.printing import print_rows

    print_rows(f"genre bench {name} (dry run)", cells)
    typer.echo(f"about {sum(cell['seconds'] for cell in cells):.0f} s to measure")
