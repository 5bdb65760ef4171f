"""Make Mitsuba ready: select a differentiable variant on a compiler that works, or explain what is missing.

Dr.Jit compiles rendering kernels with LLVM (CPU) or CUDA (GPU), and takes its choice of LLVM when it is first
imported; so whatever needs Mitsuba calls `activate`, which chooses before it imports.

Example
-------
>>> import scenecaptum as sc
>>> mi = sc.activate()
>>> scene = mi.load_dict(mi.cornell_box())
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any

from ._diagnosis import Diagnosis, default_variant, diagnose, no_llvm_message
from ._llvm import OLDEST_LLVM, PATH_VARIABLE, choose_llvm, prepare_llvm
from .errors import BackendError, near_misses

if TYPE_CHECKING:
    import torch

__all__ = ["Diagnosis", "activate", "default_variant", "device", "diagnose", "dispose", "exclusively", "main"]

# Dr.Jit's state belongs to the whole process, and torch may run a backward pass on another thread.
_LOCK = threading.RLock()
_depth = 0  # of nested calls of ``exclusively``, by the thread that holds the lock
_disposed: list[Any] = []

_is_forked = False


def _note_fork() -> None:
    global _is_forked  # noqa: PLW0603 -- it is a fact about the process
    _is_forked = _is_forked or _active_variant() is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


def activate(variant: str | None = None) -> ModuleType:
    """Make Mitsuba ready for differentiable rendering and return the ``mitsuba`` module.

    Call it before importing ``mitsuba`` or ``drjit`` yourself; calling it again costs nothing. If it is
    the first to import Mitsuba, it quietens the log to errors; ``mi.set_log_level`` turns it up again.

    Parameters
    ----------
    variant
        A differentiable Mitsuba variant: ``"llvm_ad_rgb"`` or ``"cuda_ad_rgb"`` for a ``SceneRenderer``, which
        renders in RGB. If omitted, a differentiable variant that is already active stays; otherwise it is
        ``cuda_ad_rgb`` where a trial render on a CUDA device succeeds, else ``llvm_ad_rgb``. Scenes belong to the
        variant they were loaded under, so load them again after a change.

    Returns
    -------
    module
        ``mitsuba``.

    Raises
    ------
    BackendError
        If no usable LLVM or CUDA exists, the variant is unknown or cannot be differentiated, or this process was
        forked from one that had a variant: its threads are gone, and a render would wait for them for ever.

    Example
    -------
    >>> mi = activate()
    >>> mi.variant()
    'llvm_ad_rgb'
    """
    _refuse_after_fork()
    wanted = variant or _active_variant() or default_variant()
    if "drjit" not in sys.modules and prepare_llvm() is None and not wanted.startswith("cuda"):
        raise BackendError(no_llvm_message())
    first = "mitsuba" not in sys.modules
    mi = _import_mitsuba()
    if first:
        mi.set_log_level(mi.LogLevel.Error)  # its warnings would break progress bars and reports apart
    _check_variant(wanted, mi.variants(), asked=variant is not None)
    _check_compiler(wanted)
    if mi.variant() != wanted:
        mi.set_variant(wanted)
    return mi


@contextlib.contextmanager
def exclusively(variant: str | None = None) -> Iterator[ModuleType]:
    """Have Mitsuba to this thread alone, under a differentiable variant, and give back the caller's afterwards.

    Parameters
    ----------
    variant
        The variant; by default the active one if it renders RGB with derivatives, else ``default_variant()``.
    """
    global _depth  # noqa: PLW0603 -- like the lock that guards it
    _refuse_after_fork()  # before the lock: a thread that the fork has left behind may hold it
    with _LOCK:
        callers = _active_variant()
        if variant is None and callers is not None and not callers.endswith("_ad_rgb"):
            variant = default_variant()
        mi = activate(variant)
        _depth += 1
        try:
            yield mi
        finally:
            _depth -= 1
            if callers is not None and mi.variant() != callers:
                mi.set_variant(callers)
            if not _depth:
                _disposed.clear()


def dispose(what: Any) -> None:
    """Let go of what holds a scene once no kernel is being recorded: going then, it would end the process."""
    _disposed.append(what)
    if not _is_forked and _LOCK.acquire(blocking=False):
        try:
            if not _depth:
                _disposed.clear()
        finally:
            _LOCK.release()


def device() -> torch.device:
    """Return the torch device on which the active variant's images and gradients live."""
    import torch  # this module must stay importable without torch

    variant: str = activate().variant()
    return torch.device("cuda" if variant.startswith("cuda") else "cpu")


def _refuse_after_fork() -> None:
    if _is_forked:
        raise BackendError(
            "This process was forked from one in which Mitsuba was ready to render, and its threads did not come "
            "along: a render would hang. Start workers with the method 'spawn' (for a DataLoader "
            "multiprocessing_context='spawn'), and load the scene in the worker."
        )


def _active_variant() -> str | None:
    mi = sys.modules.get("mitsuba")
    variant: str | None = mi.variant() if mi is not None else None
    return variant


def _import_mitsuba() -> ModuleType:
    try:
        import mitsuba  # its import fixes the choice of LLVM, so it comes last
    except ImportError as error:
        raise BackendError(
            f"Mitsuba cannot be imported: {error}. Fix: pip install 'mitsuba>=3.9,<3.10'"
        ) from error
    module: ModuleType = mitsuba
    return module


def _check_variant(wanted: str, known: list[str], *, asked: bool) -> None:
    """Raise unless the variant exists and has derivatives."""
    differentiable = [name for name in known if "_ad_" in name]
    if wanted not in known:
        hint = near_misses(wanted, differentiable)
        raise BackendError(
            f"Unknown Mitsuba variant {wanted!r}.{hint} Differentiable variants: {', '.join(differentiable)}."
        )
    if wanted not in differentiable:
        cause = "" if asked else f" It was set by mi.set_variant({wanted!r}): remove that line."
        raise BackendError(
            f"Mitsuba's variant {wanted!r} cannot be differentiated; one with '_ad_' in its name is needed."
            f"{cause} Fix: call scenecaptum.activate({default_variant()!r})."
        )


def _check_compiler(variant: str) -> None:
    """Raise where Dr.Jit, as it was imported, would abort or fail on this variant."""
    import drjit as dr  # importing it loads LLVM

    if variant.startswith("cuda"):
        if not dr.has_backend(dr.JitBackend.CUDA):
            raise BackendError(
                f"{variant} needs CUDA, and Dr.Jit found none. Fix: scenecaptum.activate('llvm_ad_rgb')"
            )
        return
    version = dr.detail.llvm_version()[0] if dr.has_backend(dr.JitBackend.LLVM) else None
    if version is not None and version >= OLDEST_LLVM:
        return
    library = choose_llvm()
    if library is None:
        raise BackendError(no_llvm_message())
    loaded = f"LLVM {version}, which it cannot compile with" if version else "no LLVM that it could load"
    raise BackendError(
        f"Dr.Jit was imported with {loaded}, and this cannot be changed any more. Fix: call "
        f"scenecaptum.activate() before importing mitsuba or drjit, or start Python with "
        f"{PATH_VARIABLE}={library.path}"
    )


def main() -> int:
    """Print the diagnosis and return the exit status: 0 when scenes can be rendered, else 1."""
    diagnosis = diagnose()
    print(diagnosis)
    return 0 if diagnosis.ok else 1


if __name__ == "__main__":
    sys.exit(main())
