"""Pretrained models from torchvision, an optional dependency that is imported lazily."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import torch

from ..errors import SceneCaptumError, near_misses


def load_pretrained(name: str, weights: Any) -> tuple[torch.nn.Module, Any]:
    """Return a torchvision model in evaluation mode, and the weights it was loaded with."""
    models = _models()
    known = models.list_models()
    if name not in known:
        raise SceneCaptumError(
            f"torchvision has no model called {name!r}.{near_misses(name, known)} "
            "torchvision.models.list_models() lists them."
        )
    chosen = _member(models.get_model_weights(name), name, weights)
    try:
        model: torch.nn.Module = models.get_model(name, weights=chosen)
    except (OSError, RuntimeError) as error:  # no connection, or a file that is incomplete
        raise SceneCaptumError(_not_loaded(name, chosen, error)) from error
    return model.eval(), chosen


def _models() -> ModuleType:
    try:
        from torchvision import models
    except ImportError as error:
        raise SceneCaptumError(
            "torchvision, which provides the pretrained classifiers, is not installed. Fix: "
            "pip install 'scenecaptum[vision]'. Without it, metrics.ClassLogit accepts any model of your own, and "
            "metrics.ShapeClassifier.pretrained() ships with scenecaptum."
        ) from error
    except RuntimeError as error:  # 'operator torchvision::nms does not exist'
        raise SceneCaptumError(
            f"torchvision does not match the installed torch {torch.__version__}: {error}. Fix: install "
            "torchvision for this torch; `scenecaptum doctor` prints how"
        ) from error
    module: ModuleType = models
    return module


def _member(enumeration: Any, name: str, weights: Any) -> Any:
    if isinstance(weights, enumeration):
        return weights
    short = str(weights).rpartition(".")[2]  # accept 'ResNet50_Weights.IMAGENET1K_V2' and 'IMAGENET1K_V2'
    names = list(enumeration.__members__)
    if not isinstance(weights, str) or short not in names:
        raise SceneCaptumError(
            f"{weights!r} is not one of the weights of {name}: {', '.join(names) or 'none'}."
        )
    return enumeration[short]


def _not_loaded(name: str, chosen: Any, error: Exception) -> str:
    folder = f"{torch.hub.get_dir()}/checkpoints"
    return (
        f"The weights {chosen} of {name} cannot be loaded: {error}. Without a connection, download {chosen.url} "
        f"on another machine and copy the file to {folder} with the same name, replacing a damaged one; or "
        "use metrics.ShapeClassifier.pretrained(), which ships with scenecaptum."
    )
