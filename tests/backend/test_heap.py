"""The heap of the C library."""

from pathlib import Path

import pytest

from scenecaptum.backend import trim_heap

STATUS = Path("/proc/self/status")


def resident() -> int:
    """Return the resident memory of this process in KiB."""
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1])


def test_freed_blocks_between_small_objects_are_returned() -> None:
    if not STATUS.exists():
        pytest.skip("there is no /proc/self/status")
    blocks, small = [], []
    for _ in range(2000):  # each below the size from which the C library always maps memory by itself
        blocks.append(bytearray(100_000))
        small.append(bytearray(600))
    before = resident()
    blocks.clear()
    trim_heap()
    assert before - resident() > 100_000  # of 195 000 KiB
    assert len(small) == 2000
