"""Checks that raise on non-finite images and gradients, with their location."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

import torch

from .errors import SceneCaptumError

_AXES = ("row", "column", "channel")


class NotFiniteError(SceneCaptumError):
    """An image, derivative or metric is infinite or NaN."""


def check_image(
    image: torch.Tensor, what: str, describe_pixels: Callable[[torch.Tensor], str] | None = None
) -> None:
    """Raise if an image, or its derivative, is not finite; the message gives the pixels.

    ``describe_pixels`` returns a sentence about the objects visible in a mask of pixels, ``(H, W)``.

    Example
    -------
    >>> image = torch.zeros(4, 6, 3)
    >>> image[1:3, 5] = torch.nan
    >>> check_image(image, "The render with seed 7")
    Traceback (most recent call last):
    scenecaptum.finite.NotFiniteError: The render with seed 7 is nan on 2 of 24 pixels: rows 1 to 2, column 5,
    channels 0 to 2.
    """
    if _is_finite(image):
        return
    bad = ~torch.isfinite(image)
    pixels = bad.any(-1) if bad.ndim > 2 else bad
    raise NotFiniteError(
        f"{what} is {image[bad][0].item():g} on {int(pixels.sum())} of {pixels.numel()} pixels: "
        f"{describe_location(bad, 'camera')}.{describe_pixels(pixels) if describe_pixels else ''}"
    )


def check_gradient(name: str, gradient: torch.Tensor, context: str) -> None:
    """Raise if the gradient of a parameter is not finite; the message gives the texels and channels."""
    if _is_finite(gradient):
        return
    bad = ~torch.isfinite(gradient)
    where = f" at {describe_location(bad, 'slice')}" if bad.ndim else ""
    raise NotFiniteError(
        f"The gradient of {name!r} is {gradient[bad][0].item():g}{where} ({context}). Its value, or a factor of "
        "it, is too extreme for float32: change it slightly, or leave it out of inputs=."
    )


@contextlib.contextmanager
def error_context(prefix: str) -> Iterator[None]:
    """Prefix the message of a ``NotFiniteError``."""
    try:
        yield
    except NotFiniteError as error:
        raise NotFiniteError(f"{prefix}: {error}") from error


def describe_location(bad: torch.Tensor, outer: str = "slice") -> str:
    """Return the bounding box of a mask in words: ``'rows 1 to 2, column 5, channel 0'``.

    The last three axes are rows, columns and channels; ``outer`` names the axes before them.
    """
    axes: Sequence[str] = _AXES if bad.ndim >= 3 else ("row", "channel") if bad.ndim == 2 else ("channel",)
    names = [outer] * (bad.ndim - len(axes)) + list(axes)
    return ", ".join(
        _span(name, indices.min().item(), indices.max().item())
        for name, indices in zip(names, bad.nonzero(as_tuple=True), strict=True)
    )


def _span(name: str, first: int | float, last: int | float) -> str:
    return f"{name} {first}" if first == last else f"{name}s {first} to {last}"


def _is_finite(values: torch.Tensor) -> bool:
    # The sum allocates no memory; it is only non-finite for values that are, or that overflow.
    return bool(values.sum().isfinite()) or bool(values.isfinite().all())
