"""The bridge to Captum: a renderer and a metric as a function of batched tensors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Literal, TypeAlias

import torch

from ..denoising import guides_of, straight_through
from ..errors import SceneCaptumError, check_seed
from ..protocols import Capabilities, Renderer
from ..scene import reflect

Values: TypeAlias = dict[str, torch.Tensor]


def as_captum(
    renderer: Renderer,
    metric: Callable[[torch.Tensor], torch.Tensor],
    *,
    seed: int | None = 0,
    bounds: Literal["raise", "reflect"] = "raise",
    denoise: bool = False,
) -> tuple[Callable[..., torch.Tensor], tuple[torch.Tensor, ...]]:
    """Return ``(forward, inputs)`` for Captum's classes, as ``SceneRenderer.as_captum``.

    ``renderer`` needs an ``inputs`` attribute, and ``bounds`` for reflection. Open bounds are taken from its
    ``parameters_table()``, if it has one.
    """
    if seed is not None:
        check_seed("seed", seed)
    own = {name: value.detach().clone() for name, value in (Capabilities(renderer).inputs or {}).items()}
    if not own:
        raise SceneCaptumError(
            "The renderer has no inputs to pass to Captum: it needs an attribute inputs, a dict from parameter "
            "name to tensor."
        )
    bound = _bounding(renderer, own, bounds)
    spp = Capabilities(renderer).spp

    def forward(*tensors: torch.Tensor) -> torch.Tensor:
        """Evaluate the metric on the render of each row: ``(B,)``, or ``(B, K)`` for a metric with K elements."""
        outputs = []
        for row in _rows(tuple(own), tensors):
            row_seed = int(torch.randint(2**32, ())) if seed is None else seed
            values = bound(row)
            image = renderer(values, seed=row_seed, spp=spp)
            image = straight_through(image, guides_of(renderer, values)) if denoise else image
            outputs.append(_evaluate(metric, image))
        return torch.stack(outputs)

    return forward, tuple(value[None].clone() for value in own.values())


def _bounding(renderer: Renderer, own: Values, bounds: str) -> Callable[[Values], Values]:
    """Return the function that brings the values of a row within bounds before they are rendered."""
    if bounds == "raise":
        return lambda row: row
    if bounds != "reflect":
        raise SceneCaptumError(f'bounds must be "raise" or "reflect", not {bounds!r}.')
    offered = Capabilities(renderer)
    if offered.bounds is None:
        raise SceneCaptumError(
            'bounds="reflect" needs a renderer that has bounds, a dict from parameter name to (low, high).'
        )
    limits = dict(offered.bounds)
    table = offered.parameters_table() if offered.parameters_table else None
    is_open = {name: table is not None and table[name].bounds.open_low for name in own}

    def bound(row: Values) -> Values:
        bounded = {}
        for name, value in row.items():
            # The scene's own values can be rendered even beyond the bounds, and stay as they are.
            unchanged = torch.equal(value.detach(), own[name].to(value))
            low, high = limits.get(name, (-math.inf, math.inf))
            bounded[name] = value if unchanged else reflect(value, low, high, open_low=is_open[name])
        return bounded

    return bound


def _rows(names: tuple[str, ...], tensors: tuple[torch.Tensor, ...]) -> Iterator[Values]:
    """Check a batch, and iterate over its rows as values by name."""
    if len(tensors) != len(names):
        raise SceneCaptumError(
            f"forward takes one tensor for each of the renderer's {len(names)} inputs, in their order, not "
            f"{len(tensors)}. Pass the whole tuple to Captum, and no additional_forward_args."
        )
    for name, tensor in zip(names, tensors, strict=True):
        if not isinstance(tensor, torch.Tensor) or tensor.ndim == 0:
            came = "a 0-d tensor" if isinstance(tensor, torch.Tensor) else type(tensor).__name__
            raise SceneCaptumError(
                f"{name!r} must be a tensor whose first dimension counts the rows of the batch, not {came}."
            )
    sizes = {name: tensor.shape[0] for name, tensor in zip(names, tensors, strict=True)}
    size = sizes[names[0]]
    other = next((name for name in names if sizes[name] != size), None)
    if other is not None:
        raise SceneCaptumError(
            f"All inputs must have the same number of rows; {names[0]!r} has {size} and {other!r} {sizes[other]}."
        )
    if size == 0:
        raise SceneCaptumError("The batch has no rows: there is nothing to render.")
    return (dict(zip(names, row, strict=True)) for row in zip(*tensors, strict=True))


def _evaluate(metric: Callable[[torch.Tensor], torch.Tensor], image: torch.Tensor) -> torch.Tensor:
    output = metric(image)
    called = getattr(metric, "__name__", type(metric).__name__)
    if not isinstance(output, torch.Tensor):
        raise SceneCaptumError(
            f"The metric {called} must return a torch tensor, not {type(output).__name__}. Write it in torch "
            "operations, without .item(), float() or numpy; for a method of Captum without gradients, such as "
            "FeatureAblation, torch.tensor(number) will do."
        )
    if output.ndim > 1 or output.numel() == 0:
        raise SceneCaptumError(
            f"The metric {called} must return a scalar or a vector for one image of shape {tuple(image.shape)}; "
            f"it returned shape {tuple(output.shape)}. It sees one image at a time, not a batch."
        )
    return output
