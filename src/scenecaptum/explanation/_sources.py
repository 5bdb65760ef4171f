"""The objects of the picture that a metric depends on."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

from ..attr import Source
from ..estimation import TargetedMetric, delete_one_jackknife
from ..metrics import GlareRating
from ..metrics import luminance as relative_luminance
from ..projection import SurfaceMap
from ..rendering import FILLED, SmallLamp

MIN_SHARE = 0.02
CELLS = 32  # along the longer side of the picture: a thinner bar of a window does not separate its panes
MIN_PART, MAX_PLACES = 0.1, 3  # of the weight of an object, for a place of its own; more places are "several"
PURITY = 8  # exponent of the coverage of the pixels that tell the luminance of an object

TINY = np.finfo(np.float64).tiny

Floats = NDArray[np.float64]


def find_sources(
    metric: TargetedMetric,
    images: torch.Tensor,
    surfaces: SurfaceMap | None,
    lamps: Mapping[str, SmallLamp] | None = None,
    light: Mapping[str, torch.Tensor] | None = None,
    reflected: torch.Tensor | None = None,
) -> tuple[Source, ...]:
    """Return the objects that cause at least 2 % of a metric, the largest share first, with the errors.

    ``images`` are independent pictures, ``(replicates, H, W, 3)``. Without a map of the objects there are no
    sources. ``lamps`` are those of a glare rating that are smaller than a pixel, which the map may lack, and
    ``light`` is the radiance that objects themselves send to each pixel, ``(H, W, 3)``. ``reflected`` are the
    pixels that show bright lamps by way of panes, ``(H, W)``: few samples meet these, and the noise is theirs.
    """
    if surfaces is None:
        return ()
    parts = _Parts.of(surfaces, light or {})
    if reflected is not None:
        parts = dataclasses.replace(parts, noisy=reflected.flatten().cpu().numpy()[parts.pixel])
    if lamps and isinstance(metric.metric, GlareRating):
        parts = parts.with_lamps(lamps, metric.metric.camera.solid_angles)

    def shares(kept: torch.Tensor) -> torch.Tensor:
        weights = parts.weights(metric, images[kept].mean(0))
        return torch.from_numpy(parts.by_name(weights) / max(weights.sum(), TINY))

    means, errors = delete_one_jackknife(shares, len(images))
    mean = images.mean(0)
    weights, luminance = parts.weights(metric, mean), _source_luminance(metric, mean)
    return tuple(
        Source(
            parts.names[index],
            _place(weights[parts.name == index], parts.pixel[parts.name == index], surfaces.shape),
            means[index].item(),
            errors[index].item(),
            None if luminance is None else parts.mean_of(luminance, weights, index),
        )
        for index in means.argsort(descending=True).tolist()
        if means[index] >= MIN_SHARE
    )


@dataclass(frozen=True)
class _Parts:
    """The parts of pixels that objects cover: the object ``name[k]`` covers ``fraction[k]`` of ``pixel[k]``.

    It sends ``emitted[k]`` to that pixel itself, as luminance before the efficacy.
    """

    names: list[str]
    name: NDArray[np.int64]
    pixel: NDArray[np.int64]
    fraction: Floats
    emitted: Floats
    known: Mapping[int, float]  # the luminance of objects of which no pixel shows it
    noisy: NDArray[np.bool_]  # parts that do not tell the luminance of an object, if others do

    @classmethod
    def of(cls, surfaces: SurfaceMap, light: Mapping[str, torch.Tensor]) -> _Parts:
        """Return the parts of a map; those of objects of the same name are one."""
        of_objects = [_name(surfaces, index) for index in range(len(surfaces.objects))]
        names = sorted(set(of_objects))
        number = np.array([names.index(name) for name in of_objects], np.int64)
        size = surfaces.shape[0] * surfaces.shape[1]
        shown = number[surfaces.object_index] * size + surfaces.pixel
        keys, fractions = [shown], [surfaces.fraction.astype(float)]
        emissions = [np.zeros(len(shown))]
        for index in (i for i, own in enumerate(surfaces.objects) if own in light):
            luminance = _luminance(light[surfaces.objects[index]])
            (lit,) = luminance.nonzero()
            keys.append(number[index] * size + lit)
            fractions.append(np.zeros(len(lit)))
            emissions.append(luminance[lit])
        parts, entry = np.unique(np.concatenate(keys), return_inverse=True)
        fraction, emitted = (
            np.bincount(entry, np.concatenate(one)).astype(float) for one in (fractions, emissions)
        )
        return cls(names, parts // size, parts % size, fraction, emitted, {}, np.zeros(len(parts), bool))

    def with_lamps(self, lamps: Mapping[str, SmallLamp], solid_angles: torch.Tensor) -> _Parts:
        """Return the parts with those of lamps that are smaller than a pixel, of which few rays or none are.

        A lamp may reach into the pixels around the one that shows it. Where it does not, they have no weight.
        """
        (height, width), size = solid_angles.shape, solid_angles.flatten().cpu().numpy()
        names = [*self.names, *(name for name in lamps if name not in self.names)]
        index, pixel, fraction = [], [], []
        for name, lamp in lamps.items():
            for row, column in product(*(range(max(0, at - 1), at + 2) for at in lamp.pixel)):
                if row < height and column < width and size[row * width + column]:
                    index.append(names.index(name))
                    pixel.append(row * width + column)
                    fraction.append(min(1.0, lamp.solid_angle / size[pixel[-1]]))
        others = ~np.isin(self.name * len(size) + self.pixel, np.array(index) * len(size) + pixel)
        is_lamp = np.isin(self.name, [names.index(name) for name in lamps])
        radiance = torch.stack([lamp.radiance for lamp in lamps.values()])[None]
        luminance = relative_luminance(radiance)[0].tolist()
        return _Parts(
            names,
            np.concatenate([self.name[others], index]),
            np.concatenate([self.pixel[others], pixel]),
            np.concatenate([self.fraction[others], fraction]),
            np.concatenate([np.where(is_lamp, 0.0, self.emitted)[others], np.zeros(len(index))]),
            {names.index(name): one for name, one in zip(lamps, luminance, strict=True)},
            np.concatenate([self.noisy[others], np.zeros(len(index), bool)]),
        )

    def by_name(self, weights: Floats) -> Floats:
        """Return the sum of the weights of each object's parts."""
        return np.bincount(self.name, weights=weights, minlength=len(self.names)).astype(np.float64)

    def weights(self, metric: TargetedMetric, image: torch.Tensor) -> Floats:
        """Return how much of the metric each part causes.

        A pixel at the edge of a window shows its frame as well, but the light is that of the sky. The objects of a
        pixel have shares in it in proportion to the light that each sends: what it emits, and of the rest of the
        light its fraction times the luminance that it has there, which is the mean over its pixels, mostly of
        those that show nothing else.
        """
        rest = _luminance(image) - np.bincount(self.pixel, self.emitted, image.shape[0] * image.shape[1])
        purity = self.fraction**PURITY
        clean = purity * ~self.noisy
        purity = np.where(self.by_name(clean)[self.name] > 0, clean, purity)
        own = self.by_name(purity * rest[self.pixel]) / np.maximum(self.by_name(purity), TINY)
        own = own.clip(min=0.0)  # noise takes that of emitters below 0
        own[list(self.known)] = list(self.known.values())
        light = self.emitted + self.fraction * own[self.name]
        of_pixel = np.bincount(self.pixel, weights=light)[self.pixel]
        share = light / np.maximum(of_pixel, TINY)
        of_metric: Floats = _weights(metric, image).flatten().cpu().numpy()[self.pixel]
        return share * of_metric

    def mean_of(self, values: torch.Tensor, weights: Floats, index: int) -> float:
        """Return the mean of pixels, ``(H, W)``, over the parts of an object, mostly those that show only it.

        Of one that no pixel shows alone, such as in a pane, the fractions do not say which show it best.
        """
        own = self.name == index
        weights, fraction = weights[own], self.fraction[own]
        if fraction.max() >= FILLED:
            weights = weights * fraction**PURITY
        return float((weights * values.flatten().cpu().numpy()[self.pixel[own]]).sum() / weights.sum())


def _luminance(image: torch.Tensor) -> Floats:
    """Return the luminance of each pixel before the efficacy, ``(H * W,)``."""
    values: Floats = relative_luminance(image).double().clamp_min(0).flatten().cpu().numpy()
    return values


def _name(surfaces: SurfaceMap, index: int) -> str:
    """Return the material of an object, if it has one and emits no light, or else its own name."""
    own = surfaces.objects[index]
    used = surfaces.parameters[index]
    if any(name.startswith(f"{own}.emitter.") for name in used):
        return own
    # A material that is defined in a shape is named after that one, even where others use it, too.
    materials = {name.split(".")[0] for name in used}.difference(surfaces.objects)
    return materials.pop() if len(materials) == 1 else own


def _weights(metric: TargetedMetric, image: torch.Tensor) -> torch.Tensor:
    """Return how much of the metric each pixel causes, ``(H, W)``, of at least 0 and in any unit.

    A glare source contributes ``L² ω / P²`` to the sum of the rating, its pixels in proportion to their light.
    """
    if not isinstance(metric.metric, GlareRating):
        _, adjoint = metric.value_and_adjoint(image)
        return (adjoint.double() * image.double()).sum(-1).abs()
    weights = torch.zeros(image.shape[:2], dtype=torch.float64)
    light = (relative_luminance(metric.transform(image)) * metric.metric.camera.solid_angles).double().cpu()
    for source in metric.metric.sources(metric.transform(image)):
        rows, columns = source.pixels.cpu().unbind(-1)
        part = source.luminance**2 * source.solid_angle / source.position_index**2
        weights[rows, columns] += part * light[rows, columns] / light[rows, columns].sum()
    return weights


def _source_luminance(metric: TargetedMetric, image: torch.Tensor) -> torch.Tensor | None:
    """Return the luminance of each pixel in cd/m², ``(H, W)``; None for metrics without glare sources."""
    if not isinstance(metric.metric, GlareRating):
        return None
    # Not of the denoised picture: beside a small lamp it may be brighter than the lamp.
    return metric.metric.efficacy * relative_luminance(image).double()


def _place(weights: Floats, pixels: NDArray[np.int64], shape: tuple[int, int]) -> str:
    """Return the ninth of the picture that holds the centre of some pixels, or those of their separate parts.

    Parts are separate if a cell of the picture without weight is between them, such as a wall between windows.
    """
    own = weights > 0
    weights, (rows, columns) = weights[own], np.divmod(pixels[own], shape[1])
    side = max(1.0, max(shape) / CELLS)
    parts = _connected((rows // side).astype(np.int64), (columns // side).astype(np.int64))
    places: dict[str, float] = {}
    for part in range(parts.max() + 1):
        of_part = parts == part
        place = _ninth(rows[of_part], columns[of_part], weights[of_part], shape)
        places[place] = places.get(place, 0.0) + weights[of_part].sum()
    large = [one for one in places if places[one] >= MIN_PART * weights.sum()]
    found = sorted(large, key=lambda one: -places[one])
    if not 1 <= len(found) <= MAX_PLACES:
        return "several places"
    *others, last = found
    return " and ".join(filter(None, [", ".join(others), last]))


def _ninth(
    rows: NDArray[np.int64], columns: NDArray[np.int64], weights: Floats, shape: tuple[int, int]
) -> str:
    """Return the ninth of the picture that holds the centre of the weights of some pixels."""
    row = (np.average(rows, weights=weights) + 0.5) / shape[0]
    column = (np.average(columns, weights=weights) + 0.5) / shape[1]
    vertical = ("top", "", "bottom")[min(int(3 * row), 2)]
    horizontal = ("left", "", "right")[min(int(3 * column), 2)]
    return " ".join(filter(None, (vertical, horizontal))) or "centre"


def _connected(rows: NDArray[np.int64], columns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the number of the part that each of some cells belongs to, from 0; neighbours are of one part."""
    stride = int(columns.max()) + 3  # the columns beside the first and the last are empty
    cells, index = np.unique(rows * stride + columns, return_inverse=True)
    around = [i * stride + j for i in (-1, 0, 1) for j in (-1, 0, 1)]
    parts: dict[int, int] = {}
    unseen, count = set(cells.tolist()), 0
    while unseen:
        edge = [unseen.pop()]
        while edge:
            cell = edge.pop()
            parts[cell] = count
            new = {cell + step for step in around} & unseen
            unseen -= new
            edge += new
        count += 1
    return np.array([parts[cell] for cell in cells.tolist()], np.int64)[index]
