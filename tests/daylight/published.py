"""The published definitions of the annual metrics as plain loops over points and hours."""

from __future__ import annotations

import numpy as np


def daylight_autonomy(illuminance: np.ndarray, threshold: float = 300.0) -> float:
    counted = 0
    for point in illuminance:
        for value in point:
            counted += value >= threshold
    return 100 * counted / illuminance.size


def continuous_daylight_autonomy(illuminance: np.ndarray, threshold: float = 300.0) -> float:
    credit = 0.0
    for point in illuminance:
        for value in point:
            credit += 1 if value >= threshold else value / threshold
    return 100 * credit / illuminance.size


def useful_daylight_illuminance(illuminance: np.ndarray, band: str) -> float:
    counted = 0
    for point in illuminance:
        for value in point:
            if value < 100:
                found = "fell-short"
            elif value < 300:
                found = "supplementary"
            elif value <= 3000:
                found = "autonomous"
            else:
                found = "exceeded"
            counted += found == band
    return 100 * counted / illuminance.size


def spatial_daylight_autonomy(
    illuminance: np.ndarray, threshold: float = 300.0, fraction: float = 0.5
) -> float:
    passing = 0
    for point in illuminance:
        hours = 0
        for value in point:
            hours += value >= threshold
        passing += hours >= fraction * len(point)
    return 100 * passing / len(illuminance)


def annual_sunlight_exposure(
    illuminance: np.ndarray, threshold: float = 1000.0, limit: float = 250.0
) -> float:
    failing = 0
    for point in illuminance:
        hours = 0
        for value in point:
            hours += value > threshold
        failing += hours > limit
    return 100 * failing / len(illuminance)


def total_annual_illumination(illuminance: np.ndarray) -> float:
    total = 0.0
    for point in illuminance:
        for value in point:
            total += value
    return total / len(illuminance)


def daylight_provision(illuminance: np.ndarray, target: float, minimum: float) -> float:
    """Percentage of the required points: half at the target, 95 % at the minimum target."""
    ratios = []
    for threshold, required in ((target, 0.5), (minimum, 0.95)):
        passing = 0
        for point in illuminance:
            bright = sorted(point, reverse=True)[: -(-len(point) // 2)]  # the brighter half, rounded up
            passing += bright[-1] >= threshold
        ratios.append(passing / len(illuminance) / required)
    return 100 * min(ratios)
