"""Past one machine: workers, orchestration, the store on S3, a simulated cluster, and files that do harm.

genre bench scale --json docs/results/data/scale.json [--only cached] [--set settings="gnet.iterations=3"]

The cells start real services: PostgreSQL, a Prefect server, workers, an S3 server. They want a quiet machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET_PARAMETERS,
    Bench,
    Cell,
    Row,
    SmallestForm,
    list_not_measured,
    settings_from_options,
    split_option,
)
from benchmarks.common.cell_parameters import describe_preset
from benchmarks.common.claims import Claim
from benchmarks.common.lazy_modules import CODEC_MODULES, FORMAT_MODULES, STAGE_MODULES
from benchmarks.fuzz.input_fuzz import FINDINGS, measure_input_fuzz
from benchmarks.scale.cluster import measure_cluster
from benchmarks.scale.datasets import (
    measure_cached_logs,
    measure_object_store,
    measure_orchestration,
    measure_throughput,
)
from benchmarks.scale.report import scale_claims
from benchmarks.scale.simulated_stages import read_stage_seconds


class Scale:
    """Datasets on workers, the store on S3, and the fuzzers."""

    name = "scale"
    options: Mapping[str, str] = {
        "seeds": ",".join(str(seed) for seed in range(900, 916)),
        "street": "&cameras=1&frames=8",
        "preset": "small",
        "throughput_preset": "demo",
        "settings": "",
        "cached_street": TINY_STREET_PARAMETERS,
        "cluster": "1000x100",
        "seconds_scale": "0.4",
        "inputs": "10000",
    }
    code: tuple[str, ...] = (
        "benchmarks.scale",
        "benchmarks.fuzz.fuzz_worker",
        "flows.dataset.flow",
        "flows.reconstruction.flow",
        "flows.operations",
        "storage.local",
        "storage.objects.object_store",
        *CODEC_MODULES,
        *FORMAT_MODULES,
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.posed_images.image_log",
        "genre_tasks.logs.synthetic",
    )
    # The other cells need PostgreSQL and minutes.
    smallest = SmallestForm({"inputs": "60"}, only="fuzz")

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the measurements.

        Args:
            options: ``seeds`` and ``street``, the parameters of the streets; ``preset``, ``throughput_preset`` of the
                many logs, and ``settings``; ``cached_street``, of the streets that come from the store; ``cluster``,
                logs x workers, and ``seconds_scale`` of its stages; ``inputs`` of the fuzzers.
            quick: fewer rounds.

        Returns:
            Six cells.
        """
        seeds = split_option(options["seeds"])
        logs = [f"synthetic:street?seed={seed}{options['street']}" for seed in seeds]
        cached = [f"synthetic:street?seed={seed}{options['cached_street']}" for seed in seeds[:4]]
        settings = settings_from_options(options)
        tiny = tuple(TINY_SETTINGS.split())
        # Of a log that comes from the store, the size of its images plays no part.
        preset, small = options["preset"], options["throughput_preset"]
        rounds = 1 if quick else 3
        cluster_logs, _, workers = options["cluster"].partition("x")
        log = f"synthetic:street?seed={seeds[0]}"
        resolved = describe_preset(preset, settings)
        return [
            Cell(
                "throughput",
                1200.0,
                partial(measure_throughput, logs, small, settings),
                {"logs": logs, **describe_preset(small, settings)},
            ),
            Cell(
                "orchestration", 200.0, partial(measure_orchestration, log, preset, settings), {"log": log, **resolved}
            ),
            Cell(
                "cached",
                300.0,
                partial(measure_cached_logs, cached, "demo", tiny, rounds),
                {"logs": cached, "rounds": rounds, **describe_preset("demo", tiny)},
            ),
            Cell(
                "object_store",
                600.0,
                partial(measure_object_store, logs[0], preset, settings, rounds),
                {"log": logs[0], "rounds": rounds, **resolved},
            ),
            Cell(
                "cluster",
                1800.0,
                partial(measure_cluster, int(cluster_logs), int(workers), 0, float(options["seconds_scale"])),
                # Seconds of stages are in a file, which is no code.
                {name: options[name] for name in ("cluster", "seconds_scale")} | {"seconds": read_stage_seconds()},
            ),
            Cell(
                "fuzz",
                120.0,
                partial(measure_input_fuzz, int(options["inputs"]), 0),
                {"inputs": options["inputs"]},
            ),
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims.

        Args:
            rows: by cell.

        Yields:
            Claim: each once.
        """
        yield from scale_claims({name: row for name, row in rows.items() if "not_measured" not in row})

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Makes the table that the command prints.

        Args:
            rows: by cell.

        Yields:
            str: lines of Markdown.
        """
        fuzz = rows.get("fuzz", {})
        if "formats" in fuzz:
            yield "| format | read | refused | findings |"
            yield "|---|---|---|---|"
            for name, counts in fuzz["formats"].items():
                found = sum(counts[outcome] for outcome in FINDINGS)
                yield f"| {name} | {counts['read']} | {counts['refused']} | {found} |"
        yield from list_not_measured(rows)


BENCH: Bench = Scale()
