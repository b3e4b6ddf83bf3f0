"""Proof that a change of code keeps every result: payload digests of all stages on fixed logs.

Run it before and after a change, on the same machine::

    python -m benchmarks.tools.payload_digests --out benchmarks/tools/payload_digests.json
    python -m benchmarks.tools.payload_digests --compare benchmarks/tools/payload_digests.json

Digests are equal on one machine with the CPU backend, at any number of threads. Another CPU may round differently, so
the file names the machine that it was written on.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.common.run_stages import ALL_STAGES, print_progress
from flows.configuration import load_configuration
from flows.experiments.stages import run_stages
from flows.machine.facts import describe_machine
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage

EVERY_EFFECT = (
    "rolling_shutter_s=0.03&exposure_jitter=0.2&white_balance_jitter=0.05&bonnet=0.08&distortion=0.02"
    "&gloss=1&stride=1&pedestrians=16&pedestrians_aside_m=5.3"
)
"""A street that calls for every modelled effect but motion blur."""

FEW_ITERATIONS = ("gnet.iterations=12", "enet.iterations=8")
"""Enough for every branch of the loop; a full run with every effect takes ten minutes."""

SCENE_STAGES = ("ingest", "effects", "initial", "gnet", "evaluate/gnet")


@dataclass(frozen=True)
class Case:
    """One reconstruction whose payloads are compared.

    Attributes:
        log: the log's URI; ``{pandaset}`` is replaced by the folder of the real sequence.
        chunk: index of the chunk.
        preset: name of a preset in ``configs/``.
        settings: ``section.key=value`` on top of the preset.
        stages: stages to run, in the pipeline's order; empty for all.
    """

    log: str
    chunk: int
    preset: str
    settings: tuple[str, ...] = ()
    stages: tuple[str, ...] = ()


DEMO_LOG = "synthetic:street?seed=1000"
CASES = {
    "demo": Case(DEMO_LOG, 0, "demo"),
    "every_effect": Case(
        f"synthetic:street?seed=900&{EVERY_EFFECT}",
        0,
        "demo",
        (*FEW_ITERATIONS, "effects=on", "effects.motion_blur=auto"),
    ),
    "motion_blur": Case(
        "synthetic:street?seed=900&exposure_s=0.02&frames=8",
        0,
        "demo",
        (*FEW_ITERATIONS, "effects.motion_blur=on"),
    ),
    "real_chunk_1": Case("pandaset:{pandaset}", 1, "small"),
    "adam": Case(DEMO_LOG, 0, "demo", ("gnet.method=adam", "gnet.iterations=12"), SCENE_STAGES),
    "g3r": Case(DEMO_LOG, 0, "demo", ("gnet.method=g3r", "gnet.iterations=12"), SCENE_STAGES),
    "street_gs": Case(DEMO_LOG, 0, "demo", ("gnet.method=street_gs", "gnet.per_scene.iterations=600"), SCENE_STAGES),
    "standard_3dgs": Case(
        DEMO_LOG, 0, "demo", ("gnet.method=standard_3dgs", "gnet.per_scene.iterations=600"), SCENE_STAGES
    ),
}


def digests_of(case: Case, pandaset: str, store: str) -> dict[str, str]:
    """Payload digests of one case, computed in an empty store.

    Args:
        case: what to reconstruct.
        pandaset: folder of the real sequence.
        store: folder of the store.

    Returns:
        stage name → sha256 of its payload.
    """
    config = load_configuration(case.preset, settings=case.settings)
    job = Job(case.log.format(pandaset=pandaset), case.chunk, store, config.model_dump(mode="json"))
    refs = run_stages(case.stages or ALL_STAGES, job, _run_and_print_digest)
    return {name: ref.payload_digest for name, ref in refs.items()}


def _run_and_print_digest(stage: str, job: Job, inputs: dict[str, ArtifactRef]) -> ArtifactRef:
    ref = run_stage(stage, job, inputs)
    print_progress(f"  {stage}: {ref.payload_digest[:12]}")
    return ref


def differences(before: dict[str, dict[str, str]], after: dict[str, dict[str, str]]) -> list[str]:
    """Lists the stages whose payload changed.

    Args:
        before: case → stage → digest, of the old code.
        after: the same of the new code; cases that did not run are not compared.

    Returns:
        A line for each changed stage.

    >>> differences({"demo": {"gnet": "aa", "enet": "bb"}}, {"demo": {"gnet": "aa", "enet": "cc"}})
    ['demo enet: bb is now cc']
    """
    lines = []
    for name, stages in after.items():
        for stage, digest in stages.items():
            expected = before.get(name, {}).get(stage, "absent")
            if expected != digest:
                lines.append(f"{name} {stage}: {expected} is now {digest}")
    return lines


def main() -> int:
    """Runs the cases and writes or compares their digests.

    Returns:
        The exit status: 1 where a payload changed.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="write the digests to this JSON file")
    parser.add_argument("--compare", type=Path, help="compare with the digests in this JSON file")
    parser.add_argument("--cases", default=",".join(CASES), help="comma-separated names of cases")
    parser.add_argument("--pandaset", default="../shared/data/pandaset/002", help="folder of the real sequence")
    options = parser.parse_args()
    torch.set_num_threads(2)
    found: dict[str, dict[str, str]] = {}
    for name in options.cases.split(","):
        print_progress(name)
        # An empty store: an artifact of the old code would prove nothing.
        with tempfile.TemporaryDirectory() as store:
            found[name] = digests_of(CASES[name], options.pandaset, store)
    if options.out:
        options.out.write_text(json.dumps({"machine": describe_machine(), "digests": found}, indent=1) + "\n")
    changed: list[str] = []
    if options.compare:
        changed = differences(json.loads(options.compare.read_text())["digests"], found)
        count = sum(len(stages) for stages in found.values())
        sys.stdout.write("\n".join([*changed, f"{count - len(changed)} of {count} payloads are the same", ""]))
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())
