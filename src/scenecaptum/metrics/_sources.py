"""Detection of glare sources as in evalglare: thresholding (optionally relaxed), grouping and summation."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from ..camera import Camera
from ._grouping import group_as_evalglare
from ._illuminance import projected_solid_angles
from ._position_index import position_index

MIN_BACKGROUND = 1e-6  # cd/m², about the threshold of vision


@dataclass(frozen=True)
class GlareSource:
    """A detected glare source.

    Attributes
    ----------
    row, column
        Centroid, weighted by luminance and solid angle, in pixels; the centre of the top left pixel is (0, 0).
    luminance
        Mean luminance in cd/m².
    solid_angle
        In steradians.
    position_index
        Guth position index at the pixel that evalglare uses as the centre.
    direction
        Unit vector to that pixel: x right, y up, z forward.
    pixels
        ``(N, 2)`` rows and columns of its pixels.
    """

    row: float
    column: float
    luminance: float
    solid_angle: float
    position_index: float
    direction: tuple[float, float, float]
    pixels: torch.Tensor = field(repr=False, compare=False)


@dataclass(frozen=True)
class Sources:
    """The N sources of an image as tensors, differentiable where a derivative exists."""

    luminance: torch.Tensor
    solid_angle: torch.Tensor
    position_index: torch.Tensor
    background: torch.Tensor
    max_weight: torch.Tensor  # the largest weight of any pixel
    pixels: torch.Tensor  # flat indices of all source pixels
    labels: torch.Tensor  # their source numbers
    centre: torch.Tensor


class PixelGeometry(torch.nn.Module):
    """Direction, solid angle and position index of each pixel of a camera, flattened to ``(H W,)``."""

    directions: torch.Tensor
    solid_angle: torch.Tensor
    projected: torch.Tensor
    position_index: torch.Tensor

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self.camera = camera
        in_front = camera.directions[..., 2] >= 0
        values = {
            "directions": camera.directions.reshape(-1, 3),
            "solid_angle": (camera.solid_angles * in_front).flatten(),
            "projected": projected_solid_angles(camera).flatten(),
            "position_index": position_index(camera.directions).flatten(),
        }
        for name, value in values.items():
            self.register_buffer(name, value.double(), persistent=False)


def find_sources(
    luminance: torch.Tensor,
    geometry: PixelGeometry,
    *,
    compared: torch.Tensor,
    threshold: torch.Tensor,
    relaxation: float,
    grouping: str,
    background: str,
) -> Sources | None:
    """Detect and sum the sources of an image, ``(H, W)`` in cd/m²; None if there are none.

    ``compared`` is the image that is compared with the threshold: the same, or one of a little more or less light.
    Each pixel has the weight w of `source_weight`. For the pixels of one source, ``ω_s = Σ w ω`` is the solid
    angle and ``L_s = Σ w ω L / ω_s`` the luminance; both are differentiable, also through w. The grouping of
    pixels into sources and their centres are not.
    """
    values = luminance.flatten()
    solid_angle, projected = geometry.solid_angle.to(values), geometry.projected.to(values)
    weight = source_weight(compared.flatten(), threshold, relaxation) * (solid_angle > 0)
    pixels = ((weight > 0) & (values > 0)).nonzero().squeeze(-1)
    if len(pixels) == 0:
        return None
    labels = _labels(values.detach()[pixels], geometry.directions.to(values.device)[pixels], grouping)
    weighted_angle = (weight * solid_angle)[pixels]
    weighted_luminance = weighted_angle * values[pixels]
    zeros = torch.zeros(int(labels.max()) + 1, dtype=values.dtype, device=values.device)
    angle_sum = zeros.index_add(0, labels, weighted_angle)
    luminance_sum = zeros.index_add(0, labels, weighted_luminance)
    centre = _centroids(pixels, labels, weighted_luminance.detach(), geometry.camera.width)
    return Sources(
        luminance=luminance_sum / angle_sum,
        solid_angle=angle_sum,
        position_index=geometry.position_index.to(values)[_centre_pixels(centre, geometry.camera)],
        background=_background(values, 1 - weight, solid_angle, projected, background),
        max_weight=weight.max(),
        pixels=pixels,
        labels=labels,
        centre=centre,
    )


def source_weight(luminance: torch.Tensor, threshold: torch.Tensor, relaxation: float) -> torch.Tensor:
    """Return the weight of each pixel in a source: 0 below the threshold, 1 above it, a sigmoid in between.

    With ``relaxation`` r the sigmoid is the cubic smoothstep from ``(1 − 3 r) threshold`` to ``(1 + 3 r)
    threshold``. At the threshold it has the slope of a logistic function of scale ``r threshold``. Outside the
    band the weight is exactly 0 or 1, so a large dim background cannot add up to a source.
    """
    if not threshold > 0:  # a black image with a relative threshold has no sources
        return torch.zeros_like(luminance)
    if relaxation == 0:
        return (luminance > threshold).to(luminance)
    t = ((luminance / threshold - 1) / (6 * relaxation) + 0.5).clamp(0, 1)
    return t * t * (3 - 2 * t)


def _labels(luminance: torch.Tensor, directions: torch.Tensor, grouping: str) -> torch.Tensor:
    if grouping == "pixel":
        return torch.arange(len(luminance), device=luminance.device)
    labels = group_as_evalglare(directions.double().cpu().numpy(), luminance.cpu().numpy())
    return torch.from_numpy(labels).to(luminance.device)


def _background(
    values: torch.Tensor, weight: torch.Tensor, solid_angle: torch.Tensor, projected: torch.Tensor, mode: str
) -> torch.Tensor:
    if mode == "hemisphere":
        mean = (weight * projected * values).sum() / torch.pi
    else:
        # If the whole image is a source, the sum of weights is 0 and the mean becomes 0 / tiny = 0.
        area = (weight * solid_angle).sum().clamp(min=torch.finfo(values.dtype).tiny)
        mean = (weight * solid_angle * values).sum() / area
    return mean.clamp(min=MIN_BACKGROUND)


def _centroids(pixels: torch.Tensor, labels: torch.Tensor, weights: torch.Tensor, width: int) -> torch.Tensor:
    """Return the centroids of the sources in rows and columns, with weights ``L ω`` as in evalglare 3.06."""
    coordinates = torch.stack([pixels // width, pixels % width, torch.ones_like(pixels)], -1).to(weights)
    sums = torch.zeros(int(labels.max()) + 1, 3, dtype=weights.dtype, device=weights.device)
    sums = sums.index_add(0, labels, weights[:, None] * coordinates)
    return sums[:, :2] / sums[:, 2:]


def _centre_pixels(centre: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Return the flat pixel index of each centre; evalglare truncates, and counts rows from the bottom."""
    tolerance = 1e-6  # for rounding errors of integer coordinates
    row = torch.ceil(centre[:, 0] - tolerance).clamp(0, camera.height - 1)
    column = torch.floor(centre[:, 1] + tolerance).clamp(0, camera.width - 1)
    return (row * camera.width + column).long()


def to_glare_sources(sources: Sources, geometry: PixelGeometry) -> list[GlareSource]:
    """Convert the sources to Python numbers, the brightest first."""
    width = geometry.camera.width
    centre_pixels = _centre_pixels(sources.centre, geometry.camera)
    order = torch.argsort(sources.luminance.detach(), descending=True).tolist()
    result = []
    for number in order:
        members = sources.pixels[sources.labels == number]
        x, y, z = geometry.directions[centre_pixels[number]].tolist()
        result.append(
            GlareSource(
                row=sources.centre[number, 0].item(),
                column=sources.centre[number, 1].item(),
                luminance=sources.luminance[number].item(),
                solid_angle=sources.solid_angle[number].item(),
                position_index=sources.position_index[number].item(),
                direction=(x, y, z),
                pixels=torch.stack([members // width, members % width], -1),
            )
        )
    return result
