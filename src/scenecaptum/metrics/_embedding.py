"""Distance between the embedding of an image and a reference."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

import torch

from ..errors import SceneCaptumError
from ._checks import cast_like
from ._measure import Measure
from ._network import Model, NetworkMetric, Transform, describe_output, wrap_it
from ._picture import check_reference
from ._preprocessing import ResizeCropNormalize

Distance: TypeAlias = Literal["cosine", "euclidean"]


class EmbeddingDistance(NetworkMetric):
    """Distance between the embedding of an image and that of a reference: ``1 − cos(f(x), f(y))``.

    Example
    -------
    >>> encoder = torch.nn.Sequential(torch.nn.AdaptiveAvgPool2d(2), torch.nn.Flatten())
    >>> reference = torch.rand(48, 64, 3)
    >>> EmbeddingDistance(reference, encoder)(reference).abs() < 1e-6
    tensor(True)
    >>> EmbeddingDistance(torch.rand(12), encoder, smoothing=0.3)(reference).shape  # a given embedding
    torch.Size([])

    Parameters
    ----------
    reference
        An image, ``(H, W, 3)`` linear radiance of any size; or an embedding ``(D,)``, such as CLIP's of a text; or
        several embeddings ``(K, D)``, for a vector of distances that ``attribute(target=)`` indexes.
    encoder
        Any network or function from ``(N, 3, h, w)`` to ``(N, D)``. A network runs in evaluation mode and does not
        change.
    transform
        Differentiable preprocessing from an sRGB picture ``(1, 3, H, W)`` in [0, 1] to the encoder's input. By
        default the encoder's own ``preprocess`` if it has one, otherwise ImageNet's ``ResizeCropNormalize()``.
    distance
        ``"cosine"``, from 0 to 2, or ``"euclidean"``.
    exposure, smoothing
        As in ``ClassLogit``. A reference image is not smoothed.

    Raises
    ------
    SceneCaptumError
        If the reference is neither an image nor an embedding, or ``distance`` is unknown. From ``forward``, if the
        encoder does not return ``(N, D)`` or ``D`` is not that of the reference.

    Notes
    -----
    At the reference itself the distance has a minimum, and its gradient is 0.
    """

    reference: torch.Tensor

    def __init__(
        self,
        reference: torch.Tensor,
        encoder: Model,
        transform: Transform | None = None,
        *,
        distance: Distance = "cosine",
        exposure: float = 1.0,
        smoothing: float | None = None,
    ) -> None:
        super().__init__(encoder, transform, ResizeCropNormalize(), exposure, smoothing)
        if distance not in get_args(Distance):
            raise SceneCaptumError(f"distance must be 'cosine' or 'euclidean', not {distance!r}.")
        self.distance = distance
        self.register_buffer("reference", _check_reference(reference))

    def of_batch(self, images: torch.Tensor) -> torch.Tensor:
        """Return the distances of images ``(N, H, W, 3)`` without smoothing: ``(N,)``, or ``(N, K)``."""
        x, y = self.embeddings(images), self._expected(images)
        if x.shape[-1] != y.shape[-1]:
            raise SceneCaptumError(
                f"The reference has {y.shape[-1]} numbers, but {type(self.model).__name__} returns embeddings of "
                f"{x.shape[-1]}: compute both with the same network."
            )
        values = _distances(self.distance, x[:, None], y.to(x).reshape(1, -1, y.shape[-1]))
        return values[:, 0] if y.ndim == 1 else values

    def embeddings(self, images: torch.Tensor) -> torch.Tensor:
        """Return the embeddings of images ``(N, H, W, 3)`` without smoothing, ``(N, D)``."""
        output = self.output(images)
        valid = isinstance(output, torch.Tensor) and output.ndim == 2 and len(output) == len(images)
        if not valid or not output.is_floating_point():
            raise SceneCaptumError(_not_embeddings(self.model, output))
        return cast_like(output, images)

    def _expected(self, images: torch.Tensor) -> torch.Tensor:
        """Return the embedding or embeddings of the reference, ``(D,)`` or ``(K, D)``."""
        if self.reference.ndim < 3:
            return self.reference
        with torch.no_grad():
            return self.embeddings(self.reference.to(images)[None])[0]

    @property
    def measure(self) -> Measure:
        """Name and direction."""
        return self.named_measure(f"{self.distance} distance of embeddings", better="lower")

    def extra_repr(self) -> str:
        """Show the settings."""
        return f"reference={tuple(self.reference.shape)}, distance={self.distance!r}, {self.settings()}"


def _distances(distance: Distance, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    if distance == "cosine":
        return 1 - torch.nn.functional.cosine_similarity(x, y, dim=-1)
    distances: torch.Tensor = torch.linalg.vector_norm(x - y, dim=-1)  # with a derivative of 0 at 0
    return distances


def _check_reference(reference: torch.Tensor) -> torch.Tensor:
    """Return a detached copy of an image or of embeddings; raise if it is neither."""
    if not isinstance(reference, torch.Tensor) or reference.ndim not in (1, 2, 3):
        came = tuple(reference.shape) if isinstance(reference, torch.Tensor) else type(reference).__name__
        raise SceneCaptumError(
            f"reference must be an image (H, W, 3) or an embedding (D,) or (K, D), not {came}."
        )
    if reference.ndim == 3:
        return check_reference(reference)
    if not reference.numel() or not torch.isfinite(reference).all() or not reference.any(-1).all():
        raise SceneCaptumError("The reference must have finite numbers that are not all 0.")
    return reference.detach().clone()


def _not_embeddings(encoder: object, output: object) -> str:
    fix = (
        wrap_it(output, 2, "the tensor", "pooler_output")
        if not isinstance(output, torch.Tensor)
        else "Keep the batch dimension: use flatten(1) instead of flatten(), and no squeeze()."
        if output.ndim < 2
        else "Reduce it to one vector for each picture: torch.nn.Sequential(encoder, torch.nn.Flatten())."
    )
    return (
        f"An encoder must return embeddings of shape (N, D); {type(encoder).__name__} returned "
        f"{describe_output(output)}. {fix}"
    )
