"""Predict the memory of a job before it starts, and refuse a job that would not fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from pathlib import Path

from ..errors import SceneCaptumError
from ._chunks import MAX_SAMPLES

MEBIBYTE = 2**20

# Upper bounds of the measurements of ``benchmarks/memory.py --predict``, in bytes.
FIXED = 64 * MEBIBYTE  # kernels and lazily imported libraries
PER_INPUT = (
    3 * MEBIBYTE // 2
)  # kernels: each input has code for its material, and some have renders of their own
PER_SAMPLE = 128  # of a chunk
PER_PIXEL = 320  # of one image with its pilots and its backward pass
PER_PICTURE = 80  # and pixel: an image, its adjoint, and their jackknife replicates
PER_TEXEL = 44  # and channel, of the tracked parameters: values, gradients and their variances

# Linux: a process's control groups, and the folder with their limits.
CGROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
_CGROUP_V2_FILES = ("memory.max", "memory.current")
_CGROUP_V1_FILES = ("memory.limit_in_bytes", "memory.usage_in_bytes")

# The fraction of the available memory that a job may take.
MAX_FRACTION = 0.9


def predict(resolution: tuple[int, int], spp: int, pictures: int, sizes: Collection[int]) -> int:
    """Return an upper bound on the bytes that rendering and differentiating allocates.

    ``resolution`` is ``(width, height)``, for several cameras with their total width; ``pictures`` the number of
    images held at the same time, the replicates of an attribution; ``sizes`` the numbers of scalars of each input.
    """
    pixels = math.prod(resolution)
    samples = min(spp * pixels, max(MAX_SAMPLES, pixels))
    return (
        FIXED
        + PER_SAMPLE * samples
        + (PER_PIXEL + PER_PICTURE * pictures) * pixels
        + PER_INPUT * len(sizes)
        + PER_TEXEL * sum(sizes)
    )


def available() -> int | None:
    """Return the bytes of main memory available to this process, or None where that is unknown."""
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        free = 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
    return min([free, *_available_in_cgroups()])


def _available_in_cgroups() -> list[int]:
    """Return the bytes available under the limits of containers and batch systems (cgroups v2 and v1)."""
    own, root = CGROUPS
    remaining = []
    try:
        groups = [line.split(":", 2) for line in own.read_text().splitlines()]
    except OSError:
        return []
    for _, controllers, place in groups:
        if controllers not in ("", "memory"):
            continue
        files = _CGROUP_V1_FILES if controllers else _CGROUP_V2_FILES
        group = root / controllers / place.lstrip("/")
        # Any ancestor may have the limit; a container sees its own group as the root.
        for folder in [group, *group.parents]:
            try:
                limit, used = (int((folder / file).read_text()) for file in files)
            except (OSError, ValueError):  # no such file, or "max"
                continue
            remaining.append(max(0, limit - used))
    return remaining


def require(
    resolution: tuple[int, int], spp: int, pictures: int, sizes: Collection[int], free: int | None
) -> None:
    """Raise if a job does not fit into the free memory, with both amounts and settings that would fit."""
    needed = predict(resolution, spp, pictures, sizes)
    if free is None or needed <= MAX_FRACTION * free:
        return

    def fits(size: tuple[int, int], samples: int, count: int) -> bool:
        return predict(size, samples, count, sizes) <= MAX_FRACTION * free

    width, height = resolution
    remedies = []
    # Fewer replicates have more samples each.
    if (count := _largest(pictures, lambda n: fits(resolution, math.ceil(spp * pictures / n), n))) > 1:
        remedies.append(f"replicates={count}")
    if (samples := _largest(spp, lambda n: fits(resolution, n, pictures))) > 0:
        remedies.append(f"{samples} samples per pixel in a replicate (spp={samples * pictures})")
    fractions = ((max(width // k, 1), max(height // k, 1)) for k in range(2, max(resolution) + 1))
    if smaller := next((size for size in fractions if fits(size, spp, pictures)), None):
        remedies.append(f"resolution={smaller}")
    job = f"{pictures} image{'s' if pictures > 1 else ''} of {width}×{height} pixels at {spp} spp each"
    remedy = (
        f"Settings that fit: {', or '.join(remedies)}." if remedies else "No smaller setting fits either."
    )
    raise SceneCaptumError(
        f"This would take about {format_bytes(needed)} of memory ({job}), but only {format_bytes(free)} are "
        f"available. {remedy}"
    )


def _largest(below: int, fits: Callable[[int], bool]) -> int:
    """Return the largest number from 1 to ``below − 1`` that fits, or 0, by bisection."""
    low, high = 0, below
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def format_bytes(count: int) -> str:
    """Format a number of bytes for people.

    Example
    -------
    >>> format_bytes(3 * 2**29), format_bytes(5 * 2**20)
    ('1.5 GB', '5 MB')
    """
    return f"{count / 2**30:.1f} GB" if count >= 2**30 else f"{count / MEBIBYTE:.0f} MB"
