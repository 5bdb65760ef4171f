"""A scene to first order about a design: derivatives of the picture, and gradients of metrics with errors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from ..attr import SceneAttribution, VanillaSceneGradient, checked_over_ranges
from ..denoising import Guides, denoise
from ..estimation import TargetedMetric, channel_totals, covariance_of_mean, pseudo_values
from ..projection import SurfaceMap
from ..protocols import accepted_keywords
from ..rendering import SceneRenderer
from ._designs import REPLICATES, Designs, Measured
from ._sliders import Design, Place, Slider

GRADIENT_REPLICATES = 8
GRADIENT_SPP = 8
RANGE_SPP = 256  # a quarter or half of them at each end of the range of a pose
PICTURE_NOISE_SPP = 2  # of the gradients along the noise of an adjoint, which need only be known roughly
_ROUNDING = 1e-4  # what the adjoints of a linear metric may differ by, relative to the largest
_COMMON = 0.999  # of the pixels decide how far a derivative is below zero


@dataclass(frozen=True)
class Gradient:
    """Gradient of a metric per unit of a slider.

    Attributes
    ----------
    rows
        Independent estimates, ``(replicates, numbers of the slider)``.
    turned
        Standard error that all of them share, with the sign that it has for all sliders: ``(numbers,)``. Their
        adjoint has the noise of a picture, and over the range of a pose the metric may not be linear.
    """

    rows: torch.Tensor
    turned: torch.Tensor


@dataclass(frozen=True)
class Derivative:
    """The derivatives along a slider: ``images``, ``(images, H, W, 3)``, and the ``gradients`` of the metrics.

    Of what moves there are no images.
    """

    images: torch.Tensor
    gradients: list[Gradient]


class Linearization:
    """The picture and the metrics of a scene to first order about a design.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", resolution=(16, 16), spp=16)
    >>> designs = Designs(renderer, [metrics.MeanLuminance()])
    >>> about = Linearization(designs, designs.measure({}))
    >>> about.rank()
    >>> floor = about.leading(1)[0]
    >>> derivative = about.derive(designs.sliders[floor])
    >>> derivative.images.shape
    torch.Size([1, 16, 16, 3])

    Parameters
    ----------
    designs
        What renders the scene.
    start
        The design about which it is linear, as measured by ``designs``.

    Attributes
    ----------
    attributions : list of SceneAttribution
        The gradients of each metric at the start, once ``rank`` has been called.
    """

    def __init__(self, designs: Designs, start: Measured) -> None:
        self.designs, self.start = designs, start
        self.attributions: list[SceneAttribution] = []
        self._adjoints: list[torch.Tensor] = []  # of each metric: of all images, and of two halves of them
        self._beyond: dict[
            int, dict[str, torch.Tensor]
        ] = {}  # of each metric: errors of poses over their ranges
        self._derived: dict[str, Derivative] = {}

    def rank(self) -> None:
        """Attribute the metrics, to first order about the picture of the start."""
        designs, images = self.designs, self.start.images
        means = [images.mean(0), images[::2].mean(0), images[1::2].mean(0)]
        deviations = []
        for metric in designs.metrics_of(self.start.design):
            designs.pause()
            adjoints = torch.stack([metric.value_and_adjoint(mean)[1] for mean in means])
            self._adjoints.append(adjoints)
            deviations.append(self._adjoint_noise(metric, adjoints[0]))
        functional = _FirstOrder(designs.metrics, [adjoint[0] for adjoint in self._adjoints], self.start)
        values = designs.values(self.start.design)
        method = VanillaSceneGradient(_Pausing(designs.renderer, designs.pause), functional)
        found = method.attribute(
            {name: values[name] for name in designs.inputs},
            target=list(range(len(designs.metrics))),
            seed=designs.seed,
            spp=GRADIENT_SPP,
            replicates=GRADIENT_REPLICATES,
        )
        found = [
            one if noise is None else self._over_ranges(number, self._with_picture_noise(one, noise), noise)
            for number, (one, noise) in enumerate(zip(found, deviations, strict=True))
        ]
        # They are of the metric to first order, which is linear in the light whatever the metric is.
        self.attributions = [
            self._as_measured(number, one, linear_in_light=noise is None)
            for number, (one, noise) in enumerate(zip(found, deviations, strict=True))
        ]

    def _over_ranges(
        self, number: int, attribution: SceneAttribution, noise: torch.Tensor
    ) -> SceneAttribution:
        """Return an attribution of a metric that is not linear, with what this does over the ranges of poses."""
        designs, start = self.designs, self.start
        metric = designs.metrics_of(start.design)[number]
        if metric.is_smoothed:  # with hundreds of draws for each value, this would take longer than the rest
            return attribution
        values = designs.values(start.design)
        checked, self._beyond[number] = checked_over_ranges(
            attribution,
            _Pausing(designs.renderer, designs.pause),
            metric,
            {name: values[name] for name in designs.inputs},
            image=start.image,
            adjoints=list(noise + self._adjoints[number][0]),
            spp=RANGE_SPP,
        )
        return checked

    def _adjoint_noise(self, metric: TargetedMetric, adjoint: torch.Tensor) -> torch.Tensor | None:
        """Return the pseudo-values of an adjoint minus itself, ``(images, H, W, 3)``; None if it has no noise."""
        images = self.start.images

        def of_mean(kept: torch.Tensor) -> torch.Tensor:
            self.designs.pause()
            return metric.value_and_adjoint(images[kept].mean(0))[1]

        deviations = pseudo_values(of_mean, len(images)) - adjoint
        return deviations if deviations.abs().max() > _ROUNDING * adjoint.abs().max() else None

    def _with_picture_noise(self, attribution: SceneAttribution, noise: torch.Tensor) -> SceneAttribution:
        """Return an attribution whose errors have those of its adjoint, which all of its replicates share."""
        designs = self.designs
        values = designs.values(self.start.design)

        def along_noise(image: torch.Tensor) -> torch.Tensor:
            return torch.einsum("khwc,hwc->k", noise, image)

        found = VanillaSceneGradient(_Pausing(designs.renderer, designs.pause), along_noise).attribute(
            {name: values[name] for name in designs.inputs},
            target=list(range(len(noise))),
            seed=designs.seed,
            spp=PICTURE_NOISE_SPP,
            replicates=1,
            denoise=False,
        )
        errors, covariance = dict(attribution.standard_error or {}), dict(attribution.covariance or {})
        for name in attribution:
            rows = torch.stack([one[name] for one in found])
            # The mean of pseudo-values minus the value is the bias that the noise of the picture causes.
            bias = rows.mean(0)
            errors[name] = errors[name].hypot((rows.var(0) / len(rows) + bias.square()).sqrt())
            totals = torch.stack([channel_totals(row) for row in rows])
            covariance[name] = covariance[name] + covariance_of_mean(totals, channel_totals(bias))
        info = {**attribution.info, "degrees_of_freedom": REPLICATES - 1}
        return dataclasses.replace(attribution, standard_error=errors, covariance=covariance, info=info)

    def _as_measured(self, number: int, attribution: SceneAttribution, **info: object) -> SceneAttribution:
        """Return an attribution of a metric to first order with the metric itself at the start, and more info."""
        value, error = self.start.value(number)
        image = self.start.image
        info = {**attribution.info, **self.designs.metrics[number].describe(value, image), **info}
        return dataclasses.replace(
            attribution,
            metric_value=value,
            metric_standard_error=error,
            metric_error_parts=None,
            image=image,
            info=info,
        )

    @property
    def surfaces(self) -> SurfaceMap:
        """The objects that each pixel shows at the start."""
        values = self.designs.values(self.start.design)
        found = self.designs.renderer.surfaces_with_texels((), values)
        assert found is not None, "Designs checks it"
        return found

    def leading(self, count: int) -> list[str]:
        """Return the parameters with the largest effects on any metric, relative to the largest on this metric.

        Those whose effects say little of their ranges for every metric come last; what has no effect is left out.
        """
        best: dict[str, tuple[bool, float]] = {}  # the lowest comes first
        for attribution in self.attributions:
            last = attribution.ranked_last()
            rows = [row for row in attribution.ranking() if row.name in self.designs.sliders]
            most = max((row.saliency for row in rows if row.name not in last), default=0.0) or 1.0
            for row in rows:
                if row.saliency or row.saliency_error:
                    place = (row.name in last, -row.saliency / most)
                    best[row.name] = min(best.get(row.name, place), place)
        return sorted(best, key=lambda name: best[name])[:count]

    def derive(self, slider: Slider) -> Derivative:
        """Compute the derivatives of the picture, by differences with the random numbers of the start.

        A dimmer takes all replicates of the start, so that the picture is exact however far it goes. For others
        one is enough, if an attribution has the gradients.
        """
        known = [self._known_rows(slider, attribution) for attribution in self.attributions]
        is_known = bool(known) and all(rows is not None for rows in known)
        seeds = self.designs.seeds[:1] if is_known else self.designs.seeds
        place = self.start.design.get(slider.name, slider.start)
        images = torch.stack([self._differences(slider, place, step, seeds) for step in slider.steps(place)])
        gradients = []
        for number, adjoints in enumerate(self._adjoints):
            products = torch.einsum("ahwc,jshwc->asjc", adjoints.double(), images.double())
            products = products[:, :, 0] if slider.by_channel else products.sum(-1)
            rows = known[number]
            turned = (products[1] - products[2]).mean(0) / 2
            beyond = self._beyond.get(number, {}).get(slider.name)
            if beyond is not None:
                along = beyond.double().reshape(-1)  # the slider of a pose has its numbers
                turned = turned + (along if turned @ along >= 0 else -along)
            gradients.append(Gradient(products[0] if rows is None else rows, turned))
        shown = images.mean(1) if slider.is_shown else images.new_zeros(0, *images.shape[2:])
        if slider.is_shown:
            guides = self.designs.renderer.guides_of(self.designs.values(self.start.design))
            shown = torch.stack([_denoise_signed(one, guides) for one in shown])
        self._derived[slider.name] = Derivative(shown, gradients)
        return self._derived[slider.name]

    def predict(self, design: Design) -> tuple[torch.Tensor, list[tuple[float, float]]]:
        """Return the picture of a design, and the change of each metric with its standard error, to first order.

        The picture shows objects, lamps and the camera where they are at the start.

        Raises
        ------
        KeyError
            If a slider that the design moves has not been derived.
        """
        picture = self.designs.denoised(self.start.image, self.start.design)
        totals: list[dict[int, torch.Tensor]] = [{} for _ in self._adjoints]
        turned = [0.0 for _ in self._adjoints]
        for name in {**self.start.design, **design}:
            slider = self.designs.sliders[name]
            ends = (one.get(name, slider.start) for one in (design, self.start.design))
            way = torch.tensor([to - start for to, start in zip(*ends, strict=True)], dtype=torch.float64)
            if not way.any():
                continue
            derivative = self._derived[name]
            picture = picture + torch.einsum(
                "jhwc,jc->hwc", derivative.images, slider.weights(way).to(picture)
            )
            for number, gradient in enumerate(derivative.gradients):
                # Replicates of the same renders are added before their spread is taken.
                sums, count = totals[number], len(gradient.rows)
                sums[count] = gradient.rows @ way + sums.get(count, 0.0)
                turned[number] += (gradient.turned @ way).item()
        return picture, [_sum_up(sums, shared) for sums, shared in zip(totals, turned, strict=True)]

    def _differences(self, slider: Slider, place: Place, step: Place, seeds: Sequence[int]) -> torch.Tensor:
        """Return the derivative of the picture along a step for each seed, ``(seeds, H, W, 3)``."""
        moved = {**self.start.design, slider.name: tuple(n + d for n, d in zip(place, step, strict=True))}
        length = torch.tensor(step) if slider.by_channel else torch.tensor(max(step, key=abs))
        pairs = zip(seeds, self.start.images, strict=False)
        return torch.stack([(self.designs.render(moved, seed) - image) / length for seed, image in pairs])

    @staticmethod
    def _known_rows(slider: Slider, attribution: SceneAttribution) -> torch.Tensor | None:
        """Return the gradient in every replicate of an attribution, per unit of the slider, if that has it."""
        without = {*attribution.info.get("jumps", ()), *attribution.info.get("kept_directions", ())}
        if slider.name not in attribution or slider.name in without:
            return None
        return slider.rows(attribution.replicates[slider.name].double())


def _sum_up(totals: Mapping[int, torch.Tensor], turned: float) -> tuple[float, float]:
    variances = [(total.var() / count).item() for count, total in totals.items()]
    change = sum(total.mean().item() for total in totals.values())
    return change, math.sqrt(sum(variances) + turned**2)


def _denoise_signed(image: torch.Tensor, guides: Guides) -> torch.Tensor:
    """Denoise an image that may be negative, which the denoiser does not take: lift it, and lower it again."""
    below = -image.amin(-1).flatten()
    lift = max(0.0, below.kthvalue(max(1, round(_COMMON * len(below)))).values.item())
    return denoise(image + lift, guides.keeping_lamps()) - lift


class _FirstOrder:
    """Metrics to first order about a picture: linear, so that their gradients need no metric image."""

    def __init__(
        self, metrics: Sequence[TargetedMetric], adjoints: Sequence[torch.Tensor], start: Measured
    ) -> None:
        self._metrics, self._adjoints = metrics, torch.stack(list(adjoints))
        products = torch.einsum("mhwc,hwc->m", self._adjoints.double(), start.image.double())
        self._constants = start.values.mean(0).to(products) - products

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        return torch.einsum("mhwc,hwc->m", self._adjoints, image) + self._constants.to(image)

    def measure_of(self, target: int) -> Any:
        """Return what a metric measures."""
        return self._metrics[target].measure


class _Pausing:
    """A renderer that pauses before every render."""

    def __init__(self, renderer: SceneRenderer, pause: Callable[[], None]) -> None:
        self.renderer, self.pause = renderer, pause
        self.accepted_keywords = accepted_keywords(renderer)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.renderer, name)

    def __call__(self, inputs: Mapping[str, torch.Tensor], **options: Any) -> torch.Tensor:
        self.pause()
        image: torch.Tensor = self.renderer(inputs, **options)
        return image
