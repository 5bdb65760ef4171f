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
    DELETION_ORDERS = 9
    SUBSETS = 10
    PERTURBATIONS = 11
    RANDOM_NETWORKS = 12
    NETWORK_LAYERS = 13
    SENSITIVITY_DESIGN = 14
    DERIVATIVE_DESIGN = 15
    TRADEOFF_RUNS = 16
    OPTIMIZATION = 17
    PARAMETER_NOISE = 18
    EXPLANATION = 19
    PILOT = 20
    STEP_CHANGES = 21
    RANGE_CHANGES = 22


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
