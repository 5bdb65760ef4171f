"""Perceptual distance between two images: distance between the features of a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from ..errors import SceneCaptumError, near_misses
from ._frozen import run_frozen, run_transform
from ._measure import Measure
from ._noise import ROUGH
from ._picture import check_exposure, check_reference, check_same_shape, srgb_picture
from ._preprocessing import ResizeCropNormalize, own_preprocessing

# Added to squared feature norms: without it the derivative would be NaN for zero features, as on black regions.
_EPSILON = 1e-8


class PerceptualDistance(torch.nn.Module):
    """Distance between an image and a reference in feature space: ``Σ_l mean |f̂_l(x) − f̂_l(y)|² / layers``.

    ``f̂_l`` are the features of layer ``l``, normalized over the channels at each position; the mean is over
    positions. The distance and its gradient are 0 for identical images; the maximum is 4 (2 for non-negative
    features, such as after a ReLU).

    Example
    -------
    >>> backbone = torch.nn.Conv2d(3, 8, 3)
    >>> reference = torch.rand(16, 16, 3)
    >>> PerceptualDistance(reference, backbone)(reference)
    tensor(0.)

    Parameters
    ----------
    reference
        ``(H, W, 3)`` linear radiance.
    backbone
        Any network. It runs in evaluation mode and is not modified; its parameters get no gradients.
    layers
        Names of the submodules (``named_modules``) whose outputs are compared. By default the output of the
        network: a tensor, or several in a list or dict.
    transform
        Preprocessing from an sRGB picture ``(1, 3, H, W)`` in [0, 1] to the network's input. By default its own
        ``preprocess`` if it has one, otherwise ImageNet's normalization without resizing.
    exposure
        Factor on radiance before it is clipped at white and encoded as sRGB.

    Raises
    ------
    SceneCaptumError
        If the backbone has no such layer or, from ``forward``, returns no features, or the image does not have the
        size of the reference or has values that are negative or not finite.

    References
    ----------
    Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", 2018 (LPIPS), without
    learnt channel weights, so that any network can be used.
    """

    measure = Measure("perceptual distance", better="lower")
    gradient_note = ROUGH
    reference: torch.Tensor

    def __init__(
        self,
        reference: torch.Tensor,
        backbone: torch.nn.Module,
        layers: Sequence[str] | None = None,
        *,
        transform: Callable[[torch.Tensor], torch.Tensor] | None = None,
        exposure: float = 1.0,
    ) -> None:
        super().__init__()
        layers = [layers] if isinstance(layers, str) else layers
        _check_layers(backbone, layers)
        self.layers = None if layers is None else tuple(layers)
        self.exposure = check_exposure(exposure)
        self.transform = transform or own_preprocessing(backbone, ResizeCropNormalize(resize=None, crop=None))
        self.backbone = backbone
        self.register_buffer("reference", check_reference(reference))

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the distance of an ``(H, W, 3)`` image to the reference, a 0-d dimensionless tensor."""
        check_same_shape(image, self.reference)
        with torch.no_grad():
            expected = self.features(self.reference.to(image))
        distances = [
            (_normalize(a) - _normalize(b)).square().sum(1).mean()
            for a, b in zip(self.features(image), expected, strict=True)
        ]
        return torch.stack(distances).mean()

    def features(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Return each layer's features of an ``(H, W, 3)`` image, ``(1, channels, …)``."""
        x = run_transform(self.transform, srgb_picture(image, self.exposure))
        if self.layers is None:
            return _check_features(run_frozen(self.backbone, x))
        features: dict[str, torch.Tensor] = {}
        hooks = [
            self.backbone.get_submodule(name).register_forward_hook(_store(features, name))
            for name in self.layers
        ]
        try:
            run_frozen(self.backbone, x)
        finally:
            for hook in hooks:
                hook.remove()
        if missing := [name for name in self.layers if name not in features]:
            raise SceneCaptumError(f"The backbone did not call its layer {missing[0]!r}: choose another.")
        return [features[name] for name in self.layers]

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"layers={self.layers}, exposure={self.exposure:g}, reference={tuple(self.reference.shape)}"


def _store(features: dict[str, torch.Tensor], name: str) -> Callable[..., None]:
    def hook(_module: torch.nn.Module, _inputs: Any, output: Any) -> None:
        # A copy, because the next layer may be an in-place activation.
        features[name] = _check_features(output, name)[0].clone()

    return hook


def _check_features(output: Any, layer: str | None = None) -> list[torch.Tensor]:
    """Return the output of a network or layer as a list of tensors; raise if it is not one."""
    outputs = list(output.values()) if isinstance(output, Mapping) else output
    outputs = [outputs] if isinstance(outputs, torch.Tensor) else outputs
    valid = isinstance(outputs, list | tuple) and all(
        isinstance(o, torch.Tensor) and o.ndim >= 2 and o.is_floating_point() for o in outputs
    )
    if not valid or not outputs:
        source = "The backbone" if layer is None else f"The backbone's layer {layer!r}"
        raise SceneCaptumError(
            f"{source} must return features of shape (1, channels, …), or a list of such tensors; it returned "
            f"{_description(output)}. Name the layers to compare with layers=."
        )
    return list(outputs)


def _description(output: Any) -> str:
    if isinstance(output, torch.Tensor):
        return f"{output.dtype} of shape {tuple(output.shape)}"
    return f"a {type(output).__name__}"


def _normalize(features: torch.Tensor) -> torch.Tensor:
    return features * torch.rsqrt(features.square().sum(1, keepdim=True) + _EPSILON)


def _check_layers(backbone: torch.nn.Module, layers: Sequence[str] | None) -> None:
    known = dict(backbone.named_modules())
    for name in layers or ():
        if name not in known:
            raise SceneCaptumError(
                f"The backbone has no layer {name!r}.{near_misses(name, known)} "
                "dict(backbone.named_modules()) lists them."
            )
    if layers is not None and not layers:
        raise SceneCaptumError("layers is empty: give at least one layer, or leave it out.")
