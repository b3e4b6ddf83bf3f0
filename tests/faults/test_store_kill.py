"""kill −9 at random moments inside commits: afterwards there is no artifact or a whole one."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from storage.address import Address
from storage.local import LocalStore
from tests.storage.artifact_values import COLORS, assert_same, make

ROOT = Path(__file__).parents[2]
KILLS = 30
KINDS = ("reconstruction", "novel_views", "chunk")

# Everything is imported once, then a child is forked for each kill: the moments lie inside commits, not in imports.
SERVER = """
import os, sys
from pathlib import Path
from storage.address import Address
from storage.codecs import get_codec
from storage.local import LocalStore
from tests.storage.artifact_values import make

store = LocalStore(Path(sys.argv[1]))
values = {kind: make(kind) for kind in sys.argv[2:]}
for kind in values:
    get_codec(kind)
store.commit(Address("d", "l", 0, "reconstruction", "warm"), "reconstruction", values["reconstruction"])
print("ready", flush=True)
for line in sys.stdin:
    child = os.fork()
    if child == 0:
        n = int(line)
        while True:
            kind = list(values)[n % len(values)]
            store.commit(Address("d", "l", 0, kind, f"{line.strip()}-{n}"), kind, values[kind])
            n += 1
    print(child, flush=True)
    os.waitpid(child, 0)
    print("done", flush=True)
"""


@pytest.mark.fault
def test_kills_inside_commits(tmp_path: Path) -> None:
    moments = random.Random(0)
    server = subprocess.Popen(
        [sys.executable, "-c", SERVER, str(tmp_path), *KINDS],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"},
    )
    assert server.stdin is not None and server.stdout is not None
    assert server.stdout.readline() == "ready\n"
    store, half_written = LocalStore(tmp_path), 0
    expected = {kind: store.commit(Address("d", "l", 0, kind, "reference"), kind, make(kind)) for kind in KINDS}
    try:
        for k in range(KILLS):
            server.stdin.write(f"{k}\n")
            server.stdin.flush()
            child = int(server.stdout.readline())
            time.sleep(moments.uniform(0.01, 0.5))
            os.kill(child, signal.SIGKILL)
            assert server.stdout.readline() == "done\n"
            half_written += len(list(tmp_path.rglob(".tmp-*")))
            for path, error in store.verify_all():
                assert error is None, path
            store.clean_temporaries(older_than_s=0)
    finally:
        server.stdin.close()
        server.wait(60)
    made = list(store.artifacts())
    # The moments are good ones: many left a commit half-done, and many commits were done.
    assert len(made) >= KILLS // 2 and half_written >= KILLS // 3, (len(made), half_written)
    for artifact in made:
        assert artifact.manifest.payload_digest == expected[artifact.manifest.kind].manifest.payload_digest
    for artifact in made[-9:]:
        kind = artifact.manifest.kind
        assert_same(make(kind), store.read(artifact), kind, COLORS)
    assert not list(tmp_path.rglob(".tmp-*"))
