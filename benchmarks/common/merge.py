"""Merges files of a benchmark that was measured part by part; claims are made again from all their rows.

python -m benchmarks.common.merge optimiser docs/results/data/optimiser.json race.json enhancement.json
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common.bench import Bench, Row
from benchmarks.common.claims import Result, write_json
from flows.cli.bench import load_bench
from genre_tasks.errors import ArtifactCorruptError


def merge_results(bench: Bench, results: Sequence[Result]) -> Result:
    """Merges results of one benchmark.

    Args:
        bench: makes the claims.
        results: at least one; of a cell in several of them the last one's row counts, unless it was not measured there.

    Returns:
        All rows, in the order in which the counted ones were read: a cell that is measured again moves behind those
        before it. Machine and commit are the last result's; a row from elsewhere carries its own.

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
    # A row that an earlier merge took from elsewhere keeps its own machine and commit.
    complete = {"machine": result.machine, "commit": result.commit} | row
    return {k: v for k, v in complete.items() if k not in ("machine", "commit") or v != getattr(last, k)}


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
        ConfigError: there is no such benchmark.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", help="the benchmark's name")
    parser.add_argument("out", type=Path, help="file to write; may be one of those read")
    parser.add_argument("results", type=Path, nargs="+", help="files to read; of a cell in several the last counts")
    options = parser.parse_args(arguments)
    result = merge_results(load_bench(options.bench), [read_result(path) for path in options.results])
    write_json(options.out, result.model_dump(mode="json"))


if __name__ == "__main__":
    main()
