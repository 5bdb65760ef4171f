"""Score of a segmentation network on the pixels of an object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias, get_args

import torch

from ..errors import SceneCaptumError
from ..visualization import rounded
from ._checks import cast_like
from ._classes import (
    check_class,
    check_names,
    class_index,
    class_name,
    class_names,
    from_start,
    named_class,
    warn_of_probabilities,
)
from ._mask import check_mask, check_mask_fits, mask_in_input
from ._measure import Measure
from ._network import Model, NetworkMetric, Transform, describe_output, wrap_it
from ._noise import without_smoothing
from ._preprocessing import ResizeCropNormalize

Score: TypeAlias = Literal["logit", "log_probability"]


class SegmentationScore(NetworkMetric):
    """Mean logit of a class over the pixels of an object: ``Σ m · model(transform(picture))[target] / Σ m``.

    Example
    -------
    >>> network = torch.nn.Conv2d(3, 21, 3, padding=1)
    >>> mask = torch.zeros(48, 64)
    >>> mask[10:30, 20:40] = 1
    >>> SegmentationScore(network, target=9, mask=mask, smoothing=0.3)(torch.rand(48, 64, 3)).shape
    torch.Size([])

    Parameters
    ----------
    model
        Any network from ``(N, 3, h, w)`` to logits ``(N, classes, h', w')``, or to a dict with these under
        ``"out"``, as torchvision's. It runs in evaluation mode and is not modified.
    target
        Index of the class, or its name in ``classes``. None: the vector of all classes, which
        ``attribute(target=)`` indexes.
    mask
        ``(H, W)``, the object's fraction of each pixel of the image: ``renderer.mask("chair*")``.
    transform
        Differentiable preprocessing from an sRGB picture ``(1, 3, H, W)`` in [0, 1] to the model's input; for a
        torchvision model ``weights.transforms()``. It may resize, crop, flip, pad and normalize; the mask passes
        through it, too. By default the model's own ``preprocess`` if it has one, otherwise ImageNet's
        normalization without resizing.
    score
        ``"logit"``, or ``"log_probability"``, which compares with the other classes at each pixel.
    exposure, classes, smoothing
        As in ``ClassLogit``.

    Raises
    ------
    SceneCaptumError
        If the target is not one of the classes, the mask is empty, or ``score`` is unknown. From ``forward``, if
        the mask does not have the size of the image, the transform crops it away, or the model does not return
        ``(N, classes, h', w')``.

    Notes
    -----
    If the logits have another resolution than the network's input, the mask is averaged over their pixels.
    """

    mask: torch.Tensor

    def __init__(
        self,
        model: Model,
        target: int | str | None,
        mask: torch.Tensor,
        transform: Transform | None = None,
        *,
        score: Score = "logit",
        exposure: float = 1.0,
        classes: Sequence[str] | None = None,
        smoothing: float | None = None,
    ) -> None:
        default = ResizeCropNormalize(resize=None, crop=None)
        super().__init__(model, transform, default, exposure, smoothing)
        if score not in get_args(Score):
            raise SceneCaptumError(f"score must be 'logit' or 'log_probability', not {score!r}.")
        self.score = score
        self.classes = class_names(model, classes)
        self.target = None if target is None else class_index(target, self.classes)
        self.n_classes = len(self.classes)  # 0 until the network has been called, if they have no names
        self.register_buffer("mask", check_mask(mask))

    def of_batch(self, images: torch.Tensor) -> torch.Tensor:
        """Return the scores of images ``(N, H, W, 3)`` without smoothing: ``(N,)``, or ``(N, classes)``."""
        check_mask_fits(self.mask.shape, images)
        logits = self.logits(images)
        scores = logits if self.score == "logit" else logits.log_softmax(1)
        weight = self._weight(images, logits)
        means = (scores * weight).sum((2, 3)) / weight.sum()
        if self.target is None:
            return means
        check_class(self.target, means.shape[1], self.model)
        return means[:, self.target]

    def logits(self, images: torch.Tensor) -> torch.Tensor:
        """Return the logits of every pixel of images ``(N, H, W, 3)``, ``(N, classes, h', w')``."""
        output = self.output(images)
        logits = output.get("out") if isinstance(output, Mapping) else output
        if not isinstance(logits, torch.Tensor) or logits.ndim != 4 or len(logits) != len(images):
            name = type(self.model).__name__
            raise SceneCaptumError(
                "A segmentation network must return logits of shape (N, classes, h, w), or a dict with them as "
                f"'out'; {name} returned {describe_output(output)}. {wrap_it(output, 4, 'them', 'logits')}"
            )
        check_names(self.classes, logits.shape[1], self.model)
        warn_of_probabilities(logits, self.model)
        self.n_classes = logits.shape[1]
        return cast_like(logits, images)

    def _weight(self, images: torch.Tensor, logits: torch.Tensor) -> torch.Tensor:
        """Return the mask at the pixels of the logits, ``(1, 1, h', w')``."""
        weight = mask_in_input(self.mask, self.transform, images)[None, None].to(logits)
        if weight.shape[2:] == logits.shape[2:]:
            return weight
        return torch.nn.functional.interpolate(weight, logits.shape[2:], mode="area")

    def target_index(self, name: str) -> int:
        """Return the element of the output for a class, by its name in ``classes``; raise if there is none."""
        return class_index(name, self.classes)

    def measure_of(self, target: int | tuple[int, ...] | None) -> Measure:
        """Return what an element of the output measures."""
        index = from_start(target[0] if isinstance(target, tuple) else target, self.n_classes)
        score = self.score.replace("_", " ")
        return self.named_measure(f"mean {score} of {class_name(index, self.classes)} on the mask")

    @property
    def measure(self) -> Measure:
        """Name of the score."""
        return self.measure_of(self.target)

    def verdict(self, image: torch.Tensor, target: int | tuple[int, ...] | None = None) -> str:
        """Return which share of the mask has the class as its most likely one, and the most frequent other.

        ``image`` is an ``(H, W, 3)`` linear-radiance image, ``target`` the class if the metric has none itself.
        """
        index = self.target if self.target is not None else target[0] if isinstance(target, tuple) else target
        if index is None:
            return ""
        with torch.no_grad():
            logits, value = self.logits(image[None]), self.of_batch(image[None])[0]
            weight = self._weight(image[None], logits)
        index = index % logits.shape[1]  # an index from the end is negative
        shares = torch.bincount(
            logits.argmax(1).flatten(), weight.flatten().double(), minlength=logits.shape[1]
        )
        shares /= shares.sum()
        text = f"{rounded(shares[index].item(), 2)} of the mask is {class_name(index, self.classes)}"
        best = int(shares.argmax())
        if best != index:
            text += f"; {rounded(shares[best].item(), 2)} is {class_name(best, self.classes)}"
        value = value if self.target is not None else value[index]
        return text if self.noise is None else without_smoothing(value.item(), text)

    def extra_repr(self) -> str:
        """Show the class and the settings."""
        target = named_class(self.target, self.classes)
        return f"target={target}, score={self.score!r}, mask={tuple(self.mask.shape)}, {self.settings()}"
