"""Metrics by their names: those of the registry, and the user's own."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import sys
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import torch

from ..errors import SceneCaptumError, near_misses
from ..protocols import WithSensor

Metric: TypeAlias = Callable[[torch.Tensor], torch.Tensor]


class NamedMetric(NamedTuple):
    """A metric that can be created from a sensor and options alone; ``description`` says what it measures.

    ``create`` is the metric's class, or a function that returns it. It is given the camera as ``camera``, the
    points of a sensor grid as ``grid``, and every option of the command line under its own name, as far as it has
    these parameters.
    """

    create: Callable[..., Metric]
    description: str

    @property
    def parameters(self) -> Collection[str]:
        """The names of the parameters of ``create``."""
        return inspect.signature(self.create).parameters.keys()

    def create_for(self, renderer: WithSensor, options: Mapping[str, Any]) -> Metric:
        """Return the metric for the sensor of a ``SceneRenderer``, with the options that it has.

        Raises
        ------
        SceneCaptumError
            If it is a metric of a sensor grid, and the renderer shows a view.
        """
        known = {option: value for option, value in options.items() if option in self.parameters}
        # Not every sensor has a camera or a grid, and not every metric needs one.
        if "camera" in self.parameters:
            known["camera"] = renderer.camera
        if "grid" in self.parameters:
            if renderer.shows_a_view:
                raise SceneCaptumError(
                    f"A metric of points in a room ({self.description}): add --sensor grid, in Python "
                    'sensor="grid".'
                )
            if renderer.has_grid:  # otherwise an irradiance meter: every pixel counts
                known["grid"] = renderer.grid
        return self.create(**known)


def import_metric(name: str) -> Metric:
    """Import a metric of the user by ``FILE.py:NAME`` or ``MODULE:NAME``; a class is called without arguments.

    As with ``python FILE.py`` and ``python -m MODULE``, the folder of the file, or the current one, is on the
    import path from then on, so that a file can import those beside it.

    Raises
    ------
    SceneCaptumError
        If it cannot be imported, or is not callable.
    """
    module, _, attribute = name.rpartition(":")
    try:
        found = _import_module(module)
        imported = getattr(found, attribute, None)
    except Exception as error:  # the user's code may raise anything
        advice = ". 'scenecaptum doctor' shows the fix" if "torchvision" in str(error) else ""
        raise SceneCaptumError(
            f"The metric {name!r} cannot be imported: {type(error).__name__}: {error}{advice}"
        ) from error
    if imported is None:
        names = [own for own, value in vars(found).items() if callable(value) and not own.startswith("_")]
        known = f" It has {', '.join(names)}." if names else ""
        raise SceneCaptumError(
            f"The metric {name!r} cannot be imported: {module} has no {attribute!r}."
            f"{near_misses(attribute, names, instead=known)}"
        )
    metric: Metric = imported() if isinstance(imported, type) else imported
    if not callable(metric):
        raise SceneCaptumError(f"The metric {name!r} is {type(metric).__name__}, not a function of an image.")
    return metric


def _import_module(name: str) -> Any:
    """Import a module by its name, or by its path if it ends in ``.py``."""
    is_file = name.endswith(".py")
    folder = str(Path(name).resolve().parent if is_file else Path.cwd())
    if folder not in sys.path:
        sys.path.insert(0, folder)
    if not is_file:
        return importlib.import_module(name)
    spec = importlib.util.spec_from_file_location(Path(name).stem, name)
    if spec is None or spec.loader is None:
        raise ImportError(name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
