"""The folder of a checkpoint."""

from __future__ import annotations

import hashlib
import io
import json
import os
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from ..errors import SceneCaptumError
from ..files import atomic_write, remove_abandoned, write_error
from ._digest import digest

FORMAT = "scenecaptum pass 1"
SUFFIX = ".pass"

Tensors: TypeAlias = tuple[torch.Tensor, ...]
Folder: TypeAlias = "str | os.PathLike[str] | Checkpoint | None"

_DIGEST = hashlib.sha256().digest_size


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
            remove_abandoned(self.folder, SUFFIX)
        except OSError as error:
            raise write_error(self.folder, error) from error

    def get_or_render(
        self, inputs: Any, render: Callable[[], Tensors], device: torch.device | None = None
    ) -> Tensors:
        """Return the cached result for ``inputs`` on ``device``; call ``render`` and store it if there is none.

        ``inputs`` are everything that the result depends on: strings, numbers and tensors, in tuples and mappings.
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
        """Return the stored decision for ``inputs``, which depended on the clock; ``decide`` if there is none.

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
