"""Interactions of parameters: the Hessian of a metric between the most salient parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import torch
from tqdm import tqdm

from ..attr import SceneAttribution, VanillaSceneGradient, range_lengths
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Target, channel_totals, student_t
from ..protocols import Renderer
from ..visualization import (
    SMALL,
    TEXT,
    TITLE,
    Format,
    add_footnotes,
    axes_or_new,
    figure_of,
    first_few,
    grid,
    jump_notes,
    metric_name,
    metric_unit,
    minus,
    name_rows,
    shorten,
    unit_of_change,
    wrap,
    wrapped_lines,
)
from ._hessian import max_steps, product_of
from ._scenes import is_plain_gradient, scenes_of, unit_gradient

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIGNIFICANCE_LEVEL = 0.95  # of the confidence interval of each interaction
SYMMETRY_LEVEL = 0.99  # of the simultaneous confidence intervals of all pairs
HessianScale = Literal["unit", "range"]
_NAME_WIDTH, _NOTE_WIDTH = 28, 90
_CELL = 0.72  # inches
_WHITE_TEXT_ABOVE = 0.6  # of the largest value
_KEY = "0.0123(4) is 0.0123 ± 0.0004; ? marks values that are not significantly different from 0"


def interactions(  # noqa: PLR0913 -- the options of every check, and its own
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    top: int = 6,
    scale: HessianScale = "unit",
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
    show_progress: bool = False,
) -> Interactions:
    """Return the second derivatives between the most salient parameters, from finite differences of gradients.

    Each parameter moves along its unit gradient ``u``, along which the slope is its saliency; all texels of a
    texture move together. Element ``(p, q)`` is ``u_p · H u_q``, the derivative of the slope along ``q`` with
    respect to a step along ``p``. (In a sum over the channels of a colour opposite effects would cancel, and one
    row per channel would make the matrix three times as large.) Both orders are measured independently, ``p``
    moved and ``q`` differentiated and vice versa, so the symmetry of the matrix checks the steps and the
    derivatives.

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
        As for ``VanillaSceneGradient``; the renderer must have ``bounds``.
    attribution
        The plain gradients that give the ranking and the directions, at the values for which they were made;
        computed by default.
    top
        Number of parameters. Each costs the gradients of four scenes, with the samples of ``VanillaSceneGradient``
        for each, and before these two to four renders of each replicate for every length of the step that is
        tried, at most eight. The metric is evaluated as often as there are replicates, plus one, for each of these
        scenes: of a smoothed network, with all of its draws, this takes most of the time.
    scale
        ``"unit"``: per unit step of both parameters. ``"range"``: times the physical ranges of both, which makes
        an albedo and a radiance comparable; an infinite range is replaced by the parameter's largest value.
    seed, spp, replicates, checkpoint, show_progress
        As for ``ablation_test``.

    Returns
    -------
    Interactions
        The matrix ``(P, P)`` in the metric's unit per unit step of both parameters along their gradients, or in
        the metric's unit for ``scale="range"``, with standard errors and a symmetry test.

    Raises
    ------
    SceneCaptumError
        If the attribution is not one of plain gradients, all gradients are 0, or it was made for another texture
        than that of the renderer.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    if scale not in ("unit", "range"):
        raise SceneCaptumError(f'scale must be "unit" or "range", not {scale!r}.')
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(
            target=target, **options, show_progress=show_progress
        )
    if not is_plain_gradient(attribution):
        raise SceneCaptumError("interactions needs plain gradients: VanillaSceneGradient(...).attribute().")
    scenes = scenes_of(attribution, renderer, metric, target, **options)
    rows = [row for row in attribution.ranking(whole_number("top", top)) if row.saliency > 0]
    uphill = {
        row.name: unit_gradient(attribution.with_derivative(row.name), scenes.values[row.name])
        for row in rows
    }
    directions = {name: u for name, u in uphill.items() if max(max_steps(scenes, {name: u})) > 0}
    if not directions:
        jumps = [note.lstrip("– ") for note in jump_notes(attribution)]
        others = "All gradients are 0 or lead out of bounds: " if attribution.ranking() or not jumps else ""
        none = f"{others}there is no direction to move in" if others else "There is no direction to move in"
        raise SceneCaptumError(f"{first_few([none, *jumps], '; ')}.")
    moves = tqdm(directions.items(), disable=not show_progress, desc="interactions", unit="parameter")
    products = [product_of(scenes, {name: u}, directions, **options) for name, u in moves]
    lengths = range_lengths(renderer, {name: scenes.values[name] for name in directions})
    factors = torch.tensor([lengths[name].item() if scale == "range" else 1.0 for name in directions])
    both = torch.outer(factors, factors).double()
    return Interactions(
        names=tuple(directions),
        labels=tuple(row.label for row in rows if row.name in directions),
        replicates=both * torch.stack([_slopes(product.replicates, directions) for product in products], 1),
        shared_error=both * torch.stack([_shared_error(p, attribution, directions) for p in products]),
        steps=tuple(product.info["step"] for product in products),
        metric=metric_name(attribution),
        scale=scale,
        left_out=tuple(row.label for row in rows if row.name not in directions),
        unit=unit_of_change(metric_unit(attribution)),
    )


def _slopes(totals: Mapping[str, torch.Tensor], directions: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Return the slopes along every direction, ``(replicates, P)``, from channel totals ``(replicates, C)``."""
    slopes = [totals[name].double() @ u.reshape(-1).double() for name, u in directions.items()]
    return torch.stack(slopes, -1)


def _shared_error(
    product: SceneAttribution, gradient: SceneAttribution, directions: Mapping[str, torch.Tensor]
) -> torch.Tensor:
    """Return the error that all replicates share: of the bias correction, and of rounding over a short step."""
    relative = torch.finfo(torch.float32).eps / product.info["step"]
    rounding = torch.tensor([relative * channel_totals(gradient[n]).norm() for n in directions]).double()
    if product.bias is None:
        return rounding
    bias = _slopes({name: channel_totals(product.bias[name])[None] for name in directions}, directions)[0]
    return torch.hypot(bias, rounding)


@dataclass(frozen=True, repr=False)
class Interactions:
    """Second derivatives between parameters, each along its own gradient; prints as a table.

    Attributes
    ----------
    names, labels
        The parameters, in order of decreasing saliency.
    replicates
        ``(replicates, P, P)`` float64. Row ``p``, column ``q``: derivative of the slope along ``q`` with respect
        to a step of ``p``.
    shared_error
        ``(P, P)``: the error that all replicates share, from the bias correction and from rounding.
    steps
        The largest step of each parameter, in its own unit.
    metric, scale
        Name of the metric, and ``"unit"`` or ``"range"``.
    left_out
        Labels of salient parameters that cannot move either way: textures with texels at both bounds.
    unit
        That of a change of the metric; empty if it has none.
    """

    names: tuple[str, ...]
    labels: tuple[str, ...]
    replicates: torch.Tensor
    shared_error: torch.Tensor
    steps: tuple[float, ...]
    metric: str
    scale: HessianScale
    left_out: tuple[str, ...] = ()
    unit: str = ""

    @property
    def measured(self) -> torch.Tensor:
        """``(P, P)``: rows are moved, columns are differentiated; symmetric up to errors."""
        return self.replicates.mean(0)

    @property
    def matrix(self) -> torch.Tensor:
        """``(P, P)``, symmetric: the mean of both orders."""
        return (self.measured + self.measured.T) / 2

    @property
    def standard_error(self) -> torch.Tensor:
        """Standard error of ``matrix``, ``(P, P)``."""
        both = (self.replicates + self.replicates.mT) / 2
        return torch.hypot(_standard_error(both), (self.shared_error + self.shared_error.T) / 2)

    @property
    def asymmetry(self) -> torch.Tensor:
        """``(P, P)``: ``measured`` minus its transpose, in standard errors."""
        difference = self.replicates - self.replicates.mT
        shared = torch.hypot(self.shared_error, self.shared_error.T)
        error = torch.hypot(_standard_error(difference), shared)
        return torch.nan_to_num(difference.mean(0) / error)

    @property
    def is_symmetric(self) -> bool:
        """Whether no pair is significantly asymmetric, by simultaneous 99 % confidence intervals."""
        pairs = max(1, math.comb(len(self.names), 2))
        limit = student_t(1 - (1 - SYMMETRY_LEVEL) / pairs, len(self.replicates) - 1)
        return bool(self.asymmetry.abs().max() <= limit)

    @property
    def significant(self) -> torch.Tensor:
        """``(P, P)`` bool: whether the 95 % confidence interval of an element of ``matrix`` excludes 0."""
        limit = student_t(SIGNIFICANCE_LEVEL, len(self.replicates) - 1)
        return self.matrix.abs() > limit * self.standard_error

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        count = len(self.names)
        upper = torch.triu_indices(count, count)
        significant = int(self.significant[upper[0], upper[1]].sum())
        worst = self.asymmetry.abs().max().item()
        symmetric = "symmetric within its errors" if self.is_symmetric else "not symmetric within its errors"
        left_out = f"; left out, being at both bounds: {', '.join(self.left_out)}" if self.left_out else ""
        return (
            f"{significant} of {upper.shape[1]} second derivatives of {self.metric} differ from 0; the matrix is "
            f"{symmetric} (largest difference {worst:.1f} standard errors){left_out}"
        )

    def plot(self, *, ax: Axes | None = None) -> Figure:
        """Plot the matrix, into ``ax`` if given: red where parameters strengthen each other's effect, else blue.

        Each cell shows its value with the error of the last digits in brackets; grey cells do not differ
        significantly from 0.
        """
        count = len(self.names)
        width = 2.6 + _CELL * max(count, 4)
        ax = axes_or_new(ax, width, 1.7 + 0.55 * _CELL * max(count, 3))
        matrix, significant = self.matrix, self.significant
        largest = matrix.abs().max().item() or 1.0
        # Masked elements show the grey background.
        masked = matrix.masked_fill(~significant, math.nan)
        ax.set_facecolor("0.92")
        shown = ax.imshow(masked.numpy(), cmap="RdBu_r", vmin=-largest, vmax=largest, aspect="auto")
        for (row, column), text in self._formatted().items():
            strong = significant[row, column] and matrix[row, column].abs() > _WHITE_TEXT_ABOVE * largest
            color = "white" if strong else "black" if significant[row, column] else "0.45"
            ax.text(column, row, text, ha="center", va="center", fontsize=SMALL, color=color)
        # Columns have numbers only: names would have to be vertical.
        ax.set_xticks(range(count), [str(k) for k in range(1, count + 1)], fontsize=TEXT)
        name_rows(ax, [f"{name}  {k}" for k, name in enumerate(shorten(self.labels, _NAME_WIDTH), 1)])
        ax.set_ylim(count - 0.5, -0.5)
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        bar = figure_of(ax).colorbar(shown, ax=ax, aspect=18, pad=0.03)
        bar.ax.tick_params(labelsize=SMALL)
        bar.outline.set_visible(False)
        title = wrap(f"Interactions: {self._heading}", 16 + 9 * count, indent=0)
        ax.set_title(title, loc="left", fontsize=TITLE, parse_math=False)
        note = f"{self.verdict}. Grey: not significantly different from 0."
        add_footnotes(ax, wrapped_lines(note, int(width * _NOTE_WIDTH / 7.2)), below=22)
        return figure_of(ax)

    def __str__(self) -> str:
        significant, formatted = self.significant, self._formatted()
        numbers = [str(number) for number in range(1, len(self.names) + 1)]
        rows = [[f"{k} {name}"] for k, name in zip(numbers, shorten(self.labels, _NAME_WIDTH), strict=True)]
        for (row, column), text in formatted.items():
            mark = "" if significant[row, column] else "?"
            rows[row].append(text + mark if column >= row else "")
        lines = grid(["", *numbers], rows, right=True)
        return "\n".join([self._heading, "", *lines, "", _KEY, self.verdict])

    __repr__ = __str__

    @property
    def _heading(self) -> str:
        step = "per unit" if self.scale == "unit" else "over the range"
        unit = f" ({self.unit})" if self.unit else ""
        return f"second derivatives of {self.metric}{unit}, {step} along each parameter's own gradient"

    def _formatted(self) -> dict[tuple[int, int], str]:
        indices = range(len(self.names))
        matrix, errors = self.matrix, self.standard_error
        return {(p, q): _concise(matrix[p, q].item(), errors[p, q].item()) for p in indices for q in indices}


def _standard_error(replicates: torch.Tensor) -> torch.Tensor:
    return replicates.std(0) / math.sqrt(len(replicates))


def _concise(value: float, error: float) -> str:
    """Format a value with the error of its last digits in brackets: ``'0.0123(4)'``, ``'0.00(5)'``, ``'0(9)e−8'``.

    A value far below its error is rounded to zero, but keeps the decimals and the power of ten of the error.
    """
    style = Format.of(value, error)
    if error == 0:
        return style.write(value)
    decimals = style.place + style.exponent  # of what stands before the power of ten
    scaled = round(value / 10.0**style.exponent, decimals) + 0.0  # + 0.0 turns −0.0 into 0.0
    is_plain_integer = style.exponent == 0 and style.place <= 0
    digits = style.write(error) if is_plain_integer else round(error * 10.0**style.place)
    return minus(f"{scaled:.{max(decimals, 0)}f}({digits}){f'e{style.exponent}' if style.exponent else ''}")
