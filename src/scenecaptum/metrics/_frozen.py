"""Call a user's network without side effects, and its preprocessing; errors name the tensor that they got."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from ..errors import SceneCaptumError

# What errors say about a tensor that does not fit; those of torchvision and timm name the height.
_OF_SHAPE = re.compile(r"channels|shape|size|dimension|height|width")


def run_transform(transform: Callable[[torch.Tensor], torch.Tensor], pictures: torch.Tensor) -> torch.Tensor:
    """Return ``transform(pictures)``."""
    with _input_named("transform=", pictures, "the picture (N, 3, H, W)"):
        return transform(pictures)


def run_frozen(model: Callable[..., Any], x: torch.Tensor | list[torch.Tensor]) -> Any:
    """Return ``model(x)`` in evaluation mode and with detached parameters; gradients propagate to ``x`` only.

    The model's training mode and running statistics and its parameters' ``requires_grad`` and ``grad`` do not
    change. ``x``, a tensor or a list of them, is cast to the dtype of the parameters and moved to their device;
    the result comes back to that of ``x``.

    Raises
    ------
    SceneCaptumError
        If the model cannot take a tensor of this shape.
    """
    name = getattr(model, "__name__", type(model).__name__)
    what = "which transform= makes of the picture: most networks take (N, 3, h, w), of the size of their training"
    with _input_named(name, _first(x), what):
        return _run(model, x)


def _run(model: Callable[..., Any], x: torch.Tensor | list[torch.Tensor]) -> Any:
    if not isinstance(model, torch.nn.Module):
        return model(x)
    parameters = {name: parameter.detach() for name, parameter in model.named_parameters()}
    like = next((p for p in parameters.values() if p.is_floating_point()), torch.empty(0).to(_first(x)))
    cast = [one.to(like) for one in x] if isinstance(x, list) else x.to(like)
    with _evaluation_mode(model):
        if isinstance(model, torch.jit.ScriptModule):  # not supported by functional_call
            result = model(cast)
        else:
            result = torch.func.functional_call(model, parameters, (cast,))
    device = _first(x).device
    return result if like.device == device else _moved(result, device)


def _first(x: torch.Tensor | list[torch.Tensor]) -> torch.Tensor:
    return x[0] if isinstance(x, list) else x


def _moved(result: Any, device: torch.device) -> Any:
    """Return what a network returned, a tensor or a collection of them, on another device."""
    if isinstance(result, torch.Tensor):
        return result.to(device)
    if isinstance(result, Mapping):
        return {name: _moved(one, device) for name, one in result.items()}
    return type(result)(_moved(one, device) for one in result) if type(result) in (list, tuple) else result


@contextmanager
def _input_named(name: str, x: torch.Tensor, what: str) -> Iterator[None]:
    """Name the tensor that a function gets, and what it is, in an error about its shape."""
    try:
        yield
    except (RuntimeError, AssertionError) as error:
        if not _OF_SHAPE.search(str(error)):
            raise
        raise SceneCaptumError(
            f"{name} cannot take a tensor of shape {tuple(x.shape)}, {what}. torch says: {error}"
        ) from error


@contextmanager
def _evaluation_mode(model: torch.nn.Module) -> Iterator[None]:
    # Per module, since some of them, such as batch normalization, may already be in evaluation mode.
    training = [module for module in model.modules() if module.training]
    model.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True
