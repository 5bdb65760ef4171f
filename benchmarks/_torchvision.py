"""torchvision where its CUDA wheel stands beside a CPU-only torch, as it does on machines without a GPU."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import torch

_KEPT: list[Any] = []  # operators exist as long as the library that defined them


def load() -> Any:
    """Import torchvision, and define the two operators of object detection that such a pair lacks.

    Networks, weights and transforms work then; ``torchvision.ops.nms`` does not.

    Raises
    ------
    ModuleNotFoundError
        If torchvision is not installed.
    """
    try:
        return importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::nms" not in str(error):
            raise
    for name in [name for name in sys.modules if name.partition(".")[0] == "torchvision"]:
        del sys.modules[name]  # partially imported
    library = torch.library.Library("torchvision", "FRAGMENT")
    for name in ("nms", "qnms"):
        library.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _KEPT.append(library)
    return importlib.import_module("torchvision")
