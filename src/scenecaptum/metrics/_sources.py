"""Glare sources in a picture: detected, relaxed, grouped and summed, as evalglare does it."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from ..camera import Camera
from ._grouping import group_as_evalglare
from ._illuminance import projected_solid_angles
from ._position_index import position_index

DARKEST = 1e-6  # cd/m²: no eye sees less, and a background counts as at least this much


@dataclass(frozen=True)
class GlareSource:
    """One detected source.

    Attributes
    ----------
    row, column
        Centre of its light in pixels; the middle of the top left pixel is (0, 0).
    luminance
        Its mean luminance in cd/m².
    solid_angle
        In steradians.
    position_index
        Guth's index at the pixel that evalglare takes for the centre.
    direction
        Unit vector to that pixel: x right, y up, z forward.
    pixels
        ``(N, 2)`` rows and columns of the pixels that belong to it.
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
    """The sources of one picture as tensors of N sources, with derivatives where they exist."""

    luminance: torch.Tensor
    solid_angle: torch.Tensor
    index: torch.Tensor
    background: torch.Tensor
    presence: torch.Tensor
    pixels: torch.Tensor
    labels: torch.Tensor
    centre: torch.Tensor


class View(torch.nn.Module):
    """What a camera says about each pixel in front of the eye, flattened to ``(H W,)``."""

    directions: torch.Tensor
    solid_angle: torch.Tensor
    projected: torch.Tensor
    index: torch.Tensor

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self.camera = camera
        in_front = camera.directions[..., 2] >= 0
        values = {
            "directions": camera.directions.reshape(-1, 3),
            "solid_angle": (camera.solid_angles * in_front).flatten(),
            "projected": projected_solid_angles(camera).flatten(),
            "index": position_index(camera.directions).flatten(),
        }
        for name, value in values.items():
            self.register_buffer(name, value.double(), persistent=False)


def find_sources(
    luminance: torch.Tensor,
    view: View,
    *,
    threshold: torch.Tensor,
    relaxation: float,
    grouping: str,
    background: str,
) -> Sources | None:
    """Detect and sum the sources of a picture, ``(H, W)`` in cd/m²; None where there is none.

    A pixel counts with the weight w that `membership` gives it. Of the pixels of one source, ``ω_s = Σ w ω`` is
    the solid angle and ``L_s = Σ w ω L / ω_s`` the luminance; both carry derivatives, through w as well. Which
    pixels form a source, and where its centre is, carries none.
    """
    values = luminance.flatten()
    solid_angle, projected = view.solid_angle.to(values), view.projected.to(values)
    weight = membership(values, threshold, relaxation) * (solid_angle > 0)
    pixels = ((weight > 0) & (values > 0)).nonzero().squeeze(-1)
    if len(pixels) == 0:
        return None
    labels = _labels(values.detach()[pixels], view.directions[pixels], grouping)
    part = (weight * solid_angle)[pixels]
    size = torch.zeros(int(labels.max()) + 1, dtype=values.dtype, device=values.device)
    total = size.index_add(0, labels, part)
    light = size.index_add(0, labels, part * values[pixels])
    centre = _centres(pixels, labels, (part * values[pixels]).detach(), view.camera.width)
    return Sources(
        luminance=light / total,
        solid_angle=total,
        index=view.index.to(values)[_centre_pixels(centre, view.camera)],
        background=_background(values, 1 - weight, solid_angle, projected, background),
        presence=weight.max(),
        pixels=pixels,
        labels=labels,
        centre=centre,
    )


def membership(luminance: torch.Tensor, threshold: torch.Tensor, relaxation: float) -> torch.Tensor:
    """Return how far each pixel belongs to a source: 0 below the threshold, 1 above it, and a sigmoid in between.

    With ``relaxation`` r the sigmoid is the cubic smoothstep from ``(1 − 3 r) threshold`` to ``(1 + 3 r)
    threshold``: it has the slope of a logistic function of scale ``r threshold`` where they cross the threshold,
    but ends. Outside the band the weight is exactly 0 or 1, as with r = 0, so a wide dim background cannot add up
    to a source.
    """
    if not threshold > 0:  # a black picture measured against its own mean has no source
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
    values: torch.Tensor, rest: torch.Tensor, solid_angle: torch.Tensor, projected: torch.Tensor, mode: str
) -> torch.Tensor:
    if mode == "hemisphere":
        mean = (rest * projected * values).sum() / torch.pi
    else:
        # No pixel is left where the whole picture is a source; 0 / tiny is then the darkest background.
        area = (rest * solid_angle).sum().clamp(min=torch.finfo(values.dtype).tiny)
        mean = (rest * solid_angle * values).sum() / area
    return mean.clamp(min=DARKEST)


def _centres(pixels: torch.Tensor, labels: torch.Tensor, light: torch.Tensor, width: int) -> torch.Tensor:
    """Return the centres of the sources in rows and columns, each pixel weighted by ``L ω`` (evalglare 3.06)."""
    places = torch.stack([pixels // width, pixels % width, torch.ones_like(pixels)], -1).to(light)
    sums = torch.zeros(int(labels.max()) + 1, 3, dtype=light.dtype, device=light.device)
    sums = sums.index_add(0, labels, light[:, None] * places)
    return sums[:, :2] / sums[:, 2:]


def _centre_pixels(centre: torch.Tensor, camera: Camera) -> torch.Tensor:
    """Return the flat index of the pixel of a centre: evalglare drops the fraction, counting rows upward."""
    rounding = 1e-6  # a centre that is a whole pixel up to rounding is that pixel
    row = torch.ceil(centre[:, 0] - rounding).clamp(0, camera.height - 1)
    column = torch.floor(centre[:, 1] + rounding).clamp(0, camera.width - 1)
    return (row * camera.width + column).long()


def describe(sources: Sources, view: View) -> list[GlareSource]:
    """Return the sources as plain numbers, the brightest first."""
    width = view.camera.width
    centre_pixels = _centre_pixels(sources.centre, view.camera)
    order = torch.argsort(sources.luminance.detach(), descending=True).tolist()
    described = []
    for number in order:
        members = sources.pixels[sources.labels == number]
        x, y, z = view.directions[centre_pixels[number]].tolist()
        described.append(
            GlareSource(
                row=sources.centre[number, 0].item(),
                column=sources.centre[number, 1].item(),
                luminance=sources.luminance[number].item(),
                solid_angle=sources.solid_angle[number].item(),
                position_index=sources.index[number].item(),
                direction=(x, y, z),
                pixels=torch.stack([members // width, members % width], -1),
            )
        )
    return described
