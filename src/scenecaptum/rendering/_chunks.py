"""Splitting the samples of a render into chunks that fit into memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

# A sample takes about 250 bytes of memory while it is traced and differentiated.
MAX_SAMPLES = 2**22


@dataclass(frozen=True)
class Chunk:
    """Part of the samples of a render: seed, samples per pixel, and the fraction of all samples as its weight."""

    seed: int
    spp: int
    weight: float


def chunks(seed: int, spp: int, resolution: tuple[int, int]) -> Iterator[Chunk]:
    """Split ``spp`` samples per pixel into chunks of at most ``MAX_SAMPLES`` samples, or one sample per pixel.

    Example
    -------
    >>> [(chunk.spp, chunk.weight) for chunk in chunks(0, 8, (1280, 720))]
    [(4, 0.5), (4, 0.5)]

    The first chunk uses ``seed`` itself, so a render that fits into one chunk does not depend on the chunking.
    """
    width, height = resolution
    max_spp = max(1, MAX_SAMPLES // (width * height))
    count = -(-spp // max_spp)
    seeds = [seed, *map(int, np.random.SeedSequence(seed).generate_state(count))]
    start = 0
    for index in range(count):
        end = spp * (index + 1) // count
        yield Chunk(seeds[index], end - start, (end - start) / spp)
        start = end
