"""What is not finite is never passed on: it is reported by what it is and where it lies."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence

import torch

from .errors import SceneCaptumError

_AXES = ("row", "column", "channel")


class NotFiniteError(SceneCaptumError):
    """A picture, a derivative or a metric that is infinite or not a number."""


def check_image(image: torch.Tensor, what: str, shows: Callable[[torch.Tensor], str] | None = None) -> None:
    """Refuse a picture, or its derivative, that is not finite; say on which pixels.

    ``shows`` says in a sentence what a mask ``(H, W)`` of pixels shows.

    Example
    -------
    >>> image = torch.zeros(4, 6, 3)
    >>> image[1:3, 5] = torch.nan
    >>> check_image(image, "The render with seed 7")
    Traceback (most recent call last):
    scenecaptum._finite.NotFiniteError: The render with seed 7 is nan on 2 of 24 pixels: rows 1 to 2, column 5,
    channels 0 to 2.
    """
    if _is_finite(image):
        return
    bad = ~torch.isfinite(image)
    pixels = bad.any(-1) if bad.ndim > 2 else bad
    raise NotFiniteError(
        f"{what} is {image[bad][0].item():g} on {int(pixels.sum())} of {pixels.numel()} pixels: "
        f"{place(bad, 'camera')}.{shows(pixels) if shows else ''}"
    )


def check_gradient(name: str, gradient: torch.Tensor, where: str) -> None:
    """Refuse a parameter's gradient that is not finite; say at which texels and channels."""
    if _is_finite(gradient):
        return
    bad = ~torch.isfinite(gradient)
    at = f" at {place(bad, 'slice')}" if bad.ndim else ""
    raise NotFiniteError(
        f"The gradient of {name!r} is {gradient[bad][0].item():g}{at} ({where}). Its value, or one that it is "
        "multiplied by, is at an extreme that float32 cannot follow: move it a little, or leave it out of inputs=."
    )


@contextlib.contextmanager
def located(where: str) -> Iterator[None]:
    """Say where it happened, in front of the message of what is not finite."""
    try:
        yield
    except NotFiniteError as error:
        raise NotFiniteError(f"{where}: {error}") from error


def place(bad: torch.Tensor, outer: str = "slice") -> str:
    """Say where a mask is true, in the smallest box that holds it: ``'rows 1 to 2, column 5, channel 0'``.

    The last axis is that of the channels, those before it columns and rows; ``outer`` is what comes before.
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
    # The sum needs no memory of its own, and only what is not finite, or near to it, makes it so.
    return bool(values.sum().isfinite()) or bool(values.isfinite().all())
