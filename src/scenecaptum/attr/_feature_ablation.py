"""Feature ablation: what each part of the scene is worth when it alone is taken away."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import NamedTuple

import torch

from ..checkpoint import Folder
from ..errors import SceneCaptumError
from ._baselines import Baselines, Values, resolve_baselines
from ._gradients import input_values
from ._groups import Groups, resolve_groups
from ._method import Result, Settings, Targets
from ._passes import DEFAULT_PASSES, channel_totals
from ._perturbation import Arm, Effect, Effects, Perturbation
from ._view import Denoise


class FeatureAblationScene(Perturbation):
    """The effect of each feature: the metric of the scene minus that with the feature at its baseline.

    Example
    -------
    >>> from scenecaptum import SceneRenderer, metrics
    >>> renderer = SceneRenderer("cornell-box", inputs="all", resolution=(16, 16), spp=16)
    >>> ablation = FeatureAblationScene(renderer, metrics.MeanLuminance())
    >>> attribution = ablation.attribute(baselines="dark", groups="material", seed=0)
    >>> abs(attribution["light"].item() - attribution.metric_value) < 1e-6  # no light, no luminance
    True

    Without ``groups`` a feature is an element of a scalar, vector or matrix, and a whole channel of a texture or
    grid, whose effect is spread evenly over its texels, so that the channel's total is the effect. With
    ``groups`` all parameters of a group are taken away together, and the result has a number for each group.

    Parameters
    ----------
    renderer
        A ``SceneRenderer``, or any callable ``renderer(inputs, *, seed, spp)`` that returns an image.
    metric
        A torch function from the image to a scalar, or to a vector of which ``target`` names elements; it need not
        be differentiable.

    References
    ----------
    Zeiler and Fergus, "Visualizing and Understanding Convolutional Networks", ECCV 2014.
    """

    def attribute(  # noqa: PLR0913 -- those of every method, and its own
        self,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Targets = None,
        *,
        baselines: Baselines = None,
        groups: Groups = None,
        seed: int = 0,
        spp: int | None = None,
        replicates: int = DEFAULT_PASSES,
        denoise: Denoise = "auto",
        checkpoint: Folder = None,
        show_progress: bool = False,
    ) -> Result:
        """Attribute the metric to each feature.

        Parameters
        ----------
        inputs
            Values by parameter name; the renderer's own by default.
        target
            Which element of the metric's output is meant, where it is not a scalar; a list of them gives a list of
            results from the same renders.
        baselines
            What a feature is set to when it is taken away: None (lights and reflectances 0, everything else as it
            is), ``"dark"``, ``"black"``, ``"grey"``, a number, a mapping by name, glob or kind, or another
            renderer.
        groups
            ``"kind"``, ``"material"``, ``"object"``, or a mapping from a group's name to the names or globs of its
            members; what is in no group is taken away alone.
        seed
            Seed from which those of all replicates are drawn; the same for the scene with and without a feature.
        spp
            Total samples per pixel over the unchanged scene and all changed ones, the renderer's by default: each
            scene gets its share, rounded up, split over the replicates, and each replicate at least one sample.
        replicates
            Number of independent seeds. Their spread gives the standard errors; with 1 there are none, and no
            correction of the bias that a noisy image puts into a non-linear metric.
        denoise
            Whether a metric that is not linear sees denoised pictures (Open Image Denoise). ``"auto"`` measures on
            two halves of the samples whether that brings them nearer to the truth; ``info["picture"]`` says what
            was done.
        checkpoint
            A folder that keeps every finished pass: a job that was killed goes on from there when it is started
            again with the same arguments. ``info["checkpoint"]`` counts the passes that came from it.
        show_progress
            Whether to show a progress bar.

        Returns
        -------
        SceneAttribution
            Signed effects in units of the metric, shaped like the parameters, or 0-d by group with the members in
            ``info["groups"]``. A feature that is at its baseline already has effect 0, and costs no render.

        Raises
        ------
        SceneCaptumError
            Where baselines or groups do not fit the parameters, every feature is at its baseline already, or the
            metric is not a finite scalar.
        AttributionInterrupted
            On Ctrl-C after all features of one parameter or more, with the result for these.
        """
        values = input_values(self.renderer, inputs)
        absent = resolve_baselines(self.renderer, values, baselines)
        members = None if groups is None else resolve_groups(self.renderer, values, groups)
        features = _elements(values, absent) if members is None else _whole(values, absent, members)
        if not features:
            raise SceneCaptumError(
                f"There is nothing to ablate: all {len(values)} inputs are at their baselines already. Give "
                "others with baselines=, a number or a mapping by name, say."
            )
        arms = [Arm("the unchanged scene", lambda: values)]
        arms += [Arm(one.what, partial(_without, one, values, absent)) for one in features]
        measured = self._measure(
            arms,
            target,
            Settings(seed, spp, replicates, show_progress, checkpoint=checkpoint, denoise=denoise),
        )
        likes = dict(values) if members is None else {group: torch.zeros(()) for group in members}

        def effects_of(pseudo: torch.Tensor) -> tuple[Effects, None]:
            return _effects(pseudo, features, likes), None

        info = {"quantity": "effect of ablation"}
        grouped = {} if members is None else {"groups": {g: list(names) for g, names in members.items()}}
        return self._results(measured, target, effects_of, **info, **grouped)


class _Feature(NamedTuple):
    """What is taken away together: the channel of a parameter, or whole parameters (channel None)."""

    owner: str
    names: tuple[str, ...]
    channel: int | None

    @property
    def what(self) -> str:
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
    """Return a view of one channel at all places of a texture, or of one element of a scalar or vector."""
    return tensor.reshape(-1)[channel] if tensor.ndim < 2 else tensor[..., channel]


def _without(feature: _Feature, values: Values, absent: Values) -> dict[str, torch.Tensor]:
    if feature.channel is None:
        return {**values, **{name: absent[name] for name in feature.names}}
    (name,) = feature.names
    changed = values[name].clone(memory_format=torch.contiguous_format)
    _channel(changed, feature.channel).copy_(_channel(absent[name], feature.channel))
    return {**values, name: changed}


def _effects(pseudo: torch.Tensor, features: list[_Feature], likes: Values) -> Effects:
    """Return the effect of every parameter or group whose features have all been measured."""
    effects: Effects = {}
    done = len(pseudo) - 1
    for owner, like in likes.items():
        own = [(index, one.channel or 0) for index, one in enumerate(features) if one.owner == owner]
        if any(index >= done for index, _ in own):
            continue
        totals = pseudo.new_zeros(pseudo.shape[1], channel_totals(like).numel())
        for index, channel in own:
            totals[:, channel] = pseudo[0] - pseudo[1 + index]
        effects[owner] = Effect.of_totals(totals, like)
    return effects
