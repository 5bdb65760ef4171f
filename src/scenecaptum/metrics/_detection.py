"""Score of an object detector for a class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch

from ..errors import SceneCaptumError
from ..visualization import pluralize, rounded
from ._checks import cast_like
from ._classes import class_index, class_name, class_names, named_class
from ._frozen import run_frozen
from ._mask import check_mask, check_mask_fits
from ._measure import Measure
from ._network import Model, NetworkMetric, Transform
from ._noise import without_smoothing


class _Found(NamedTuple):
    """The detections of the class in one picture: their scores and their overlaps with the box, both ``(K,)``."""

    scores: torch.Tensor
    overlaps: torch.Tensor


class DetectionScore(NetworkMetric):
    """Best score of an object detector for a class, ``max_k score_k · IoU(box_k, box)`` over its detections.

    Example
    -------
    >>> def detector(pictures):  # finds one object of class 1, with the brightness of the picture as its score
    ...     box, label = torch.tensor([[10.0, 20.0, 30.0, 40.0]]), torch.tensor([1])
    ...     return [{"boxes": box, "labels": label, "scores": p.mean()[None]} for p in pictures]
    >>> anywhere, there = DetectionScore(detector, 1), DetectionScore(detector, 1, box=(10, 20, 30, 60))
    >>> [round(metric(torch.ones(48, 64, 3)).item(), 3) for metric in (anywhere, there)]
    [1.0, 0.5]

    Parameters
    ----------
    model
        A detector with torchvision's interface: from a list of pictures ``(3, h, w)`` in [0, 1] to a list of dicts
        with ``boxes`` ``(K, 4)``, ``labels`` ``(K,)`` and ``scores`` ``(K,)``. It runs in evaluation mode and is
        not modified.
    target
        Label of the class, or its name in ``classes``; torchvision's names are ``weights.meta["categories"]``.
    box
        Where the object is: ``(left, top, right, bottom)`` in pixels of the image, or its mask ``(H, W)``, such as
        ``renderer.mask("chair*")``, for the smallest box around it. Scores are multiplied by the overlap of their
        box with it, intersection over union. None: detections anywhere.
    transform
        Differentiable preprocessing of sRGB pictures ``(N, 3, H, W)`` in [0, 1] that shows the whole image: it may
        resize, but not crop. None by default: torchvision's detectors resize and normalize by themselves.
    exposure, classes, smoothing
        As in ``ClassLogit``.

    Raises
    ------
    SceneCaptumError
        If the target is not one of the classes, or the box is empty. From ``forward``, if the model does not
        return detections, or a mask does not have the size of the image.

    Notes
    -----
    Without a detection of the class the score is 0, and so is its gradient. Detectors drop detections below a
    threshold and those that overlap with better ones, so that the score can jump; lower the threshold
    (torchvision's ``box_score_thresh`` or ``score_thresh``) to differentiate scores of objects that are hardly
    seen, and use ``smoothing``. A score is a probability, which saturates: see ``ClassProbability``.
    """

    box: torch.Tensor | None

    def __init__(
        self,
        model: Model,
        target: int | str,
        box: Sequence[float] | torch.Tensor | None = None,
        transform: Transform | None = None,
        *,
        exposure: float = 1.0,
        classes: Sequence[str] | None = None,
        smoothing: float | None = None,
    ) -> None:
        super().__init__(model, transform, torch.nn.Identity(), exposure, smoothing)
        self.classes = class_names(model, classes)
        self.target = class_index(target, self.classes)
        self._mask_shape = tuple(box.shape) if isinstance(box, torch.Tensor) and box.ndim == 2 else None
        self.register_buffer("box", None if box is None else _as_box(box))

    def of_batch(self, images: torch.Tensor) -> torch.Tensor:
        """Return the best scores of images ``(N, H, W, 3)`` without smoothing, ``(N,)``."""
        best = [torch.cat([s * o, s.new_zeros(1)]).max() for s, o in self._detect(images)]
        # Without a detection, too, the value is a function of the image: a constant one.
        return torch.stack(best) + 0 * images.sum((1, 2, 3))

    def _detect(self, images: torch.Tensor) -> list[_Found]:
        """Return what the detector finds of the class in each of the images ``(N, H, W, 3)``."""
        if self._mask_shape is not None:
            check_mask_fits(self._mask_shape, images)
        pictures = self.pictures(images)
        outputs = run_frozen(self.model, list(pictures))
        if not isinstance(outputs, list | tuple) or len(outputs) != len(images):
            raise SceneCaptumError(_not_detections(self.model, outputs))
        height, width = (new / old for new, old in zip(pictures.shape[2:], images.shape[1:3], strict=True))
        box = None if self.box is None else self.box.to(images) * images.new_tensor([width, height] * 2)
        return [self._of_class(output, box, images) for output in outputs]

    def _of_class(self, output: Any, box: torch.Tensor | None, images: torch.Tensor) -> _Found:
        names = ("boxes", "labels", "scores")
        if not isinstance(output, Mapping) or any(not isinstance(output.get(n), torch.Tensor) for n in names):
            raise SceneCaptumError(_not_detections(self.model, [output]))
        chosen = output["labels"] == self.target
        scores, boxes = (cast_like(output[name][chosen], images) for name in ("scores", "boxes"))
        return _Found(scores, torch.ones_like(scores) if box is None else _overlap(boxes, box))

    @property
    def measure(self) -> Measure:
        """Name of the score."""
        where = "" if self.box is None else " in the box"
        return self.named_measure(f"detection score of {class_name(self.target, self.classes)}{where}")

    def verdict(self, image: torch.Tensor, target: None = None) -> str:
        """Return the number of detections of the class in an ``(H, W, 3)`` ``image``, and the best of them.

        The metric has no elements that ``target`` could select.
        """
        with torch.no_grad():
            [found] = self._detect(image[None])
        text = f"{pluralize(len(found.scores), 'detection')} of {class_name(self.target, self.classes)}"
        value = 0.0
        if len(found.scores):
            products = found.scores * found.overlaps
            best = int(products.argmax())
            value = products[best].item()
            text += f", the best with score {rounded(found.scores[best].item(), 2)}"
            if self.box is not None:
                text += f" and overlap {rounded(found.overlaps[best].item(), 2)}"
        return text if self.noise is None else without_smoothing(value, text)

    def extra_repr(self) -> str:
        """Show the class, the box and the settings."""
        box = None if self.box is None else tuple(self.box.tolist())
        return f"target={named_class(self.target, self.classes)}, box={box}, {self.settings()}"


def _overlap(boxes: torch.Tensor, box: torch.Tensor) -> torch.Tensor:
    """Return the intersection over union of boxes ``(K, 4)`` with a box ``(4,)``, ``(K,)``."""
    low, high = torch.maximum(boxes[:, :2], box[:2]), torch.minimum(boxes[:, 2:], box[2:])
    intersection = (high - low).clamp(min=0).prod(1)
    areas = (boxes[:, 2:] - boxes[:, :2]).prod(1)
    return intersection / (areas + (box[2:] - box[:2]).prod() - intersection)


def _as_box(box: Sequence[float] | torch.Tensor) -> torch.Tensor:
    """Return ``(left, top, right, bottom)``, of four numbers or of the pixels of a mask ``(H, W)``."""
    if isinstance(box, torch.Tensor) and box.ndim == 2:
        rows, columns = check_mask(box).nonzero().unbind(1)
        limits = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
        return torch.stack(limits).float()
    sides = torch.as_tensor(box, dtype=torch.float32)
    if sides.shape != (4,) or not (sides[2:] > sides[:2]).all() or not sides.isfinite().all():
        raise SceneCaptumError(
            "box must be (left, top, right, bottom) in pixels, with right > left and bottom > top, or a mask "
            f"(H, W), not {box!r}."
        )
    return sides


def _not_detections(model: object, outputs: Any) -> str:
    got = f"a {type(outputs).__name__}"
    if isinstance(outputs, list | tuple) and outputs:
        got += (
            f" of {', '.join(map(repr, outputs[0]))}" if isinstance(outputs[0], Mapping) else " without dicts"
        )
    return (
        "A detector must return a list with a dict of the tensors 'boxes', 'labels' and 'scores' for each "
        f"picture; {type(model).__name__} returned {got}. Pass a torch.nn.Module that returns these."
    )
