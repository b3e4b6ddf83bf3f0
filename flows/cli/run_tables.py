"""What ``genre run`` prints at its end, and what it would compute."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich import box

from flows.cli.printing import make_console, print_table
from flows.error_record import describe_record

_METRIC_HEADINGS = {
    "interpolation/psnr": "PSNR",
    "interpolation/ssim": "SSIM",
    "interpolation/perceptual": "perc.",
    "shift_3m/psnr": "PSNR@3m",
    "shift_3m/perceptual": "perc.@3m",
    "shift_3m/kernel": "kernel@3m",
}
"""The metrics in the table at the end; the report has all of them."""


def print_run(record: Mapping[str, Any]) -> None:
    """Prints a finished run: metrics of each stage, what came from the cache, and the files that were written.

    Args:
        record: the run's record, as ``reconstruct_log`` returns it.
    """
    console = make_console()
    for chunk in record["chunks"]:
        _print_metrics(f"{record['log']}, chunk {chunk['chunk']}", chunk["stages"])
        # Evaluation is apart, since it is no part of making a scene: its time would hide that of the stages.
        evaluation_s = sum(s["seconds"] for s in chunk["stages"] if s["stage"].startswith("evaluate/"))
        console.print(f"  evaluation took {evaluation_s:.1f} s, which no stage's seconds include")
        for warning in chunk["warnings"]:
            console.print(f"  note: {warning}")
    for entry in record.get("left_out", ()):
        console.print(f"chunk {entry['chunk']} is left out: {describe_record(entry)}")
    stages = [stage for chunk in record["chunks"] for stage in chunk["stages"]]
    hits = sum(stage["cached"] for stage in stages)
    all_of_them = " (all of them)" if hits == len(stages) else ""
    console.print(f"{hits} of {len(stages)} stages came from the cache{all_of_them}")
    if "budget" in record:
        budget = record["budget"]
        used = f"{budget['used_s']:.0f} s of a budget of {budget['budget_s']:g} s used"
        console.print(f"{used}; evaluation is not counted")
    console.print(f"run    {record['run']}")
    # A path must stay in one piece, so that a terminal can open it with a click.
    console.print(f"wrote  {record['report']}", soft_wrap=True)
    console.print(f"wrote  {Path(record['report']).with_name('run.json')}", soft_wrap=True)


def print_prediction(prediction: Mapping[str, Any]) -> None:
    """Prints what a run would compute and what it would take.

    Args:
        prediction: what ``predict_run`` returns, with ``differs``: (before, after) of each setting that the run has
            otherwise than its preset; ``checked``: what is there; ``warnings``: what may not suffice.
    """
    console = make_console()
    rows = [
        [
            str(row["chunk"]),
            row["stage"],
            (row["key"] or "")[:12],
            row["cache"],
            f"{row['seconds']:.0f}",
            f"{row['gigabytes']:.1f}",
        ]
        for row in prediction["stages"]
    ]
    headings = ("chunk", "stage", "key", "cache", "seconds", "GB")
    print_table(f"{prediction['log']} (dry run)", headings, rows, right=("seconds", "GB"))
    cost = f"about {prediction['seconds']:.0f} s to compute, {prediction['gigabytes']:.1f} GB at the peak"
    console.print(f"{cost}; predicted from {prediction['basis']}")
    for key, (before, after) in prediction["differs"].items():
        console.print(f"  {key}: {before} → {after}")
    console.print("checked:")
    for line in prediction["checked"]:
        console.print(f"  {line}", soft_wrap=True)
    for warning in prediction["warnings"]:
        console.print(f"warning: {warning}", soft_wrap=True)


def _print_metrics(title: str, stages: list[dict[str, Any]]) -> None:
    shown = [name for name in _METRIC_HEADINGS if any(name in stage["metrics"] for stage in stages)]
    numbers = ("s", "MiB", *(_METRIC_HEADINGS[name] for name in shown))
    rows = []
    for stage in stages:
        if stage["stage"].startswith("evaluate/"):
            continue
        metrics = stage["metrics"]
        values = [f"{metrics[name]:.3f}" if name in metrics else "" for name in shown]
        served = "cached" if stage["cached"] else "new"
        rows.append([stage["stage"], served, f"{stage['seconds']:.1f}", f"{stage['peak_mib']:.0f}", *values])
    print_table(title, ("stage", "", *numbers), rows, right=numbers, box=box.SIMPLE)
