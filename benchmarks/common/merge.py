"""One result of several files of a benchmark, measured part by part; claims are made anew from all their rows.

python -m benchmarks.common.merge optimiser docs/benchmarks/optimiser_split.json race.json enhancement.json
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.common.bench import Bench, Row
from benchmarks.common.claims import Result, write_json
from flows.cli.bench import load
from genre_tasks.errors import ArtifactCorruptError


def merged(bench: Bench, results: Sequence[Result]) -> Result:
    """All rows, in the order in which their cells first appear; of a cell in several results the last one's row.

    Machine and commit are the last result's; a row from elsewhere says its own. A cell that was not measured does not
    replace one that was. Raises ``ValueError`` without a result.
    """
    if not results:
        raise ValueError("expected at least one result to merge; there is none")
    last, rows = results[-1], dict[str, Row]()
    for result in results:
        for row in result.rows:
            name = str(row["cell"])
            if "not_measured" not in row or name not in rows:
                rows[name] = _with_origin(row, result, last)
    named = {name: {k: v for k, v in row.items() if k != "cell"} for name, row in rows.items()}
    return last.model_copy(update={"rows": list(rows.values()), "claims": list(bench.claims(named))})


def _with_origin(row: Row, result: Result, last: Result) -> Row:
    own = {"machine": result.machine, "commit": result.commit} | row
    return {k: v for k, v in own.items() if k not in ("machine", "commit") or v != getattr(last, k)}


def read(path: Path) -> Result:
    """A result that ``genre bench`` wrote. Raises ``ArtifactCorruptError`` for anything else."""
    try:
        return Result.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ArtifactCorruptError(
            f"not a benchmark's result: {error}", remedy="Name files that `genre bench … --json FILE` wrote.", file=path
        ) from error


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bench", help="the benchmark's name")
    parser.add_argument("out", type=Path, help="file to write; may be one of those read")
    parser.add_argument("results", type=Path, nargs="+", help="files to read; of a cell in several the last counts")
    given = parser.parse_args(arguments)
    result = merged(load(given.bench), [read(path) for path in given.results])
    write_json(given.out, result.model_dump(mode="json"))


if __name__ == "__main__":
    main()
