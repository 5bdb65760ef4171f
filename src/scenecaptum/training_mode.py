"""Networks that a function refers to, found without calling it; a warning if one is in training mode."""

from __future__ import annotations

import collections
import contextlib
import dis
import functools
import inspect
import itertools
import types
import warnings
from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import torch
from torch.nn.modules.batchnorm import _NormBase
from torch.nn.modules.dropout import _DropoutNd

Reference: TypeAlias = "tuple[str, Any]"  # the expression for a value, and the value

_PACKAGE = __name__.partition(".")[0]
_CONTAINERS = (dict, list, tuple, set, frozenset)
_FOLLOWED = (torch.nn.Module, *_CONTAINERS, types.SimpleNamespace, functools.partial, types.MethodType)
# What is frequent in containers, and is and contains no network.
_LEAVES = frozenset({str, bytes, bool, int, float, complex, type(None), torch.Tensor})


def warn_of_training_mode(function: Callable[..., Any]) -> None:
    """Warn of every network in training mode that a function refers to, or that it is itself."""
    name = getattr(function, "__name__", type(function).__name__)
    for place, network in _networks(function):
        if _trains(network):
            state = "is in training mode" if network.training else "has layers in training mode"
            refers = "" if network is function else f" refers to {place} ({type(network).__name__}), which"
            warnings.warn(
                f"{name}{refers} {state}: layers such as dropout and batch normalization act as in training, and "
                f"may change their statistics. Call .eval() on {place} first.",
                stacklevel=_outside(),
            )


def _trains(network: torch.nn.Module) -> bool:
    """Whether it has a layer in training mode that behaves differently there."""
    return any(layer.training and _differs_in_training(layer) for layer in _layers(network))


def _differs_in_training(layer: torch.nn.Module) -> bool:
    """Whether a layer itself, without those in it, behaves differently in training mode.

    What is not known, a layer with hooks or a class of torch outside ``torch.nn.modules`` such as spectral
    normalization, may do so if it has parameters or buffers.
    """
    kind = type(layer).__module__
    if layer._forward_pre_hooks or (kind.startswith("torch.") and not kind.startswith("torch.nn.modules.")):
        own = itertools.chain(layer.parameters(recurse=False), layer.buffers(recurse=False))
        return next(own, None) is not None
    if isinstance(layer, _NormBase):
        return bool(layer.track_running_stats)  # else the batch's statistics in both modes
    if isinstance(layer, torch.nn.MultiheadAttention | torch.nn.RNNBase) and layer.dropout > 0:
        return True
    if isinstance(layer, torch.nn.RReLU) or (isinstance(layer, _DropoutNd) and layer.p > 0):
        return True
    return _reads_training(type(layer))


def _reads_training(kind: type[torch.nn.Module]) -> bool:
    """Whether a method of a class, or of one outside ``torch`` that it inherits from, reads ``training``."""
    members = [
        member.fget if isinstance(member, property) else member
        for cls in kind.__mro__
        if not cls.__module__.startswith("torch.")
        for member in vars(cls).values()
    ]
    functions = [inspect.unwrap(one) for one in members if callable(one)]
    return any(_names_training(one.__code__) for one in functions if isinstance(one, types.FunctionType))


def _names_training(code: types.CodeType) -> bool:
    """Whether code, or that of a function inside, has the name ``training``, or the string for getattr."""
    inside = (one for one in code.co_consts if isinstance(one, types.CodeType))
    return "training" in (*code.co_names, *code.co_consts) or any(map(_names_training, inside))


def _layers(network: torch.nn.Module) -> Iterator[torch.nn.Module]:
    """Yield a network and all in it, without what is of this package.

    Its metrics run their networks in evaluation mode, and check the functions that they are given.
    """
    if not any(cls.__module__.partition(".")[0] == _PACKAGE for cls in type(network).__mro__):
        yield network
        for child in network.children():
            yield from _layers(child)


def _networks(function: Any) -> list[Reference]:
    """Return the networks that a callable refers to, each once, with the expressions for them there."""
    if isinstance(function, torch.nn.Module):
        return [("the metric", function)]
    found: list[Reference] = []
    seen: dict[int, Any] = {}  # with the objects, so that no other gets the identity of one that is gone
    waiting = collections.deque([("partial" if _is_partial(function) else "self", function, "")])
    while waiting:
        place, value, module = waiting.popleft()
        if id(value) in seen:
            continue
        seen[id(value)] = value
        if isinstance(value, torch.nn.Module):
            found.append((place, value))
        else:
            module = _module_of(value) if callable(value) else module
            waiting.extend((*reference, module) for reference in _references(place, value, module))
    return found


def _references(place: str, value: Any, module: str) -> list[Reference]:
    """Return what a value refers to that may be a network or lead to one.

    ``place`` is the expression for the value, ``module`` the name of the file of the function that refers to it.
    """
    if _is_partial(value):
        return [(f"{place}.func", value.func), *_arguments(place, value)]
    if isinstance(value, _CONTAINERS):
        return _elements(place, value)
    if isinstance(value, types.MethodType):
        owner = place if place == "self" else f"{place}.__self__"
        return [(place, value.__func__), (owner, value.__self__), *_attributes(owner, value.__self__)]
    if isinstance(value, types.FunctionType):
        return [*_closure(value), *_globals(value)]
    if callable(value) and not isinstance(value, type | types.BuiltinFunctionType):
        return [(place, type(value).__call__), *_attributes(place, value)]
    if isinstance(value, types.SimpleNamespace) or type(value).__module__ == module:
        return _attributes(place, value)
    return []


def _is_partial(value: Any) -> bool:
    return isinstance(value, functools.partial)


def _module_of(function: Any) -> str:
    """Return the name of the file in which a function, or the class of an object, is defined."""
    if _is_partial(function):
        return _module_of(function.func)
    is_function = isinstance(function, types.FunctionType | types.MethodType)
    return str((function if is_function else type(function)).__module__)


def _arguments(place: str, partial: functools.partial[Any]) -> list[Reference]:
    """Return the arguments of a partial function, by the names of the function's parameters."""
    try:
        bound = inspect.signature(partial.func).bind_partial(*partial.args, **partial.keywords)
    except (TypeError, ValueError):  # the function has no signature, or not these arguments
        return [(f"{place}.args", partial.args), *partial.keywords.items()]
    return list(bound.arguments.items())


def _elements(place: str, container: Any) -> list[Reference]:
    """Return the elements of a container that are no numbers, strings or tensors."""
    if isinstance(container, set | frozenset):
        return [(f"an element of {place}", one) for one in container if type(one) not in _LEAVES]
    keyed = container.items() if isinstance(container, dict) else enumerate(container)
    return [(f"{place}[{key!r}]", one) for key, one in keyed if type(one) not in _LEAVES]


def _attributes(place: str, owner: Any) -> list[Reference]:
    """Return the attributes of an object; those of a network are found with it."""
    if isinstance(owner, torch.nn.Module | type):
        return []
    return [(f"{place}.{name}", value) for name, value in getattr(owner, "__dict__", {}).items()]


def _closure(function: types.FunctionType) -> list[Reference]:
    """Return the variables of the enclosing functions, and the defaults of the arguments."""
    code = function.__code__
    defaults, positional = function.__defaults__ or (), code.co_varnames[: code.co_argcount]
    found = list(zip(positional[len(positional) - len(defaults) :], defaults, strict=True))
    found += (function.__kwdefaults__ or {}).items()
    for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # a variable without a value yet
            found.append((name, cell.cell_contents))
    return found


def _globals(function: types.FunctionType) -> list[Reference]:
    """Return what a function loads by name: networks, what may contain them, and what is of the same file."""
    found = []
    for name in dict.fromkeys(_loaded(function.__code__)):
        value = function.__globals__.get(name)
        same_file = getattr(type(value), "__module__", None) == function.__module__ or (
            isinstance(value, types.FunctionType) and value.__globals__ is function.__globals__
        )
        if same_file or isinstance(value, _FOLLOWED):
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
