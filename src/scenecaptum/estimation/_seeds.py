"""Named streams of random numbers: one seed gives each purpose numbers that are independent of the others."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from ..errors import check_seed


class Stream(IntEnum):
    """What random numbers are used for. Results depend on the numbers of the streams, so these do not change."""

    REPLICATES = 0
    INPUT_METRIC = 1
    ROUNDS = 2
    COMPARISON = 3
    EXTRA_IMAGE_SAMPLES = 4
    NOISY_SCENES = 5
    RANDOM_POINTS = 6
    PERMUTATIONS = 7
    SCENES = 8
    NETWORK_LAYERS = 9
    HESSIAN_PROBES = 10
    RANDOM_BACKGROUND = 11
    FAITHFULNESS_SUBSETS = 12
    FAITHFULNESS_PERTURBATIONS = 13
    DELETION_ORDERS = 14
    SENSITIVITY_DESIGN = 15
    DERIVATIVE_DESIGN = 16
    TRADEOFF_RUNS = 17
    OPTIMIZATION = 18


def random_generator(seed: int, stream: Stream, *path: int) -> np.random.Generator:
    """Return NumPy's generator of a stream, or of a part of it, such as a round."""
    return np.random.default_rng(_sequence(seed, stream, path))


def derived_seeds(seed: int, stream: Stream, count: int, *path: int) -> list[int]:
    """Return seeds of 32 bits from a stream, or from a part of it, such as a round.

    Example
    -------
    >>> derived_seeds(0, Stream.SCENES, 2) == derived_seeds(0, Stream.SCENES, 3)[:2]
    True
    >>> derived_seeds(0, Stream.SCENES, 1) == derived_seeds(0, Stream.ROUNDS, 1)
    False
    """
    return [int(state) for state in _sequence(seed, stream, path).generate_state(count)]


def _sequence(seed: int, stream: Stream, path: tuple[int, ...]) -> np.random.SeedSequence:
    # A spawn key, because entropy is padded with zeros: [seed, 2] and [seed, 2, 0] would be the same.
    return np.random.SeedSequence(check_seed("seed", seed), spawn_key=(stream.value, *path))
