"""Differences of logits: of one class minus another, or minus the best other class."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypeAlias

import torch

from ..errors import SceneCaptumError
from ._classes import check_class, class_index

Against: TypeAlias = "int | Literal['best'] | None"


def resolve_against(against: int | str | None, target: int | None, classes: Sequence[str]) -> Against:
    """Return the index of the other class, or ``"best"`` unless a class has this name; raise if invalid."""
    if against is None:
        return None
    if against == "best" and "best" not in classes:
        return "best"
    index = class_index(against, classes, "against")
    if index == target:
        raise SceneCaptumError(
            f"against={against!r} is the target itself, so that the difference is always 0: choose another class, "
            'or against="best".'
        )
    return index


def differences(logits: torch.Tensor, against: Against, model: object) -> torch.Tensor:
    """Return the logits of all classes minus that of another, or each minus the best other; ``(N, classes)``."""
    if against is None:
        return logits
    if against != "best":
        check_class(against, logits.shape[1], model, "against")
        return logits - logits[:, against : against + 1]
    if logits.shape[1] < 2:
        raise SceneCaptumError(
            f'against="best" needs at least two classes, and {type(model).__name__} has one.'
        )
    best = logits.topk(2, dim=1)
    is_best = torch.arange(logits.shape[1], device=logits.device) == best.indices[:, :1]
    return logits - torch.where(is_best, best.values[:, 1:], best.values[:, :1])
