"""The renderer as a ``torch.autograd.Function``: reverse mode, forward mode, and ``torch.func`` transforms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from torch.autograd import forward_ad

from ..errors import SceneCaptumError
from ..finite import check_gradient, check_image

if TYPE_CHECKING:
    from ._view import View


@dataclass(frozen=True)
class RenderCall:
    """Arguments of one call of the renderer, for its forward and backward passes; all but the values.

    The backward pass either replays the forward pass, sample by sample, or has samples of its own, which it
    distributes over the pixels by ``importance_sampling``.
    """

    view: View
    names: tuple[str, ...]
    seed: int
    seed_grad: int
    spp: int
    spp_grad: int
    importance_sampling: bool
    tracked: tuple[str, ...]  # of the names, those whose tensors require gradients
    check: Callable[[dict[str, torch.Tensor]], None]

    def values(self, tensors: tuple[torch.Tensor, ...]) -> dict[str, torch.Tensor]:
        """Return the tensors by name, detached from torch's graph and from dual numbers."""
        plain = (forward_ad.unpack_dual(tensor).primal.detach() for tensor in tensors)
        return dict(zip(self.names, plain, strict=True))


class Render(torch.autograd.Function):
    """θ → image: ``render(call, *tensors)``, the tensors in the order of ``call.names``."""

    @staticmethod
    def forward(call: RenderCall, *tensors: torch.Tensor) -> torch.Tensor:
        values = call.values(tensors)
        call.check(values)
        image = call.view.engine.primal(values, call.seed, call.spp, call.tracked)
        check_image(image, f"The render with seed {call.seed}", call.view.describe_pixels)
        return image

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        call, *tensors = inputs
        ctx.call = call
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, adjoint: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        if torch._C._functorch.is_legacy_batchedtensor(adjoint):
            raise SceneCaptumError(
                "is_grads_batched=True and functional.jacobian(vectorize=True) use torch's legacy batching, which "
                "cannot call a renderer. Use torch.func.jacrev, or vectorize=False; the cost is the same."
            )
        needed = ctx.needs_input_grad[1:]
        tracked = tuple(name for name, need in zip(ctx.call.names, needed, strict=True) if need)
        gradients = iter(_vjp(ctx.call, tracked, adjoint, *ctx.saved_tensors))
        return None, *(next(gradients) if need else None for need in needed)

    @staticmethod
    def jvp(ctx: Any, _: None, *tangents: torch.Tensor | None) -> torch.Tensor:
        given = zip(ctx.call.names, tangents, strict=True)
        moving = {name: tangent for name, tangent in given if tangent is not None}
        return _jvp(ctx.call, tuple(moving), *moving.values(), *ctx.saved_tensors)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *inputs: Any) -> tuple[torch.Tensor, int]:
        return _map_over_batch(Render, info, in_dims, inputs), 0


class _Derivative(torch.autograd.Function):
    """A first derivative of ``Render``: a function, so that it can be batched, without derivatives of its own."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *_: Any) -> Any:
        raise SceneCaptumError(
            "A render can be differentiated once, not twice: path replay has no second derivatives; "
            "validation.hessian_vector_product and validation.interactions compute them. For a directional "
            "derivative use torch.func.jvp or renderer.derivative_image: torch.autograd.functional.jvp "
            "differentiates twice. Drop create_graph=True if only first derivatives are needed."
        )

    jvp = backward


class RenderVJP(_Derivative):
    """The vector–Jacobian product: a gradient for each name in ``tracked``."""

    @staticmethod
    def forward(
        call: RenderCall, tracked: tuple[str, ...], adjoint: torch.Tensor, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        check_image(adjoint, f"The derivative with respect to the render with seed {call.seed}")
        gradients = call.view.engine.vjp(
            call.values(tensors),
            tracked,
            adjoint,
            call.seed_grad,
            call.spp_grad,
            importance_sampling=call.importance_sampling,
        )
        for name, gradient in zip(tracked, gradients, strict=True):
            check_gradient(name, gradient, f"seed {call.seed_grad}")
        call.view.live.free_unused(sum(gradient.numel() for gradient in gradients))
        return gradients

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *inputs: Any) -> tuple[Any, Any]:
        gradients = _map_over_batch(RenderVJP, info, in_dims, inputs)
        return gradients, (0,) * len(gradients)


class RenderJVP(_Derivative):
    """The Jacobian–vector product; ``tensors`` are a tangent for each name in ``moving``, then all values."""

    @staticmethod
    def forward(call: RenderCall, moving: tuple[str, ...], *tensors: torch.Tensor) -> torch.Tensor:
        tangents = dict(zip(moving, tensors, strict=False))
        values = call.values(tensors[len(moving) :])
        image = call.view.engine.jvp(values, tangents, call.seed_grad, call.spp_grad)
        check_image(
            image, f"The derivative of the render with seed {call.seed_grad}", call.view.describe_pixels
        )
        return image

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], *inputs: Any) -> tuple[torch.Tensor, int]:
        return _map_over_batch(RenderJVP, info, in_dims, inputs), 0


render: Callable[..., torch.Tensor] = Render.apply
_vjp: Callable[..., tuple[torch.Tensor, ...]] = RenderVJP.apply
_jvp: Callable[..., torch.Tensor] = RenderJVP.apply


def _map_over_batch(function: Any, info: Any, in_dims: tuple[Any, ...], inputs: tuple[Any, ...]) -> Any:
    """Apply a function to each element of a batch in turn, and stack the results."""
    results = []
    for index in range(info.batch_size):
        element = (
            value.select(dim, index) if isinstance(value, torch.Tensor) and dim is not None else value
            for value, dim in zip(inputs, in_dims, strict=True)
        )
        results.append(function.apply(*element))
    if isinstance(results[0], tuple):
        return tuple(torch.stack(column) for column in zip(*results, strict=True))
    return torch.stack(results)
