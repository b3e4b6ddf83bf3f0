"""What the terminal shows: one live line per stage, tables at the end."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich import box
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from types import TracebackType

    from flows.pipeline.stage_runner import ArtifactRef

_HEADLINES = {
    "interpolation/psnr": "PSNR",
    "interpolation/ssim": "SSIM",
    "interpolation/perceptual": "perc.",
    "shift_3m/psnr": "PSNR@3m",
    "shift_3m/perceptual": "perc.@3m",
    "shift_3m/kernel": "kernel@3m",
}
"""What the table at the end shows; the report has everything."""


class TerminalReporter:
    """Progress on stderr: a line that rewrites itself on a terminal, a line every ten seconds elsewhere.

    ``flows``: whether flows run in its context, which start a server of Prefect's where none is configured.
    """

    def __init__(self, what: str, flows: bool = False) -> None:
        self._live = sys.stderr.isatty()
        self._started = self._said = time.monotonic()
        self._what = what
        self._total, self._first, self._counting = -1, 0, 0.0
        self._flows, self._handles = flows, False

    def __enter__(self) -> TerminalReporter:
        self._write(self._what, end=not self._live)
        if self._flows and _ends_on_ctrl_c() and _starts_a_server():
            signal.signal(signal.SIGINT, self._stop_at_once)
            self._handles = True
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if self._handles:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        if self._live:
            self._write("")
        if kind is KeyboardInterrupt:
            self.stopped()
            raise typer.Exit(130)

    def stopped(self) -> None:
        self._write("stopped; what is finished is kept: run the same command again to go on", end=True)

    def _stop_at_once(self, number: int, frame: Any) -> None:
        """On Ctrl-C: Prefect's own server gets it too and is gone, and Prefect would try to reach it for a minute.

        Whatever is written is written whole, so that an end at any moment is sound.
        """
        import psutil

        self.stopped()
        for child in psutil.Process().children():
            child.terminate()
        os._exit(130)

    def stage_started(self, stage: str, chunk: int) -> None:
        self.began(f"chunk {chunk}  {stage}")

    def began(self, what: str) -> None:
        self._started = self._said = time.monotonic()
        self._what, self._total = what, -1
        if self._live:
            self._write(what)

    def ended(self, outcome: str) -> None:
        self._write(f"{self._what:<28} {outcome} in {time.monotonic() - self._started:.1f} s", end=True)

    def said(self, text: str) -> None:
        self._write(text, end=True)

    def progress(self, done: int, total: int, note: str = "") -> None:
        now = time.monotonic()
        if total != self._total:  # what was done before, by a run that was stopped, says nothing about speed
            self._total, self._first, self._counting = total, done, now
        if now - self._said < (0.2 if self._live else 10.0):
            return
        self._said = now
        fresh = done - self._first
        left = (now - self._counting) / fresh * (total - done) if fresh > 0 else None
        ahead = "" if left is None else f"  {left:.0f} s left"
        self._write(f"{self._what}  {done}/{total}  {note}{ahead}", end=not self._live)

    def stage_ended(self, stage: str, chunk: int, ref: ArtifactRef) -> None:
        seconds = time.monotonic() - self._started
        word = "from the cache" if ref.cached else f"computed in {seconds:.1f} s"
        self._write(f"chunk {chunk}  {stage:<18} {word}", end=True)
        if ref.note:
            self._write(f"  warning: {ref.note}", end=True)

    def _write(self, text: str, end: bool = False) -> None:
        if self._live:
            sys.stderr.write("\r\x1b[2K" + (text + "\n" if end else text[:118]))
        else:
            sys.stderr.write(text + "\n")
        sys.stderr.flush()


def _ends_on_ctrl_c() -> bool:
    """Whether this thread would: a shell may have it ignored."""
    main = threading.current_thread() is threading.main_thread()
    return main and signal.getsignal(signal.SIGINT) is signal.default_int_handler


def _starts_a_server() -> bool:
    """Whether Prefect will, because neither the environment nor a profile names one."""
    from prefect.settings import get_current_settings

    return get_current_settings().api.url is None


def reporting(what: str = "starting Prefect") -> TerminalReporter:
    """Makes Prefect's home and a reporter, and has the process's runs tell it; to be used as a context."""
    from flows.pipeline.progress import report_to

    Path(os.environ["PREFECT_HOME"]).mkdir(parents=True, exist_ok=True)
    reporter = TerminalReporter(what, flows=True)
    report_to(reporter)
    return reporter


def print_run(summary: dict[str, Any]) -> None:
    """The table of metrics per stage, what came from the cache, and where the report is."""
    console = _console()
    for chunk in summary["chunks"]:
        table = Table(
            title=f"{summary['log']}, chunk {chunk['chunk']}",
            title_justify="left",
            box=box.SIMPLE,
            padding=(0, 1, 0, 0),
        )
        shown = [h for h in _HEADLINES if any(h in s["metrics"] for s in chunk["stages"])]
        for column in ("stage", "", "s", "MiB", *(_HEADLINES[h] for h in shown)):
            table.add_column(column, justify="left" if column in ("stage", "") else "right", no_wrap=True)
        for stage in chunk["stages"]:
            if not stage["stage"].startswith("evaluate/"):
                cells = [f"{stage['metrics'][h]:.3f}" if h in stage["metrics"] else "" for h in shown]
                served = "cached" if stage["cached"] else "new"
                table.add_row(stage["stage"], served, f"{stage['seconds']:.1f}", f"{stage['peak_mib']:.0f}", *cells)
        console.print(table)
        evaluation = sum(s["seconds"] for s in chunk["stages"] if s["stage"].startswith("evaluate/"))
        console.print(f"  evaluation took {evaluation:.1f} s, which no stage's seconds include")
        for warning in chunk["warnings"]:
            console.print(f"  note: {warning}", markup=False)
    stages = [s for c in summary["chunks"] for s in c["stages"]]
    hits = sum(s["cached"] for s in stages)
    console.print(
        f"{hits} of {len(stages)} stages came from the cache" + (" (all of them)" if hits == len(stages) else "")
    )
    if "budget" in summary:
        spent = summary["budget"]
        console.print(f"{spent['used_s']:.0f} s of a budget of {spent['budget_s']:g} s used; evaluation is not counted")
    console.print(f"run    {summary['run']}")
    console.print(f"report {summary['report']}", soft_wrap=True)


def _console() -> Console:
    """As wide as the terminal; wide enough for the tables where there is none."""
    return Console() if sys.stdout.isatty() else Console(width=110)


def print_plan(plan: dict[str, Any]) -> None:
    """The dry run's table."""
    console = _console()
    table = Table(title=f"{plan['log']} (dry run)", title_justify="left")
    for column in ("chunk", "stage", "key", "cache", "seconds", "GB"):
        table.add_column(column, justify="right" if column in ("seconds", "GB") else "left")
    for row in plan["stages"]:
        table.add_row(
            str(row["chunk"]),
            row["stage"],
            (row["key"] or "")[:12],
            row["cache"],
            f"{row['seconds']:.0f}",
            f"{row['gigabytes']:.1f}",
        )
    console.print(table)
    cost = f"about {plan['seconds']:.0f} s to compute, {plan['gigabytes']:.1f} GB at the peak"
    console.print(f"{cost}; predicted from {plan['basis']}")
    for key, (before, after) in plan["differs"].items():
        console.print(f"  {key}: {before} → {after}", markup=False)
