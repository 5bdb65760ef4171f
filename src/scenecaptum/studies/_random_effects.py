"""The mean of an effect over rooms, and how much of its variance is between rooms, between cameras, and noise.

The model is

    effect in a cell = mean + room + camera in the room + noise.

Rooms are a sample of the rooms that the study stands for. The cameras of a room are a sample of its views; what a
camera has in common in all rooms, such as a fisheye's smaller effects, is no deviation of any room. The noise is
that of the renders. Seeds repeat the noise, and nothing else.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..estimation import student_t
from . import _extras as extras

LEVEL = 0.95
MIN_ROOMS_FOR_NEW_ROOM = 3
# Of two rooms: below, one of little noise has nearly all the weight, and tells nothing of others.
MIN_EFFECTIVE_ROOMS = 1.5

# Relative to the square of the unit: a variance of 0 would have an infinite weight.
_SMALLEST_VARIANCE = 1e-6

Array = NDArray[np.float64]


@functools.cache
def quantile(degrees: int) -> float:
    """Return the half-width of an interval of this level in standard errors (Student's t)."""
    return student_t(LEVEL, degrees)


class Observation(NamedTuple):
    """An effect in a cell, and its standard error, None if it has none."""

    room: str
    camera: str
    effect: float
    error: float | None
    degrees: int = 1  # of freedom of the error


@dataclass(frozen=True)
class RoomEffect:
    """The effect in one room: the mean over its cameras and seeds.

    Attributes
    ----------
    room
        Name of the scene.
    effect, error
        The effect and its standard error, that of the renders; the error is None if the noise is unknown.
    low, high
        95 % confidence interval for exactly these cameras (Student's t); None if the noise is unknown.
    cameras
        The effect of each camera, by name.
    """

    room: str
    effect: float
    error: float | None
    low: float | None
    high: float | None
    cameras: dict[str, float]

    @property
    def sign(self) -> int:
        """1 or -1 if the interval excludes 0, else 0."""
        if self.low is None or self.high is None or self.low <= 0 <= self.high:
            return 0
        return 1 if self.low > 0 else -1

    @property
    def is_unclear(self) -> bool:
        """Whether the noise hides the sign; an effect of exactly 0 has none to hide."""
        return self.sign == 0 and self.low != self.high


@dataclass(frozen=True)
class Combined:
    """The mean of an effect over rooms; what cannot be estimated is None. `GroupEffect` describes the fields."""

    mean: float
    error: float | None
    low: float | None
    high: float | None
    new_low: float | None
    new_high: float | None
    between: float | None
    within: float | None
    noise: float | None
    seed_spread: float | None
    rooms: tuple[RoomEffect, ...]
    effective_rooms: float


@dataclass(frozen=True)
class _Views:
    """The mean over the seeds for each camera of each room; the variance is that of the noise."""

    rooms: list[str]
    cameras: list[str]
    effects: Array
    variances: Array
    degrees: Array

    @property
    def room_index(self) -> NDArray[np.int64]:
        """The number of each view's room, in their order."""
        order = {room: index for index, room in enumerate(dict.fromkeys(self.rooms))}
        return np.array([order[room] for room in self.rooms])


def combine(observations: Sequence[Observation]) -> Combined:
    """Return the mean over the rooms with its interval, and the components of variance.

    References
    ----------
    Paule and Mandel, "Consensus values and weighting factors", Journal of Research of the National Bureau of
    Standards 87(5), 1982 (the variance between rooms); IntHout, Ioannidis and Borm, "The Hartung-Knapp-Sidik-
    Jonkman method for random effects meta-analysis", BMC Medical Research Methodology 14:25, 2014 (the interval of
    the mean); Knapp and Hartung, "Improved tests for a random effects meta-regression with a single covariate",
    Statistics in Medicine 22(17), 2003, and Röver, Knapp and Friede, "Hartung-Knapp-Sidik-Jonkman approach and its
    modification for random-effects meta-analysis with few studies", BMC Medical Research Methodology 15:99, 2015
    (no factor below 1); Kish, "Survey Sampling", Wiley, 1965, section 11.2C (the effective number of rooms, from
    which the degrees of freedom are taken); IntHout et al., "Plea for routinely presenting prediction intervals in
    meta-analysis", BMJ Open 6, 2016 (that of a new room).
    """
    seed_spread = _spread_of_seeds(observations)
    has_errors = all(one.error is not None for one in observations)
    noise = (
        math.sqrt(np.mean([(one.error or 0.0) ** 2 for one in observations])) if has_errors else seed_spread
    )
    views = _views(observations, None if has_errors else seed_spread or 0.0)
    rooms = _rooms(views, noise is not None)
    within = _variance_between_cameras(views, remove_common=False)
    mean, error, between, width, effective = _mean_over_rooms(views)
    is_one_room = len(rooms) == 2 and effective < MIN_EFFECTIVE_ROOMS
    half = None if error is None or is_one_room else width * error
    new = None
    if half is not None and between is not None and len(rooms) >= MIN_ROOMS_FOR_NEW_ROOM:
        new = width * math.hypot(error or 0.0, between)
    return Combined(
        mean=mean,
        error=error,
        low=None if half is None else mean - half,
        high=None if half is None else mean + half,
        new_low=None if new is None else mean - new,
        new_high=None if new is None else mean + new,
        between=between,
        within=None if within is None else math.sqrt(within),
        noise=noise,
        seed_spread=seed_spread,
        rooms=tuple(rooms),
        effective_rooms=effective,
    )


def _mean_over_rooms(views: _Views) -> tuple[float, float | None, float | None, float, float]:
    """Return the mean, its standard error, the deviation of rooms, a half-width in standard errors, and the rooms.

    The error is that of Hartung, Knapp, Sidik and Jonkman, the half-width that of a 95 % interval.
    Their factor q compares the spread of the rooms with what their variances predict. Where rooms agree by chance
    it is far below 1; here it is at least 1 (Knapp and Hartung's ad hoc correction), so that the error is never
    smaller than that of a mean of rooms that do not differ. The interval of a new room contains the same error.

    The degrees of freedom are those of the effective number of rooms, 1 / Σ w² for weights w that add up to 1: if
    a few rooms of little noise have nearly all the weight, only these few say how much rooms differ. This
    number is the last that is returned.

    statsmodels estimates all but the last, in units of the rooms' spread because its tolerances are absolute.
    """
    index = views.room_index
    counts = np.bincount(index)
    effects = np.bincount(index, views.effects) / counts
    if len(effects) == 1:
        return float(effects[0]), None, None, math.nan, 1.0
    common = _variance_between_cameras(views, remove_common=True)
    variances = np.bincount(index, views.variances) / counts**2 + (common or 0.0) / counts
    # With a spread below the smallest error, the variance between rooms is 0 in any unit.
    unit = max(float(effects.std(ddof=1)), math.sqrt(variances.min()))
    centre = float(effects.mean())
    if unit == 0:
        return centre, 0.0, 0.0, quantile(len(effects) - 1), float(len(effects))
    scaled = np.maximum(variances / unit**2, _SMALLEST_VARIANCE)
    with np.errstate(
        divide="ignore"
    ):  # in a number that is not used here, where all rooms have the same effect
        found: Any = extras.meta_analysis().combine_effects(
            (effects - centre) / unit, scaled, method_re="pm", use_t=True
        )
    effective = 1 / float(np.square(found.weights_rel_re).sum())
    return (
        float(centre + unit * found.mean_effect_re),
        float(unit * max(found.sd_eff_w_re_hksj, found.sd_eff_w_re)),  # with q, and with 1
        float(unit * math.sqrt(found.tau2)),
        float(extras.student_t().ppf((1 + LEVEL) / 2, max(1.0, effective - 1))),
        effective,
    )


def _variance_between_cameras(views: _Views, *, remove_common: bool) -> float | None:
    """Return the variance between the cameras of one room, less the noise.

    With ``remove_common``, without what a camera has in common in all rooms that have one of its name; where that
    leaves no degree of freedom, as in a single room, with it. None if no room has two cameras.
    """
    index = views.room_index
    counts = np.bincount(index)
    residuals, leverage = (
        views.effects - (np.bincount(index, views.effects) / counts)[index],
        1 / counts[index],
    )
    degrees = len(index) - len(counts)
    rooms_with = Counter(views.cameras) if remove_common else Counter[str]()
    shared = [camera for camera, rooms in rooms_with.items() if rooms > 1]
    if shared:
        columns = np.array([[float(camera == name) for name in shared] for camera in views.cameras])
        # Cameras as columns, less their means in each room (Frisch and Waugh), span what they have in common.
        means = np.stack([np.bincount(index, column) / counts for column in columns.T], axis=1)
        basis, sizes, _ = np.linalg.svd(columns - means[index], full_matrices=False)
        basis = basis[:, sizes > 1e-9 * max(sizes.max(), 1.0)]
        if degrees > basis.shape[1]:
            degrees -= basis.shape[1]
            residuals = residuals - basis @ (basis.T @ residuals)
            leverage = leverage + np.square(basis).sum(1)
    if degrees == 0:
        return None
    # The residuals have this expected sum of squares from noise alone.
    noise = float(((1 - leverage) * views.variances).sum())
    return max(0.0, (float(residuals @ residuals) - noise) / degrees)


def _views(observations: Sequence[Observation], spread: float | None) -> _Views:
    """Return the means over the seeds, with the variance of their noise: from the errors, or a spread of seeds."""
    groups: dict[tuple[str, str], list[Observation]] = {}
    for one in observations:
        groups.setdefault((one.room, one.camera), []).append(one)
    repeats = max(1, len(observations) - len(groups))
    return _Views(
        rooms=[room for room, _ in groups],
        cameras=[camera for _, camera in groups],
        effects=np.array([np.mean([one.effect for one in group]) for group in groups.values()]),
        variances=np.array(
            [
                sum((one.error or 0.0) ** 2 if spread is None else spread**2 for one in group)
                / len(group) ** 2
                for group in groups.values()
            ]
        ),
        degrees=np.array(
            [sum(one.degrees for one in group) if spread is None else repeats for group in groups.values()]
        ),
    )


def _spread_of_seeds(observations: Sequence[Observation]) -> float | None:
    """Return the standard deviation between seeds of one camera; None if each has one seed."""
    groups: dict[tuple[str, str], list[float]] = {}
    for one in observations:
        groups.setdefault((one.room, one.camera), []).append(one.effect)
    degrees = sum(len(effects) - 1 for effects in groups.values())
    squares = sum(float(np.square(np.array(e) - np.mean(e)).sum()) for e in groups.values())
    return math.sqrt(squares / degrees) if degrees else None


def _rooms(views: _Views, noise_is_known: bool) -> list[RoomEffect]:
    """Return the mean effect of each room with its interval, from the noise alone."""
    index, found = views.room_index, []
    for number, room in enumerate(dict.fromkeys(views.rooms)):
        of_room = np.flatnonzero(index == number)
        effect = float(views.effects[of_room].mean())
        error = math.sqrt(views.variances[of_room].sum()) / len(of_room) if noise_is_known else None
        half = None if error is None else quantile(int(views.degrees[of_room].sum())) * error
        found.append(
            RoomEffect(
                room=room,
                effect=effect,
                error=error,
                low=None if half is None else effect - half,
                high=None if half is None else effect + half,
                cameras={views.cameras[k]: float(views.effects[k]) for k in of_room},
            )
        )
    return found
