"""Studies made by hand: folders of cells with known effects, without a render."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from results import surfaces

from scenecaptum import SceneAttribution
from scenecaptum.studies import Cell, StudyResult
from scenecaptum.studies._folder import StudyFolder
from scenecaptum.studies._recipe import Recipe
from scenecaptum.visualization import metric_name, metric_unit

REPLICATES = 8
LUMINANCE = {"name": "mean luminance", "unit": "cd/m²"}
KINDS = {"reflectance": "reflectance", "alpha": "roughness"}

# Name of a parameter, its effect.
Effects = Mapping[str, float]


def attribution(
    effects: Effects,
    *,
    noise: float = 0.1,
    seed: int = 0,
    shared: float = 0.0,
    picture: bool = True,
    measure: Mapping[str, str] = LUMINANCE,
) -> SceneAttribution:
    """Return an attribution of scalars whose errors are about ``noise``; ``shared`` noise is the same for all."""
    generator = np.random.default_rng(seed)
    deviation = REPLICATES**0.5
    common = shared * deviation * generator.standard_normal(REPLICATES)
    rows = {
        name: torch.tensor(effect + common + noise * deviation * generator.standard_normal(REPLICATES))[
            :, None
        ]
        for name, effect in effects.items()
    }
    covariance = {name: one.T.cov().reshape(1, 1) / REPLICATES for name, one in rows.items()}
    names = [*effects, *effects]
    return SceneAttribution(
        attributions={name: one.mean().float() for name, one in rows.items()},
        standard_error={name: one.sqrt().reshape(()).float() for name, one in covariance.items()},
        metric_value=10.0,
        metric_standard_error=noise,
        replicates=rows,
        covariance=covariance,
        extents={name: torch.ones(1) for name in effects},
        labels={name: name.replace(".", ": ", 1) for name in effects},
        image=torch.from_numpy(generator.random((4, 6, 3), dtype=np.float32)),
        surfaces=surfaces(names[0], names[1]) if picture else None,
        info={
            "metric": "MeanLuminance",
            "measure": dict(measure),
            "method": "VanillaSceneGradient",
            "spp": 64,
            "replicates": REPLICATES,
            "degrees_of_freedom": REPLICATES - 1,
            "seconds": 1.0,
        },
    )


def study(
    folder: Path,
    effects: Mapping[Cell, Effects],
    *,
    failures: Mapping[Cell, str] | None = None,
    missing: Sequence[Cell] = (),
    values_only: Sequence[Cell] = (),
    said: Mapping[Cell, Mapping[str, Any]] | None = None,
    **options: Any,
) -> StudyResult:
    """Write a folder with these cells, and read it; their noise has a seed of its own in each.

    ``said`` is what a worker writes beside the value of a cell, such as notes; older versions wrote less.
    """
    cells = {
        f"{number:032x}": cell
        for number, cell in enumerate([*effects, *(failures or {}), *missing, *values_only])
    }
    manifest = {
        "study": "made",
        "begun": "2026-01-01 00:00",
        "versions": {},
        "cells": {k: [*c] for k, c in cells.items()},
    }
    opened = StudyFolder.begin(folder, manifest)
    for number, (key, cell) in enumerate(cells.items()):
        recipe = Recipe(cell, "scene", 0, "luminance", {}, {}, "gradient", {}, {}, key)
        if cell in effects:
            made = attribution(effects[cell], seed=number, **options)
            opened.write(recipe, {**numbers(made), **(said or {}).get(cell, {})}, made)
        elif cell in values_only:
            opened.write(recipe, {**numbers(None), "rows": []}, None)
        elif failures and cell in failures:
            opened.write_failure(recipe, failures[cell])
    return StudyResult.load(folder)


def numbers(made: SceneAttribution | None) -> dict[str, Any]:
    """Return the numbers that a worker writes beside an attribution."""
    rows = [] if made is None else made.ranking()
    return {
        "measure": "mean luminance" if made is None else metric_name(made),
        "unit": "cd/m²" if made is None else metric_unit(made),
        "value": 10.0 if made is None else made.metric_value,
        "standard_error": 0.1,
        "verdict": "",
        "seconds": 1.5,
        "rows": [
            {
                "rank": row.rank,
                "name": row.name,
                "label": row.label,
                "kind": KINDS[row.name.rpartition(".")[2]],
                "effect": row.effect,
                "effect_error": row.effect_error,
                "saliency": row.saliency,
                "saliency_error": row.saliency_error,
                "caution": "",
            }
            for row in rows
        ],
    }


def cells(
    rooms: Sequence[str],
    cameras: Sequence[str] = ("front",),
    metrics: Sequence[str] = ("luminance",),
    seeds: Sequence[int] = (0,),
) -> list[Cell]:
    """Return the cells of a grid."""
    return [
        Cell(room, camera, metric, "as it is", "gradient", seed)
        for room, camera, metric, seed in itertools.product(rooms, cameras, metrics, seeds)
    ]


def random_effects(
    cells: Sequence[Cell], seed: int, *, rooms: float = 1.0, cameras: float = 0.5
) -> dict[Cell, Effects]:
    """Return effects that vary between rooms and cameras by these standard deviations, around 3, −2, 0.5 and 0."""
    generator = np.random.default_rng(seed)
    means = {"wall.reflectance": 3.0, "floor.reflectance": -2.0, "desk.alpha": 0.5, "lamp.alpha": 0.0}
    of_room = {cell.scene: rooms * generator.standard_normal(len(means)) for cell in cells}
    of_camera = {cell[:2]: cameras * generator.standard_normal(len(means)) for cell in cells}
    return {
        cell: dict(
            zip(means, np.array([*means.values()]) + of_room[cell.scene] + of_camera[cell[:2]], strict=True)
        )
        for cell in cells
    }
