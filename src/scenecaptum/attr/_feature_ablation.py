"""Feature ablation: the effect of setting each part of the scene to its baseline."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from functools import partial
from typing import NamedTuple

import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError
from ..estimation import DEFAULT_REPLICATES, Denoise, channel_totals, input_values
from ..protocols import ResultKind
from ._baseline_words import describe_baselines
from ._baselines import Baselines, Values, resolve_baselines
from ._groups import Groups, resolve_groups
from ._method import Result, Settings, Targets
from ._perturbation import Arm, Effect, Effects, Perturbation, measured_drops


class FeatureAblationScene(Perturbation):
    """The effect of each feature: the metric of the scene minus the metric with the feature at its baseline.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="all", resolution=(16, 16), spp=16)
    >>> ablation = FeatureAblationScene(renderer, metrics.MeanLuminance())
    >>> attribution = ablation.attribute(baselines="dark", groups="material", seed=0)
    >>> abs(attribution["light"].item() - attribution.metric_value) < 1e-3  # no light, no luminance
    True

    Without ``groups`` a feature is an element of a scalar, vector or matrix, or a whole channel of a texture or
    grid, whose effect is distributed evenly over its texels, so that the channel's total is the effect. With
    ``groups`` all parameters of a group are ablated together, and the result has one number per group.

    Parameters
    ----------
    renderer
        A ``SceneRenderer``, or any callable ``renderer(inputs, *, seed, spp)`` that returns an image.
    metric
        A torch function from the image to a scalar, or to a vector indexed by ``target``; it need not be
        differentiable.

    References
    ----------
    Zeiler and Fergus, "Visualizing and Understanding Convolutional Networks", ECCV 2014.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        *,
        target: Targets = None,
        baselines: Baselines = None,
        groups: Groups = None,
        seed: int = 0,
        spp: int | None = None,
        replicates: int = DEFAULT_REPLICATES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        executor: Executor | None = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to each feature.

        Parameters
        ----------
        inputs, target, checkpoint, executor, show_progress
            As for ``VanillaSceneGradient``.
        denoise
            As for ``VanillaSceneGradient``, but ``"auto"`` denoises only if this changes the metric by more than
            its noise: most of the noise of two scenes cancels in their difference, and the denoiser brings a part
            of it back.
        baselines
            Values of ablated features: None (emitters and reflectances 0, everything else unchanged), ``"dark"``,
            ``"black"``, ``"grey"``, a number, a mapping by name, glob or kind, or another renderer. Inputs that a
            mapping does not name take the default; ``{**renderer.inputs, "floor.reflectance.value": 0.2}`` leaves
            them unchanged. ``info["baselines"]`` has what each input was compared with.
        groups
            ``"kind"``, ``"material"``, ``"object"``, or a mapping from a group's name to the names or globs of its
            members; parameters in no group are ablated one by one.
        seed
            Random seed. All scenes are rendered with common random numbers.
        spp
            Total samples per pixel over the unchanged scene and all changed ones; the renderer's by default. They
            are split evenly over scenes and replicates, rounded up to at least one each.
        replicates
            Number of independent replicates, whose variance gives the standard errors. With 1 there are no errors,
            and no correction of the bias that image noise causes in a non-linear metric.

        Returns
        -------
        SceneAttribution
            Signed effects in units of the metric, shaped like the parameters, or 0-d by group with the members in
            ``info["groups"]``. A feature that is already at its baseline has effect 0 and is not rendered.

        Raises
        ------
        SceneCaptumError
            If baselines or groups do not fit the parameters, every feature is already at its baseline, or the
            metric is not a finite scalar.
        AttributionInterrupted
            On Ctrl-C after all features of at least one parameter, with the result for these.
        """
        values = input_values(self.renderer, inputs)
        absent = resolve_baselines(self.renderer, values, baselines)
        members = None if groups is None else resolve_groups(self.renderer, values, groups)
        features = _elements(values, absent) if members is None else _whole(values, absent, members)
        if not features:
            raise SceneCaptumError(
                f"There is nothing to ablate: all {len(values)} inputs are already at their baselines. Give other "
                "baselines=, such as a number or a mapping by name."
            )
        arms = [Arm("the unchanged scene", lambda: values)]
        arms += [Arm(feature.description, partial(_ablate, feature, values, absent)) for feature in features]
        settings = Settings(
            seed, spp, replicates, show_progress, checkpoint=checkpoint, denoise=denoise, executor=executor
        )
        measured = self._measure(arms, target, settings)
        templates = dict(values) if members is None else {group: torch.zeros(()) for group in members}
        parts = [(feature.owner, feature.channel or 0) for feature in features]
        sizes = {owner: channel_totals(template).numel() for owner, template in templates.items()}

        def effects_of(per_replicate: torch.Tensor) -> tuple[Effects, None]:
            drops = measured_drops(per_replicate, parts, sizes)
            return {owner: Effect.of_totals(own, templates[owner]) for owner, own in drops.items()}, None

        info = describe_baselines(self.renderer, values, baselines, absent)
        if members is not None:
            info["groups"] = {group: list(names) for group, names in members.items()}
        return self._results(measured, target, effects_of, quantity=ResultKind.ABLATION, **info)


class _Feature(NamedTuple):
    """A channel of a parameter, or whole parameters (channel None), that are ablated together."""

    owner: str
    names: tuple[str, ...]
    channel: int | None

    @property
    def description(self) -> str:
        element = "" if self.channel is None else f"[{self.channel}]"
        return f"the scene with {self.owner!r}{element} at its baseline"


def _elements(values: Values, absent: Values) -> list[_Feature]:
    return [
        _Feature(name, (name,), channel)
        for name, value in values.items()
        for channel in range(channel_totals(value).numel())
        if not torch.equal(_channel(value, channel), _channel(absent[name], channel))
    ]


def _whole(values: Values, absent: Values, members: Mapping[str, tuple[str, ...]]) -> list[_Feature]:
    return [
        _Feature(group, names, None)
        for group, names in members.items()
        if any(not torch.equal(values[name], absent[name]) for name in names)
    ]


def _channel(tensor: torch.Tensor, channel: int) -> torch.Tensor:
    """Return a view of one channel of a texture, or of one element of a scalar or vector."""
    return tensor.reshape(-1)[channel] if tensor.ndim < 2 else tensor[..., channel]


def _ablate(feature: _Feature, values: Values, absent: Values) -> dict[str, torch.Tensor]:
    if feature.channel is None:
        return {**values, **{name: absent[name] for name in feature.names}}
    (name,) = feature.names
    changed = values[name].clone(memory_format=torch.contiguous_format)
    _channel(changed, feature.channel).copy_(_channel(absent[name], feature.channel))
    return {**values, name: changed}
