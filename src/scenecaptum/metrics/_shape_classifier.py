"""A small classifier of spheres, cubes and cylinders, trained on renders."""

from __future__ import annotations

from importlib.resources import as_file, files
from itertools import pairwise

import torch

from ._preprocessing import ResizeCropNormalize

_WEIGHTS = "shape_classifier.pt"
_WIDTHS = (3, 10, 16, 24, 32)


class ShapeClassifier(torch.nn.Module):
    """Convolutional network with 12 thousand parameters and the classes ``sphere``, ``cube`` and ``cylinder``.

    Four 3 × 3 convolutions, each followed by batch normalization and a ReLU, with max pooling between them, then
    global average pooling and one linear layer. The weights ship with scenecaptum; they were trained by
    ``examples/train_shape_classifier.py``.

    Example
    -------
    >>> from scenecaptum import metrics
    >>> model = metrics.ShapeClassifier.pretrained()
    >>> metric = metrics.ClassLogit(model, target="sphere")
    >>> metric(torch.rand(96, 96, 3)).shape
    torch.Size([])

    Notes
    -----
    Trained on 4000 images of one shape on a floor in front of a wall, with random poses, colours and lights. The
    accuracy on 600 held-out images of that kind is 98.2 %. Do not rely on it for other images.
    """

    classes = ("sphere", "cube", "cylinder")

    def __init__(self) -> None:
        super().__init__()
        self.preprocess = ResizeCropNormalize(48, 48, mean=(0.5, 0.5, 0.5), std=(0.25, 0.25, 0.25))
        blocks = [
            [
                torch.nn.Conv2d(before, after, 3, padding=1, bias=False),
                torch.nn.BatchNorm2d(after),
                torch.nn.ReLU(),
                torch.nn.MaxPool2d(2) if after != _WIDTHS[-1] else torch.nn.AdaptiveAvgPool2d(1),
            ]
            for before, after in pairwise(_WIDTHS)
        ]
        self.features = torch.nn.Sequential(*(layer for block in blocks for layer in block))
        self.head = torch.nn.Linear(_WIDTHS[-1], len(self.classes))

    @classmethod
    def pretrained(cls) -> ShapeClassifier:
        """Return the classifier with the weights that ship with scenecaptum, in evaluation mode."""
        model = cls()
        with as_file(files(__package__) / _WEIGHTS) as path:
            model.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
        return model.eval()

    def forward(self, picture: torch.Tensor) -> torch.Tensor:
        """Return the logits, ``(N, 3)``, of preprocessed pictures ``(N, 3, h, w)``."""
        logits: torch.Tensor = self.head(self.features(picture).flatten(1))
        return logits
