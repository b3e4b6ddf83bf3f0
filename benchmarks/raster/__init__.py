"""The renderer's claims, measured against gsplat's torch reference and against the machine's limits.

genre bench raster --json docs/results/data/raster.json
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

from benchmarks.common.bench import Bench, Cell, Row, SmallestForm
from benchmarks.common.claims import Claim, Op, claim
from benchmarks.raster import ablation, cells, gsplat_comparison, table
from benchmarks.raster.scenes import CASES

_CLAIMS: tuple[tuple[str, str, str, Op, float, str, str], ...] = (
    ("vs_gsplat_torch", "peer/300k", "ratio", ">=", 230.0, "ratio", "forward + backward, 300k, 2 threads"),
    ("ns_per_pair", "scene/300k", "ns_per_pair", "<=", 2.4, "ns", "forward + backward, 300k, 2 threads"),
    ("gemm_share", "scene/300k", "gemm_share", ">=", 0.33, "ratio", "executed operations, 300k, 2 threads"),
    ("many_views", "views", "ratio", "<=", 0.8, "ratio", "32 views of 20k at 180×320, per view, to single calls"),
    ("threads", "scene/300k", "two_threads_gain", ">=", 1.8, "ratio", "forward + backward, 300k, 1 thread to 2"),
    ("avx2", "isas", "ratio", "<=", 1.3, "ratio", "forward + backward, 300k, 2 threads, to AVX-512"),
    ("build_s", "build", "seconds", "<=", 10.0, "s", "all instruction sets, an empty folder"),
)
"""Claim, its cell and number, requirement, unit, data."""


class Raster:
    """Cells of the renderer; two of the claims need gsplat or AVX-512."""

    name = "raster"
    options: Mapping[str, str] = {}
    code: tuple[str, ...] = (
        "benchmarks.raster.cells",
        "benchmarks.raster.machine_limits",
        "benchmarks.raster.gsplat_torch",
        "benchmarks.raster.instruction_set_worker",
        "benchmarks.raster.instruction_sets",
        "benchmarks.raster.gsplat_comparison",
        "benchmarks.raster.scenes",
        "benchmarks.raster.ablation",
        "benchmarks.common.timing",
        "genre_tasks.render.api",
    )
    smallest = SmallestForm({}, only="scene/20k")

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists scenes, gsplat's, many views, instruction sets, ablations, the build and the GPU.

        Args:
            options: none.
            quick: fewer rounds.

        Returns:
            Cells in the order in which they are measured.
        """
        # Claims are about the largest scene, where fixed costs of a call no longer count.
        largest = CASES[-1]
        out = []
        for case, seconds in zip(CASES, (2.0, 2.5, 3.5), strict=True):
            rounds = 5 if quick else 15
            out.append(_cell(f"scene/{case.name}", seconds, rounds, partial(cells.measure_scene, case)))
        # The reference takes most of a minute a round at 300k Gaussians, so it has fewer rounds there.
        for case, seconds, rounds in zip(CASES, (2.0, 8.0, 45.0), (2, 2, 2) if quick else (9, 5, 3), strict=True):
            out.append(
                _cell(f"peer/{case.name}", seconds, rounds, partial(gsplat_comparison.measure_torch_reference, case))
            )
        out.append(_cell("views", 2.0, 5 if quick else 11, cells.measure_views))
        out.append(_cell("isas", 1.0, 5 if quick else 15, partial(cells.measure_instruction_sets, largest)))
        out.append(
            _cell("without", 2.0, 5 if quick else 15, partial(ablation.measure_ablations, largest, cells.THREADS))
        )
        out.append(_cell("build", 10.0, 2 if quick else 5, cells.measure_build))
        out += [_cell(f"cuda/{case.name}", 1.0, 15, partial(gsplat_comparison.measure_cuda, case)) for case in CASES]
        return out

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes every claim; those whose cell was not measured say so.

        Args:
            rows: by cell.

        Yields:
            Claim: each once.
        """
        for name, cell, number, op, target, unit, data in _CLAIMS:
            # A cell that was not measured has no numbers, and its claim then says so.
            m = rows[cell].get(number)
            if m is None:
                yield claim(f"raster.{name}", None, op, target, unit, data)
            else:
                yield claim(f"raster.{name}", m["median"], op, target, unit, data, m["n"], (m["low"], m["high"]))

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Makes the tables that the documents show."""
        return table.markdown(rows)


def _cell(name: str, seconds_a_round: float, rounds: int, measure: Callable[[int], Row]) -> Cell:
    # A round more for warming up.
    return Cell(name, seconds_a_round * (rounds + 1), partial(measure, rounds), {"rounds": rounds})


BENCH: Bench = Raster()
