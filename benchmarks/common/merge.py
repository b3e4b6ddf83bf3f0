"""Merges files of a benchmark that was measured part by part; claims are made again from all their rows.

python -m benchmarks.common.merge optimiser docs/results/data/optimiser.json race.json enhancement.json
python -m benchmarks.common.merge evaluation docs/results/data/evaluation.json budgets.json guards.json --set rounds=3
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common.bench import Bench, Row
from benchmarks.common.claims import Result, write_json
from benchmarks.common.runner import changed_options, parse_options
from flows.cli.bench import load_bench
from genre_tasks.errors import ArtifactCorruptError

_ORIGIN = ("machine", "commit", "options")
"""What a file says of all its rows, and a row of itself where it is from elsewhere."""


def merge_results(bench: Bench, results: Sequence[Result]) -> Result:
    """Merges results of one benchmark.

    Args:
        bench: makes the claims.
        results: at least one; of a cell in several of them the last one's row counts, unless it was not measured there.

    Returns:
        All rows, in the order in which the counted ones were read: a cell that is measured again moves behind those
        before it. Machine, commit and options are the last result's; a row from elsewhere carries its own.

    Raises:
        ValueError: there is no result.
    """
    if not results:
        raise ValueError("expected at least one result to merge; there is none")
    last = results[-1]
    rows: dict[str, Row] = {}
    for result in results:
        for row in result.rows:
            name = str(row["cell"])
            # A later partial run leaves most cells out, and must not erase what an earlier one measured.
            if "not_measured" not in row or name not in rows:
                # Two cells may measure the same; of those the later one counts, which has to be the newer one.
                rows.pop(name, None)
                rows[name] = _with_origin(row, result, last)
    # Claims are made again, because they may span cells of several files.
    named = {name: {k: v for k, v in row.items() if k != "cell"} for name, row in rows.items()}
    return last.model_copy(update={"rows": list(rows.values()), "claims": list(bench.claims(named))})


def _with_origin(row: Row, result: Result, last: Result) -> Row:
    # A row that an earlier merge took from elsewhere keeps its own.
    complete: Row = {"machine": result.machine, "commit": result.commit, "options": dict(result.options)} | row
    return {k: v for k, v in complete.items() if k not in _ORIGIN or v != getattr(last, k)}


def add_options(bench: Bench, result: Result, settings: Sequence[str]) -> Result:
    """Says with which options a file was measured that notes none.

    Args:
        bench: has the defaults.
        result: of a version that did not note them; one that notes some stays as it is.
        settings: ``NAME=VALUE``, as ``genre bench --set`` takes them.

    Raises:
        ConfigError: there is no such option.
    """
    options = changed_options(bench, parse_options(bench, settings))
    return result if result.options else result.model_copy(update={"options": options})


def read_result(path: Path) -> Result:
    """Reads a result that ``genre bench`` wrote.

    Raises:
        ArtifactCorruptError: the file is not there or is no such result.
    """
    try:
        return Result.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ArtifactCorruptError(
            f"not a benchmark's result: {error}", remedy="Name files that `genre bench … --json FILE` wrote.", file=path
        ) from error


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line, see the top of this module.

    Args:
        arguments: of the command; those of the process if ``None``.

    Raises:
        ArtifactCorruptError: a file is no result.
        ConfigError: there is no such benchmark or option.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", help="the benchmark's name")
    parser.add_argument("out", type=Path, help="file to write; may be one of those read")
    parser.add_argument("results", type=Path, nargs="+", help="files to read; of a cell in several the last counts")
    words = "an option with which those files were measured that note none, as NAME=VALUE"
    parser.add_argument("--set", dest="settings", action="append", default=[], help=words)
    options = parser.parse_args(arguments)
    bench = load_bench(options.bench)
    results = [add_options(bench, read_result(path), options.settings) for path in options.results]
    result = merge_results(bench, results)
    write_json(options.out, result.model_dump(mode="json"))


if __name__ == "__main__":
    main()
