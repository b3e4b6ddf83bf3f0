"""The renderer's rows as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from benchmarks.common.bench import Row, list_not_measured
from benchmarks.raster.scenes import CASES


def markdown(rows: Mapping[str, Row]) -> Iterator[str]:
    """Makes the tables of times, of the work and the machine's limits, and of the other cells.

    Args:
        rows: by cell.

    Yields:
        Lines of Markdown.
    """
    yield from _times(rows)
    yield ""
    yield from _work(rows)
    yield ""
    yield from _rest(rows)
    yield from list_not_measured(rows)


def _times(rows: Mapping[str, Row]) -> Iterator[str]:
    yield "| ms, forward / forward + backward | " + " | ".join(_title(rows, c.name) for c in CASES) + " |"
    yield "|---|" + "---|" * len(CASES)
    lines = (
        ("this renderer, 1 thread", "scene", "forward 1", "forward+backward 1"),
        ("this renderer, 2 threads", "scene", "forward 2", "forward+backward 2"),
        ("gsplat torch reference, 2 threads", "peer", "gsplat forward", "gsplat forward+backward"),
        ("gsplat CUDA", "cuda", "forward", "forward+backward"),
    )
    for title, kind, forward, both in lines:
        # A row that says only why nothing was measured has no times.
        found = [rows[f"{kind}/{c.name}"].get("milliseconds") for c in CASES]
        yield _line(title, ("" if m is None else f"{_ms(m[forward])} / {_ms(m[both])}" for m in found))
    # Cells that were not measured stay empty: the table has the same shape on every machine.
    ratios = [rows[f"peer/{c.name}"] for c in CASES]
    yield _line("gsplat torch ÷ this", (f"{_of(r, 'forward_ratio', '.0f')} / {_of(r, 'ratio', '.0f')}" for r in ratios))
    yield _line("largest difference of colour", (_difference(r) for r in ratios))


def _work(rows: Mapping[str, Row]) -> Iterator[str]:
    yield "| forward + backward, 2 threads | " + " | ".join(_title(rows, c.name) for c in CASES) + " |"
    yield "|---|" + "---|" * len(CASES)
    measured = [rows[f"scene/{c.name}"] for c in CASES]
    counts = ("drawn", "tile_pairs", "lanes", "contributions")
    for name in counts:
        yield _line(name.replace("_", " "), (f"{r['work'][name]:,}" if "work" in r else "" for r in measured))
    yield _line("lane density", (f"{r['lane_density']:.3f}" if "work" in r else "" for r in measured))
    for title, key, form in (
        ("ns a contributing pair", "ns_per_pair", ".2f"),
        ("GFLOP/s, executed", "gflop_s", ".1f"),
        ("share of GEMM, executed operations", "gemm_share", ".3f"),
        ("share of GEMM, contributing operations only", "gemm_share_of_contributing", ".3f"),
        ("2 threads against 1", "two_threads_gain", ".2f"),
    ):
        yield _line(title, (_of(r, key, form) for r in measured))
    for title, key in (("GEMM, GFLOP/s, 1 / 2 threads", "gemm_gflop_s"), ("copy, GB/s, 1 / 2 threads", "copy_gb_s")):
        yield _line(
            title, (" / ".join(f"{r[key][t]['median']:.1f}" for t in ("1", "2")) if key in r else "" for r in measured)
        )


def _rest(rows: Mapping[str, Row]) -> Iterator[str]:
    yield "| what | measured |"
    yield "|---|---|"
    views = rows["views"]
    isas = rows["isas"]
    build = rows["build"]
    if "ratio" in views:
        m = views["milliseconds_per_view"]
        times = f"{_ms(m['forward+backward, one call'])} to {_ms(m['forward+backward, single calls'])} ms a view"
        yield f"| {views['views']} views in one call ÷ single calls | {_of(views, 'ratio', '.3f')}: {times} |"
    if "ratio" in isas:
        m = isas["milliseconds"]
        yield f"| AVX2 ÷ AVX-512 | {_of(isas, 'ratio', '.3f')}: {_ms(m['avx2'])} to {_ms(m['avx512'])} ms |"
    for name in rows["without"].get("cost", ()):
        m = rows["without"]["milliseconds"]
        times = f"{_ms(m['ordinary'])} to {_ms(m[name])} ms"
        yield f"| with ÷ without {name} | {_of(rows['without']['cost'], name, '.3f')}: {times} |"
    if "seconds" in build:
        yield f"| building {len(build['libraries'])} libraries | {_of(build, 'seconds', '.1f')} s |"


def _title(rows: Mapping[str, Row], case: str) -> str:
    found = next(c for c in CASES if c.name == case)
    return f"{case}, {found.height_px}×{found.width_px}"


def _line(title: str, values: Iterator[str]) -> str:
    return f"| {title} | " + " | ".join(values) + " |"


def _ms(m: Mapping[str, Any]) -> str:
    # Three digits of a number above a thousand would be printed with an exponent.
    return f"{m['median']:.3g}" if m["median"] < 1000 else f"{m['median']:,.0f}"


def _of(row: Row, key: str, form: str) -> str:
    """Median and, in brackets, the quartiles."""
    if key not in row:
        return ""
    m = row[key]
    return f"{m['median']:{form}} ({m['low']:{form}}–{m['high']:{form}})"


def _difference(row: Row) -> str:
    return f"{row['max_difference']['color']:.1e}" if "max_difference" in row else ""
