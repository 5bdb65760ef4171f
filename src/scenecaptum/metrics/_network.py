"""What all metrics of a network's output share: the picture, a call without side effects, and smoothing."""

from __future__ import annotations

import copy
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, TypeAlias, TypeVar

import torch

from ..errors import SceneCaptumError
from ..images import check_image_shape
from ..training_mode import warn_of_training_mode
from ._frozen import run_frozen, run_transform
from ._measure import Measure
from ._noise import PLAIN_TOLERANCE, ROUGH, PictureNoise, smoothed_measure
from ._picture import check_exposure, srgb_picture
from ._preprocessing import ResizeCropNormalize, own_preprocessing

Model: TypeAlias = Callable[[torch.Tensor], Any]
Transform: TypeAlias = Callable[[torch.Tensor], torch.Tensor]

_MUCH_LARGER = 2  # times the shorter side

M = TypeVar("M", bound="NetworkMetric")


class NetworkMetric(torch.nn.Module, ABC):
    """A metric of ``model(transform(sRGB(exposure · L)))``, or its mean over noise of the picture.

    A subclass defines ``of_batch``, from images ``(N, H, W, 3)`` to one value, or one vector, for each.
    """

    def __init__(
        self,
        model: Model,
        transform: Transform | None,
        default_transform: torch.nn.Module,
        exposure: float,
        smoothing: float | None,
    ) -> None:
        super().__init__()
        if not callable(model):
            raise SceneCaptumError(_not_a_network(model))
        self.exposure = check_exposure(exposure)
        self.transform = transform or own_preprocessing(model, default_transform)
        self._is_default = self.transform is default_transform
        if not isinstance(model, torch.nn.Module):  # a module runs in evaluation mode
            warn_of_training_mode(model)
        self.model = model
        self.noise = None if smoothing is None else PictureNoise.create(smoothing)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        """Return the value of an ``(H, W, 3)`` image, a 0-d tensor, or its vector of values."""
        check_image_shape(image)
        return self.of_batch(image[None])[0] if self.noise is None else self.noise.mean(self.of_batch, image)

    @abstractmethod
    def of_batch(self, images: torch.Tensor) -> torch.Tensor:
        """Return the values of images ``(N, H, W, 3)`` without smoothing."""

    @property
    def n_draws(self) -> int:
        """Number of draws of noise over which the value is averaged, 0 without smoothing."""
        return 0 if self.noise is None else self.noise.n

    def with_draws(self: M, draws: Mapping[int, int]) -> M:
        """Return the same metric with other draws of noise: a number of them for each seed, rounded up to even."""
        other = copy.copy(self)
        other.noise = None if self.noise is None else self.noise.with_draws(draws)
        return other

    @property
    def gradient_note(self) -> str | None:
        """What the effects and errors of an attribution are of; None if it is smoothed."""
        return ROUGH if self.noise is None else None

    @property
    def tolerated_noise(self) -> float | None:
        """Relative noise of the pixels above which it biases the value; None if it is not known."""
        return PLAIN_TOLERANCE if self.noise is None else self.noise.tolerated

    @property
    def advice(self) -> str | None:
        """What helps if the errors of an attribution are large."""
        if self.noise is not None:
            return None
        return (
            "the gradient of a network at a noisy image is rough; with smoothing 0.3, an option of the metric, it "
            "has smaller errors"
        )

    def pictures(self, images: torch.Tensor) -> torch.Tensor:
        """Return what the network gets for images ``(N, H, W, 3)``."""
        if self._is_default and isinstance(self.transform, ResizeCropNormalize):
            _warn_of_enlarging(self.transform, *images.shape[1:3])
        return run_transform(self.transform, srgb_picture(images, self.exposure))

    def output(self, images: torch.Tensor) -> Any:
        """Return what the network returns for images ``(N, H, W, 3)``."""
        return run_frozen(self.model, self.pictures(images))

    def named_measure(self, name: str, **details: Any) -> Measure:
        """Return a measure with this name, which says whether it is smoothed."""
        measure = Measure(name, **details)
        return measure if self.noise is None else smoothed_measure(measure)

    def settings(self) -> str:
        """Return the settings of every network metric for ``extra_repr``."""
        smoothing = "" if self.noise is None else f", smoothing={self.noise.sigma:g}"
        return f"exposure={self.exposure:g}{smoothing}"


def describe_output(output: Any) -> str:
    """Return what a network returned, in words: a shape, or the keys of a dict."""
    if isinstance(output, torch.Tensor):
        return f"shape {tuple(output.shape)}"
    kind = type(output).__name__
    article = "an" if kind[0] in "AEIOUaeiou" else "a"
    if isinstance(output, Mapping):
        return f"{article} {kind} with {', '.join(map(repr, output)) or 'nothing'}"
    return f"{article} {kind} of {len(output)}" if isinstance(output, list | tuple) else f"{article} {kind}"


def wrap_it(output: Any, ndim: int, wanted: str, default: str) -> str:
    """Return how to pass a network whose output contains a tensor ``wanted`` of ``ndim`` dimensions.

    ``default`` is the attribute for an output that is neither a dict nor a sequence, such as ``"logits"``.
    """
    found = output if isinstance(output, Mapping) else dict(enumerate(output)) if _is_sequence(output) else {}
    fits = [key for key, value in found.items() if isinstance(value, torch.Tensor) and value.ndim == ndim]
    key = next(iter([*fits, *found]), None)
    access = f".{default}" if key is None else f"[{key!r}]"
    return (
        f"Pass a torch.nn.Module that returns {wanted}, with return self.model(x){access} in its forward: it runs "
        "in evaluation mode. In a function, the model would run in its own mode."
    )


def _is_sequence(output: Any) -> bool:
    return isinstance(output, list | tuple)


def _not_a_network(model: object) -> str:
    is_state = isinstance(model, Mapping) and any(isinstance(one, torch.Tensor) for one in model.values())
    fix = (
        "It is a state dict: construct the network, and load it with network.load_state_dict(…)."
        if is_state
        else "Give a torch.nn.Module."
    )
    return f"model must be a network or a function of pictures, not {type(model).__name__}. {fix}"


def _warn_of_enlarging(transform: ResizeCropNormalize, height: int, width: int) -> None:
    """Warn if a transform that nobody chose enlarges pictures much: the network may be made for small ones."""
    if transform.resize is not None and transform.resize > _MUCH_LARGER * min(height, width):
        warnings.warn(
            f"Pictures of {width}×{height} pixels are enlarged until their shorter side has {transform.resize}, "
            "as for ImageNet: the default without transform=. For a network of small pictures give transform=, "
            "such as ResizeCropNormalize(72, 64) or lambda picture: picture; to keep this, ResizeCropNormalize().",
            stacklevel=3,
        )
