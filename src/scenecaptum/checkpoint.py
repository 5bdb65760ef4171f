"""Checkpoints: a folder that caches finished renders and backward passes, to resume interrupted jobs.

The result of a render or backward pass depends only on its arguments. A job is resumed by running it again with
the same arguments: calls whose results are in the folder are read from there, whatever the attribution method.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from .errors import SceneCaptumError
from .files import atomic_write, write_error
from .protocols import Capabilities, Checkpointable, Renderer, accepted_keywords

FORMAT = "scenecaptum pass 1"
SUFFIX = ".pass"

Tensors: TypeAlias = tuple[torch.Tensor, ...]
Folder: TypeAlias = "str | os.PathLike[str] | Checkpoint | None"

_DIGEST = hashlib.sha256().digest_size
_STALE_SECONDS = 3600.0  # age at which a partially written file is assumed to be abandoned


class Checkpoint:
    """A content-addressed cache of renders and backward passes; file names are hashes of all their inputs.

    The hash covers scene, parameter values, seed, samples and adjoint image, so several jobs can share a folder:
    two metrics of the same scene reuse each other's renders.

    Parameters
    ----------
    folder
        Created if it does not exist.

    Attributes
    ----------
    reused, rendered
        Number of results that were read from the folder, and number that had to be rendered.
    seconds_saved
        Original render time of the reused results.

    Raises
    ------
    SceneCaptumError
        If the folder is not writable.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.reused = self.rendered = 0
        self.seconds_saved = 0.0
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for partial in self.folder.glob(f".*{SUFFIX}"):  # left behind by a killed process
                if time.time() - partial.stat().st_mtime > _STALE_SECONDS:
                    partial.unlink(missing_ok=True)
        except OSError as error:
            raise write_error(self.folder, error) from error

    def get_or_render(
        self, inputs: Any, render: Callable[[], Tensors], device: torch.device | None = None
    ) -> Tensors:
        """Return the cached result for ``inputs``; render and store it if there is none.

        Parameters
        ----------
        inputs
            Everything that the result depends on: strings, numbers and tensors, in tuples and mappings.
        render
            Called on a cache miss.
        device
            Device of the returned tensors when they are read from the folder.

        Raises
        ------
        SceneCaptumError
            If the folder is not writable.
        """
        key = digest(inputs)
        cached = self._read(key)
        if cached is not None:
            tensors, seconds = cached
            self.reused += 1
            self.seconds_saved += seconds
            return tuple(tensor.to(device) for tensor in tensors)
        start = time.perf_counter()
        result = render()
        self._write(key, result, time.perf_counter() - start)
        self.rendered += 1
        return result

    def get_or_decide(
        self, inputs: Any, decide: Callable[[], Sequence[int] | None]
    ) -> tuple[int, ...] | None:
        """Return a stored decision that depended on the clock; decide and store it if there is none.

        A resumed job must repeat such decisions, or it would not find its cached renders.
        """
        key = digest(("decision", inputs))
        cached = self._read(key)
        if cached is not None:
            (numbers,), _ = cached
            return tuple(numbers.tolist()) or None
        decision = decide()
        self._write(key, (torch.tensor(decision or (), dtype=torch.int64),), 0.0)
        return None if decision is None else tuple(decision)

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}{SUFFIX}"

    def _read(self, key: str) -> tuple[Tensors, float] | None:
        path = self._path(key)
        try:
            content = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise SceneCaptumError(f"{path} cannot be read: {error.strerror or error}.") from error
        # Verify the checksum before parsing anything.
        if hashlib.sha256(content[_DIGEST:]).digest() == content[:_DIGEST]:
            with np.load(io.BytesIO(content[_DIGEST:]), allow_pickle=False) as file:
                header = json.loads(str(file["header"]))
                if (header["format"], header["key"]) == (FORMAT, key):
                    tensors = tuple(torch.from_numpy(file[str(n)]) for n in range(header["count"]))
                    return tensors, header["seconds"]
        warnings.warn(f"The checkpoint {path} is damaged; it is rendered again.", stacklevel=2)
        return None

    def _write(self, key: str, tensors: Tensors, seconds: float) -> None:
        header = {"format": FORMAT, "key": key, "count": len(tensors), "seconds": seconds}
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {str(n): tensor.numpy(force=True) for n, tensor in enumerate(tensors)}
        np.savez(buffer, header=np.array(json.dumps(header)), **arrays)
        content = buffer.getvalue()
        with atomic_write(self._path(key)) as partial:
            partial.write_bytes(hashlib.sha256(content).digest() + content)


def with_checkpoint(renderer: Renderer, checkpoint: Folder) -> Any:
    """Return a renderer that caches its renders and backward passes in a folder; the renderer itself for None.

    A renderer other than ``SceneRenderer`` needs an attribute ``fingerprint``, a string that changes whenever its
    images change. If such a renderer is interrupted between forward and backward pass, the image is rendered again
    on resumption, because torch's graph cannot be stored.

    Raises
    ------
    SceneCaptumError
        If the renderer has no fingerprint, or the folder is not writable.
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
        gradients = torch.autograd.grad(image, leaves, adjoint, retain_graph=True, allow_unused=True)
        return tuple(
            torch.zeros_like(leaf) if gradient is None else gradient
            for gradient, leaf in zip(gradients, leaves, strict=True)
        )

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


class Stopwatch:
    """Elapsed time, including the original render time of results that a checkpoint supplied."""

    def __init__(self, renderer: Renderer | None) -> None:
        self._checkpoint: Checkpoint | None = Capabilities(renderer).checkpoint
        self._start = self.now()
        self._counts = self._count()

    def now(self) -> float:
        """Return the current time on this clock, in seconds."""
        return time.perf_counter() + (self._checkpoint.seconds_saved if self._checkpoint else 0.0)

    @property
    def seconds(self) -> float:
        """Seconds since construction."""
        return self.now() - self._start

    @property
    def info(self) -> dict[str, Any]:
        """Entries for a result's ``info``: elapsed seconds, and use of the checkpoint since construction."""
        if self._checkpoint is None:
            return {"seconds": self.seconds}
        reused, rendered = (new - old for new, old in zip(self._count(), self._counts, strict=True))
        usage = {"folder": str(self._checkpoint.folder), "reused": reused, "passes": reused + rendered}
        return {"seconds": self.seconds, "checkpoint": usage}

    def _count(self) -> tuple[int, int]:
        return (self._checkpoint.reused, self._checkpoint.rendered) if self._checkpoint else (0, 0)


def digest(content: Any) -> str:
    """Return a hash of strings, numbers and tensors, in tuples and mappings.

    Example
    -------
    >>> digest(("picture", {"a": torch.zeros(2), "b": 1})) == digest(("picture", {"b": 1, "a": torch.zeros(2)}))
    True
    >>> digest(torch.zeros(2)) == digest(torch.zeros(2, 1))
    False
    """
    state = hashlib.blake2b(digest_size=16)
    _update(state, content)
    return state.hexdigest()


def _update(state: Any, content: Any) -> None:
    """Update a hash; every item is prefixed with its type and size, so that the encoding is unambiguous."""
    if isinstance(content, torch.Tensor):
        content = content.detach().cpu().contiguous()
        state.update(f"tensor {content.dtype} {tuple(content.shape)} ".encode())
        state.update(content.reshape(-1).view(torch.uint8).numpy())
    elif isinstance(content, np.ndarray):
        state.update(f"array {content.dtype} {content.shape} ".encode())
        state.update(np.ascontiguousarray(content).reshape(-1).view(np.uint8))
    elif isinstance(content, Mapping):
        state.update(f"mapping {len(content)} ".encode())
        for name in sorted(content):
            _update(state, name)
            _update(state, content[name])
    elif isinstance(content, (tuple, list)):
        state.update(f"tuple {len(content)} ".encode())
        for item in content:
            _update(state, item)
    elif content is None or isinstance(content, (str, int, float)):
        text = repr(content).encode()
        state.update(f"{type(content).__name__} {len(text)} ".encode() + text)
    else:
        raise SceneCaptumError(
            f"checkpoint= supports tensors, numbers and strings as arguments, not {type(content).__name__}."
        )
