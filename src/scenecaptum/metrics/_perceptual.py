"""Distance between two pictures in the features of a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from ..errors import SceneCaptumError, near_misses
from ._frozen import run_frozen
from ._picture import check_exposure, check_reference, check_same_shape, srgb_picture
from ._preprocessing import ResizeCropNormalize, own_preprocessing

# Below this squared length a feature vector fades to zero instead of being blown up to unit length: without it
# the derivative would be NaN where a network says nothing, as on black regions.
_FAINT = 1e-8


class PerceptualDistance(torch.nn.Module):
    """How differently a network sees the picture and a reference: ``Σ_l mean |f̂_l(x) − f̂_l(y)|² / layers``.

    ``f̂_l`` are the features of layer ``l``, scaled to unit length over their channels at each place; the mean
    goes over places. It is 0 with a gradient of 0 where the pictures are the same, and at most 4 (2 for features
    that a ReLU leaves).

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
        Any network. It is run in evaluation mode and left as it is, without gradients in its parameters.
    layers
        Names of its submodules (``named_modules``) whose outputs are compared. By default what the network itself
        returns: a tensor, or several in a list or dict.
    transform
        From an sRGB picture ``(1, 3, H, W)`` in [0, 1] to what the network takes. By default its own
        ``preprocess`` where it has one, otherwise ImageNet's normalisation at the picture's own size.
    exposure
        What radiance is multiplied by before it is clipped at white and encoded as sRGB.

    Raises
    ------
    SceneCaptumError
        Where the backbone has no such layer or, when it is called, returns no features, or the image has another
        size than the reference or values that are negative or not finite.

    References
    ----------
    Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", 2018 (LPIPS). Its
    learnt weights of the channels are left out: every channel counts alike, so that any network will do.
    """

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
        """Return the distance of an ``(H, W, 3)`` image, a 0-d tensor without a unit."""
        check_same_shape(image, self.reference)
        with torch.no_grad():
            expected = self.features(self.reference.to(image))
        distances = [
            (_unit(a) - _unit(b)).square().sum(1).mean()
            for a, b in zip(self.features(image), expected, strict=True)
        ]
        return torch.stack(distances).mean()

    def features(self, image: torch.Tensor) -> list[torch.Tensor]:
        """Return each layer's features of an ``(H, W, 3)`` image, ``(1, channels, …)``."""
        x = self.transform(srgb_picture(image, self.exposure))
        if self.layers is None:
            return _tensors(run_frozen(self.backbone, x))
        kept: dict[str, torch.Tensor] = {}
        hooks = [
            self.backbone.get_submodule(name).register_forward_hook(_keep(kept, name)) for name in self.layers
        ]
        try:
            run_frozen(self.backbone, x)
        finally:
            for hook in hooks:
                hook.remove()
        if missing := [name for name in self.layers if name not in kept]:
            raise SceneCaptumError(
                f"The backbone ran without calling its layer {missing[0]!r}: choose another."
            )
        return [kept[name] for name in self.layers]

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"layers={self.layers}, exposure={self.exposure:g}, reference={tuple(self.reference.shape)}"


def _keep(kept: dict[str, torch.Tensor], name: str) -> Callable[..., None]:
    def hook(_module: torch.nn.Module, _inputs: Any, output: Any) -> None:
        # A copy, because the next layer may be an activation that works in place.
        kept[name] = _tensors(output, name)[0].clone()

    return hook


def _tensors(output: Any, layer: str | None = None) -> list[torch.Tensor]:
    outputs = list(output.values()) if isinstance(output, Mapping) else output
    outputs = [outputs] if isinstance(outputs, torch.Tensor) else outputs
    valid = isinstance(outputs, list | tuple) and all(
        isinstance(o, torch.Tensor) and o.ndim >= 2 and o.is_floating_point() for o in outputs
    )
    if not valid or not outputs:
        whose = "The backbone" if layer is None else f"The backbone's layer {layer!r}"
        raise SceneCaptumError(
            f"{whose} must return features of shape (1, channels, …), or a list of such tensors; it returned "
            f"{_description(output)}. Name the layers to compare with layers=."
        )
    return list(outputs)


def _description(output: Any) -> str:
    if isinstance(output, torch.Tensor):
        return f"{output.dtype} of shape {tuple(output.shape)}"
    return f"a {type(output).__name__}"


def _unit(features: torch.Tensor) -> torch.Tensor:
    return features * torch.rsqrt(features.square().sum(1, keepdim=True) + _FAINT)


def _check_layers(backbone: torch.nn.Module, layers: Sequence[str] | None) -> None:
    known = dict(backbone.named_modules())
    for name in layers or ():
        if name not in known:
            raise SceneCaptumError(
                f"The backbone has no layer {name!r}.{near_misses(name, known)} "
                "dict(backbone.named_modules()) lists them."
            )
    if layers is not None and not layers:
        raise SceneCaptumError("layers is empty: name one layer or more, or leave it out.")
