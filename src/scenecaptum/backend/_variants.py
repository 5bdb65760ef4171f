"""Select a variant, import Mitsuba, and hold the lock of the process while Dr.Jit works."""

from __future__ import annotations

import contextlib
import gc
import inspect
import os
import sys
import threading
import warnings
import weakref
from collections.abc import Iterator
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar, cast

from ..errors import BackendError, near_misses
from ._diagnosis import default_variant, no_llvm_message
from ._llvm import OLDEST_LLVM, PATH_VARIABLE, choose_llvm, prepare_llvm

if TYPE_CHECKING:
    import torch

# Dr.Jit's state belongs to the whole process, and torch may run a backward pass on another thread. No array or
# scene is freed without the lock either. A thread that launches a frozen kernel would find fewer objects than it
# has recorded, or wait forever: it has Dr.Jit's own lock and needs Python's, while the thread that frees an array
# has Python's and needs Dr.Jit's.
_LOCK = threading.RLock()
_depth = 0  # of nested ``exclusively`` calls, in the thread that holds the lock
_disposed: list[dict[str, Any]] = []  # the attributes of objects that are gone

_is_collecting = False  # Python's garbage, with the lock
_is_forked = False


def _note_fork() -> None:
    global _is_forked  # noqa: PLW0603 -- a property of the process
    _is_forked = _is_forked or _active_variant() is not None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


def activate(variant: str | None = None) -> ModuleType:
    """Prepare Mitsuba for differentiable rendering and return the ``mitsuba`` module.

    Call it before importing ``mitsuba`` or ``drjit`` yourself; repeated calls cost nothing. If it is the first to
    import Mitsuba, it sets the log level to errors only; ``mi.set_log_level`` changes it.

    Parameters
    ----------
    variant
        A differentiable Mitsuba variant: ``"llvm_ad_rgb"`` or ``"cuda_ad_rgb"`` for a ``SceneRenderer``, which
        renders in RGB. By default an active differentiable variant is kept; otherwise it is ``cuda_ad_rgb`` if a
        test render on a CUDA device succeeds, else ``llvm_ad_rgb``. Scenes belong to the variant under which they
        were loaded, so load them again after a change.

    Returns
    -------
    module
        ``mitsuba``.

    Raises
    ------
    BackendError
        If no usable LLVM or CUDA exists, the variant is unknown or not differentiable, or this process was forked
        from one with an active variant: it lacks Dr.Jit's threads, and a render would wait for them forever.

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
    if _lock_collector not in gc.callbacks:
        gc.callbacks.append(_lock_collector)
    if first:
        mi.set_log_level(mi.LogLevel.Error)  # its warnings would disrupt progress bars and reports
    _check_variant(wanted, mi.variants(), asked=variant is not None)
    _check_compiler(wanted)
    if mi.variant() != wanted:
        mi.set_variant(wanted)
    return mi


@contextlib.contextmanager
def exclusively(variant: str | None = None) -> Iterator[ModuleType]:
    """Lock Mitsuba for this thread, under a differentiable variant, and restore the caller's variant afterwards.

    By default it is the active variant if that is differentiable and RGB, else ``default_variant()``.
    """
    global _depth  # noqa: PLW0603 -- like the lock that guards it
    _refuse_after_fork()  # before the lock, which a thread of the parent process may have held
    with _LOCK:
        previous = _active_variant()
        if variant is None and previous is not None and not previous.endswith("_ad_rgb"):
            variant = default_variant()
        mi = activate(variant)
        _depth += 1
        try:
            yield mi
        finally:
            _depth -= 1
            if previous is not None and mi.variant() != previous:
                mi.set_variant(previous)
            if not _depth:
                _free_disposed()


def warn_unless_rgb() -> None:
    """Warn that a scene which is loaded now is rendered in RGB, if the user's variant is not one of RGB."""
    previous = _active_variant()
    if previous is not None and not previous.endswith("_rgb"):
        warnings.warn(
            f"The variant {previous} is active, but a SceneRenderer renders in RGB: it uses {default_variant()}, "
            "and spectra become RGB colours. Your variant stays active for your own code.",
            stacklevel=3,  # where the renderer is created
        )


_Owner = TypeVar("_Owner", bound="SceneOwner")


class SceneOwner:
    """Base of objects that lead to a scene or to Dr.Jit's arrays; what they refer to is freed under the lock."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # Sphinx shows the signature of __new__ where there is one, and that says nothing.
        if "__init__" in vars(cls):
            _, *others = inspect.signature(cls.__init__).parameters.values()
            cls.__signature__ = inspect.Signature(others)  # type: ignore[attr-defined]

    def __new__(cls: type[_Owner], *_: Any, **__: Any) -> _Owner:
        self = super().__new__(cls)
        weakref.finalize(self, _dispose, self.__dict__).atexit = False
        return self


def _dispose(attributes: dict[str, Any]) -> None:
    """Free the attributes of an object that is going, or leave that to the thread that has the lock."""
    _disposed.append(attributes.copy())
    # The object and the caller of this function refer to the dictionary until they are gone.
    attributes.clear()
    if not _is_forked and _LOCK.acquire(blocking=False):
        try:
            if not _depth:
                _free_disposed()
        finally:
            _LOCK.release()


def _free_disposed() -> None:
    while _disposed:  # an owner that goes may have been the last reference to another
        _disposed.pop()


def _lock_collector(phase: str, _: Any) -> None:
    """Let Python collect garbage under the lock: each frozen function that has gone is a cycle of references."""
    global _is_collecting  # noqa: PLW0603 -- like the lock that it is about
    if phase == "start":
        # When Python ends, a thread that has the lock does not run any more.
        _is_collecting = not (_is_forked or sys.is_finalizing()) and _LOCK.acquire()
    elif _is_collecting:
        _is_collecting = False
        _LOCK.release()


def device() -> torch.device:
    """Return the torch device of the active variant's images and gradients."""
    import torch  # this module must stay importable without torch

    variant: str = activate().variant()
    return torch.device("cuda" if variant.startswith("cuda") else "cpu")


def _refuse_after_fork() -> None:
    if _is_forked:
        raise BackendError(
            "This process was forked from one with an active Mitsuba variant, and a fork does not copy its "
            "threads: a render would hang. Start workers with the method 'spawn' (for a DataLoader "
            "multiprocessing_context='spawn'), and load the scene in the worker."
        )


def _active_variant() -> str | None:
    mi = sys.modules.get("mitsuba")
    return cast("str | None", mi.variant()) if mi is not None else None


def _import_mitsuba() -> ModuleType:
    try:
        import mitsuba  # last, because its import loads LLVM
    except ImportError as error:
        raise BackendError(
            f"Mitsuba cannot be imported: {error}. Fix: pip install 'mitsuba>=3.9,<3.10'"
        ) from error
    return cast(ModuleType, mitsuba)


def _check_variant(wanted: str, known: list[str], *, asked: bool) -> None:
    """Raise unless the variant exists and is differentiable."""
    differentiable = [name for name in known if "_ad_" in name]
    if wanted not in known:
        in_rgb = [name for name in differentiable if name.endswith("_ad_rgb")]  # which a SceneRenderer needs
        raise BackendError(
            f"Unknown Mitsuba variant {wanted!r}.{near_misses(wanted, in_rgb)} Those of a SceneRenderer: "
            f"{', '.join(in_rgb)}."
        )
    if wanted not in differentiable:
        cause = "" if asked else f" It was set by mi.set_variant({wanted!r}): remove that line."
        raise BackendError(
            f"Mitsuba's variant {wanted!r} cannot be differentiated; use one with '_ad_' in its name."
            f"{cause} Fix: call scenecaptum.activate({default_variant()!r})."
        )


def _check_compiler(variant: str) -> None:
    """Raise if the imported Dr.Jit would abort or fail on this variant."""
    import drjit as dr  # which loads LLVM

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
    loaded = f"LLVM {version}, which it cannot use" if version else "no LLVM library that it could load"
    raise BackendError(
        f"Dr.Jit was imported with {loaded}, and this cannot be changed afterwards. Fix: call "
        f"scenecaptum.activate() before importing mitsuba or drjit, or start Python with "
        f"{PATH_VARIABLE}={library.path}"
    )
