"""Classes of a network by index or by name."""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import torch

from ..errors import SceneCaptumError, listed, near_misses, whole_number
from ..visualization import pluralize

_ROUNDING = 1e-4  # error of a sum of probabilities in single precision, with room


def class_names(model: object, classes: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the classes: those given, or the model's own, or none."""
    own = getattr(model, "classes", None)
    return tuple(classes if classes is not None else own if isinstance(own, list | tuple) else ())


def class_index(target: int | str, classes: Sequence[str], setting: str = "target") -> int:
    """Return the index of a class that is given by its index or its name; raise if there is none."""
    if not isinstance(target, str):
        return whole_number(setting, target, 0, len(classes) - 1 if classes else None)
    if target in classes:
        return classes.index(target)
    known = (
        f"It has {len(classes)} classes{listed(classes)}.{near_misses(target, classes)}"
        if classes
        else "Give the names of its classes with classes=, or the class's index."
    )
    raise SceneCaptumError(f"The model has no class called {target!r}. {known}")


def from_start(index: int | None, count: int) -> int | None:
    """Return a negative index, from the end of ``count`` classes, as that from the start."""
    return index + count if index is not None and -count <= index < 0 else index


def class_name(index: int | None, classes: Sequence[str]) -> str:
    """Return the name of a class, or ``class 3`` without names."""
    return classes[index] if index is not None and 0 <= index < len(classes) else f"class {index}"


def named_class(index: int | None, classes: Sequence[str]) -> str:
    """Return an index with the name of the class, for ``extra_repr``."""
    return f"{index} ({classes[index]})" if index is not None and classes else f"{index}"


def check_names(classes: Sequence[str], count: int, model: object) -> None:
    """Raise if there are names of classes, but not one for each output of the model."""
    if classes and len(classes) != count:
        name = type(model).__name__
        raise SceneCaptumError(
            f"{name} returns {pluralize(count, 'logit')}, but has {pluralize(len(classes), 'name')} of classes: "
            "give classes= with one name for each logit, in their order, or none."
        )


def warn_of_probabilities(output: torch.Tensor, model: object) -> None:
    """Warn if what a model returns as the logits of its classes, along the second axis, has had a softmax."""
    classes = output.detach().double()
    if classes.shape[1] > 1 and bool((classes >= 0).all() & ((classes.sum(1) - 1).abs() <= _ROUNDING).all()):
        warnings.warn(
            f"The output of {type(model).__name__} looks like probabilities: no number is negative, and their sum "
            "over the classes is 1. Logits are expected, as a softmax is taken of them: return what goes into the "
            "network's own softmax.",
            stacklevel=2,  # one line for all calls of the model, which warns once
        )


def check_class(index: int, count: int, model: object, setting: str = "target") -> None:
    """Raise if the output of a model with so many classes has no such class."""
    if index >= count:
        raise SceneCaptumError(
            f"{setting}={index} is not a class of {type(model).__name__}: it has {count} classes, 0 to "
            f"{count - 1}."
        )
