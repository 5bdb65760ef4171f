"""Which parameters act together: the Hessian of a metric between the most salient parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..attr._metric import Metric, Target
from ..attr._passes import DEFAULT_PASSES, channel_totals
from ..attr._ranges import ranges
from ..attr._student import student_t
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ._hessian import product_of, reaches
from ._scenes import Scenes, unit_gradient, view_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LEVEL = 0.95  # of a confidence interval that tells an interaction from 0
SYMMETRIC = 0.99  # of the simultaneous intervals of all pairs

Scale = Literal["unit", "range"]


@dataclass(frozen=True, repr=False)
class Interactions:
    """Second derivatives between parameters, each along its own gradient; prints as a table.

    Attributes
    ----------
    names, labels
        The parameters by falling saliency.
    replicates
        ``(passes, P, P)`` float64. In row ``p`` and column ``q``: how the slope along ``q`` changes where ``p``
        moves.
    rest
        ``(P, P)``: the error that the passes have in common, of the bias that was taken out and of rounding.
    reaches
        How far each parameter was moved, in its own unit.
    metric, scale
        What was differentiated, and ``"unit"`` or ``"range"``.
    left_out
        Labels of salient parameters that cannot move either way: textures with texels at both bounds.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    replicates: torch.Tensor
    rest: torch.Tensor
    reaches: tuple[float, ...]
    metric: str
    scale: Scale
    left_out: tuple[str, ...] = ()

    @property
    def measured(self) -> torch.Tensor:
        """``(P, P)``: rows move, columns are differentiated; symmetric but for errors."""
        return self.replicates.mean(0)

    @property
    def matrix(self) -> torch.Tensor:
        """``(P, P)``, symmetric: the mean of both orders."""
        return (self.measured + self.measured.T) / 2

    @property
    def standard_error(self) -> torch.Tensor:
        """Standard error of ``matrix``, ``(P, P)``."""
        both = (self.replicates + self.replicates.mT) / 2
        return torch.hypot(_error(both), (self.rest + self.rest.T) / 2)

    @property
    def asymmetry(self) -> torch.Tensor:
        """``(P, P)``: one order minus the other, in standard errors of that."""
        difference = self.replicates - self.replicates.mT
        error = torch.hypot(_error(difference), torch.hypot(self.rest, self.rest.T))
        return torch.nan_to_num(difference.mean(0) / error)

    @property
    def is_symmetric(self) -> bool:
        """Whether no pair is told from symmetric, by simultaneous 99 % intervals."""
        pairs = max(1, math.comb(len(self.names), 2))
        limit = student_t(1 - (1 - SYMMETRIC) / pairs, len(self.replicates) - 1)
        return bool(self.asymmetry.abs().max() <= limit)

    @property
    def told_apart(self) -> torch.Tensor:
        """``(P, P)`` bool: which elements of ``matrix`` are told from 0, by 95 % intervals."""
        limit = student_t(LEVEL, len(self.replicates) - 1)
        return self.matrix.abs() > limit * self.standard_error

    @property
    def verdict(self) -> str:
        """One sentence."""
        count = len(self.names)
        upper = torch.triu_indices(count, count)
        clear = int(self.told_apart[upper[0], upper[1]].sum())
        worst = self.asymmetry.abs().max().item()
        symmetric = "symmetric within its errors" if self.is_symmetric else "not symmetric within its errors"
        left_out = f"; left out, being at both bounds: {', '.join(self.left_out)}" if self.left_out else ""
        return (
            f"{clear} of {upper.shape[1]} second derivatives of {self.metric} are told from 0; the matrix is "
            f"{symmetric} (largest difference {worst:.1f} standard errors){left_out}"
        )

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the matrix as a heatmap with its values."""
        from ..visualization import plot_interactions

        return plot_interactions(self, ax=ax)

    def __str__(self) -> str:
        from ..visualization import interactions_text

        return interactions_text(self)

    __repr__ = __str__


def interactions(  # noqa: PLR0913 -- those of every long job, and its own
    renderer: Any,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    top: int = 6,
    scale: Scale = "unit",
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_PASSES,
    checkpoint: Folder = None,
) -> Interactions:
    """Return the second derivatives between the most salient parameters, from differences of gradients.

    Each parameter moves along its own unit gradient ``u``, the direction in which its saliency is the slope, a
    texture with all its texels alike: element ``(p, q)`` is ``u_p · H u_q``, the change of the slope along ``q``
    per unit of a step along ``p``. The sum of a colour's channels would let those of opposite effect cancel, and a
    row for each channel would be three times as long. Row and column are measured independently, ``p`` moved and
    ``q`` differentiated and the reverse, so that the symmetry of the matrix judges steps and derivatives.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", ["reflectance", "emitters"], resolution=(16, 16), spp=16)
    >>> found = interactions(renderer, metrics.MeanLuminance(), top=2)
    >>> found.matrix.shape, found.is_symmetric
    (torch.Size([2, 2]), True)

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``; the renderer must tell its ``bounds``.
    attribution
        The plain gradients whose ranking and directions are used; by default they are computed.
    top
        How many parameters. Each costs the gradients of four scenes.
    scale
        ``"unit"``: per unit of both parameters. ``"range"``: times the physical ranges of both, so that an albedo
        and a radiance compare; where that is infinite its largest value stands in.
    seed
        Seed from which all others are drawn; all scenes share theirs.
    spp
        Samples per pixel of each scene, in all its passes; the renderer's by default.
    replicates
        Least number of independent passes; their spread gives the standard errors.
    checkpoint
        A folder that keeps every finished pass: a job that was killed goes on from there when it is started again
        with the same arguments.

    Returns
    -------
    Interactions
        The matrix ``(P, P)`` in the metric's unit per unit of both parameters, or in the metric's unit for
        ``scale="range"``, with errors and a test of its symmetry.

    Raises
    ------
    SceneCaptumError
        Where the attribution is not one of plain gradients, or no parameter has one that is not 0.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    if scale not in ("unit", "range"):
        raise SceneCaptumError(f'scale must be "unit" or "range", not {scale!r}.')
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(target=target, **options)
    if attribution.info.get("scale") != "unit":
        raise SceneCaptumError("interactions takes plain gradients: VanillaSceneGradient(...).attribute().")
    scenes = Scenes.split(renderer, metric, target, **options, denoise=view_of(attribution))
    rows = [row for row in attribution.ranking(whole_number("top", top)) if row.saliency > 0]
    ways = {row.name: unit_gradient(attribution[row.name], scenes.values[row.name]) for row in rows}
    directions = {name: one for name, one in ways.items() if max(reaches(scenes, {name: one})) > 0}
    if not directions:
        raise SceneCaptumError("All gradients are 0 or lead out of bounds: there is no direction to move in.")
    products = [product_of(scenes, {name: one}, directions, **options) for name, one in directions.items()]
    lengths = ranges(renderer, {name: scenes.values[name] for name in directions})
    factors = torch.tensor([lengths[name].item() if scale == "range" else 1.0 for name in directions])
    both = torch.outer(factors, factors).double()
    return Interactions(
        names=tuple(directions),
        labels=tuple(row.label for row in rows if row.name in directions),
        replicates=both * torch.stack([_projected(one.replicates, directions) for one in products], 1),
        rest=both * torch.stack([_rest(one, attribution, directions) for one in products]),
        reaches=tuple(one.info["reach"] for one in products),
        metric=str(attribution.info["metric"]),
        scale=scale,
        left_out=tuple(row.label for row in rows if row.name not in directions),
    )


def _projected(totals: Mapping[str, torch.Tensor], directions: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the slopes along every direction, ``(passes, P)``, from channel totals ``(passes, C)``."""
    slopes = [totals[name].double() @ one.reshape(-1).double() for name, one in directions.items()]
    return torch.stack(slopes, -1)


def _rest(
    product: SceneAttribution, gradient: SceneAttribution, directions: Mapping[str, torch.Tensor]
) -> torch.Tensor:
    """Return the errors that all passes share: of the bias, and of single precision over so short a way."""
    rounding = torch.finfo(torch.float32).eps / product.info["reach"]
    sizes = torch.tensor([rounding * channel_totals(gradient[name]).norm() for name in directions])
    if product.bias is None:
        return sizes.double()
    bias = _projected({name: channel_totals(product.bias[name])[None] for name in directions}, directions)[0]
    return torch.hypot(bias, sizes.double())


def _error(replicates: torch.Tensor) -> torch.Tensor:
    return replicates.std(0) / math.sqrt(len(replicates))
