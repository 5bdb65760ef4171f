"""The data of an attribution: its tensors and errors, and the numbers that follow from them alone."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, get_args

import torch

from ..errors import SceneCaptumError, UnknownNameError, near_misses, whole_number
from ..estimation import channel_totals, covariance_of_mean, student_t
from ..projection import SurfaceMap
from ..protocols import ResultKind, Scale

Tensors = Mapping[str, torch.Tensor]

CLEARLY_TURNED = 3.0  # standard errors from which the direction of a vector is known

_MAX_NUMBERS = 16  # of a value in a summary: a 4 × 4 transform


class Ranked(NamedTuple):
    """One row of a ranking.

    Attributes
    ----------
    rank
        From 1, the most salient.
    name, label
        The parameter's name in the scene, and a readable label.
    effect, effect_error
        The signed effect of changing all channels together, in the scale of the ranking, and its standard error;
        errors are None with fewer than two replicates.
    saliency, saliency_error
        The magnitude by which the parameters are ranked, and its standard error.
    total, total_error
        The attribution summed over texels, one element per channel, and its standard errors.
    """

    rank: int
    name: str
    label: str
    effect: float
    effect_error: float | None
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
    metric_error_parts: torch.Tensor | None = None
    convergence_delta: float | None = None
    convergence_delta_error: float | None = None
    bias: Tensors | None = None
    quadrature_error: Tensors | None = None
    replicates: Tensors = field(default_factory=dict)
    covariance: Tensors | None = None
    extents: Tensors = field(default_factory=dict)
    parameter_values: Tensors = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    image: torch.Tensor | None = None
    surfaces: SurfaceMap | None = None
    info: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for one in dataclasses.fields(self):
            object.__setattr__(self, one.name, _on_cpu(getattr(self, one.name)))

    def __getitem__(self, name: str) -> torch.Tensor:
        try:
            return self.attributions[name]
        except (KeyError, TypeError):
            if not isinstance(name, str):
                raise SceneCaptumError(
                    f"An attribution is indexed by a parameter's name, such as {next(iter(self), 'NAME')!r}, not "
                    f"{name!r}; ranking()[{name!r}] is a row of the ranking."
                ) from None
            raise UnknownNameError(
                f"There is no attribution to {name!r}."
                f"{near_misses(name, self.attributions, instead=' list(attribution) gives all names.')}"
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

    def scale_or_default(self, scale: Scale | None = None) -> Scale:
        """Return the scale of a comparison: by default ``"range"``, or ``"unit"`` where the ranges are unknown.

        Raises
        ------
        SceneCaptumError
            If the scale is unknown, or needs ranges or values that this result does not have.
        """
        if scale is None:
            return "range" if self.extents or not self.kind.is_gradient_per_unit else "unit"
        if scale not in get_args(Scale):
            raise SceneCaptumError(f'scale must be "range", "unit" or "value", not {scale!r}.')
        known = {"range": self.extents, "value": self.parameter_values}.get(scale, self)
        missing = [name for name in self if name not in known]
        if missing and self.kind.is_gradient_per_unit:
            raise SceneCaptumError(
                f"scale={scale!r} needs the {scale} of {missing[0]!r}, which this result does not have. Use "
                'scale="unit".'
            )
        return scale

    def factors(self, scale: Scale | None = None) -> dict[str, torch.Tensor]:
        """Return a ``(C,)`` tensor for each parameter, by which its channels are multiplied in a scale.

        Contributions and other quantities in the metric's unit are compared as they are, in any scale.
        """
        chosen = self.scale_or_default(scale)
        if chosen == "unit" or not self.kind.is_gradient_per_unit:
            # Of an occlusion, each texel has the effect of its patch in all channels, which counts once.
            copies = {
                n: texels * self[n].shape[-1] for n, texels in self.info.get("patch_texels", {}).items()
            }
            factors = {n: torch.ones_like(channel_totals(one)) / copies.get(n, 1) for n, one in self.items()}
        else:
            given = self.extents if chosen == "range" else self.parameter_values
            factors = {name: given[name].reshape(-1) for name in self}
        # Directions of poses without a derivative do not count.
        kept = self.info.get("kept_directions", {})
        masks = {name: factors[name].new_tensor(mask) for name, mask in kept.items() if name in factors}
        return {**factors, **{name: factors[name] * mask for name, mask in masks.items()}}

    def with_derivative(self, name: str) -> torch.Tensor:
        """Return an attribution that is 0 in the directions in which a pose has no derivative."""
        kept = self.info.get("kept_directions", {}).get(name)
        return self[name] if kept is None else self[name] * self[name].new_tensor(kept)

    def weights(self, scale: Scale | None = None) -> dict[str, torch.Tensor]:
        """Return a ``(C,)`` tensor for each parameter: its effect is the sum of its channels times these.

        They are the ``factors``, and of a vector in space those in the direction of its largest effect.
        """
        factors = self.factors(scale)
        for name in self.vectors & factors.keys():
            factors[name] = factors[name] * _direction(channel_totals(self[name]) * factors[name])
        return factors

    def effects(self, scale: Scale | None = None) -> dict[str, float]:
        """Return the signed effect of each parameter in the metric's unit: one number, all channels together.

        To first order, ``scale="range"`` is the change of the metric over the parameter's range (for a radiance
        from off to its value), ``"value"`` that per relative change of its value, and ``"unit"`` that per unit.
        A texture changes by the same amount in all texels. A vector in space (a translation, a rotation) changes
        in the direction with the largest effect, which is positive.
        """
        factors = self.factors(scale)
        return {
            name: self._length(name, factors[name])[0]
            if name in self.vectors
            else (channel_totals(value).double() @ factors[name].double()).item()
            for name, value in self.items()
        }

    def effects_error(self, scale: Scale | None = None) -> dict[str, float] | None:
        """Return the standard error of each effect; None with fewer than two replicates."""
        if self.covariance is None:
            return None
        factors = {name: factor.double() for name, factor in self.factors(scale).items()}
        return {
            name: self._length(name, factors[name])[1]
            if name in self.vectors
            else _error_along(factors[name], self.covariance[name])
            for name in self
        }

    @property
    def vectors(self) -> frozenset[str]:
        """The parameters that are vectors in space."""
        return frozenset(self.info.get("vectors", ()))

    def _length(self, name: str, factors: torch.Tensor) -> tuple[float, float]:
        """Return the length of a vector, without what noise adds to it on average, and its standard error.

        Where noise may have turned the vector, the error is that of all directions.
        """
        vector = channel_totals(self[name]).double() * factors.double()
        if self.covariance is None:
            return vector.norm().item(), 0.0
        covariance = self.covariance[name].double() * factors.double()[:, None] * factors.double()
        total = noise = covariance.diagonal().sum()
        if self.bias is not None:  # an error, but one that does not change from run to run
            noise = (total - (channel_totals(self.bias[name]) * factors).double().square().sum()).clamp_min(0)
        length = (vector.square().sum() - noise).clamp_min(0).sqrt().item()
        if length**2 < CLEARLY_TURNED**2 * noise:
            return length, total.sqrt().item()
        return length, _norm_error(vector, covariance)

    def saliency(self, scale: Scale | None = None) -> dict[str, float]:
        """Return each parameter's magnitude, by which it is ranked: that of its effect.

        Per unit (``scale="unit"``) it is the ℓ2 norm over the channels, as in the paper. Textures are summed over
        their texels, the derivative with respect to a common offset, so that a uniform texture ranks like a
        constant colour.
        """
        if self.ranks_by_norm(scale):
            effects = self.effects(scale)
            return {
                name: effects[name] if name in self.vectors else channel_totals(value).double().norm().item()
                for name, value in self.items()
            }
        return {name: abs(effect) for name, effect in self.effects(scale).items()}

    def saliency_error(self, scale: Scale | None = None) -> dict[str, float] | None:
        """Return the standard error of each saliency, from the covariance of the channel totals.

        It is None with fewer than two replicates.
        """
        if self.covariance is None or not self.ranks_by_norm(scale):
            return self.effects_error(scale)
        errors = self.effects_error(scale) or {}
        return {
            name: errors[name]
            if name in self.vectors
            else _norm_error(channel_totals(self[name]), self.covariance[name])
            for name in self
        }

    def ranks_by_norm(self, scale: Scale | None = None) -> bool:
        """Whether parameters are ranked by the norm over their channels, which have no common unit."""
        return self.kind.is_gradient_per_unit and self.scale_or_default(scale) == "unit"

    def ranking(self, top: int | None = None, *, scale: Scale | None = None) -> list[Ranked]:
        """Return the parameters by descending saliency, all or the first ``top``; scales as for ``effects``.

        Poses without a derivative, ``info["jumps"]``, are left out. Those of ``ranked_last`` follow after the
        others.
        """
        count = None if top is None else whole_number("top", top)
        effects, effect_errors = self.effects(scale), self.effects_error(scale)
        saliency, errors = self.saliency(scale), self.saliency_error(scale)
        jumps = self.info.get("jumps", {})
        last = self.ranked_last(scale)
        order = sorted(
            (name for name in self if name not in jumps), key=lambda name: (name in last, -saliency[name])
        )
        return [
            Ranked(
                rank=rank,
                name=name,
                label=self.labels.get(name, name),
                effect=effects[name],
                effect_error=None if effect_errors is None else effect_errors[name],
                saliency=saliency[name],
                saliency_error=None if errors is None else errors[name],
                total=tuple(channel_totals(self[name]).tolist()),
                total_error=self._total_error(name),
            )
            for rank, name in enumerate(order[:count], start=1)
        ]

    def ranked_last(self, scale: Scale | None = None) -> frozenset[str]:
        """Return the parameters whose effects say little of their ranges; none if all are such.

        They rank after the others, and bars and maps leave them out. These are lights that are off, under a metric
        that is not linear in the light: to first order, the effect of switching one on may be far off, even in its
        sign. And these are poses over whose ranges the metric, as rendered, changes by less than half of the
        effect, or in the other direction. Per unit (``scale="unit"``) there are none.
        """
        # Only a linear metric grows with a light as its derivative at 0 says.
        off = frozenset() if self.info.get("linear_in_light") else self.lights_off(scale)
        last = off | self.overstated(scale)
        return last if len(last) < len(self) else frozenset()

    def overstated(self, scale: Scale | None = None) -> frozenset[str]:
        """Return the poses over whose ranges renders show less than half of the effect; per unit none."""
        if self.kind.in_scale(self.scale_or_default(scale)) is not ResultKind.EFFECT:
            return frozenset()
        effects, changes = self.saliency(scale), self.info.get("range_changes", {})
        return frozenset(n for n, (change, _) in changes.items() if n in self and change < effects[n] / 2)

    def lights_off(self, scale: Scale | None = None) -> frozenset[str]:
        """Return the lights that are off, whose effects are those of switching them on; per unit none."""
        if self.kind.in_scale(self.scale_or_default(scale)) is not ResultKind.EFFECT:
            return frozenset()
        return frozenset(self.info.get("lights_off", ())).intersection(self)

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


def _on_cpu(value: Any) -> Any:
    """Return a tensor, or a mapping with some, on the CPU; anything else as it is."""
    if isinstance(value, torch.Tensor):
        return value.cpu()
    if isinstance(value, Mapping) and any(
        isinstance(one, torch.Tensor) and not one.is_cpu for one in value.values()
    ):
        return {name: _on_cpu(one) for name, one in value.items()}
    return value


def _direction(vector: torch.Tensor) -> torch.Tensor:
    """Return the unit vector of a direction; 0 for no direction."""
    norm = vector.norm()
    return vector / norm if norm > 0 else vector


def _norm_error(total: torch.Tensor, covariance: torch.Tensor) -> float:
    """Return the first-order standard error of a norm: the standard deviation in the direction of the vector."""
    total, covariance = total.double(), covariance.double()
    norm = total.norm()
    if norm == 0:
        return float(covariance.diagonal().sum().sqrt())
    return _error_along(total / norm, covariance)


def _error_along(weights: torch.Tensor, covariance: torch.Tensor) -> float:
    """Return the standard error of a weighted sum of channels."""
    return float((weights @ covariance.double() @ weights).clamp_min(0).sqrt())
