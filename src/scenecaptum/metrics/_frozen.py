"""Call a user's network without side effects."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch


def run_frozen(model: Callable[..., Any], x: torch.Tensor | list[torch.Tensor]) -> Any:
    """Return ``model(x)`` in evaluation mode and with detached parameters; gradients propagate to ``x`` only.

    The model's training mode and running statistics and its parameters' ``requires_grad`` and ``grad`` do not
    change. ``x``, a tensor or a list of them, is cast to the dtype of the parameters.
    """
    if not isinstance(model, torch.nn.Module):
        return model(x)
    parameters = {name: parameter.detach() for name, parameter in model.named_parameters()}
    precision = next((p.dtype for p in parameters.values() if p.is_floating_point()), None)
    cast = [one.to(precision) for one in x] if isinstance(x, list) else x.to(precision)
    with _evaluation_mode(model):
        if isinstance(model, torch.jit.ScriptModule):  # not supported by functional_call
            return model(cast)
        return torch.func.functional_call(model, parameters, (cast,))


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
