"""Checkpoints: a folder keeps every pass that is finished, and none that is in it is rendered again.

Methods know rendering only through calls, and all that a call returns follows from what it is asked. So a job is
resumed by starting it again: each call whose answer is in the folder gets it from there, whatever the method is.
"""

from __future__ import annotations

import hashlib
import inspect
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

from ._writing import cannot_write, whole_file
from .errors import SceneCaptumError

FORMAT = "scenecaptum pass 1"
SUFFIX = ".pass"

Tensors: TypeAlias = tuple[torch.Tensor, ...]
Folder: TypeAlias = "str | os.PathLike[str] | Checkpoint | None"

_DIGEST = hashlib.sha256().digest_size
_ABANDONED = 3600.0  # seconds after which nobody can still be writing a file


class Checkpoint:
    """A folder of finished passes, each under a name that is a hash of all that it follows from.

    A pass of another scene, other values, another seed or another adjoint has another name. So runs may share a
    folder: two metrics of one scene share its pictures.

    Parameters
    ----------
    folder
        Made where there is none.

    Attributes
    ----------
    reused, rendered
        How many passes were found in the folder, and how many were not.
    saved
        How many seconds it took to render those that were found, when they were rendered.

    Raises
    ------
    SceneCaptumError
        Where the folder cannot be written.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder = Path(folder)
        self.reused = self.rendered = 0
        self.saved = 0.0
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for one in self.folder.glob(f".*{SUFFIX}"):  # what a killed run was writing
                if time.time() - one.stat().st_mtime > _ABANDONED:
                    one.unlink(missing_ok=True)
        except OSError as error:
            raise cannot_write(self.folder, error) from error

    def take(self, what: Any, render: Callable[[], Tensors], device: torch.device | None = None) -> Tensors:
        """Return the pass that follows from ``what``: from the folder, or rendered and put there.

        Parameters
        ----------
        what
            Strings, numbers and tensors, in tuples and mappings.
        render
            What to do where the pass is not there.
        device
            Where the tensors are to be, if they come from the folder.

        Raises
        ------
        SceneCaptumError
            Where the folder cannot be written.
        """
        key = digest(what)
        kept = self._read(key)
        if kept is not None:
            tensors, seconds = kept
            self.reused += 1
            self.saved += seconds
            return tuple(one.to(device) for one in tensors)
        began = time.perf_counter()
        found = render()
        self._write(key, found, time.perf_counter() - began)
        self.rendered += 1
        return found

    def decide(self, what: Any, choose: Callable[[], Sequence[int] | None]) -> tuple[int, ...] | None:
        """Return what was chosen by the clock, which no second run would choose again, or choose it now."""
        key = digest(("decision", what))
        kept = self._read(key)
        if kept is not None:
            (numbers,), _ = kept
            return tuple(numbers.tolist()) or None
        chosen = choose()
        self._write(key, (torch.tensor(chosen or (), dtype=torch.int64),), 0.0)
        return None if chosen is None else tuple(chosen)

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
        # Nothing in a damaged file is looked at.
        if hashlib.sha256(content[_DIGEST:]).digest() == content[:_DIGEST]:
            with np.load(io.BytesIO(content[_DIGEST:]), allow_pickle=False) as file:
                header = json.loads(str(file["header"]))
                if (header["format"], header["key"]) == (FORMAT, key):
                    tensors = tuple(torch.from_numpy(file[str(n)]) for n in range(header["count"]))
                    return tensors, header["seconds"]
        warnings.warn(f"The checkpoint {path} is damaged; the pass is rendered again.", stacklevel=2)
        return None

    def _write(self, key: str, tensors: Tensors, seconds: float) -> None:
        header = {"format": FORMAT, "key": key, "count": len(tensors), "seconds": seconds}
        buffer = io.BytesIO()
        arrays: dict[str, Any] = {str(n): one.numpy(force=True) for n, one in enumerate(tensors)}
        np.savez(buffer, header=np.array(json.dumps(header)), **arrays)
        content = buffer.getvalue()
        with whole_file(self._path(key)) as partial:
            partial.write_bytes(hashlib.sha256(content).digest() + content)


def with_checkpoint(renderer: Any, checkpoint: Folder) -> Any:
    """Return the renderer with its passes kept in a folder; the renderer itself for None.

    A ``SceneRenderer`` keeps every picture and every backward pass. Any other renderer must have an attribute
    ``fingerprint``, a string that tells its pictures from those of any other, and where its backward pass was not
    finished its picture is computed once more, because torch's graph cannot be kept.

    Raises
    ------
    SceneCaptumError
        Where the renderer has no fingerprint, or the folder cannot be written.
    """
    if checkpoint is None:
        return renderer
    if not isinstance(checkpoint, Checkpoint):
        checkpoint = Checkpoint(checkpoint)
    # That of its class: a wrapper that hands attributes on would be left out.
    if hasattr(type(renderer), "with_checkpoint"):
        return renderer.with_checkpoint(checkpoint)
    return Recorded(renderer, checkpoint)


def without_checkpoint(renderer: Any) -> Any:
    """Return the renderer that renders whatever it is asked."""
    if isinstance(renderer, Recorded):
        return renderer.renderer
    return renderer.with_checkpoint(None) if hasattr(type(renderer), "with_checkpoint") else renderer


class Recorded:
    """Any renderer, its passes kept in a folder: see ``with_checkpoint``."""

    def __init__(self, renderer: Any, checkpoint: Checkpoint) -> None:
        fingerprint = inspect.getattr_static(renderer, "fingerprint", None) and renderer.fingerprint
        if not isinstance(fingerprint, str) or not fingerprint:
            raise SceneCaptumError(
                f"checkpoint= cannot tell the pictures of this {type(renderer).__name__} from those of another "
                "renderer: give it an attribute fingerprint, a string that is another whenever its pictures are."
            )
        self.renderer = renderer
        self.checkpoint = checkpoint
        self.fingerprint = fingerprint
        # Whether it takes seed_grad is read from here.
        self.__signature__ = inspect.signature(getattr(renderer, "forward", renderer))

    def __getattr__(self, name: str) -> Any:
        if name == "forward" or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.renderer, name)

    def __call__(self, inputs: Mapping[str, torch.Tensor], **options: Any) -> torch.Tensor:
        """Render as the renderer does; gradients reach ``inputs`` only."""
        tracked = torch.is_grad_enabled() and any(value.requires_grad for value in inputs.values())
        call = _Call(self, tuple(inputs), options, tracked)
        return _pass(call, *inputs.values())


@dataclass
class _Call:
    """One call of a renderer, and its graph once there is one."""

    recorded: Recorded
    names: tuple[str, ...]
    options: dict[str, Any]
    tracked: bool
    graph: tuple[Tensors, torch.Tensor] | None = None

    def picture(self, tensors: Tensors) -> torch.Tensor:
        """Render, with a graph where one is wanted."""
        leaves = tuple(one.detach().clone().requires_grad_(self.tracked) for one in tensors)
        with torch.set_grad_enabled(self.tracked):
            image: torch.Tensor = self.recorded.renderer(
                dict(zip(self.names, leaves, strict=True)), **self.options
            )
        if self.tracked:
            self.graph = leaves, image
        return image.detach()

    def gradients(self, tensors: Tensors, adjoint: torch.Tensor) -> Tensors:
        """Propagate an adjoint image; where the picture came from the folder it is computed first."""
        if self.graph is None:
            self.picture(tensors)
        assert self.graph is not None
        leaves, image = self.graph
        found = torch.autograd.grad(image, leaves, adjoint, retain_graph=True, allow_unused=True)
        return tuple(
            torch.zeros_like(leaf) if one is None else one for one, leaf in zip(found, leaves, strict=True)
        )

    def what(self, kind: str, tensors: Tensors, *more: Any) -> Any:
        """Return all that the answer follows from."""
        options = self.options if more else {k: v for k, v in self.options.items() if not k.endswith("_grad")}
        values = dict(zip(self.names, tensors, strict=True))
        return kind, self.recorded.fingerprint, values, options, *more


class _Pass(torch.autograd.Function):
    """A renderer as a function whose two passes are taken from the checkpoint."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: torch.Tensor) -> torch.Tensor:
        ctx.call = call
        ctx.save_for_backward(*tensors)
        (image,) = call.recorded.checkpoint.take(
            call.what("picture", tensors),
            lambda: (call.picture(tensors),),
            tensors[0].device if tensors else None,
        )
        return image

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, adjoint: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        tensors, call = ctx.saved_tensors, ctx.call
        return None, *call.recorded.checkpoint.take(
            call.what("gradient", tensors, adjoint),
            lambda: call.gradients(tensors, adjoint),
            adjoint.device,
        )


_pass: Callable[..., torch.Tensor] = _Pass.apply


class Stopwatch:
    """Counts seconds as if the passes that a checkpoint gave back had been rendered."""

    def __init__(self, renderer: Any) -> None:
        self._checkpoint: Checkpoint | None = getattr(renderer, "checkpoint", None)
        self._began = self.now()
        self._counts = self._count()

    def now(self) -> float:
        """Return the time on this clock, in seconds."""
        return time.perf_counter() + (self._checkpoint.saved if self._checkpoint else 0.0)

    @property
    def seconds(self) -> float:
        """How long ago the watch was made."""
        return self.now() - self._began

    @property
    def record(self) -> dict[str, Any]:
        """What a result's ``info`` tells: the seconds, and since then how many passes came from the folder."""
        if self._checkpoint is None:
            return {"seconds": self.seconds}
        reused, rendered = (new - old for new, old in zip(self._count(), self._counts, strict=True))
        about = {"folder": str(self._checkpoint.folder), "reused": reused, "passes": reused + rendered}
        return {"seconds": self.seconds, "checkpoint": about}

    def _count(self) -> tuple[int, int]:
        return (self._checkpoint.reused, self._checkpoint.rendered) if self._checkpoint else (0, 0)


def digest(what: Any) -> str:
    """Return a hash of strings, numbers and tensors, in tuples and mappings.

    Example
    -------
    >>> digest(("picture", {"a": torch.zeros(2), "b": 1})) == digest(("picture", {"b": 1, "a": torch.zeros(2)}))
    True
    >>> digest(torch.zeros(2)) == digest(torch.zeros(2, 1))
    False
    """
    found = hashlib.blake2b(digest_size=16)
    _feed(found, what)
    return found.hexdigest()


def _feed(found: Any, what: Any) -> None:
    """Feed a hash: with everything comes its kind and size, so that no two things look alike."""
    if isinstance(what, torch.Tensor):
        what = what.detach().cpu().contiguous()
        found.update(f"tensor {what.dtype} {tuple(what.shape)} ".encode())
        found.update(what.reshape(-1).view(torch.uint8).numpy())
    elif isinstance(what, np.ndarray):
        found.update(f"array {what.dtype} {what.shape} ".encode())
        found.update(np.ascontiguousarray(what).reshape(-1).view(np.uint8))
    elif isinstance(what, Mapping):
        found.update(f"mapping {len(what)} ".encode())
        for name in sorted(what):
            _feed(found, name)
            _feed(found, what[name])
    elif isinstance(what, (tuple, list)):
        found.update(f"tuple {len(what)} ".encode())
        for one in what:
            _feed(found, one)
    elif what is None or isinstance(what, (str, int, float)):
        text = repr(what).encode()
        found.update(f"{type(what).__name__} {len(text)} ".encode() + text)
    else:
        raise SceneCaptumError(
            f"checkpoint= works with calls of tensors, numbers and strings, not {type(what).__name__}."
        )
