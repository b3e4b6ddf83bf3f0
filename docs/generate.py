"""Writes what the documents take from the code and from measurements.

``make docs`` runs it. References of commands and of the configuration are whole files. Tables of numbers stand between
``<!-- generated: NAME -->`` and ``<!-- end -->`` in README.md and in the pages, so that no number is typed by hand.

python docs/generate.py            # write
python docs/generate.py --check    # exit status 1 where a document differs from code or measurements
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from docs import (
    cost_tables,
    effect_tables,
    exchange_tables,
    fault_tables,
    full_size_tables,
    part_tables,
    perception_tables,
    published_tables,
    real_log_tables,
    references,
    result_tables,
    scale_tables,
    simulation_tables,
)  # after the path is set

BLOCK = re.compile(r"<!-- generated: ([\w-]+) -->\n(.*?)<!-- end -->", re.DOTALL)

BLOCKS: Mapping[str, Callable[[], str]] = {
    "glance": result_tables.glance,
    "presets": references.presets,
    "preset-choice": result_tables.preset_choice,
    "pipeline-stages": result_tables.pipeline_stages,
    "pipeline-seconds": result_tables.pipeline_seconds,
    "pipeline-claims": lambda: result_tables.claims("pipeline"),
    "optimiser-claims": lambda: result_tables.claims("optimiser"),
    "optimiser-logs": result_tables.optimiser_logs,
    "raster-machines": result_tables.raster_machines,
    "raster-times": result_tables.raster_times,
    "raster-claims": lambda: result_tables.claims("raster"),
    "start-up-claims": lambda: result_tables.claims("start_up"),
    "cost-included": cost_tables.included,
    **{f"cost-{preset}": partial(cost_tables.accuracy, preset) for preset in cost_tables.PRESETS},
    **{f"cost-{preset}-seconds": partial(cost_tables.seconds, preset) for preset in cost_tables.PRESETS},
    "budget-runs": result_tables.budget_runs,
    "effects-claims": effect_tables.claims,
    "effects-real": effect_tables.on_real_chunks,
    "effects-streets": effect_tables.on_streets,
    "effects-whole-plans": effect_tables.whole_plans,
    "evaluation-claims": lambda: result_tables.claims("evaluation"),
    "full-size-claims": full_size_tables.claims,
    "full-size-memory": full_size_tables.memory,
    "full-size-paper": full_size_tables.paper,
    "full-size-quality": full_size_tables.quality,
    "full-size-stages": full_size_tables.stages,
    "fixer-claims": part_tables.fixer_claims,
    "fixer-logs": part_tables.fixer_logs,
    "fixer-shifts": part_tables.fixer_shifts,
    "fixer-real": part_tables.fixer_real,
    "ground": part_tables.ground,
    "facades": part_tables.facades,
    "log-faults": result_tables.log_faults,
    "log-faults-claims": lambda: result_tables.claims("log_faults"),
    **{f"paper-table-{number}": partial(published_tables.published_table, number) for number in range(1, 6)},
    "perception-claims": perception_tables.claims,
    "perception-differences": perception_tables.differences,
    "perception-ranges": perception_tables.ranges,
    "perception-shifts": perception_tables.shifts,
    "perception-speed": perception_tables.speed,
    "perception-training": perception_tables.training,
    "perception-transfer": perception_tables.transfer,
    "real-logs-claims": real_log_tables.claims,
    "real-logs-chain": real_log_tables.chain,
    "real-logs-effects": real_log_tables.effects,
    "real-logs-pose-noise": real_log_tables.pose_noise,
    "real-logs-race": real_log_tables.race,
    "faults": fault_tables.matrix,
    "fault-injections": fault_tables.injections,
    "scale-claims": lambda: result_tables.claims("scale"),
    "scale-workers": scale_tables.workers,
    "scale-cluster": scale_tables.cluster,
    "scale-cluster-run": scale_tables.cluster_runs,
    "fuzz-formats": scale_tables.fuzz,
    "exchange-claims": exchange_tables.claims,
    "exchange-formats": exchange_tables.formats,
    "exchange-enhancement": exchange_tables.enhancement,
    "simulation-behaviours": simulation_tables.behaviours,
    "simulation-comparison": simulation_tables.comparison_claims,
    "simulation-claims": simulation_tables.claims,
    "simulation-removal": simulation_tables.removal,
}
FILES: Mapping[str, Callable[[], str]] = {
    "docs/reference/cli.md": references.cli_reference,
    "docs/reference/configuration.md": references.configuration_reference,
}


def filled(text: str) -> str:
    """A page with every generated block written anew; an unknown block is a ``KeyError``."""
    # A block without an end would swallow the sentences up to the next one's.
    if text.count("<!-- generated: ") != len(BLOCK.findall(text)):
        raise ValueError("a generated block has no end")
    return BLOCK.sub(lambda m: f"<!-- generated: {m[1]} -->\n\n{BLOCKS[m[1]]()}\n<!-- end -->", text)


def documents() -> dict[Path, str]:
    """Path → text as code and measurements have it now, for every page that takes something from them."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    out = {
        page: filled(page.read_text(encoding="utf-8"))
        for page in pages
        if page.relative_to(ROOT).as_posix() not in FILES
    }
    return out | {ROOT / name: make() for name, make in FILES.items()}


def main() -> int:
    """Writes the documents, or with ``--check`` names those that differ."""
    stale = []
    for path, text in documents().items():
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            stale.append(path.relative_to(ROOT).as_posix())
            if "--check" not in sys.argv:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(text, encoding="utf-8")
    sys.stdout.write("".join(f"{name}\n" for name in stale))
    return 1 if stale and "--check" in sys.argv else 0


if __name__ == "__main__":
    sys.exit(main())
