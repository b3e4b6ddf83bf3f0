"""Writes what the documents take from the code and from measurements.

``make docs`` runs it. References of commands and of the configuration are whole files; tables of numbers stand between
``<!-- generated: NAME -->`` and ``<!-- end -->`` in README.md and in the pages, so that no number is typed by hand.

python docs/generate.py            # write
python docs/generate.py --check    # exit status 1 where a document differs from code or measurements
"""

from __future__ import annotations

import json
import re
import statistics
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "docs/results/data"
BLOCK = re.compile(r"<!-- generated: ([\w-]+) -->\n(.*?)<!-- end -->", re.DOTALL)

CLAIM_WORDS = {
    "main.gnet_over_initial_db": "GNet gains over the initial scene, held-out frames",
    "main.gnet_vs_adam_db": "GNet gains over tuned Adam with as many renders",
    "main.enet_interpolation_db": "ENet keeps held-out PSNR: ENet minus GNet",
    "main.minutes_per_chunk": "Stages of one chunk with preset `fine`, without evaluation",
    "main.fine_heldout_db": "Preset `fine` over `small`, held-out frames",
    "main.fine_kernel_3m": "Kernel distance at 3 m, preset `fine` minus `small`",
    "main.fnet_psnr_3m_db": "FNet's images gain over the renders at 3 m",
    "main.fnet_perceptual_3m": "Perceptual distance at 3 m, FNet over renders",
    "main.enet_perceptual_3m": "Perceptual distance at 3 m, ENet over GNet",
    "main.enet_kernel_3m": "Kernel distance at 3 m, ENet minus GNet",
    "optimiser.vs_standard_3dgs": "Time of standard 3DGS to GNet's held-out PSNR, over GNet's time",
    "optimiser.vs_tuned_adam": "Time of the best tuned Adam to GNet's held-out PSNR, over GNet's time",
    "optimiser.equal_renders_db": "GNet over the best tuned Adam with as many renders",
    "optimiser.converged": "Time of preset `long` to within 0.2 dB of converged Adam, over Adam's time",
    "optimiser.distillation": "ENet's time over that of the best distillation by tuned Adam",
    "optimiser.distillation_standard": "ENet's time over that of distillation by the 3DGS recipe",
    "optimiser.enhance_1m": "Fraction of runs in which ENet beats GNet at 1 m",
    "optimiser.enhance_2m": "Fraction of runs in which ENet beats GNet at 2 m",
    "optimiser.enhance_3m": "Fraction of runs in which ENet beats GNet at 3 m",
    "optimiser.enhance_4m": "Fraction of runs in which ENet beats GNet at 4 m",
    "optimiser.enhance_5m": "Fraction of runs in which ENet beats GNet at 5 m",
    "optimiser.enet_vs_gnet": "Distance to the truth that ENet removes, minus what GNet's network removes",
    "optimiser.interpolation": "Held-out PSNR, ENet minus GNet, worst run",
    "optimiser.stable_10x": "Loss after ten times the iterations, over the loss at the end, worst run",
    "optimiser.network_100k": "Seconds of the network on 100,000 Gaussians",
    "raster.vs_gsplat_torch": "Speed over gsplat's torch reference, forward and backward",
    "raster.ns_per_pair": "Nanoseconds a contributing Gaussian-pixel pair, forward and backward",
    "raster.gemm_share": "Fraction of the floating-point rate of a matrix product",
    "raster.many_views": "Time a view of 32 views in one call, over single calls",
    "raster.threads": "Speed of two threads over one",
    "raster.avx2": "Time with AVX2 over time with AVX-512",
    "raster.build_s": "Seconds to compile all instruction sets",
    "evaluation.budget_kept": "Fraction of runs that end within their budget",
    "evaluation.budget_overrun": "Seconds used over the budget, worst run",
    "evaluation.budget_used": "Seconds used over the budget, least of the runs that had something better to spend on",
    "evaluation.budget_worth": "Rise of perceptual distance from a budget to the next larger one, worst",
    "evaluation.reliability_gnet": "Rank correlation of estimated and true PSNR, scenes of GNet",
    "evaluation.reliability": "Rank correlation of estimated and true PSNR, scenes of ENet",
    "evaluation.reliability_worst": "Rank correlation of estimated and true PSNR, worst street",
}
"""What each claim says, for people. A claim without words is an error."""


# Tables of measurements


def result(name: str) -> dict[str, Any]:
    """The JSON of one benchmark, as ``genre bench NAME --json`` wrote it."""
    loaded: dict[str, Any] = json.loads((DATA / f"{name}.json").read_text(encoding="utf-8"))
    return loaded


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table.

    Args:
        head: titles of the columns.
        rows: cells of each row, as many as titles.
    """
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """A number with three significant digits or two decimals, whichever is shorter to read.

    >>> number(212.29), number(1.6807), number(0.0214), number(-0.0822)
    ('212', '1.68', '0.021', '-0.082')
    """
    size = abs(value)
    if size >= 100:
        return f"{value:.0f}"
    return f"{value:.2f}" if size >= 1 or size == 0 else f"{value:.3f}"


def provenance(name: str) -> str:
    """One line that says what a table was measured on, and how to measure it again."""
    loaded = result(name)
    return (
        f"Measured on {loaded['machine']} at commit `{loaded['commit'][:12]}` by "
        f"`genre bench {name} --json docs/results/data/{name}.json`.\n"
    )


def claims(name: str) -> str:
    """Every claim of a benchmark: target, measured number, and whether it holds. Several logs share a row."""
    grouped: dict[str, list[dict[str, Any]]] = {}
    for claim in result(name)["claims"]:
        grouped.setdefault(claim["id"], []).append(claim)
    rows = []
    for claim_id, found in grouped.items():
        measured = [c["measured"] for c in found if c["measured"] is not None]
        values = ", ".join(number(m) for m in measured) or "not measured"
        held = sum(c["holds"] for c in found)
        verdict = "yes" if held == len(found) else "**missed**" if held == 0 else f"**{held} of {len(found)}**"
        unit = {"share": "", "ratio": "", "share of runs": ""}.get(found[0]["unit"], found[0]["unit"])
        runs = ", ".join(str(c["n"]) for c in found) if len(found) == 1 else f"{len(found)} logs"
        target = f"{found[0]['op']} {found[0]['target']:g} {unit}".strip()
        rows.append([CLAIM_WORDS[claim_id], target, values, runs, verdict])
    return table(["claim", "target", "measured", "n", "holds"], rows) + "\n" + provenance(name)


def short_log(row: Mapping[str, Any]) -> str:
    """``street 1001`` or ``PandaSet 002, chunk 1``."""
    seed = re.search(r"seed=(\d+)", row["log"])
    return f"street {seed[1]}" if seed else f"PandaSet 002, chunk {row['chunk']}"


METHODS = {
    "initial": "initial scene from LiDAR",
    "street_gs": "per-scene 3DGS, 1,000 iterations, actors in 3D boxes",
    "small_gnet": "GNet, preset `small`",
    "small_enet": "GenRe, preset `small`",
    "fine_gnet": "GNet, preset `fine`",
    "fine_enet": "GenRe, preset `fine`",
}
"""The rows of the table at a glance, in order: key in the JSON → words."""


def glance() -> str:
    """Results at a glance: a row a method; streets as a mean, the real chunk by itself."""
    rows = result("pipeline")["rows"]
    streets = [r for r in rows if r["log"].startswith("synthetic")]
    real = [r for r in rows if not r["log"].startswith("synthetic")]

    def mean(found: Sequence[Mapping[str, Any]], method: str, metric: str, digits: int) -> str:
        values = [r["methods"][method]["metrics"].get(metric) for r in found]
        known = [v for v in values if v is not None]
        return f"{statistics.fmean(known):.{digits}f}" if known and len(known) == len(found) else "–"

    lines = []
    for method, words in METHODS.items():
        seconds = [r["methods"][method]["cpu_seconds"] for r in rows]
        lines.append(
            [
                words,
                mean(real, method, "interpolation/psnr", 2),
                mean(real, method, "shift_3m/kernel", 3),
                mean(streets, method, "interpolation/psnr", 2),
                mean(streets, method, "shift_3m/psnr", 2),
                mean(streets, method, "shift_3m/perceptual", 3),
                f"{statistics.median(seconds):.0f}",
            ]
        )
    head = [
        "method",
        "real: held-out PSNR, dB ↑",
        "real: kernel distance at 3 m ↓",
        "streets: held-out PSNR, dB ↑",
        "streets: PSNR at 3 m, dB ↑",
        "streets: perceptual distance at 3 m ↓",
        "CPU seconds a chunk ↓",
    ]
    return table(head, lines)


def pipeline_stages() -> str:
    """Metrics after each stage, a row a log and stage."""
    columns = {
        "held-out PSNR": "interpolation/psnr",
        "SSIM": "interpolation/ssim",
        "perceptual": "interpolation/perceptual",
        "PSNR at 3 m": "shift_3m/psnr",
        "perceptual at 3 m": "shift_3m/perceptual",
        "kernel at 3 m": "shift_3m/kernel",
    }
    lines = []
    for row in result("pipeline")["rows"]:
        for method, found in row["methods"].items():
            metrics = found["metrics"]
            cells = [f"{metrics[key]:.3f}" if key in metrics else "–" for key in columns.values()]
            lines.append([short_log(row), METHODS.get(method, METHOD_WORDS.get(method, method)), *cells])
    return table(["log", "after", *columns], lines)


METHOD_WORDS = {
    "adam": "tuned Adam, preset `small`",
    "small_fnet": "FNet's images, preset `small`",
    "fine_fnet": "FNet's images, preset `fine`",
}


def pipeline_seconds() -> str:
    """Wall and CPU seconds of every stage, median over logs, for both presets."""
    stages = ("ingest", "effects", "initial", "gnet", "novel_views", "fnet", "enet")
    lines = []
    for preset in ("small", "fine"):
        for kind, words in (("seconds", "wall"), ("cpu_seconds", "CPU")):
            rows = [r[kind][preset] for r in result("pipeline")["rows"]]
            cells = [statistics.median(row[stage] for row in rows) for stage in stages]
            lines.append([f"`{preset}`, {words}", *(f"{c:.1f}" for c in cells), f"{sum(cells):.0f}"])
    return table(["seconds", *stages, "all"], lines)


def budget_runs() -> str:
    """Every budget that was tried: seconds used, and what was made of them."""
    lines = []
    for row in result("evaluation")["rows"]:
        if "budget_s" in row:
            used = f"{row['used_s']:.1f}"
            ratio = f"{row['used_s'] / row['budget_s']:.2f}"
            made = ", ".join(row["settings"]) or "the preset"
            lines.append([short_log(row), f"{row['budget_s']:.0f}", used, ratio, made, row["end"]])
    return table(["log", "budget, s", "used, s", "used over budget", "settings", "last stage"], lines)


LOG_TABLES = (
    "The race",
    "How far it goes",
    "Distillation by tuned Adam",
    "Distillation by the 3DGS recipe",
    "Enhancement: GNet → ENet",
)


def optimiser_logs() -> str:
    """Tables of the optimiser's benchmark, log by log."""
    from benchmarks.optimiser import per_log_tables

    rows = {row["cell"]: row for row in result("optimiser")["rows"]}
    tables = "\n".join(per_log_tables.pages(rows)).strip().split("\n\n")
    return "\n".join(f"### {title}\n\n{text}\n" for title, text in zip(LOG_TABLES, tables, strict=True))


# References


def presets() -> str:
    """What the presets differ in, and what they are for."""
    from flows.configuration import PRESETS, load_configuration

    purpose = {
        "demo": "a first look: the synthetic street, minutes",
        "small": "quick runs, and time budgets",
        "fine": "the default: real logs on a CPU",
        "long": "a longer GNet at the size of `small`",
        "paper": "the paper's settings with SD-Turbo; needs a GPU, never run whole",
    }
    lines = []
    for name in PRESETS:
        config = load_configuration(name)
        size = f"{config.ingest.width_px}×{config.ingest.height_px}"
        gaussians = f"{config.initial.max_points + config.initial.distant_count:,}"
        lines.append(
            [f"`{name}`", purpose[name], size, gaussians, str(config.gnet.iterations), str(config.enet.iterations)]
        )
    head = [
        "preset",
        "use it for",
        "image size",
        "Gaussians at the start, at most",
        "GNet iterations",
        "ENet iterations",
    ]
    return table(head, lines)


def configuration_reference() -> str:
    """docs/reference/configuration.md: every key, its type, default, bounds and meaning."""
    from genre_tasks.config import PipelineConfig, RangeConfig

    parts = [
        "# Configuration\n\nThis page is generated from `genre_tasks/config/`. Set a key with "
        "`--set section.key=value`, or in a YAML file given by `--config`. A preset is such a file; "
        "`genre show config --preset NAME` prints its values.\n"
    ]
    for name, field in PipelineConfig.model_fields.items():
        parts.append(_section(name, field.annotation, field.default))
    parts.append(_section("range (command `genre range` only)", RangeConfig, RangeConfig()))
    return "\n".join(parts)


def _section(name: str, model: Any, default: Any) -> str:
    about = (model.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ")
    lines = []
    nested = []
    for key, field in model.model_fields.items():
        value = getattr(default, key) if default is not None else field.default
        kinds = [k for k in (field.annotation, *get_args(field.annotation)) if hasattr(k, "model_fields")]
        if kinds:
            nested.append((f"{name}.{key}", kinds[0], value))
            shown = "null" if value is None else "a section, below"
        else:
            shown = f"`{_plain(value)}`"
        lines.append([f"`{key}`", shown, _bounds(field), field.description or ""])
    text = f"## {name}\n\n{about}\n\n" + table(["key", "default", "allowed", "meaning"], lines)
    return "\n".join([text, *(_section(*n) for n in nested)])


def _plain(value: Any) -> str:
    return "null" if value is None or repr(value) == "PydanticUndefined" else json.dumps(value, ensure_ascii=False)


def _bounds(field: Any) -> str:
    words = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    found = [f"{words[k]} {getattr(m, k):g}" for m in field.metadata for k in words if getattr(m, k, None) is not None]
    choices = [str(a) for a in get_args(field.annotation) if isinstance(a, str)]
    return ", ".join(found) or ", ".join(f"`{c}`" for c in choices)


def cli_reference() -> str:
    """docs/reference/cli.md: every command with its arguments and options."""
    import typer

    from flows.cli.main import app

    parts = ["# Commands\n\nThis page is generated from the commands' own help.\n"]
    root = typer.main.get_command(app)
    parts += [_command(f"genre {name}", command) for name, command in root.commands.items()]  # type: ignore[attr-defined]
    return "\n".join(parts)


def _command(path: str, command: Any) -> str:
    text = f"## {path}\n\n{_paragraphs(command.help or '')}\n"
    if hasattr(command, "commands"):
        return "\n".join([text, *(_command(f"{path} {name}", c) for name, c in command.commands.items())])
    rows = []
    for parameter in command.params:
        if parameter.name == "help" or getattr(parameter, "hidden", False):
            continue
        names = f"`{parameter.name.upper()}`" if parameter.param_type_name == "argument" else _option(parameter)
        default = parameter.default
        shown = "required" if parameter.required else f"`{default}`" if default not in (None, (), [], False, "") else ""
        rows.append([names, shown, " ".join((getattr(parameter, "help", "") or "").split()).replace("|", "\\|")])
    return text + "\n" + (table(["argument or option", "default", "meaning"], rows) if rows else "")


def _option(parameter: Any) -> str:
    return ", ".join(f"`{name}`" for name in parameter.opts)


def _paragraphs(text: str) -> str:
    import inspect

    return inspect.cleandoc(text).replace("\b\n", "")


BLOCKS: Mapping[str, Callable[[], str]] = {
    "glance": glance,
    "presets": presets,
    "pipeline-stages": pipeline_stages,
    "pipeline-seconds": pipeline_seconds,
    "pipeline-claims": lambda: claims("pipeline"),
    "optimiser-claims": lambda: claims("optimiser"),
    "optimiser-logs": optimiser_logs,
    "budget-runs": budget_runs,
    "evaluation-claims": lambda: claims("evaluation"),
}
FILES: Mapping[str, Callable[[], str]] = {
    "docs/reference/cli.md": cli_reference,
    "docs/reference/configuration.md": configuration_reference,
}


def filled(text: str) -> str:
    """A page with every generated block written anew; an unknown block is a ``KeyError``."""
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
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
