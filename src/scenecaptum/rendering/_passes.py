"""Splitting the samples of a picture into passes that fit into memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

# A sample takes some 250 bytes of memory while it is traced and differentiated.
SAMPLES = 2**22


@dataclass(frozen=True)
class Pass:
    """Some of the samples of a picture: seed, samples per pixel, and their share of all samples."""

    seed: int
    spp: int
    share: float


def passes(seed: int, spp: int, resolution: tuple[int, int]) -> Iterator[Pass]:
    """Split ``spp`` samples per pixel into passes of at most ``SAMPLES`` samples, or one sample per pixel.

    Example
    -------
    >>> [(one.spp, one.share) for one in passes(0, 8, (1280, 720))]
    [(4, 0.5), (4, 0.5)]

    The first pass has the seed itself, so that a picture that fits into one pass is not changed.
    """
    width, height = resolution
    most = max(1, SAMPLES // (width * height))
    count = -(-spp // most)
    seeds = [seed, *map(int, np.random.SeedSequence(seed).generate_state(count))]
    done = 0
    for index in range(count):
        end = spp * (index + 1) // count
        yield Pass(seeds[index], end - done, (end - done) / spp)
        done = end
