"""Renders of a scene, one for each replicate, of which a value by the definition is stated."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

import torch

from ..attr import SceneAttribution
from ..estimation import DEFAULT_REPLICATES, Metric
from ..rendering import SceneRenderer
from ..validation import Scenes, denoise_of


def renders_like(
    attribution: SceneAttribution,
    renderer: SceneRenderer,
    metric: Metric,
    options: argparse.Namespace,
    values: Mapping[str, torch.Tensor] | None = None,
) -> Scenes:
    """Return renders with as many samples as the picture of a result, so that their values are as accurate."""
    return Scenes(
        renderer,
        metric,
        options.target,
        seed=options.seed,
        spp=(attribution.info.get("picture") or {}).get("spp"),
        replicates=DEFAULT_REPLICATES,
        denoise=denoise_of(attribution),
        values=values,
    )
