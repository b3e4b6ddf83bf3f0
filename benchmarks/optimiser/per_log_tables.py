"""Tables of a written result with a line for each log: the mean over its orders of views, as Markdown.

python -m benchmarks.optimiser.per_log_tables docs/results/data/optimiser.json
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.bench import Row
from benchmarks.common.context import cell_label
from benchmarks.common.merge import read_result
from benchmarks.optimiser import claims, enhancement_claims
from benchmarks.optimiser.distillation import FAMILIES
from benchmarks.optimiser.plots import HELDOUT, NOVEL

SECONDS = 0
KERNEL = 2
NOVEL_PSNR = 3
"""Columns of a distillation's scores."""
SHOWN_SHIFTS = ("1", "3", "5")
"""Shifts in metres that the table of enhancement shows; the JSON has all."""


_Read = Callable[[Row], float | None]


@dataclass(frozen=True)
class Column:
    """One column of a table: the mean of a number over the rows of a log.

    Attributes:
        title: of the column.
        kind: of the rows.
        read: the number of one row; ``None`` where it has none, which then does not count.
        digits: decimals that are shown.
        at_least: whether a row's number is a lower bound; a mean over such a row is one too.
        then: a second number, shown behind an arrow.
    """

    title: str
    kind: str
    read: _Read
    digits: int = 2
    at_least: Callable[[Row], bool] = lambda row: False
    then: _Read | None = None


def pages(rows: Mapping[str, Row]) -> Iterator[str]:
    """Makes the tables of the race, of convergence, of distillation and of enhancement.

    Args:
        rows: of the optimiser's benchmark, by cell.

    Yields:
        Lines of Markdown, and an empty one behind each table; what was not measured has no table.
    """
    kinds = {method: claims.race_rows(rows, method) for method in ("tuned_adam", "tuned_adam_split", "standard_3dgs")}
    kinds |= {kind: enhancement_claims.rows_of_kind(rows, kind) for kind in ("converged", "enhancement")}
    kinds |= {family: enhancement_claims.distillation_rows(rows, family) for family in FAMILIES}
    logs = {kind: by_log(found) for kind, found in kinds.items()}
    # Every table lists the logs in the order of the race, so that a reader finds a log in the same line.
    order = dict.fromkeys(log for found in logs.values() for log in found)
    logs = {kind: {log: found[log] for log in order if log in found} for kind, found in logs.items()}
    for columns in (_RACE, _CONVERGED, _BY_ADAM, _BY_RECIPE, _ENHANCEMENT):
        if logs[columns[0].kind]:
            yield from table(columns, logs)
            yield ""


def by_log(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Groups rows of all orders by log and chunk.

    Args:
        rows: of one kind.

    Returns:
        Rows by the log's label.
    """
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(cell_label(row).partition(" order")[0], []).append(row)
    return out


def table(columns: Sequence[Column], logs: Mapping[str, Mapping[str, Sequence[Row]]]) -> Iterator[str]:
    """Makes a table with a line for each log of the first column's kind.

    Args:
        columns: behind the log and the number of its orders.
        logs: rows of each kind and log.

    Yields:
        Lines of Markdown.
    """
    yield "| log | orders | " + " | ".join(c.title for c in columns) + " |"
    yield "|---" * (len(columns) + 2) + "|"
    for log, orders in logs[columns[0].kind].items():
        cells = " | ".join(_cell(column, logs[column.kind].get(log, ())) for column in columns)
        yield f"| {log} | {len(orders)} | {cells} |"


def _cell(column: Column, rows: Sequence[Row]) -> str:
    """The mean of each reading, with its arrow or bound; a dash where no row has it."""
    # A row without the number is left out of the mean: a real log has no truth at novel views.
    readings = [column.read] if column.then is None else [column.read, column.then]
    found = [[v for row in rows if (v := read(row)) is not None] for read in readings]
    if not all(found):
        return "–"
    # A mean with one lower bound in it is itself a lower bound.
    bound = "≥ " if any(map(column.at_least, rows)) else ""
    return bound + " → ".join(f"{statistics.fmean(values):.{column.digits}f}" for values in found)


def _last(curve: Sequence[Sequence[float]], k: int) -> float | None:
    # Points of real logs are shorter, because they have no truth at 3 m.
    return curve[-1][k] if len(curve[-1]) > k else None


def _highest(row: Row, family: str, k: int) -> float | None:
    """Of all variants at any time."""
    # The start is not a result of the variant, so it does not count.
    found = [p[k] for v in row[family].values() for p in v["curve"][1:] if len(p) > k]
    return max(found, default=None)


def _never(row: Row) -> bool:
    return not claims.time_ratio_to_gnet(row)[1]


def _times(row: Row) -> float:
    return claims.time_ratio_to_gnet(row)[0]


def _score(name: str, k: int) -> _Read:
    """One number of a scene's score, or of the best score of a family."""

    def value(row: Row) -> float | None:
        found = row.get(name)
        score = found["best"] if isinstance(found, Mapping) else found
        return None if score is None else score[k]

    return value


def _time_ratio(family: str) -> _Read:
    # Elsewhere the ratio would read as a lead that ENet does not have.
    return lambda row: row["enet"][SECONDS] / row[family]["reached_s"] if row[family]["enet_as_good"] else None


def _shortest_time_ratio(family: str) -> _Read:
    """Of the shortest of ENet's lengths that is as good."""
    return lambda row: None if (first := row[family].get("enet_first_s")) is None else first / row[family]["reached_s"]


def _heldout(scene: str) -> _Read:
    return lambda row: row["heldout_psnr"][scene]


def _shifted(shift: str, scene: str, what: str) -> _Read:
    return lambda row: row["shifts"][shift][scene].get(what)


_RACE = (
    Column("GNet, s", "tuned_adam", lambda r: r["gnet"]["seconds"], 1),
    Column("GNet, held-out PSNR", "tuned_adam", lambda r: r["gnet"]["psnr"]),
    Column("GNet, PSNR at 3 m", "tuned_adam", lambda r: _last(r["gnet"]["curve"], NOVEL)),
    Column("GNet over tuned Adam at equal renders, dB", "tuned_adam", claims.gain_at_equal_renders),
    Column("tuned Adam, best PSNR", "tuned_adam", lambda r: _highest(r, "variants", HELDOUT)),
    Column("tuned Adam, best PSNR at 3 m", "tuned_adam", lambda r: _highest(r, "variants", NOVEL)),
    Column("tuned Adam, time ÷ GNet's", "tuned_adam", _times, 1, _never),
    Column("GNet over Adam on split Gaussians at equal renders, dB", "tuned_adam_split", claims.gain_at_equal_renders),
    Column("Adam on split Gaussians, time ÷ GNet's", "tuned_adam_split", _times, 1, _never),
    Column("per-scene 3DGS, best PSNR", "standard_3dgs", lambda r: _highest(r, "variants", HELDOUT)),
    Column("per-scene 3DGS, time ÷ GNet's", "standard_3dgs", _times, 0, _never),
)
_CONVERGED = (
    Column("GNet in `long`, s", "converged", lambda r: r["gnet"]["seconds"], 1),
    Column("GNet, best held-out PSNR", "converged", lambda r: r["gnet"]["best_psnr"]),
    Column("GNet, PSNR at 3 m", "converged", lambda r: _last(r["gnet"]["curve"], NOVEL)),
    Column("tuned Adam, converged PSNR", "converged", lambda r: r["plateau"]),
    Column("tuned Adam, best PSNR at 3 m", "converged", lambda r: _highest(r, "adam", NOVEL)),
    Column("tuned Adam, s to within 0.2 dB of converged", "converged", lambda r: r["adam_s"], 1),
    Column("GNet, s to the same PSNR", "converged", lambda r: r["gnet"]["reached_s"], 1),
    Column(
        "time, GNet ÷ tuned Adam",
        "converged",
        enhancement_claims.time_ratio_to_adam,
        2,
        lambda r: r["gnet"]["reached_s"] is None,
    ),
)


def _distillation(family: str, words: str) -> tuple[Column, ...]:
    """ENet against the best of a family of distillations."""
    return (
        Column("threads", family, lambda r: r.get("threads", 2), 0),
        Column("ENet, s", family, _score("enet", SECONDS), 1),
        Column(
            "kernel distance at 3 m, before → after ENet",
            family,
            _score("start", KERNEL),
            3,
            then=_score("enet", KERNEL),
        ),
        Column(
            "PSNR at 3 m, before → after ENet", family, _score("start", NOVEL_PSNR), then=_score("enet", NOVEL_PSNR)
        ),
        Column(f"{words}, best kernel distance", family, _score(family, KERNEL), 3),
        Column(f"{words}, PSNR at 3 m", family, _score(family, NOVEL_PSNR)),
        Column(f"{words}, s to its best quality", family, lambda r: r[family]["reached_s"], 0),
        Column("orders where ENet is as good, fraction", family, lambda r: float(r[family]["enet_as_good"]), 1),
        Column("time, ENet ÷ distillation, orders where ENet is as good", family, _time_ratio(family), 3),
        Column("the same, shortest ENet as good", family, _shortest_time_ratio(family), 3),
    )


_BY_ADAM = (
    *_distillation("adam", "tuned Adam"),
    Column("Adam on split Gaussians, best kernel distance", "adam_split", _score("adam_split", KERNEL), 3),
    Column("Adam on split Gaussians, PSNR at 3 m", "adam_split", _score("adam_split", NOVEL_PSNR)),
)
_BY_RECIPE = _distillation("standard", "per-scene 3DGS")
_ENHANCEMENT = (
    Column("held-out PSNR, GNet → ENet", "enhancement", _heldout("gnet"), then=_heldout("enet")),
    *(
        Column(
            f"{title} at {shift} m",
            "enhancement",
            _shifted(shift, "gnet", what),
            digits,
            then=_shifted(shift, "enet", what),
        )
        for what, title, digits in (
            ("psnr", "PSNR", 2),
            ("perceptual", "perceptual distance", 3),
            ("kernel", "kernel distance", 3),
        )
        for shift in SHOWN_SHIFTS
    ),
    Column(
        "distance removed by ENet, fraction", "enhancement", lambda r: enhancement_claims.distance_reduction(r, "enet")
    ),
    Column(
        "distance removed by GNet in ENet's place, fraction",
        "enhancement",
        lambda r: enhancement_claims.distance_reduction(r, "gnet_again"),
    ),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints the tables of a result.

    Args:
        arguments: of the command line; ``None``: those of the process.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    # The written result is read and not the cache, so that the tables are those of the committed file.
    rows = {str(row["cell"]): row for row in read_result(parser.parse_args(arguments).result).rows}
    sys.stdout.write("\n".join(pages(rows)))


if __name__ == "__main__":
    main()
