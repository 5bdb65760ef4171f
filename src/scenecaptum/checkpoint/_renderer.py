"""Renderers whose renders and backward passes are cached in a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch

from ..errors import SceneCaptumError
from ..protocols import Capabilities, Checkpointable, Renderer, accepted_keywords
from ._store import Checkpoint, Folder, Tensors


def with_checkpoint(renderer: Renderer, checkpoint: Folder) -> Any:
    """Return a renderer that caches its renders and backward passes in a folder; the renderer itself for None.

    A renderer other than ``SceneRenderer`` needs an attribute ``fingerprint``, a string that changes whenever its
    images change. If such a renderer is interrupted between forward and backward pass, the image is rendered again
    on resumption, because torch's graph cannot be stored. Raises if the renderer has no fingerprint, or the folder
    is not writable.
    """
    if checkpoint is None:
        return renderer
    if not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint(checkpoint)
    if isinstance(renderer, Checkpointable):
        return renderer.with_checkpoint(checkpoint)
    return CheckpointedRenderer(renderer, checkpoint)


def without_checkpoint(renderer: Renderer) -> Any:
    """Return the renderer without its cache."""
    return renderer.with_checkpoint(None) if isinstance(renderer, Checkpointable) else renderer


class CheckpointedRenderer:
    """Wrapper that adds a checkpoint to any renderer; see ``with_checkpoint``."""

    def __init__(self, renderer: Renderer, checkpoint: Checkpoint) -> None:
        fingerprint = Capabilities(renderer).fingerprint
        if not isinstance(fingerprint, str) or not fingerprint:
            raise SceneCaptumError(
                f"checkpoint= cannot identify the images of this {type(renderer).__name__}: give it an attribute "
                "fingerprint, a string that changes whenever its images change."
            )
        self.renderer = renderer
        self.checkpoint = checkpoint
        self.fingerprint = fingerprint
        self.accepted_keywords = accepted_keywords(renderer)

    def with_checkpoint(self, checkpoint: Checkpoint | None) -> Any:
        """Return the same with another checkpoint, or the wrapped renderer for None."""
        return self.renderer if checkpoint is None else CheckpointedRenderer(self.renderer, checkpoint)

    def __getattr__(self, name: str) -> Any:
        if name == "forward" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.renderer, name)

    def __call__(self, inputs: Mapping[str, torch.Tensor], **options: Any) -> torch.Tensor:
        """Call the wrapped renderer; gradients are propagated to ``inputs`` only."""
        tracked = torch.is_grad_enabled() and any(value.requires_grad for value in inputs.values())
        call = _Call(self, tuple(inputs), options, tracked)
        return _cached_render(call, *inputs.values())


@dataclass
class _Call:
    """One call of a renderer, with its autograd graph after the forward pass."""

    wrapper: CheckpointedRenderer
    names: tuple[str, ...]
    options: dict[str, Any]
    tracked: bool
    graph: tuple[Tensors, torch.Tensor] | None = None

    def render(self, tensors: Tensors) -> torch.Tensor:
        """Render the image; keep the graph if gradients are tracked."""
        leaves = tuple(tensor.detach().clone().requires_grad_(self.tracked) for tensor in tensors)
        with torch.set_grad_enabled(self.tracked):
            image: torch.Tensor = self.wrapper.renderer(
                dict(zip(self.names, leaves, strict=True)), **self.options
            )
        if self.tracked:
            self.graph = leaves, image
        return image.detach()

    def vjp(self, tensors: Tensors, adjoint: torch.Tensor) -> Tensors:
        """Return the vector–Jacobian product; render first if the image came from the folder."""
        if self.graph is None:
            self.render(tensors)
        assert self.graph is not None
        leaves, image = self.graph
        return torch.autograd.grad(image, leaves, adjoint, retain_graph=True, materialize_grads=True)

    def cache_inputs(self, kind: str, tensors: Tensors, *more: Any) -> Any:
        """Return everything that the result depends on."""
        options = self.options if more else {k: v for k, v in self.options.items() if not k.endswith("_grad")}
        values = dict(zip(self.names, tensors, strict=True))
        return kind, self.wrapper.fingerprint, values, options, *more


class _CachedRender(torch.autograd.Function):
    """A renderer as a torch function with cached forward and backward passes."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: torch.Tensor) -> torch.Tensor:
        ctx.call = call
        ctx.save_for_backward(*tensors)
        (image,) = call.wrapper.checkpoint.get_or_render(
            call.cache_inputs("picture", tensors),
            lambda: (call.render(tensors),),
            tensors[0].device if tensors else None,
        )
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, adjoint: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        tensors, call = ctx.saved_tensors, ctx.call
        return None, *call.wrapper.checkpoint.get_or_render(
            call.cache_inputs("gradient", tensors, adjoint),
            lambda: call.vjp(tensors, adjoint),
            adjoint.device,
        )


_cached_render: Callable[..., torch.Tensor] = _CachedRender.apply
