"""Studies: the question of an attribution for many scenes, cameras, metrics, designs, methods and seeds."""

from __future__ import annotations

import dataclasses
import inspect
import itertools
import json
import os
import time
from collections.abc import Generator, Iterable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

from ..attr import METHODS, versions
from ..camera import View
from ..checkpoint import digest
from ..errors import SceneCaptumError, check_seed, near_misses
from ..executors import Workers
from ..grid import SensorGrid
from ..scene import portable
from ._file import read_study
from ._folder import StudyFolder
from ._metrics import check_camera, check_element, check_metric, default_depth
from ._progress import Progress
from ._recipe import AXES, Cell, Recipe, digest_of_scene
from ._result import StudyResult
from ._run import on_executor, on_workers
from ._worker import VALUE, compute_cell, host_name

# The entries of an axis by name, or a list of entries that have names of their own.
Axis: TypeAlias = "Mapping[str, Any] | Sequence[Any]"

AS_IS = "as it is"


class Study:
    """Cells for scenes × cameras × metrics × designs × methods × seeds, each an attribution or a metric's value.

    Example
    -------
    >>> from scenecaptum.studies import Study
    >>> study = Study(["cornell-box", "office"], metrics=["luminance", "ugr"], spp=16, resolution=(32, 18))
    >>> len(study), study.cells[0].metric
    (4, 'luminance')
    >>> result = study.run("results")  # doctest: +SKIP

    A cell is a recipe, never a live scene, so that it can be computed in any process. Each has its own seed: the
    numbers do not depend on the executor, the number of workers or the order of the cells.

    Parameters
    ----------
    scenes
        Paths, bundled names or Mitsuba dicts: a list, or a dict by name.
    cameras
        By name, or a list: an index of the scene's sensors, a `View`, or ``"fisheye"``, ``"grid"`` or a
        ``SensorGrid``, as for ``sensor=`` of `SceneRenderer`; a dict has the arguments of a `View`.
    metrics
        By name, or a list: the names of the command line, ``"FILE.py:NAME"`` or ``"MODULE:NAME"``, functions at
        the top level of a module, or dicts of such a ``metric`` with its options:
        ``{"metric": "ugr", "threshold_factor": 5}``. ``target``, the index or the class of an element, is an
        option of ``"shape-logit"`` and of your own metrics.
    designs
        Values or changes of inputs, by name: ``{"lighter": {"*wall*.reflectance.value*": 1.2}}`` multiplies all
        that the glob matches. A last ``+`` adds. By default the scene as it is.
    methods
        By name, or a list: the names of the command line, such as ``"gradient"`` or ``"smooth-grad"``; ``"value"``
        for the metric alone; or dicts of a ``method`` with its options:
        ``{"method": "gradient", "groups": "kind"}``.
    seeds
        Random seeds, one cell each.
    cells
        The cells of the study, if not all of the grid: sequences of five names and a seed, or dicts of these.
    inputs, resolution, spp, max_depth, parameters, ranges, objects
        As for `SceneRenderer`, of all cells. The depth is 6 by default, and 10 for metrics of daylight.

    Attributes
    ----------
    cells : list of Cell
        In the order in which they are begun: cells of one scene and camera after each other.

    Raises
    ------
    SceneCaptumError
        If an axis is empty or has a name twice, a metric, a method or an option is unknown, or an entry cannot be
        sent to other processes.
    """

    def __init__(  # noqa: PLR0913 -- the axes, and what all cells have in common
        self,
        scenes: Axis,
        *,
        cameras: Axis = (0,),
        metrics: Axis = ("luminance",),
        designs: Mapping[str, Mapping[str, Any]] | None = None,
        methods: Axis = ("gradient",),
        seeds: Sequence[int] = (0,),
        cells: Iterable[Sequence[Any] | Mapping[str, Any]] | None = None,
        inputs: Any = "materials",
        resolution: tuple[int, int] | None = (160, 90),
        spp: int | None = 64,
        max_depth: int | Literal["auto"] | None = "auto",
        parameters: Mapping[str, Any] | None = None,
        ranges: Mapping[str, tuple[float, float]] | None = None,
        objects: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self._axes: dict[str, dict[str, Any]] = {
            "scene": {name: portable(one) for name, one in _axis("scenes", scenes).items()},
            "camera": {name: _camera(one) for name, one in _axis("cameras", cameras).items()},
            "metric": {name: _with_options("metric", one) for name, one in _axis("metrics", metrics).items()},
            "design": _axis("designs", {AS_IS: {}} if designs is None else designs),
            "method": {name: _with_options("method", one) for name, one in _axis("methods", methods).items()},
        }
        for name, (metric, options) in self._axes["metric"].items():
            check_metric(name, metric, options)
        for method, _ in self._axes["method"].values():
            _check_method(method)
        self.seeds = [check_seed("seeds", seed) for seed in seeds]
        self._renderer_options = {
            "inputs": inputs,
            "resolution": resolution,
            "spp": spp,
            "max_depth": max_depth,
            "parameters": parameters,
            "ranges": ranges,
            "objects": objects,
        }
        self.cells = self._grid() if cells is None else [self._cell(one) for one in cells]
        for cell in self.cells:
            check_camera(cell.metric, self._axes["metric"][cell.metric][0], self._axes["camera"][cell.camera])
        if len(set(self.cells)) < len(self.cells) or not self.cells:
            raise SceneCaptumError("A study needs at least one cell, and each only once.")
        self._scene_digests = {name: digest_of_scene(one) for name, one in self._axes["scene"].items()}

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Study:
        """Return the study that a TOML or JSON file describes, with the names of this class's parameters.

        Paths of scenes and of metrics are relative to the file.

        Raises
        ------
        SceneCaptumError
            If the file cannot be read, or describes no study.
        """
        return cls(**read_study(Path(path), inspect.signature(cls).parameters.keys()))

    def __len__(self) -> int:
        return len(self.cells)

    def _grid(self) -> list[Cell]:
        axes: list[Iterable[Any]] = [*self._axes.values(), self.seeds]
        return [Cell(*names) for names in itertools.product(*axes)]

    def _cell(self, given: Sequence[Any] | Mapping[str, Any]) -> Cell:
        """Return a cell of the user's list."""
        try:
            cell = Cell(**given) if isinstance(given, Mapping) else Cell(*given)
        except TypeError:
            raise SceneCaptumError(
                f"A cell has a name for each of {', '.join(AXES)}, and a seed; not {given!r}."
            ) from None
        for axis, name in zip(AXES, cell, strict=False):
            if name not in self._axes[axis]:
                raise SceneCaptumError(
                    f"The cell {cell} needs the {axis} {name!r}, which the study does not have."
                    f"{near_misses(str(name), self._axes[axis])} It has {', '.join(self._axes[axis])}."
                )
        return cell._replace(seed=check_seed("seed", cell.seed))

    def _recipe(self, cell: Cell) -> Recipe:
        metric, metric_options = self._axes["metric"][cell.metric]
        method, method_options = self._axes["method"][cell.method]
        sensor, options = self._axes["camera"][cell.camera], dict(self._renderer_options)
        if sensor == "grid" or isinstance(sensor, SensorGrid):
            options["resolution"] = None  # it has a pixel for each point
        if options["max_depth"] == "auto":
            options["max_depth"] = default_depth(metric)
        return Recipe(
            cell=cell,
            scene=self._axes["scene"][cell.scene],
            sensor=sensor,
            metric=metric,
            metric_options=metric_options,
            design=self._axes["design"][cell.design],
            method=method,
            method_options=method_options,
            renderer_options=options,
        ).with_key(self._scene_digests[cell.scene])

    def run(
        self,
        folder: str | os.PathLike[str],
        *,
        executor: Executor | None = None,
        workers: int | None = None,
        threads: int | None = 1,
        retry_failed: bool = False,
        show_progress: bool = False,
    ) -> StudyResult:
        """Compute the cells that the folder does not have yet, and return the results.

        A study that was killed is resumed by running it again with the same arguments.

        Parameters
        ----------
        folder
            Where finished cells are written; shared, if the workers are on several machines.
        executor
            Any ``concurrent.futures.Executor`` whose workers are processes: ``Client.get_executor()`` of Dask,
            `executors.RayExecutor`. By default a pool of processes on this machine.
        workers
            Number of processes of the default executor; one for each core by default.
        threads
            Threads of each worker, or None for their own choice. With one thread the numbers are the same to the
            last bit, however many workers there are; with more, sums have no fixed order, and they repeat to about
            a millionth.
        retry_failed
            Compute failed cells again.
        show_progress
            Show a progress bar with the time that is left, or write lines if stderr is not a terminal.

        Returns
        -------
        StudyResult
            All cells of the folder, with the failed ones and their errors.

        Raises
        ------
        SceneCaptumError
            If a metric cannot be created or its target names no element, the folder has another study or cannot
            be written, or the executor ends.
        """
        if executor is not None and workers is not None:
            raise SceneCaptumError("workers= is for the default executor: give executor= or workers=.")
        recipes = [self._recipe(cell) for cell in self.cells]
        if not StudyFolder(Path(folder)).manifest_path.exists():  # later, a correction would be another study
            for name in dict.fromkeys(cell.metric for cell in self.cells):
                check_element(name, *self._axes["metric"][name])
        opened = StudyFolder.begin(Path(folder), self._manifest(recipes))
        done = opened.finished() | (set() if retry_failed else opened.failed())
        left = [recipe for recipe in recipes if recipe.key not in done]
        names = {recipe.key: recipe for recipe in left}
        progress = Progress(len(recipes), finished=len(recipes) - len(left), show=show_progress)
        # Closed at once if the study stops: the traceback would keep the workers computing.
        with progress, closing(self._outcomes(left, opened, executor, workers, threads)) as outcomes:
            failures = 0 if retry_failed else len(opened.failed())
            for outcome in outcomes:
                if outcome.error:
                    failures += 1
                    # On one machine its name says nothing.
                    elsewhere = outcome.host not in ("", host_name())
                    where = f" [on {outcome.host}]" if elsewhere else ""
                    _write_failure(opened, names[outcome.key], f"{outcome.error}{where}")
                progress.update(failures)
        return StudyResult(opened)

    def _outcomes(
        self,
        recipes: list[Recipe],
        folder: StudyFolder,
        executor: Executor | None,
        workers: int | None,
        threads: int | None,
    ) -> Generator[Any, None, None]:
        arguments = str(folder.path.resolve()), folder.manifest()["study"], threads
        submit = partial(_submit, arguments)
        if not recipes:
            return
        if executor is not None:
            yield from on_executor(recipes, executor, submit)
            return
        with Workers(workers) as pool:
            yield from on_workers(recipes, pool, submit)

    def _manifest(self, recipes: Sequence[Recipe]) -> dict[str, Any]:
        """Return what the study is, as plain values."""
        return {
            "study": digest(sorted(recipe.key for recipe in recipes)),
            "begun": time.strftime("%Y-%m-%d %H:%M"),
            "versions": versions(),
            "axes": {axis: list(entries) for axis, entries in self._axes.items()},
            "seeds": self.seeds,
            "options": json.loads(json.dumps(self._renderer_options, default=repr)),
            "cells": {recipe.key: list(recipe.cell) for recipe in recipes},
        }


def _submit(arguments: tuple[str, str, int | None], executor: Executor, recipe: Recipe) -> Any:
    return executor.submit(compute_cell, recipe, *arguments)


def _write_failure(folder: StudyFolder, recipe: Recipe, error: str) -> None:
    """Write a failed cell; if that fails too, the folder cannot be written, and no other cell can."""
    try:
        folder.write_failure(recipe, error)
    except SceneCaptumError as problem:
        raise SceneCaptumError(
            f"The study stopped: {problem} The last cell, {recipe.cell}, failed with: {error}"
        ) from problem


def _axis(name: str, given: Axis) -> dict[str, Any]:
    """Return the entries of an axis by their names."""
    if isinstance(given, Mapping):
        entries = {str(key): value for key, value in given.items()}
    elif isinstance(given, str) or not isinstance(given, Sequence):
        raise SceneCaptumError(f"{name} must be a list, or a dict by name, not {given!r}.")
    else:
        entries = {_name(one): one for one in given}
        if len(entries) < len(given):
            raise SceneCaptumError(
                f"Two of the {name} have the same name ({', '.join(map(_name, given))}): give a dict by name, "
                f'or in TOML a table: [{name}], then name = "path".'
            )
    if not entries:
        raise SceneCaptumError(f"{name} is empty: a study needs at least one.")
    return entries


def _name(entry: Any) -> str:
    """Return the name of an entry that has none of its own."""
    if isinstance(entry, (str, os.PathLike)):
        path = Path(entry)
        if ".py:" in path.name:
            return path.name
        if path.suffix == ".xml":
            return path.resolve().parent.name if path.stem == "scene" else path.stem
        return str(entry)
    if isinstance(entry, View):
        changed = {f.name: getattr(entry, f.name) for f in dataclasses.fields(View)}
        return (
            _name({name: value for name, value in changed.items() if value != getattr(View(), name)}) or AS_IS
        )
    if isinstance(entry, Mapping):
        named = [_name(entry[kind]) for kind in ("metric", "method") if kind in entry]
        options = {k: v for k, v in entry.items() if k not in ("metric", "method")}
        # A study in a file has absolute paths here, such as that of a weather file.
        files = {k: Path(v).name for k, v in options.items() if isinstance(v, str) and Path(v).is_absolute()}
        return " ".join([*named, *(f"{k}={v}" for k, v in {**options, **files}.items())])
    return str(getattr(entry, "__name__", entry))


def _camera(given: Any) -> Any:
    """Return a sensor as ``SceneRenderer`` takes it."""
    if not isinstance(given, Mapping):
        return given
    arguments: dict[str, Any] = {k: tuple(v) if k == "move" else v for k, v in given.items()}
    try:
        return View(**arguments)
    except TypeError as error:
        raise SceneCaptumError(
            f"A camera as a dict has the arguments of View, not {dict(given)!r}."
        ) from error


def _with_options(kind: str, given: Any) -> tuple[Any, dict[str, Any]]:
    """Return a metric or a method, and its options."""
    if not isinstance(given, Mapping):
        return given, {}
    options = dict(given)
    if kind not in options:
        raise SceneCaptumError(f"A {kind} as a dict needs the entry {kind!r}: {dict(given)!r} has none.")
    return options.pop(kind), options


def _check_method(name: Any) -> None:
    if name != VALUE and name not in METHODS:
        raise SceneCaptumError(
            f"There is no method {name!r}.{near_misses(str(name), [*METHODS, VALUE])} Use "
            f"{', '.join([*METHODS, VALUE])}."
        )
