"""kill −9 at 100 moments, then run again: finished stages stay as they are, payloads are those of a quiet run."""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from flows.pipeline.definition import PIPELINE
from tests.faults import small_run

pytestmark = pytest.mark.fault
RANDOM_KILLS = 80
SYNCS = (1, 3)
"""Per stage: killed at the first and at the third sync of its commit (20 kills over the ten stages)."""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    with small_run.prefect_server(tmp_path_factory.mktemp("server")) as url:
        yield {"PREFECT_API_URL": url}


@pytest.fixture(scope="module")
def quiet(tmp_path_factory: pytest.TempPathFactory, server: dict[str, str]) -> tuple[dict[str, str], float]:
    """Payload digests and seconds of a run that nobody disturbs."""
    folder = tmp_path_factory.mktemp("quiet")
    start = time.monotonic()
    small_run.run_to_the_end(folder, folder / "store", **server)
    digests = small_run.payloads(folder / "store")
    assert len(digests) == len(PIPELINE)
    return digests, time.monotonic() - start


def _manifests(store: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in store.rglob("manifest.json") if "/." not in str(p.relative_to(store.parent))}


def test_random_kills(tmp_path: Path, server: dict[str, str], quiet: tuple[dict[str, str], float]) -> None:
    digests, seconds = quiet
    rng = random.Random(0)
    kills, rounds = 0, 0
    while kills < RANDOM_KILLS:
        rounds += 1
        store = tmp_path / f"store{rounds}"
        finished = False
        while not finished:
            before = _manifests(store)
            command = [small_run.GENRE, *small_run.arguments(store)]
            env = small_run.environment(tmp_path, **server)
            pipe = subprocess.DEVNULL
            process = subprocess.Popen(command, env=env, cwd=tmp_path, stdout=pipe, stderr=pipe)
            try:
                finished = process.wait(rng.uniform(0.2, 1.0) * seconds) == 0
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                kills += 1
            after = _manifests(store)
            assert {p: after.get(p) for p in before} == before  # what was finished is neither lost nor made again
        assert small_run.payloads(store) == digests
    assert rounds >= 2


@pytest.mark.parametrize("stage", [spec.name for spec in PIPELINE])
def test_kills_inside_a_commit(
    tmp_path: Path, server: dict[str, str], quiet: tuple[dict[str, str], float], stage: str
) -> None:
    digests, _ = quiet
    store = tmp_path / "store"
    script = str(Path(small_run.__file__).parent / "die_in_commit.py")
    for syncs in SYNCS:
        command = [sys.executable, script, stage, str(syncs), *small_run.arguments(store)]
        died = subprocess.run(
            command,
            env=small_run.environment(tmp_path, **server),
            cwd=tmp_path,
            capture_output=True,
            timeout=600,
            check=False,
        )
        assert died.returncode == -9, died.stderr[-2000:]
        here = small_run.payloads(store)
        assert not any(name.endswith("/" + stage) for name in here)
        assert here.items() <= digests.items()
    again = small_run.run_to_the_end(tmp_path, store, **server)
    served = {s["stage"]: s["cached"] for s in again["chunks"][0]["stages"]}
    earlier = [spec.name for spec in PIPELINE][: [spec.name for spec in PIPELINE].index(stage)]
    assert served == {spec.name: spec.name in earlier for spec in PIPELINE}
    assert small_run.payloads(store) == digests
