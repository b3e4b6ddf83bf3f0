"""gsply, another implementation of PLY, in a process of its own: its compiler would take longer than all tests here."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from genre_tasks.exchange.types import SplatCloud

_WRITE_AND_READ = """
import sys
# Its writer loads torch where it can, which takes seconds, and needs it for tensors only.
sys.modules["torch"] = None
import gsply
import numpy as np
arrays, path, out, compressed = sys.argv[1:]
if arrays:
    given = np.load(arrays)
    names = ("means", "log_scales", "quats", "logit_opacities", "sh_dc", "sh_rest")
    gsply.plywrite(path, *(given[name] for name in names), compressed=compressed == "yes")
read = gsply.plyread(path)
np.savez(out, means=read.means, log_scales=read.scales, quats=read.quats, logit_opacities=read.opacities,
         sh_dc=read.sh0, sh_rest=read.shN)
"""


def write_and_read_by_gsply(path: Path, cloud: SplatCloud | None, compressed: bool = False) -> SplatCloud:
    """Has gsply write a cloud, and read it; ``None``: read what is there."""
    pytest.importorskip("gsply")
    arrays = path.with_name("arrays.npz")
    out = path.with_name("read.npz")
    if cloud is not None:
        np.savez(arrays, **{name: value for name, value in vars(cloud).items() if isinstance(value, np.ndarray)})
    words = (str(arrays) if cloud is not None else "", str(path), str(out), "yes" if compressed else "no")
    command = (sys.executable, "-c", _WRITE_AND_READ, *words)
    done = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"NUMBA_DISABLE_JIT": "1"})
    assert done.returncode == 0, done.stderr
    return SplatCloud(**np.load(out))
