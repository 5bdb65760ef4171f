"""How much memory a job takes: told before it begins, and refused where there is less."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from ..errors import SceneCaptumError
from ._passes import SAMPLES

MEBIBYTE = 2**20

# Upper bounds of what ``benchmarks/memory.py --predict`` measures, in bytes.
ONCE = 250 * MEBIBYTE  # kernels, libraries and what is imported on the way
PER_SAMPLE = 40  # of a pass
PER_PIXEL = 320  # of one picture with its pilots and its backward pass
PER_PICTURE = 80  # and pixel: a picture, its adjoint, and what the jackknife makes of both
PER_TEXEL = 60  # and channel, of what is tracked: values, gradients and their spread

# Where Linux says in which control groups a process is, and what their limits are.
GROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
_NAMES = ("memory.max", "memory.current")

# Some of what is free must stay so.
MARGIN = 0.9


def predict(resolution: tuple[int, int], spp: int, pictures: int, texels: int) -> int:
    """Return the bytes that rendering and differentiating takes at most, beyond what the process holds already.

    Parameters
    ----------
    resolution
        ``(width, height)`` in pixels; of several cameras, the width of all.
    spp
        Samples per pixel of each picture. They come in passes of bounded size.
    pictures
        How many are held at the same time: the passes of an attribution.
    texels
        Numbers that are tracked.
    """
    pixels = math.prod(resolution)
    samples = min(spp * pixels, max(SAMPLES, pixels))
    return ONCE + PER_SAMPLE * samples + (PER_PIXEL + PER_PICTURE * pictures) * pixels + PER_TEXEL * texels


def available() -> int | None:
    """Return the bytes of main memory that this process may still take, or None where that is not known."""
    try:
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        free = 1024 * int(lines["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError):
        return None
    return min([free, *_left_by_groups()])


def _left_by_groups() -> list[int]:
    """Return what the limits of containers and batch systems leave (control groups, version 2 and 1)."""
    own, root = GROUPS
    found = []
    try:
        groups = [line.split(":", 2) for line in own.read_text().splitlines()]
    except OSError:
        return []
    for _, controllers, place in groups:
        if controllers not in ("", "memory"):
            continue
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes") if controllers else _NAMES
        folder = root / controllers / place.lstrip("/")
        # Any group above may have the limit; a container sees its own as the root.
        for one in [folder, *folder.parents]:
            try:
                limit, used = (int((one / name).read_text()) for name in names)
            except (OSError, ValueError):  # no such file, or "max"
                continue
            found.append(max(0, limit - used))
    return found


def require(resolution: tuple[int, int], spp: int, pictures: int, texels: int, free: int | None) -> None:
    """Refuse a job that does not fit into what is free, and name settings that would.

    Raises
    ------
    SceneCaptumError
        With what it would take, what there is, and what fits.
    """
    needed = predict(resolution, spp, pictures, texels)
    if free is None or needed <= MARGIN * free:
        return

    def fits(size: tuple[int, int], samples: int, count: int) -> bool:
        return predict(size, samples, count, texels) <= MARGIN * free

    width, height = resolution
    remedies = []
    # Fewer passes have more samples each.
    if (count := _largest(pictures, lambda n: fits(resolution, math.ceil(spp * pictures / n), n))) > 1:
        remedies.append(f"replicates={count}")
    if (samples := _largest(spp, lambda n: fits(resolution, n, pictures))) > 0:
        remedies.append(f"{samples} samples per pixel in a pass (spp={samples * pictures})")
    smaller = next(
        (
            (max(width // k, 1), max(height // k, 1))
            for k in range(2, max(resolution) + 1)
            if fits((max(width // k, 1), max(height // k, 1)), spp, pictures)
        ),
        None,
    )
    if smaller:
        remedies.append(f"resolution={smaller}")
    each = f"{pictures} picture{'s' if pictures > 1 else ''} of {width}×{height} pixels at {spp} spp each"
    remedy = f"What fits is {', or '.join(remedies)}." if remedies else "Nothing smaller fits either."
    raise SceneCaptumError(
        f"This would take about {size(needed)} of memory ({each}), and {size(free)} are available. {remedy}"
    )


def _largest(below: int, fits: Callable[[int], bool]) -> int:
    """Return the largest number from 1 to ``below − 1`` that fits, or 0: what fits less fits no more."""
    low, high = 0, below
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def size(number: int) -> str:
    """Write a number of bytes.

    Example
    -------
    >>> size(3 * 2**29), size(5 * 2**20)
    ('1.5 GB', '5 MB')
    """
    return f"{number / 2**30:.1f} GB" if number >= 2**30 else f"{number / MEBIBYTE:.0f} MB"
