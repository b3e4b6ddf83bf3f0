"""What each log came to, from a written result, as Markdown: a line for a log, the mean over its orders of views.

python -m benchmarks.optimiser.per_log_tables docs/benchmarks/optimiser.json
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.common.bench import Row
from benchmarks.common.context import place
from benchmarks.common.merge import read
from benchmarks.optimiser import claims, enhancement_claims
from benchmarks.optimiser.distillation import FAMILIES
from benchmarks.optimiser.plots import BESIDE, HELDOUT

MARK_SECONDS, KERNEL, MARK_BESIDE = 0, 2, 3
"""Places in a distillation's mark."""
AT = ("1", "3", "5")
"""Shifts in metres that the table of enhancement shows; the JSON has all."""


_Read = Callable[[Row], float | None]


@dataclass(frozen=True)
class Column:
    """What is read of each of a log's rows of a kind (``None``: it has none); the mean of those that have it.

    ``then``: what stands behind an arrow. ``at_least``: whether a row's value is a bound; so is a mean with one.
    """

    title: str
    kind: str
    read: _Read
    digits: int = 2
    at_least: Callable[[Row], bool] = lambda row: False
    then: _Read | None = None


def pages(rows: Mapping[str, Row]) -> Iterator[str]:
    """The race, how far it goes, distillation and enhancement, each where it was measured; logs in the race's order."""
    kinds = {method: claims.races(rows, method) for method in ("tuned_adam", "tuned_adam_split", "standard_3dgs")}
    kinds |= {kind: enhancement_claims.of_kind(rows, kind) for kind in ("converged", "enhancement")}
    kinds |= {family: enhancement_claims.distilled(rows, family) for family in FAMILIES}
    logs = {kind: by_log(found) for kind, found in kinds.items()}
    order = dict.fromkeys(log for found in logs.values() for log in found)
    logs = {kind: {log: found[log] for log in order if log in found} for kind, found in logs.items()}
    for columns in (_RACE, _CONVERGED, _BY_ADAM, _BY_RECIPE, _ENHANCEMENT):
        if logs[columns[0].kind]:
            yield from table(columns, logs)
            yield ""


def by_log(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """The rows of each log and chunk, in all orders."""
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(place(row).partition(" order")[0], []).append(row)
    return out


def table(columns: Sequence[Column], logs: Mapping[str, Mapping[str, Sequence[Row]]]) -> Iterator[str]:
    """A line for each log of the first column's kind; ``orders``: how many rows it has there."""
    yield "| log | orders | " + " | ".join(c.title for c in columns) + " |"
    yield "|---" * (len(columns) + 2) + "|"
    for log, own in logs[columns[0].kind].items():
        yield f"| {log} | {len(own)} | " + " | ".join(_cell(c, logs[c.kind].get(log, ())) for c in columns) + " |"


def _cell(column: Column, rows: Sequence[Row]) -> str:
    """The mean of each reading, with its arrow or bound; a dash where no row has it."""
    readings = [column.read] if column.then is None else [column.read, column.then]
    found = [[v for row in rows if (v := read(row)) is not None] for read in readings]
    if not all(found):
        return "–"
    bound = "≥ " if any(map(column.at_least, rows)) else ""
    return bound + " → ".join(f"{statistics.fmean(values):.{column.digits}f}" for values in found)


def _last(curve: Sequence[Sequence[float]], k: int) -> float | None:
    return curve[-1][k] if len(curve[-1]) > k else None


def _most(row: Row, family: str, k: int) -> float | None:
    """Of all variants at any time."""
    found = [p[k] for v in row[family].values() for p in v["curve"][1:] if len(p) > k]
    return max(found, default=None)


def _never(row: Row) -> bool:
    return not claims.times_gnet(row)[1]


def _times(row: Row) -> float:
    return claims.times_gnet(row)[0]


def _mark(name: str, k: int) -> _Read:
    """Of a scene's mark, or of the best of a family."""

    def value(row: Row) -> float | None:
        found = row.get(name)
        mark = found["best"] if isinstance(found, Mapping) else found
        return None if mark is None else mark[k]

    return value


def _share(family: str) -> _Read:
    return lambda row: row["enet"][MARK_SECONDS] / row[family]["reached_s"]


def _first_share(family: str) -> _Read:
    """Of the shortest of ENet's lengths that is as good."""
    return lambda row: None if (first := row[family].get("enet_first_s")) is None else first / row[family]["reached_s"]


def _heldout(scene: str) -> _Read:
    return lambda row: row["heldout_psnr"][scene]


def _at(shift: str, scene: str, what: str) -> _Read:
    return lambda row: row["shifts"][shift][scene].get(what)


_RACE = (
    Column("GNet: s", "tuned_adam", lambda r: r["gnet"]["seconds"], 1),
    Column("held-out PSNR", "tuned_adam", lambda r: r["gnet"]["psnr"]),
    Column("at 3 m", "tuned_adam", lambda r: _last(r["gnet"]["curve"], BESIDE)),
    Column("over tuned Adam of as many renders, dB", "tuned_adam", claims.gain_db),
    Column("tuned Adam's best", "tuned_adam", lambda r: _most(r, "variants", HELDOUT)),
    Column("its best at 3 m", "tuned_adam", lambda r: _most(r, "variants", BESIDE)),
    Column("its time over GNet's", "tuned_adam", _times, 1, _never),
    Column("over Adam on split Gaussians, dB", "tuned_adam_split", claims.gain_db),
    Column("its time over GNet's", "tuned_adam_split", _times, 1, _never),
    Column("standard 3DGS's best", "standard_3dgs", lambda r: _most(r, "variants", HELDOUT)),
    Column("its time over GNet's", "standard_3dgs", _times, 0, _never),
)
_CONVERGED = (
    Column("`long`: s", "converged", lambda r: r["gnet"]["seconds"], 1),
    Column("held-out PSNR", "converged", lambda r: r["gnet"]["best_psnr"]),
    Column("at 3 m", "converged", lambda r: _last(r["gnet"]["curve"], BESIDE)),
    Column("tuned Adam converged at", "converged", lambda r: r["plateau"]),
    Column("its best at 3 m at any time", "converged", lambda r: _most(r, "adam", BESIDE)),
    Column("Adam within 0.2 dB of that after, s", "converged", lambda r: r["adam_s"], 1),
    Column("`long` after, s", "converged", lambda r: r["gnet"]["reached_s"], 1),
    Column("ratio", "converged", enhancement_claims.times_adam, 2, lambda r: r["gnet"]["reached_s"] is None),
)


def _distillation(family: str, words: str) -> tuple[Column, ...]:
    """ENet beside a family's best."""
    return (
        Column("threads", family, lambda r: r.get("threads", 2), 0),
        Column("ENet: s", family, _mark("enet", MARK_SECONDS), 1),
        Column("kernel at 3 m", family, _mark("start", KERNEL), 3, then=_mark("enet", KERNEL)),
        Column("PSNR at 3 m", family, _mark("start", MARK_BESIDE), then=_mark("enet", MARK_BESIDE)),
        Column(f"{words}'s best: kernel", family, _mark(family, KERNEL), 3),
        Column("PSNR", family, _mark(family, MARK_BESIDE)),
        Column("first as good as that after, s", family, lambda r: r[family]["reached_s"], 0),
        Column("ENet as good, share of orders", family, lambda r: float(r[family]["enet_as_good"]), 1),
        Column("ENet's time over its", family, _share(family), 3),
        Column("of its shortest as good", family, _first_share(family), 3),
    )


_BY_ADAM = (
    *_distillation("adam", "tuned Adam"),
    Column("tuned Adam on split Gaussians: kernel", "adam_split", _mark("adam_split", KERNEL), 3),
    Column("PSNR", "adam_split", _mark("adam_split", MARK_BESIDE)),
)
_BY_RECIPE = _distillation("standard", "the standard recipe")
_ENHANCEMENT = (
    Column("held-out PSNR", "enhancement", _heldout("gnet"), then=_heldout("enet")),
    *(
        Column(f"{title} at {shift} m", "enhancement", _at(shift, "gnet", what), digits, then=_at(shift, "enet", what))
        for what, title, digits in (("psnr", "PSNR", 2), ("perceptual", "perceptual", 3), ("kernel", "kernel", 3))
        for shift in AT
    ),
    Column("less of GNet's distance, ENet", "enhancement", lambda r: enhancement_claims.reduction(r, "enet")),
    Column("GNet's network in its place", "enhancement", lambda r: enhancement_claims.reduction(r, "gnet_again")),
)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path)
    rows = {str(row["cell"]): row for row in read(parser.parse_args(arguments).result).rows}
    sys.stdout.write("\n".join(pages(rows)))


if __name__ == "__main__":
    main()
