"""Runs a benchmark: cell by cell, each cached as soon as it is measured, so that a broken-off run goes on."""

from __future__ import annotations

import hashlib
import json
import re
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.bench import Bench, Cell, NotMeasuredError, Row
from benchmarks.common.claims import Result, write_json
from benchmarks.common.run_stages import print_progress
from flows.machine.facts import describe_machine, git_commit
from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.code_digest import code_digest

CACHE = Path(".genre/bench")
QUICK_S = 20 * 60.0
"""A quick run leaves out what would not end by then."""


@dataclass(frozen=True)
class CachedCell:
    """A cell and where its row is cached.

    Attributes:
        cell: what to measure.
        path: the file of its row.
        row: what was measured; ``None`` until it was.
    """

    cell: Cell
    path: Path
    row: Row | None


def parse_options(bench: Bench, settings: Sequence[str]) -> dict[str, str]:
    """Applies the user's settings to a benchmark's options.

    Args:
        bench: has the defaults.
        settings: ``NAME=VALUE``.

    Returns:
        All options.

    Raises:
        ConfigError: there is no such option.
    """
    options = dict(bench.options)
    for setting in settings:
        # Split at the first sign alone: values such as settings hold further ones.
        name, equals, value = setting.partition("=")
        if not equals or name not in options:
            known = ", ".join(f"{k}={v}" for k, v in options.items()) or "none"
            raise ConfigError(f"bench {bench.name} has no option {setting!r}", remedy=f"Known: {known}.")
        options[name] = value
    return options


def changed_options(bench: Bench, options: Mapping[str, str]) -> dict[str, str]:
    """Lists the options that differ from a benchmark's defaults, for its file.

    Args:
        bench: has the defaults.
        options: all of its options.
    """
    return {name: value for name, value in options.items() if value != bench.options[name]}


def find_cached_rows(
    bench: Bench, options: Mapping[str, str], quick: bool, fresh: bool, cache: Path = CACHE
) -> list[CachedCell]:
    """Lists a benchmark's cells with the rows that the cache has of them.

    Args:
        bench: the benchmark.
        options: all of its options.
        quick: whether it takes fewer runs.
        fresh: whether cached rows are ignored.
        cache: folder of the rows.

    Returns:
        The cells in order. A row counts for one name, parameters, code and machine; one that was measured at another
        commit than today's says so as ``commit``.

    Raises:
        ArtifactCorruptError: a cached row cannot be read.
    """
    code = code_digest(bench.code[0], bench.code[1:])
    # Seconds of another machine are no measurement of this one.
    machine = describe_machine()
    commit = git_commit()
    found = []
    for cell in bench.cells(options, quick):
        text = json.dumps([bench.name, cell.name, dict(cell.parameters), code, machine], sort_keys=True)
        # Sixteen digits are enough for a cache, and keep file names readable.
        key = hashlib.sha256(text.encode()).hexdigest()[:16]
        # The name is for people; the key alone tells cells apart.
        readable = re.sub(r"[^\w.-]+", "_", cell.name)
        path = cache / bench.name / f"{readable}-{key}.json"
        found.append(CachedCell(cell, path, None if fresh else _read_row(path, commit)))
    return found


def _read_row(path: Path, commit: str) -> Row | None:
    if not path.exists():
        return None
    try:
        cached = json.loads(path.read_text(encoding="utf-8"))
        row = dict(cached["row"])
        measured_at = cached.get("commit", "unknown")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ArtifactCorruptError(
            f"a measured cell cannot be read: {error}", remedy="Delete the file, or use --fresh.", file=path
        ) from error
    # The file that is written of all rows states today's commit, which would be false for this one.
    return row if measured_at == commit else {"commit": measured_at, **row}


def measure_cells(
    cells: Sequence[CachedCell], report: Callable[[str], None], limit_s: float | None = None, only: str = ""
) -> dict[str, Row]:
    """Measures what is not cached, and caches it.

    Args:
        cells: in order.
        report: gets a line for each cell.
        limit_s: cells that would not end within so many seconds are left out.
        only: cells without this text in their names are left out.

    Returns:
        Rows by cell. A cell that is left out, or that cannot be measured here, has the row ``{"not_measured": why}``,
        which is not cached.
    """
    rows: dict[str, Row] = {}
    # Of the code that runs: the checkout may change while a benchmark runs for hours.
    commit = git_commit()
    began = time.monotonic()
    for cached in cells:
        name = cached.cell.name
        # Monotonic, because the wall clock may be set while a benchmark runs for hours.
        start = time.monotonic()
        try:
            if only not in name:
                raise NotMeasuredError(f"left out: measured were cells with {only!r} in their names")
            if cached.row is not None:
                rows[name] = cached.row
                report(f"{name}: from the cache")
                continue
            # Asked before the cell starts: a broken-off measurement would be lost time.
            if limit_s is not None and start - began + cached.cell.seconds > limit_s:
                raise NotMeasuredError(f"left out: would not end within {limit_s / 60:.0f} minutes")
            rows[name] = cached.cell.measure()
        except NotMeasuredError as reason:
            # Never cached: the folder or the GPU may be there the next time.
            rows[name] = {"not_measured": str(reason)}
            report(f"{name}: not measured: {reason}")
            continue
        seconds = time.monotonic() - start
        # Written after each cell, so that a run that is killed loses one cell at most.
        _write_row(cached, rows[name], seconds, commit)
        report(f"{name}: measured in {seconds:.1f} s")
    return rows


def _write_row(cached: CachedCell, row: Row, seconds: float, commit: str) -> None:
    facts = {"parameters": dict(cached.cell.parameters), "seconds": seconds, "commit": commit}
    write_json(cached.path, {"cell": cached.cell.name, **facts, "row": row})


def make_result(bench: Bench, rows: Mapping[str, Row], commit: str, options: Mapping[str, str]) -> Result:
    """Makes the benchmark's file of its rows.

    Args:
        bench: makes the claims.
        rows: by cell.
        commit: that the rows were measured at which name none of their own.
        options: all options of the benchmark.

    Returns:
        Rows and claims with machine and commit, checked against the schema.
    """
    named = [{"cell": name, **row} for name, row in rows.items()]
    return Result(
        machine=describe_machine(),
        commit=commit,
        options=changed_options(bench, options),
        rows=named,
        claims=list(bench.claims(rows)),
    )


def run_bench(
    bench: Bench,
    json_file: Path,
    options: Mapping[str, str],
    quick: bool,
    fresh: bool,
    cache: Path = CACHE,
    only: str = "",
) -> Result:
    """Measures a benchmark, writes its file, prints the table to stdout and the claims to stderr.

    Args:
        bench: the benchmark.
        json_file: the file to write.
        options: all of its options.
        quick: whether it takes fewer runs and leaves out what would not end within ``QUICK_S``.
        fresh: whether cached rows are measured again.
        cache: folder of the rows.
        only: cells without this text in their names are left out.

    Returns:
        What was written.

    Raises:
        ArtifactCorruptError: a cached row cannot be read.
    """
    commit = git_commit()
    cells = find_cached_rows(bench, options, quick, fresh, cache)
    rows = measure_cells(cells, print_progress, QUICK_S if quick else None, only)
    result = make_result(bench, rows, commit, options)
    write_json(json_file, result.model_dump(mode="json"))
    for line in bench.table(rows):
        sys.stdout.write(line + "\n")
    for c in result.claims:
        # Capitals, because one failure has to be found among a screen of lines.
        word = "holds" if c.holds else "FAILS"
        measured = "not measured" if c.measured is None else f"{c.measured:12.4f}"
        print_progress(f"{word}  {c.id:<28} {measured} {c.op} {c.target} {c.unit}  {c.data}")
    return result


def list_cells(cells: Sequence[CachedCell], only: str = "") -> list[dict[str, Any]]:
    """Lists cells for a dry run.

    Args:
        cells: in order.
        only: cells without this text in their names are left out.

    Returns:
        A line for each: its name, whether it is cached, and the seconds to measure it.
    """
    return [
        {"cell": c.cell.name, "cached": c.row is not None, "seconds": 0.0 if c.row is not None else c.cell.seconds}
        for c in cells
        if only in c.cell.name
    ]
