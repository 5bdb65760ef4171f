"""Glare sources by the objects that they lie on."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..attr import Source
from ..metrics import GlareRating, GlareSource
from ..projection import SurfaceMap

MIN_SHARE = 0.02  # of the sum over all sources


def find_sources(metric: Any, image: torch.Tensor, surfaces: SurfaceMap | None) -> tuple[Source, ...]:
    """Return the glare sources of a rating, the largest contribution first; none for other metrics.

    A source contributes ``L² ω / P²`` to the sum of UGR and DGP.
    """
    if not isinstance(metric, GlareRating):
        return ()
    found = metric.sources(image)
    parts = [source.luminance**2 * source.solid_angle / source.position_index**2 for source in found]
    total = sum(parts)
    sources: dict[tuple[str, str], Source] = {}
    for source, part in zip(found, parts, strict=True):
        name = _object_of(source, surfaces)
        where = _place(source, *image.shape[:2])
        known = sources.get((name, where))
        share, luminance = part / total, source.luminance
        if known is not None:
            share, luminance = share + known.share, max(luminance, known.luminance)
        sources[name, where] = Source(name, where, share, luminance)
    ordered = sorted(sources.values(), key=lambda source: -source.share)
    return tuple(source for source in ordered if source.share >= MIN_SHARE)


def _object_of(source: GlareSource, surfaces: SurfaceMap | None) -> str:
    """Return the object that covers most of a source."""
    if surfaces is None:
        return "a source"
    mask = np.zeros(surfaces.shape, bool)
    rows, columns = source.pixels.numpy(force=True).T
    mask[rows, columns] = True
    covered = np.bincount(
        surfaces.object_index,
        weights=surfaces.fraction * mask.ravel()[surfaces.pixel],
        minlength=len(surfaces.objects),
    )
    return surfaces.objects[int(covered.argmax())]


def _place(source: GlareSource, height: int, width: int) -> str:
    """Return the ninth of the picture in which a source lies."""
    vertical = ("top", "", "bottom")[min(int(3 * source.row / height), 2)]
    horizontal = ("left", "", "right")[min(int(3 * source.column / width), 2)]
    return " ".join(filter(None, (vertical, horizontal))) or "centre"
