"""How well attributions predict the effect of scene changes: infidelity and sensitivity-n."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from ..attr import (
    Baselines,
    IntegratedGradientsScene,
    Noise,
    SceneAttribution,
    VanillaSceneGradient,
    describe_baselines,
    resolve_baselines,
)
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError, near_misses, whole_number
from ..estimation import DEFAULT_REPLICATES, Metric, Stream, Target, derived_seeds, random_generator
from ..protocols import Renderer, ResultKind
from ..visualization import metric_name
from ._faithfulness_result import Infidelity, SensitivityN
from ._scenes import Scenes, scenes_of, values_of

Tensors = Mapping[str, torch.Tensor]


def infidelity(  # noqa: PLR0913 -- the options of every check, and its own
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    stdevs: float | Mapping[str, float] = 0.1,
    n_perturb_samples: int = 64,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> Infidelity:
    """Perturb all parameters at random and compare the change of the metric with the prediction of gradients.

    Estimates ``E[(Iᵀ Φ − (M(θ) − M(θ − I)))²]`` over perturbations ``I``, like ``captum.metrics.infidelity``, but
    corrected for the noise of rendering and, if the attribution has error bars, for that of its gradients. All
    scenes are rendered with common random numbers.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="emitters", resolution=(16, 16), spp=16)
    >>> infidelity(renderer, metrics.MeanLuminance(), n_perturb_samples=4).normalized < 0.1  # linear in the light
    True

    Parameters
    ----------
    renderer, metric, target
        As for ``VanillaSceneGradient``; the renderer must have ``bounds``.
    attribution
        Gradients per unit, plain or from SmoothGrad, at the values for which they were made; plain gradients are
        computed by default.
    stdevs
        Standard deviation of the perturbations as a fraction of each parameter's range: a number, or a mapping
        from names, globs or kinds. Perturbed values are reflected at the bounds.
    n_perturb_samples
        Number of perturbed scenes.
    seed, spp, replicates, checkpoint
        As for ``ablation_test``; at least 3 replicates.

    Returns
    -------
    Infidelity
        ``value`` is in the squared unit of the metric; ``normalized`` is relative to the mean square change, and
        NaN where that is not clear of the noise of rendering, or less than the noise of the predictions.

    Raises
    ------
    SceneCaptumError
        If the attribution is not one of gradients, or was made for another texture than that of the renderer, or
        ``stdevs`` is invalid.

    References
    ----------
    Yeh et al., "On the (In)fidelity and Sensitivity of Explanations", NeurIPS 2019.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    whole_number("replicates", replicates, 3)
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    if attribution is None:
        attribution = VanillaSceneGradient(renderer, metric).attribute(target=target, **options)
    if "quantity" not in attribution.info or not attribution.kind.is_gradient_per_unit:
        raise SceneCaptumError(
            "infidelity needs gradients per unit, from VanillaSceneGradient or SmoothGradScene, not "
            f"{attribution.info.get('method', 'this')}'s attributions. Use sensitivity_n for those."
        )
    count = whole_number("n_perturb_samples", n_perturb_samples, 3)
    scenes = scenes_of(attribution, renderer, metric, target, **options)
    values = {name: scenes.values[name] for name in parameters_of(attribution, scenes.values)}
    predicted, deviations, measured = [], [], []
    for perturbed in perturbations(renderer, values, stdevs, count, seed):
        changes = {name: (value - perturbed[name]).double() for name, value in values.items()}
        predicted.append(sum((changes[name] * attribution[name].double()).sum().item() for name in values))
        deviations.append(_deviations(changes, attribution.replicates))
        measured.append(scenes.unmodified - scenes.measure(perturbed))
    predictions = torch.tensor(predicted, dtype=torch.float64)
    return Infidelity(
        predicted=predictions,
        measured=torch.stack(measured),
        metric=metric_name(attribution),
        method=str(attribution.info["method"]),
        replicates=predictions[:, None] + torch.stack(deviations) if attribution.covariance else None,
    )


def _deviations(changes: Tensors, replicates: Tensors) -> torch.Tensor:
    """Return by how much the prediction of each replicate differs from their mean, ``(replicates,)``.

    Those of textures are left out: the perturbation is one of single texels, whose replicates are not known.
    """
    # Relative to the first: the mean of equal rows may be rounded, which would be spurious noise.
    parts = [
        (rows.double() - rows[0].double()) @ changes[name].reshape(-1)
        for name, rows in replicates.items()
        if name in changes and changes[name].numel() == rows.shape[1]
    ]
    together = torch.stack(parts).sum(0) if parts else torch.zeros(2, dtype=torch.float64)
    return together - together.mean()


def perturbations(
    renderer: Renderer, values: Tensors, stdevs: float | Mapping[str, float], count: int, seed: int
) -> Iterator[dict[str, torch.Tensor]]:
    """Yield ``count`` perturbed copies of the values, with the noise of SmoothGrad."""
    noise = Noise(renderer, values, stdevs)
    for state in derived_seeds(seed, Stream.PERTURBATIONS, count):
        yield noise.sample(state)


def sensitivity_n(  # noqa: PLR0913 -- the options of every check, and three of its own
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None = None,
    target: Target = None,
    *,
    baselines: Baselines = None,
    sizes: Sequence[int] | None = None,
    subsets: int = 32,
    seed: int = 0,
    spp: int | None = None,
    replicates: int = DEFAULT_REPLICATES,
    checkpoint: Folder = None,
) -> SensitivityN:
    """Delete random sets of n parameters and correlate the change of the metric with the sum of attributions.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", "reflectance", resolution=(16, 16), spp=32)
    >>> found = sensitivity_n(renderer, metrics.MeanLuminance(), sizes=[1], subsets=8)
    >>> found.correlations[0] > 0.8
    True

    Parameters
    ----------
    renderer, metric, target
        As for ``IntegratedGradientsScene``.
    attribution, baselines
        As for ``deletion_insertion``.
    sizes
        Numbers of parameters to delete together; by default up to six sizes from 1 to all but one.
    subsets
        Number of distinct subsets of each size; all subsets if there are fewer.
    seed, spp, replicates, checkpoint
        As for ``ablation_test``; at least 3 replicates.

    Returns
    -------
    SensitivityN
        The correlation and its standard error for each size.

    Raises
    ------
    SceneCaptumError
        If the attribution is one of gradients or of groups, was made for other baselines or another texture than
        that of the renderer, or fewer than three parameters differ from their baselines.

    References
    ----------
    Ancona et al., "Towards better understanding of gradient-based attribution methods for Deep Neural Networks",
    ICLR 2018.
    """
    renderer = with_checkpoint(renderer, checkpoint)
    whole_number("replicates", replicates, 3)
    options: dict[str, Any] = {"seed": seed, "spp": spp, "replicates": replicates}
    attribution, scenes, deleted = contributions(
        renderer, metric, attribution, target, baselines, 3, **options
    )
    sizes = _check_sizes(sizes, len(deleted))
    generator = random_generator(seed, Stream.SUBSETS)
    count = whole_number("subsets", subsets, 3)
    totals = {name: attribution[name].double().sum().item() for name in deleted}
    predicted, measured = [], []
    for size in sizes:
        drawn = _draw_subsets(list(deleted), size, count, generator)
        sums = [sum(totals[name] for name in subset) for subset in drawn]
        predicted.append(torch.tensor(sums, dtype=torch.float64))
        changes = [scenes.unmodified - measure_without(scenes, deleted, subset) for subset in drawn]
        measured.append(torch.stack(changes))
    return SensitivityN(
        parameters=len(deleted),
        sizes=sizes,
        predicted=tuple(predicted),
        measured=tuple(measured),
        metric=metric_name(attribution),
        method=str(attribution.info["method"]),
    )


def contributions(
    renderer: Renderer,
    metric: Metric,
    attribution: SceneAttribution | None,
    target: Target,
    baselines: Baselines,
    at_least: int,
    **options: Any,
) -> tuple[SceneAttribution, Scenes, dict[str, torch.Tensor]]:
    """Return contributions, the scenes that check them, and the baselines that differ from the values."""
    if attribution is None:
        method = IntegratedGradientsScene(renderer, metric)
        attribution = method.attribute(target=target, baselines=baselines, **options)
    values = values_of(attribution, renderer)
    names = parameters_of(attribution, values)
    if "quantity" in attribution.info and not attribution.kind.is_contribution:
        raise SceneCaptumError(
            f"{attribution.info['method']} returns a result of the kind {attribution.kind.value!r}, but this "
            "check replaces parameters by their baselines and needs contributions, which are relative to them. "
            "Pass those of IntegratedGradientsScene, ShapleyValueScene, FeatureAblationScene or "
            "InputXGradientScene."
        )
    resolved = resolve_baselines(renderer, values, baselines)
    _check_baselines(
        attribution, names, describe_baselines(renderer, values, baselines, resolved)["baselines"]
    )
    deleted = {n: resolved[n] for n in names if not torch.equal(resolved[n], values[n])}
    if len(deleted) < at_least:
        raise SceneCaptumError(
            f"At least {at_least} parameters must differ from their baselines, not {len(deleted)}."
        )
    return attribution, Scenes(renderer, metric, target, **options, values=values), deleted


def _check_baselines(attribution: SceneAttribution, names: Sequence[str], own: Mapping[str, str]) -> None:
    """Raise if the attribution is relative to other baselines than ``own``, those of the check in words."""
    theirs = attribution.info.get("baselines", {})
    if isinstance(theirs, str):
        raise SceneCaptumError(
            f"The attribution is relative to {theirs}, and this check replaces parameters by one. Attribute with "
            "one of them, and give it to the check as baselines=."
        )
    if attribution.info.get("quantity") == ResultKind.INPUT_X_GRADIENT:
        theirs = {name: "0" for name, baseline in own.items() if baseline != "unchanged"}
    others = [name for name in names if theirs.get(name, own[name]) != own[name]]
    if others:
        more = f" ({len(others) - 1} more differ)" if len(others) > 1 else ""
        raise SceneCaptumError(
            f"The attribution compares {others[0]!r} with the baseline {theirs[others[0]]}, and this check with "
            f"{own[others[0]]}{more}. Give the check the baselines= with which the attribution was made."
        )


def measure_without(scenes: Scenes, baselines: Tensors, names: Sequence[str]) -> torch.Tensor:
    """Return the metric's pseudo-values with the named parameters at their baselines, ``(replicates,)``."""
    measured = scenes.measure({name: baselines[name] for name in names})
    if not torch.isfinite(measured).all():
        raise SceneCaptumError(
            f"The metric {scenes.metric.name} is not finite with {len(names)} parameters at their baselines, "
            f"{names[0]!r} first. A logarithm of 0 is the usual cause: add a small constant inside it, or choose "
            "other baselines=."
        )
    return measured


def parameters_of(attribution: SceneAttribution, values: Tensors) -> list[str]:
    """Return the names of an attribution's parameters, the most salient first."""
    names = [row.name for row in attribution.ranking()]
    for name in names:
        if name not in values:
            raise SceneCaptumError(
                f"The attribution contains {name!r}, which is not an input of the renderer."
                f"{near_misses(name, values)} Attribute to parameters, without groups=."
            )
    return names


def _check_sizes(sizes: Sequence[int] | None, count: int) -> tuple[int, ...]:
    if sizes is not None:
        return tuple(whole_number("sizes", size, 1, count - 1) for size in sizes)
    return tuple(sorted({round(size) for size in np.geomspace(1, count - 1, 6).tolist()}))


def _draw_subsets(
    names: Sequence[str], size: int, count: int, generator: np.random.Generator
) -> Sequence[tuple[str, ...]]:
    """Return ``count`` distinct random subsets of ``size`` names, or all subsets if there are no more."""
    if math.comb(len(names), size) <= count:
        return list(itertools.combinations(names, size))
    chosen: dict[tuple[int, ...], None] = {}
    while len(chosen) < count:
        chosen[tuple(sorted(generator.choice(len(names), size, replace=False).tolist()))] = None
    return [tuple(names[index] for index in indices) for indices in chosen]
