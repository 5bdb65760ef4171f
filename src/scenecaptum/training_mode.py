"""Networks that a function calls, found without calling it, and a warning if one of them is in training mode."""

from __future__ import annotations

import contextlib
import dis
import functools
import inspect
import itertools
import types
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch.nn.modules.batchnorm import _NormBase
from torch.nn.modules.dropout import _DropoutNd

_PACKAGE = __name__.partition(".")[0]


def warn_of_training_mode(function: Callable[..., Any]) -> None:
    """Warn of every network in training mode that a function calls, or that it is itself."""
    name = getattr(function, "__name__", type(function).__name__)
    for place, network in _networks(function):
        if _trains(network):
            state = "is in training mode" if network.training else "has layers in training mode"
            calls = "" if network is function else f" calls {place} ({type(network).__name__}), which"
            warnings.warn(
                f"{name}{calls} {state}: dropout and batch normalization act as in training, and "
                f"running statistics change. Call .eval() on {place} first.",
                stacklevel=_outside(),
            )


def _trains(network: torch.nn.Module) -> bool:
    """Whether it has a layer in training mode that behaves differently there."""
    return any(layer.training and _differs_in_training(layer) for layer in _layers(network))


def _differs_in_training(layer: torch.nn.Module) -> bool:
    """Whether a layer itself, without those in it, behaves differently in training mode.

    What is not known, a class outside ``torch.nn`` or a layer with hooks such as spectral normalization, may do so
    if it has parameters or buffers, or a method that reads ``training``.
    """
    if not type(layer).__module__.startswith("torch.nn.modules.") or layer._forward_pre_hooks:
        own = itertools.chain(layer.parameters(recurse=False), layer.buffers(recurse=False))
        return next(own, None) is not None or _reads_training(type(layer))
    if isinstance(layer, _NormBase):
        return bool(layer.track_running_stats)  # else the batch's statistics in both modes
    if isinstance(layer, torch.nn.MultiheadAttention | torch.nn.RNNBase):
        return layer.dropout > 0
    return isinstance(layer, torch.nn.RReLU) or (isinstance(layer, _DropoutNd) and layer.p > 0)


def _reads_training(kind: type[torch.nn.Module]) -> bool:
    """Whether a method of a class, or of one outside ``torch`` that it inherits from, reads ``training``."""
    return any(
        isinstance(method, types.FunctionType) and "training" in method.__code__.co_names
        for cls in kind.__mro__
        if not cls.__module__.startswith("torch.")
        for method in vars(cls).values()
    )


def _layers(network: torch.nn.Module) -> Iterator[torch.nn.Module]:
    """Yield a network and all in it, without what is of this package.

    Its metrics run their networks in evaluation mode, and check the functions that they are given.
    """
    if not any(cls.__module__.partition(".")[0] == _PACKAGE for cls in type(network).__mro__):
        yield network
        for child in network.children():
            yield from _layers(child)


def _networks(function: Any) -> list[tuple[str, torch.nn.Module]]:
    """Return the networks that a callable refers to, by their names there."""
    found: list[tuple[str, torch.nn.Module]] = []
    seen: set[int] = set()
    waiting = [("the metric", function)]
    while waiting:
        place, value = waiting.pop(0)
        if id(value) in seen:
            continue
        seen.add(id(value))
        if isinstance(value, torch.nn.Module):
            found.append((place, value))
        else:
            waiting += _references(value)
    return found


def _references(value: Any) -> list[tuple[str, Any]]:
    """Return what a callable refers to that may be a network or call one, by its names there."""
    if isinstance(value, functools.partial):
        return [
            ("its function", value.func),
            *(("its argument", one) for one in value.args),
            *value.keywords.items(),
        ]
    if isinstance(value, list | tuple | dict):
        keyed = value.items() if isinstance(value, dict) else enumerate(value)
        return [(f"its element {key!r}", one) for key, one in keyed if isinstance(one, torch.nn.Module)]
    if isinstance(value, types.MethodType):
        return [("its function", value.__func__), ("self", value.__self__), *_attributes(value.__self__)]
    if isinstance(value, types.FunctionType):
        return [*_closure(value), *_globals(value)]
    if callable(value) and not isinstance(value, type | types.BuiltinFunctionType):
        return [("its function", type(value).__call__), *_attributes(value)]
    return []


def _attributes(owner: Any) -> list[tuple[str, Any]]:
    """Return the attributes of an object; those of a network are found with it."""
    if isinstance(owner, torch.nn.Module | type):
        return []
    return [(f"self.{name}", value) for name, value in getattr(owner, "__dict__", {}).items()]


def _closure(function: types.FunctionType) -> list[tuple[str, Any]]:
    """Return the variables of the enclosing functions, and the defaults of the arguments."""
    code = function.__code__
    defaults, positional = function.__defaults__ or (), code.co_varnames[: code.co_argcount]
    found = list(zip(positional[len(positional) - len(defaults) :], defaults, strict=True))
    found += (function.__kwdefaults__ or {}).items()
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # a variable without a value yet
            found.append((name, cell.cell_contents))
    return found


def _globals(function: types.FunctionType) -> list[tuple[str, Any]]:
    """Return the networks, and what can be called of the same file, that a function loads by name."""
    found = []
    for name in dict.fromkeys(_loaded(function.__code__)):
        value = function.__globals__.get(name)
        same_file = getattr(type(value), "__module__", None) == function.__module__ or (
            isinstance(value, types.FunctionType) and value.__globals__ is function.__globals__
        )
        of_networks = isinstance(value, torch.nn.Module | list | tuple | dict)
        if same_file or of_networks or isinstance(value, functools.partial | types.MethodType):
            found.append((name, value))
    return found


def _loaded(code: types.CodeType) -> Iterator[str]:
    """Yield the names of the global variables that code loads, that of functions inside too."""
    for instruction in dis.get_instructions(code):
        if instruction.opname == "LOAD_GLOBAL":
            yield instruction.argval
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _loaded(constant)


def _outside() -> int:
    """Return the ``stacklevel`` of the first caller outside this package, so that a line warns once."""
    level, frame = 1, inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == _PACKAGE:
        level, frame = level + 1, frame.f_back
    return level - 1
