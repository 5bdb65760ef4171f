"""From pixels to parameters: a pixel attribution, summed over the pixels that show each object."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ..errors import SceneCaptumError
from ..protocols import Capabilities, Renderer
from ._surfaces import SurfaceMap


def project_pixels(
    renderer: Renderer, pixels: torch.Tensor, *, surfaces: SurfaceMap | None = None
) -> ProjectedPixels:
    """Sum an attribution to pixels over each object, and give every parameter the sum of its objects.

    Makes attributions to pixels, such as Captum's, comparable with attributions to the scene: pass the result to
    ``validation.deletion_insertion(orders=)``.

    Example
    -------
    >>> import torch
    >>> from scenecaptum import SceneRenderer
    >>> renderer = SceneRenderer("cornell-box", ["reflectance", "emitters"], resolution=(16, 16), spp=16)
    >>> projected = project_pixels(renderer, torch.ones(16, 16, 3))  # then the sum is the area, here in 3 channels
    >>> projected["floor.reflectance.value"] == projected.objects["floor_shape"]
    True

    An object gets the sum over the pixels, each weighted by the fraction that the object covers. A parameter gets
    the sum over all objects that use it, and so do the other parameters of these objects: pixels cannot tell the
    colour of a lamp from its radiance. Pixels know nothing of what is not visible: its parameters get 0.

    Parameters
    ----------
    renderer
        A ``SceneRenderer``, with the view in which the pixels were attributed.
    pixels
        Attribution to the picture, ``(H, W)`` or ``(H, W, 3)``, or with a first dimension of 1, Captum's batch.
    surfaces
        The surface map to use instead of the directly visible objects: ``renderer.see_through()``.

    Returns
    -------
    ProjectedPixels
        A mapping from each input of the renderer to its importance.

    Raises
    ------
    SceneCaptumError
        If it is not known what the pixels show, or the attribution is not one of this picture.
    """
    found = Capabilities(renderer).surfaces if surfaces is None else surfaces
    inputs = Capabilities(renderer).inputs
    if found is None or inputs is None:
        raise SceneCaptumError("Only a SceneRenderer knows which object each pixel shows.")
    weights = found.fraction * _per_pixel(pixels, found.shape)[found.pixel]
    sums = np.bincount(found.object_index, weights=weights, minlength=len(found.objects))
    seen = found.visible_parameters()
    return ProjectedPixels(
        importance=sum_over_objects(found, dict(zip(found.objects, sums.tolist(), strict=True)), inputs),
        objects=dict(zip(found.objects, sums.tolist(), strict=True)),
        invisible=tuple(name for name in inputs if name not in seen),
    )


def sum_over_objects(
    surfaces: SurfaceMap, objects: Mapping[str, float], parameters: Iterable[str]
) -> dict[str, float]:
    """Return for each parameter the sum of the numbers of the objects that use it, 0 for none."""
    sums = dict.fromkeys(parameters, 0.0)
    for name, used in zip(surfaces.objects, surfaces.parameters, strict=True):
        for parameter in set(used) & sums.keys():
            sums[parameter] += objects.get(name, 0.0)
    return sums


def _per_pixel(pixels: torch.Tensor, shape: tuple[int, int]) -> NDArray[np.float64]:
    """Check an attribution to pixels, and sum its channels, ``(H · W,)``."""
    came = tuple(pixels.shape) if isinstance(pixels, torch.Tensor) else type(pixels).__name__
    array = pixels.detach().double().numpy(force=True) if isinstance(pixels, torch.Tensor) else np.empty(0)
    accepted = (shape, (*shape, 3))
    if array.shape[:1] == (1,) and array.shape not in accepted:
        array = array[0]
    if array.shape not in accepted:
        height, width = shape
        raise SceneCaptumError(
            f"pixels must be a tensor of shape ({height}, {width}) or ({height}, {width}, 3), one value for each "
            f"pixel, not {came}. Attribute to the linear image (H, W, 3) that the metric gets."
        )
    if not np.isfinite(array).all():
        raise SceneCaptumError("The attribution to pixels is not finite.")
    summed: NDArray[np.float64] = array.reshape(shape[0] * shape[1], -1).sum(1)
    return summed


@dataclass(frozen=True, repr=False)
class ProjectedPixels(Mapping[str, float]):
    """A mapping from parameters to their importance in an attribution to pixels; prints as a list.

    Attributes
    ----------
    importance
        Sum of the pixel attribution over the objects that use each parameter, signed as the attribution is.
    objects
        The same for each object; the last is the background.
    invisible
        The parameters of no visible object, whose importance is 0.
    """

    importance: Mapping[str, float]
    objects: Mapping[str, float]
    invisible: tuple[str, ...]

    def __getitem__(self, name: str) -> float:
        return self.importance[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.importance)

    def __len__(self) -> int:
        return len(self.importance)

    def __str__(self) -> str:
        ranked = sorted(self.importance.items(), key=lambda item: -abs(item[1]))
        width = max(map(len, self.importance), default=0)
        lines = [f"{name:{width}}  {value:+.3g}" for name, value in ranked if name not in self.invisible]
        if self.invisible:
            count = f"{len(self.invisible)} of {len(self)} parameters belong to no visible object"
            lines.append(f"{count}: their importance is 0.")
        return "\n".join(lines)

    __repr__ = __str__
