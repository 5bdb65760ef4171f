"""The data of an attribution: its tensors and errors, and the numbers that follow from them alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch

from ..errors import SceneCaptumError, UnknownNameError, near_misses
from ..estimation import channel_totals, covariance_of_mean, student_t
from ..projection import SurfaceMap
from ..protocols import ResultKind

Tensors = Mapping[str, torch.Tensor]

_MAX_NUMBERS = 16  # of a value in a summary: a 4 × 4 transform


class Ranked(NamedTuple):
    """One row of a ranking.

    Attributes
    ----------
    rank
        From 1, the most salient.
    name, label
        The parameter's name in the scene, and a readable label.
    saliency, saliency_error
        Its magnitude and the standard error; errors are None with fewer than two replicates.
    total, total_error
        The attribution summed over texels, one element per channel, and its standard errors.
    """

    rank: int
    name: str
    label: str
    saliency: float
    saliency_error: float | None
    total: tuple[float, ...]
    total_error: tuple[float, ...] | None


@dataclass(frozen=True, repr=False)
class AttributionData(Mapping[str, torch.Tensor]):
    """What the functions that transform or store attributions know of one; ``SceneAttribution`` has the fields."""

    attributions: Tensors
    standard_error: Tensors | None
    metric_value: float
    metric_standard_error: float | None = None
    convergence_delta: float | None = None
    convergence_delta_error: float | None = None
    bias: Tensors | None = None
    quadrature_error: Tensors | None = None
    replicates: Tensors = field(default_factory=dict)
    covariance: Tensors | None = None
    parameter_values: Tensors = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    image: torch.Tensor | None = None
    surfaces: SurfaceMap | None = None
    info: Mapping[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> torch.Tensor:
        try:
            return self.attributions[name]
        except KeyError:
            raise UnknownNameError(
                f"There is no attribution to {name!r}.{near_misses(name, self.attributions)}"
            ) from None

    def __contains__(self, name: object) -> bool:
        return name in self.attributions

    def __iter__(self) -> Iterator[str]:
        return iter(self.attributions)

    def __len__(self) -> int:
        return len(self.attributions)

    @property
    def kind(self) -> ResultKind:
        """The attributed quantity, such as ``ResultKind.GRADIENT``."""
        default = ResultKind.GRADIENT if self.convergence_delta is None else ResultKind.CONTRIBUTION
        return ResultKind(self.info.get("quantity", default))

    def saliency(self) -> dict[str, float]:
        """Return each parameter's magnitude: the ℓ2 norm over its channels.

        Textures are first summed over their texels, the derivative with respect to a common offset, so that a
        uniform texture ranks like a constant colour.
        """
        return {name: channel_totals(value).double().norm().item() for name, value in self.items()}

    def saliency_error(self) -> dict[str, float] | None:
        """Return the standard error of each saliency, from the covariance of the channel totals.

        It is None with fewer than two replicates.
        """
        if self.covariance is None:
            return None
        return {name: _norm_error(channel_totals(self[name]), self.covariance[name]) for name in self}

    def ranking(self, top: int | None = None) -> list[Ranked]:
        """Return the parameters by descending saliency, all or the first ``top``."""
        saliency, errors = self.saliency(), self.saliency_error()
        order = sorted(self, key=lambda name: -saliency[name])
        return [
            Ranked(
                rank=rank,
                name=name,
                label=self.labels.get(name, name),
                saliency=saliency[name],
                saliency_error=None if errors is None else errors[name],
                total=tuple(channel_totals(self[name]).tolist()),
                total_error=self._total_error(name),
            )
            for rank, name in enumerate(order[:top], start=1)
        ]

    def _total_error(self, name: str) -> tuple[float, ...] | None:
        if self.covariance is None:
            return None
        return tuple(self.covariance[name].diagonal().sqrt().tolist())

    def interval(self, level: float = 0.95) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Return the lower and upper ends of a confidence interval for each parameter, of its shape (Student's t).

        Raises
        ------
        SceneCaptumError
            If there is no standard error, or ``level`` is not between 0 and 1.
        """
        if self.standard_error is None:
            raise SceneCaptumError(
                "There are no error bars: they require at least two replicates. Call attribute(replicates=8)."
            )
        if not 0 < level < 1:
            raise SceneCaptumError(f"level must lie between 0 and 1, not {level!r}.")
        quantile = student_t(level, self.info.get("degrees_of_freedom", self.info["replicates"] - 1))
        return {
            name: (value - quantile * self.standard_error[name], value + quantile * self.standard_error[name])
            for name, value in self.items()
        }

    def metric_interval(self, level: float = 0.95) -> tuple[float, float] | None:
        """Return a confidence interval of the metric (Student's t), or None without a standard error."""
        return metric_interval(self.metric_value, self.metric_standard_error, self.info["replicates"], level)


def metric_interval(
    value: float, error: float | None, replicates: int, level: float = 0.95
) -> tuple[float, float] | None:
    """Return a confidence interval of the metric (Student's t), or None without a standard error."""
    if error is None:
        return None
    half_width = student_t(level, max(1, replicates - 1)) * error
    return value - half_width, value + half_width


def covariances(replicates: Tensors, bias: Tensors | None) -> dict[str, torch.Tensor]:
    """Return the covariance of each parameter's channel totals."""
    bias_totals = {} if bias is None else {name: channel_totals(value) for name, value in bias.items()}
    return {name: covariance_of_mean(rows, bias_totals.get(name)) for name, rows in replicates.items()}


def summarize(values: Tensors) -> dict[str, torch.Tensor]:
    """Return small values as they are, means over the texels of textures, and nothing for long vectors."""
    means = {n: v.reshape(-1, v.shape[-1]).mean(0) if v.ndim > 1 else v for n, v in values.items()}
    return {n: value.detach().clone() for n, value in means.items() if 0 < value.numel() <= _MAX_NUMBERS}


def _norm_error(total: torch.Tensor, covariance: torch.Tensor) -> float:
    """Return the first-order standard error of a norm: the standard deviation in the direction of the vector."""
    total, covariance = total.double(), covariance.double()
    norm = total.norm()
    if norm == 0:
        return float(covariance.diagonal().sum().sqrt())
    direction = total / norm
    return float((direction @ covariance @ direction).clamp_min(0).sqrt())
