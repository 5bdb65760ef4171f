"""Call a user's network without side effects."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch


def run_frozen(model: Callable[..., Any], x: torch.Tensor | list[torch.Tensor]) -> Any:
    """Return ``model(x)`` in evaluation mode and with detached parameters; gradients propagate to ``x`` only.

    The model's training mode and running statistics and its parameters' ``requires_grad`` and ``grad`` do not
    change. ``x``, a tensor or a list of them, is cast to the dtype of the parameters and moved to their device;
    the result comes back to that of ``x``.
    """
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
def _evaluation_mode(model: torch.nn.Module) -> Iterator[None]:
    # Per module, since some of them, such as batch normalization, may already be in evaluation mode.
    training = [module for module in model.modules() if module.training]
    model.eval()
    try:
        yield
    finally:
        for module in training:
            module.training = True
