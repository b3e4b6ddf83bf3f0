"""The main job's claims, measured: claim seeds of the synthetic street and chunk 1 of the real sequence.

python benchmarks/main_job.py --json docs/benchmarks/main_job.json [--store DIR] [--seeds 1001,1002]

Each log goes through the pipeline (preset ``small``) without Prefect, from and into a store: a broken-off run goes
on where it stopped. The tuned-Adam baseline has the same initial scene, renderer, loss and number of view renders.
"""

from __future__ import annotations

import argparse
import json
import platform
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flows.cli.main import prepare_environment
from flows.configuration import load_configuration
from flows.pipeline import PIPELINE
from flows.produce import ArtifactRef, Job, produce
from storage.local import open_store

SETTINGS = ("evaluate.shifts_m=[3]",)
"""Claims are made at 3 m; the other shifts would only cost time."""
ALL_STAGES = tuple(spec.name for spec in PIPELINE)


def reconstruct(job: Job, stages: tuple[str, ...] = ALL_STAGES) -> dict[str, ArtifactRef]:
    """The named stages of one chunk, in order."""
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        if spec.name in stages:
            refs[spec.name] = produce(spec.name, job, {name: refs[name] for name in spec.inputs})
            say(f"{job.log} chunk {job.chunk} {spec.name}: {'cached' if refs[spec.name].cached else 'done'}")
    return refs


def metrics_of(job: Job, ref: ArtifactRef) -> dict[str, float]:
    """Metric values of an ``evaluate/…`` artifact, intervals as ``…/low`` and ``…/high``."""
    store = open_store(job.store)
    (artifact,) = store.artifacts(key=ref.key, chunk=job.chunk)
    out: dict[str, float] = {}
    for metric in store.read(artifact).metrics:
        out[metric.name] = metric.value
        if metric.low is not None and metric.high is not None:
            out |= {f"{metric.name}/low": metric.low, f"{metric.name}/high": metric.high}
    return out


def seconds_of(job: Job, ref: ArtifactRef) -> tuple[float, float]:
    """Seconds and peak MiB of a stage, from its manifest."""
    (artifact,) = open_store(job.store).artifacts(key=ref.key, chunk=job.chunk)
    return artifact.manifest.seconds, artifact.manifest.peak_mib


def measure(log: str, chunk: int, store: str) -> dict[str, Any]:
    """One row: metrics per stage, seconds per stage, and tuned Adam's metrics."""
    values = load_configuration("small", settings=SETTINGS).model_dump(mode="json")
    job = Job(log, chunk, store, values)
    refs = reconstruct(job)
    adam_values = values | {"gnet": values["gnet"] | {"method": "adam"}}
    adam_job = Job(log, chunk, store, adam_values)
    adam = reconstruct(adam_job, ("ingest", "initial", "gnet", "evaluate/gnet"))
    names = ("initial", "gnet", "fnet", "enet")
    stages = ("ingest", "initial", "gnet", "novel_views", "fnet", "enet")
    return {
        "log": log,
        "chunk": chunk,
        "metrics": {name: metrics_of(job, refs[f"evaluate/{name}"]) for name in names}
        | {"adam": metrics_of(adam_job, adam["evaluate/gnet"])},
        "seconds": {name: seconds_of(job, refs[name])[0] for name in stages}
        | {"adam": seconds_of(job, adam["gnet"])[0]},
        "peak_mib": {name: seconds_of(job, refs[name])[1] for name in stages},
    }


def claims_of(row: dict[str, Any], real: bool) -> Iterator[dict[str, Any]]:
    """What the row says about each requirement; every claim can fail."""
    m = row["metrics"]
    data = f"{row['log'].split('/')[-1]} chunk {row['chunk']}"
    psnr = "interpolation/psnr"
    yield claim("main.gnet_over_initial_db", m["gnet"][psnr] - m["initial"][psnr], ">=", 4.0, "dB", data)
    yield claim("main.gnet_vs_adam_db", m["gnet"][psnr] - m["adam"][psnr], ">=", 0.0, "dB", data)
    yield claim("main.enet_interpolation_db", m["enet"][psnr] - m["gnet"][psnr], ">=", -0.5, "dB", data)
    total = sum(seconds for name, seconds in row["seconds"].items() if name != "adam")
    yield claim("main.minutes_per_chunk", total / 60, "<", 15.0, "min", data)
    if real:
        kernel = "shift_3m/kernel"
        yield claim("main.enet_kernel_3m", m["enet"][kernel] - m["gnet"][kernel], "<", 0.0, "kernel distance", data)
        return
    fixed = m["fnet"]
    yield claim("main.fnet_psnr_3m_db", fixed["shift_3m/psnr"] - fixed["shift_3m/render_psnr"], ">", 0.0, "dB", data)
    perceptual = fixed["shift_3m/perceptual"] / fixed["shift_3m/render_perceptual"]
    yield claim("main.fnet_perceptual_3m", perceptual, "<", 1.0, "ratio", data)
    perceptual = m["enet"]["shift_3m/perceptual"] / m["gnet"]["shift_3m/perceptual"]
    yield claim("main.enet_perceptual_3m", perceptual, "<", 1.0, "ratio", data)


def claim(name: str, measured: float, op: str, target: float, unit: str, data: str) -> dict[str, Any]:
    """One claim in the project's schema."""
    holds = {">=": measured >= target, ">": measured > target, "<": measured < target}[op]
    return {
        "id": name,
        "measured": measured,
        "op": op,
        "target": target,
        "unit": unit,
        "n": 1,
        "spread": None,
        "data": data,
        "holds": bool(holds),
    }


_STAGES = (("initial", "initial"), ("adam", "tuned Adam"), ("gnet", "GNet"), ("fnet", "FNet"), ("enet", "ENet"))
_COLUMNS = {
    "held-out PSNR": "interpolation/psnr",
    "SSIM": "interpolation/ssim",
    "perceptual": "interpolation/perceptual",
    "PSNR @3m": "shift_3m/psnr",
    "perceptual @3m": "shift_3m/perceptual",
    "kernel @3m": "shift_3m/kernel",
}


def markdown(rows: list[dict[str, Any]]) -> Iterator[str]:
    """The rows as the table that the README shows."""
    yield "| log | stage | seconds | " + " | ".join(_COLUMNS) + " |"
    yield "|---|---|---|" + "---|" * len(_COLUMNS)
    for row in rows:
        for stage, name in _STAGES:
            found = row["metrics"][stage]
            cells = [f"{found[m]:.3f}" if m in found else "" for m in _COLUMNS.values()]
            log = f"{row['log'].split('/')[-1].removeprefix('synthetic:')} chunk {row['chunk']}"
            yield f"| {log} | {name} | {row['seconds'][stage]:.1f} | " + " | ".join(cells) + " |"
        fixed = row["metrics"]["fnet"]
        given = [f"{fixed[key]:.3f}" if (key := m.replace("/", "/render_")) in fixed else "" for m in _COLUMNS.values()]
        yield "| | the renders FNet was given | | " + " | ".join(given) + " |"


def say(text: str) -> None:
    sys.stderr.write(text + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--store", default="genre-store")
    parser.add_argument("--seeds", default="1001,1002,1003")
    parser.add_argument("--pandaset", default="../shared/data/pandaset/002")
    options = parser.parse_args()
    prepare_environment(debug=False)  # before torch is imported
    rows = [measure(f"synthetic:street?seed={seed}", 0, options.store) for seed in options.seeds.split(",") if seed]
    claims = [c for row in rows for c in claims_of(row, real=False)]
    if Path(options.pandaset).is_dir():
        rows.append(measure(f"pandaset:{options.pandaset}", 1, options.store))
        claims += claims_of(rows[-1], real=True)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True, check=False).stdout.strip()
    result = {"machine": platform.processor() or platform.machine(), "commit": commit, "rows": rows, "claims": claims}
    options.json.parent.mkdir(parents=True, exist_ok=True)
    options.json.write_text(json.dumps(result, indent=1) + "\n")
    for line in markdown(rows):
        sys.stdout.write(line + "\n")
    for c in claims:
        word = "holds" if c["holds"] else "FAILS"
        say(f"{word}  {c['id']:<28} {c['measured']:9.4f} {c['op']} {c['target']}  {c['data']}")


if __name__ == "__main__":
    main()
