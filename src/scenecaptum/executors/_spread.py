"""Renderers whose passes are computed ahead in other processes; a checkpoint folder takes the results back."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, cast

import torch

from ..backend import use_threads
from ..checkpoint import Folder, with_checkpoint
from ..errors import SceneCaptumError
from ..protocols import Capabilities, Renderer, RenderPass, accepted_keywords
from ._kept import made


def spread(renderer: Renderer, executor: Executor | None, checkpoint: Folder) -> Any:
    """Return a renderer whose passes can be begun on an executor, with a checkpoint; as it is without either.

    The processes of the executor write into the checkpoint; without one, into a temporary folder of this machine.

    Raises
    ------
    SceneCaptumError
        If the renderer has no recipe for other processes, or the folder cannot be written.
    """
    if executor is None:
        return with_checkpoint(renderer, checkpoint)
    recipe = Capabilities(renderer).recipe
    if recipe is None:
        raise SceneCaptumError(
            f"executor= needs to make this {type(renderer).__name__} again in other processes: give it an "
            "attribute recipe, a function without arguments that can be pickled and returns it."
        )
    temporary = None if checkpoint is not None else tempfile.TemporaryDirectory(prefix="scenecaptum-")
    folder = checkpoint if temporary is None else temporary.name
    return SpreadRenderer(with_checkpoint(renderer, folder), recipe, executor, temporary)


@dataclass
class SpreadRenderer:
    """A renderer that takes what ``begin`` has computed elsewhere from its checkpoint."""

    renderer: Renderer
    recipe: Callable[[], Any]
    executor: Executor
    temporary: tempfile.TemporaryDirectory[str] | None  # deleted with this renderer

    @property
    def accepted_keywords(self) -> frozenset[str]:
        """The keywords of the renderer."""
        return accepted_keywords(self.renderer)

    def __getattr__(self, name: str) -> Any:
        if name == "forward" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.renderer, name)

    def __call__(self, inputs: Mapping[str, torch.Tensor], **options: Any) -> torch.Tensor:
        """Render, or take the image from the checkpoint."""
        return self.renderer(inputs, **options)

    def begin(
        self, values: Mapping[str, torch.Tensor], passes: Sequence[RenderPass]
    ) -> list[Callable[[], None]]:
        """Begin passes at the same values; return a function for each that waits until it is done."""
        known = Capabilities(self.renderer)
        own = known.inputs or {}
        changed = {
            name: value.detach().cpu()
            for name, value in values.items()
            if name not in own or not torch.equal(value, own[name])
        }
        folder = str(cast(Any, known.checkpoint).folder.resolve())
        task = self.executor.submit
        futures = [task(compute_pass, self.recipe, folder, tuple(values), changed, one) for one in passes]
        return [future.result for future in futures]


def compute_pass(
    recipe: Callable[[], Any],
    folder: str,
    names: Collection[str],
    changed: Mapping[str, torch.Tensor],
    one: RenderPass,
) -> None:
    """Compute a pass in a worker, and leave its result in the folder; with one thread, so that sums repeat."""
    use_threads(1)
    renderer = with_checkpoint(made(recipe), folder)
    own = Capabilities(renderer).inputs or {}
    values = {name: changed[name] if name in changed else own[name] for name in names}
    if one.adjoint is None:
        with torch.no_grad():
            renderer(values, **one.options)
        return
    leaves = {name: value.detach().requires_grad_(name in one.tracked) for name, value in values.items()}
    image = renderer(leaves, **one.options)  # from the folder
    torch.autograd.grad(
        (image * one.adjoint.to(image)).sum(), [leaves[name] for name in one.tracked], allow_unused=True
    )
