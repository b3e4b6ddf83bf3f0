"""Freed memory stays with the process until it is to go back."""

from __future__ import annotations

import subprocess
import sys

import pytest

_COUNT = """
import resource
import torch
from flows.machine.memory_reuse import _load_glibc, return_freed_memory, reuse_freed_memory

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        torch.empty(25_000_000).fill_(1)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def resident_mib():
    return next(int(line.split()[1]) // 1024 for line in open("/proc/self/status") if line.startswith("VmRSS"))

torch.set_num_threads(1)
without = faults()
reuse_freed_memory()
faults()
within = faults()
return_freed_memory()
print(without, within, resident_mib(), _load_glibc() is not None)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="counts the page faults of Linux")
def test_pages_are_asked_for_once() -> None:
    # A process of its own: the allocator's settings outlive the block.
    out = subprocess.run([sys.executable, "-c", _COUNT], capture_output=True, text=True, check=True).stdout.split()
    without, within, resident_mib = (int(text) for text in out[:3])
    if out[3] != "True":
        pytest.skip("the C library is not glibc")
    # Twenty tensors of 100 MB: outside their pages are cleared twenty times; huge pages make the count smaller.
    assert within < without / 10
    assert resident_mib < 400
