"""An exploration: the linearization of a scene about a design, and the renders that confirm its predictions."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch

from ..attr import SceneAttribution, VanillaSceneGradient
from ..denoising import denoise
from ..errors import SceneCaptumError, near_misses, whole_number
from ..estimation import (
    Denoise,
    Metric,
    Stream,
    Target,
    TargetedMetric,
    TransformSelector,
    check_renderer_and_metric,
    derived_seeds,
    input_values,
    mean_and_error,
    pseudo_values,
    with_image_transform,
)
from ..metrics import Measure
from ..protocols import accepted_keywords
from ..rendering import SceneRenderer
from ..visualization import automatic_exposure
from ._channel import Channel
from ._pictures import denoise_derivative, describe_objects, encode
from ._sliders import Design, Slider, make_slider, movable

REPLICATES = 4  # of every render: few, since each takes an evaluation of the metric
GRADIENT_REPLICATES = 8
PREVIEW_PIXELS = 160 * 90
PREVIEW_SPP = 4
MAX_NAME = 60  # characters of the name of a saved design
MAX_DESIGNS = 100


@dataclass(frozen=True)
class Recipe:
    """How a page writes a design as code.

    Attributes
    ----------
    python
        Lines that create ``renderer``, of whose inputs ``{inputs}`` is a list of names, and ``metric``.
    command
        A command line, to which the page adds ``--set``.
    """

    python: str = ""
    command: str = ""


class Exploration:
    """A scene that pages explore: it predicts what a change does, renders it, and says where both differ.

    Pages are notebook widgets and browser tabs; ``serve`` and ``widget`` open them. One thread does all the work,
    and only while a page is open. A page moves the ``design``, the places of the sliders.

    Parameters
    ----------
    renderer
        A ``SceneRenderer`` with one camera.
    metrics
        A metric of its images, or several by name.
    inputs
        The values to start from; by default the scene's own.
    target
        Element of the metrics' output, if they return vectors.
    seed
        Random seed.
    spp
        Samples per pixel of a render.
    top
        Number of parameters that get a slider at once, those with the largest effects.
    denoise
        As for ``VanillaSceneGradient``; decided once, for the first picture.
    recipe
        How a page writes a design as code; by default without the metric.

    Raises
    ------
    SceneCaptumError
        If the renderer has no single picture, or an option is invalid.
    """

    def __init__(  # noqa: PLR0913 -- those of every method, and two of its own
        self,
        renderer: SceneRenderer,
        metrics: Metric | Mapping[str, Metric],
        *,
        inputs: Mapping[str, torch.Tensor] | None = None,
        target: Target = None,
        seed: int = 0,
        spp: int = 32,
        top: int = 12,
        denoise: Denoise = "auto",
        recipe: Recipe | None = None,
    ) -> None:
        named = metrics if isinstance(metrics, Mapping) else {"": metrics}
        if not named:
            raise SceneCaptumError("An exploration needs at least one metric; the mapping is empty.")
        for metric in named.values():
            check_renderer_and_metric(renderer, metric)
        surfaces = renderer.surfaces if isinstance(renderer, SceneRenderer) else None
        if surfaces is None:
            raise SceneCaptumError(
                "Only a SceneRenderer with one camera can be explored: it has one picture."
            )
        self.renderer, self.surfaces = renderer, surfaces
        self.channel = Channel()
        self.targeted = [TargetedMetric(metric, target) for metric in named.values()]
        self.titles = [name or metric.label for name, metric in zip(named, self.targeted, strict=True)]
        smoothed = all(metric.is_smoothed for metric in self.targeted)
        self._selector = TransformSelector(denoise, renderer, smoothed=smoothed)
        self._seed, self._top = seed, whole_number("top", top)
        self._spp = math.ceil(whole_number("spp", spp) / REPLICATES)
        self._seeds = derived_seeds(seed, Stream.SCENES, REPLICATES)
        width, height = renderer.resolution
        shrink = max(1.0, math.sqrt(width * height / PREVIEW_PIXELS))
        size = max(8, round(width / shrink)), max(8, round(height / shrink))
        self._preview_renderer = renderer if shrink == 1 else renderer.replace(resolution=size)
        self._values = input_values(renderer, inputs)
        self._sliders = {
            name: make_slider(renderer, name, self._values.get(name, renderer.own_value(name)))
            for name in movable(renderer)
        }
        self._design: Design = {}
        self._version = self._confirmed = 0  # of the design: the latest, and the one that was rendered last
        self._tasks: deque[Callable[[], None]] = deque()
        self._is_rendering = False
        self._saved: list[dict[str, Any]] = []
        self._base: _Base | None = None
        self._fine: _Measured | None = None  # the design that was rendered last
        self.attributions: list[SceneAttribution] = []
        self._thread = threading.Thread(target=self._work, daemon=True, name="scenecaptum-explore")
        self._publish_scene(recipe or Recipe())

    # ------------------------------------------------------------------------------------------- from the pages

    def start(self) -> None:
        """Begin to work, as soon as there is a page."""
        self._thread.start()

    def close(self, timeout: float = 2.0) -> bool:
        """End the work, and return whether it has ended within so many seconds."""
        self.channel.close()
        if self._thread.is_alive():
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def receive(self, message: Any) -> None:
        """Do what a page asks for, or note that it is to be done.

        Raises
        ------
        SceneCaptumError
            If the message is none, or asks for something impossible.
        """
        if not isinstance(message, dict) or not isinstance(message.get("type"), str):
            raise SceneCaptumError("A message must be an object with a type.")
        actions: dict[str, Callable[[dict[str, Any]], None]] = {
            "design": self._receive_design,
            "add": self._receive_add,
            "start": lambda _: self._order(self._restart),
            "save": self._receive_save,
            "forget": self._receive_forget,
        }
        action = actions.get(message["type"])
        if action is None:
            raise SceneCaptumError(f"There is no message of type {message['type'][:MAX_NAME]!r}.")
        action(message)

    def _receive_design(self, message: dict[str, Any]) -> None:
        given = message.get("design")
        if not isinstance(given, dict):
            raise SceneCaptumError("A design must be an object of names with lists of numbers.")
        places = {name: self.slider(name).checked(numbers) for name, numbers in given.items()}
        design = {name: place for name, place in places.items() if place != self.slider(name).start}
        origin = message.get("origin")
        with self.channel.changed:
            if design != self._design:
                self._design = design
                self._version += 1
        self.channel.publish(
            "design",
            {"type": "design", "design": design, "origin": origin if isinstance(origin, str) else ""},
        )

    def _receive_add(self, message: dict[str, Any]) -> None:
        slider = self.slider(message.get("name"))
        if slider.name not in self._shown():
            self._publish_slider(slider, None, [])
            self._order(partial(self._derive, slider))

    def _receive_save(self, message: dict[str, Any]) -> None:
        name = message.get("name")
        if not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME:
            raise SceneCaptumError(f"A design needs a name of at most {MAX_NAME} characters.")
        with self.channel.changed:
            rendered = self.channel.latest.get("render")
            is_current = rendered is not None and rendered.message["design"] == self._design
            saved = {
                "name": name.strip(),
                "design": dict(self._design),
                "metrics": rendered.message["metrics"] if rendered is not None and is_current else None,
            }
            self._saved = [*(one for one in self._saved if one["name"] != saved["name"]), saved][
                -MAX_DESIGNS:
            ]
        self._publish_saved()

    def _receive_forget(self, message: dict[str, Any]) -> None:
        self._saved = [one for one in self._saved if one["name"] != message.get("name")]
        self._publish_saved()

    def slider(self, name: Any) -> Slider:
        """Return the slider of a parameter; raise if it can have none."""
        if not isinstance(name, str) or name not in self._sliders:
            hint = near_misses(name, self._sliders) if isinstance(name, str) and len(name) < 200 else ""
            raise SceneCaptumError(f"No slider can move {str(name)[:MAX_NAME]!r}.{hint}")
        return self._sliders[name]

    def _order(self, task: Callable[[], None]) -> None:
        with self.channel.changed:
            self._tasks.append(task)
            self.channel.changed.notify_all()

    # ------------------------------------------------------------------------------------------------- the work

    def _work(self) -> None:
        """Do everything that is due until the exploration is closed."""
        self._order(self._open)
        try:
            while True:
                with self.channel.changed:
                    self.channel.changed.wait_for(self._is_due)
                self._breathe()
                with self.channel.changed:
                    task = self._tasks.popleft() if self._tasks else None
                if task is not None:
                    self._attempt(task)
        except _ClosedError:
            pass

    def _is_due(self) -> bool:
        has_work = bool(self._tasks) or self._version != self._confirmed
        return self.channel.closed or (bool(self.channel.listeners) and has_work)

    def _attempt(self, task: Callable[[], None]) -> None:
        """Run a task; what it raises is shown on the pages, and the work goes on."""
        try:
            task()
        except _ClosedError:
            raise
        except Exception as error:  # a metric may raise anything
            text = str(error) if isinstance(error, SceneCaptumError) else f"{type(error).__name__}: {error}"
            self._complain(" ".join(text.split())[:500])
        self._say("")

    def _breathe(self) -> None:
        """Between two pieces of work: wait for a page, end, or render the design if it has changed."""
        while True:
            with self.channel.changed:
                self.channel.changed.wait_for(lambda: self.channel.closed or self.channel.listeners)
            if self.channel.closed:
                raise _ClosedError
            if self._is_rendering or self._base is None or self._version == self._confirmed:
                return
            self._is_rendering = True
            said = self.channel.latest.get("status")
            try:
                self._attempt(self._confirm)
            finally:
                self._is_rendering = False
            if said is not None:
                self.channel.publish("status", said.message)

    def _say(self, text: str) -> None:
        self.channel.publish("status", {"type": "status", "text": text})

    def _complain(self, text: str) -> None:
        """Show what went wrong, until something goes right."""
        self.channel.publish("problem", {"type": "problem", "text": text})

    def _open(self) -> None:
        self._say("Rendering the first picture")
        image = self._render_preview({})
        self._publish_picture("preview", {"type": "preview", "exposure": automatic_exposure(image)}, image)
        self._linearize({})

    def _restart(self) -> None:
        with self.channel.changed:
            design = dict(self._design)
        self._linearize(design)

    # ----------------------------------------------------------------------------------------------- rendering

    def values(self, design: Design) -> dict[str, torch.Tensor]:
        """Return the values of the parameters of a design."""
        return {**self._values, **{name: self.slider(name).tensor(place) for name, place in design.items()}}

    def _render(self, design: Design, seed: int) -> torch.Tensor:
        self._breathe()
        with torch.no_grad():
            return self.renderer(self.values(design), seed=seed, spp=self._spp).detach()

    def _render_preview(self, design: Design) -> torch.Tensor:
        with torch.no_grad():
            image = self._preview_renderer(self.values(design), seed=self._seeds[0], spp=PREVIEW_SPP).detach()
        return denoise(image, self._preview_renderer.guides)

    def _measure(self, images: torch.Tensor, check: Callable[[], None]) -> torch.Tensor:
        """Return the pseudo-values of all metrics, ``(replicates, metrics)``."""

        def values(kept: torch.Tensor) -> torch.Tensor:
            check()
            mean = images[kept].mean(0)
            return torch.tensor([metric.value(mean) for metric in self.targeted], dtype=torch.float64)

        return pseudo_values(values, len(images))

    def _confirm(self) -> None:
        """Render the design, first roughly and then well, unless there is a newer one by then."""
        assert self._base is not None
        with self.channel.changed:
            version, design = self._version, dict(self._design)
        self._confirmed = version  # also if it cannot be rendered
        if design == self._base.design:
            return
        self._say("Rendering")
        rough = {"type": "render", "design": design, "rough": True, "metrics": None}
        self._publish_picture("render", rough, self._render_preview(design))

        def check() -> None:
            if self.channel.closed:
                raise _ClosedError
            if self._version != version:
                raise _SupersededError

        try:
            images = []
            for seed in self._seeds:
                check()
                images.append(self._render(design, seed))
            stack = torch.stack(images)
            measured = self._measure(stack, check)
        except _SupersededError:
            return
        base = self._base.measured
        metrics = [
            {
                **self._describe(number, measured[:, number], stack.mean(0)),
                "change": mean_and_error(measured[:, number] - base[:, number]),
            }
            for number in range(len(self.targeted))
        ]
        self._fine = _Measured(design, stack, measured)
        self._complain("")
        fine = {
            "type": "render",
            "design": design,
            "rough": False,
            "metrics": metrics,
            "base": self._base.number,
        }
        self._publish_picture("render", fine, denoise(stack.mean(0), self.renderer.guides))

    def _describe(self, number: int, measured: torch.Tensor, image: torch.Tensor) -> dict[str, Any]:
        value, error = mean_and_error(measured)
        return {
            "value": value,
            "error": error,
            "verdict": self.targeted[number].verdict(value, image),
        }

    # ------------------------------------------------------------------------------------------- linearization

    def _linearize(self, design: Design) -> None:
        """Take a design as the start: its picture, the gradients of the metrics, and the derivatives of the picture."""
        number = 1 if self._base is None else self._base.number + 1
        self._say("Rendering the start")
        fine = self._fine
        if fine is None or fine.design != design:
            images = torch.stack([self._render(design, seed) for seed in self._seeds])
            if self._base is None:
                self.targeted = with_image_transform(self.targeted, list(images), self._selector)
            fine = _Measured(design, images, self._measure(images, self._breathe))
        images, mean = fine.images, fine.images.mean(0)
        base = _Base(design, images, fine.measured, number)
        picture = denoise(mean, self.renderer.guides)
        metrics = [self._describe(k, base.measured[:, k], mean) for k in range(len(self.targeted))]
        exposure = automatic_exposure(picture)
        self._base = base
        self._complain("")
        self.channel.withdraw("preview")
        self._publish_picture(
            "base",
            {"type": "base", "number": number, "design": design, "metrics": metrics, "exposure": exposure},
            picture,
        )
        self._say("Ranking the parameters")
        halves = [images[::2].mean(0), images[1::2].mean(0)]
        for metric in self.targeted:
            self._breathe()
            base.adjoints.append(torch.stack([metric.value_and_adjoint(one)[1] for one in (mean, *halves)]))
        self._rank(base)
        ranked = [row.name for row in self._leading()]
        added = [name for name in self._shown() if name not in ranked]
        sliders = [self.slider(name) for name in [*ranked, *added]]
        for slider in sliders:
            self._publish_slider(slider, None, [])
        for slider in sliders:
            self._attempt(partial(self._derive, slider))

    def _rank(self, base: _Base) -> None:
        """Attribute the metrics, to first order about the picture of the start."""
        functionals = FirstOrder(self.targeted, [adjoint[0] for adjoint in base.adjoints], base)
        self.attributions = VanillaSceneGradient(
            _Breathing(self.renderer, self._breathe), functionals
        ).attribute(
            {name: value for name, value in self.values(base.design).items() if name in self._values},
            target=list(range(len(self.targeted))),
            seed=self._seed,
            spp=GRADIENT_REPLICATES,
            replicates=GRADIENT_REPLICATES,
        )
        objects = describe_objects(self.surfaces, list(self._sliders), list(self.attributions))
        self.channel.publish("objects", {"type": "objects", **objects})

    def _leading(self) -> list[Any]:
        """Return the parameters with the largest effects on any metric, each relative to the largest on this one."""
        best: dict[str, tuple[float, Any]] = {}
        for attribution in self.attributions:
            ranking = [row for row in attribution.ranking() if row.name in self._sliders and row.saliency > 0]
            for row in ranking:
                share = row.saliency / ranking[0].saliency
                if share > best.get(row.name, (0.0, None))[0]:
                    best[row.name] = share, row
        return [row for _, row in sorted(best.values(), key=lambda pair: -pair[0])][: self._top]

    def _derive(self, slider: Slider) -> None:
        """Compute the derivatives of the picture by differences with the random numbers of the start."""
        base = self._base
        if base is None:  # added before the first picture: it is derived with the others
            return
        self._say(f"Derivatives: {slider.label}")
        place = base.design.get(slider.name, slider.start)
        known = all(self._rows(slider, attribution) is not None for attribution in self.attributions)
        seeds = self._seeds[:1] if known else self._seeds
        derivatives = torch.stack(
            [self._differences(slider, place, step, seeds) for step in slider.steps(place)]
        )
        rows = [
            self._gradient(slider, derivatives, adjoint, number)
            for number, adjoint in enumerate(base.adjoints)
        ]
        pictures = [denoise_derivative(one, self.renderer.guides) for one in derivatives.mean(1)]
        self._publish_slider(slider, rows, pictures)

    def _differences(
        self, slider: Slider, place: tuple[float, ...], step: tuple[float, ...], seeds: Sequence[int]
    ) -> torch.Tensor:
        """Return the derivative of the picture along a step for each seed, ``(seeds, H, W, 3)``."""
        assert self._base is not None
        moved = tuple(n + delta for n, delta in zip(place, step, strict=True))
        length = torch.tensor(step) if slider.by_channel else torch.tensor(max(step, key=abs))
        return torch.stack(
            [
                (self._render({**self._base.design, slider.name: moved}, seed) - self._base.images[number])
                / length
                for number, seed in enumerate(seeds)
            ]
        )

    def _rows(self, slider: Slider, attribution: SceneAttribution) -> torch.Tensor | None:
        """Return the gradient in every replicate of an attribution, per unit of the slider, if that has it."""
        if slider.name not in attribution or slider.name in attribution.info.get("jumps", {}):
            return None
        return slider.rows(attribution.replicates[slider.name].double())

    def _gradient(
        self, slider: Slider, derivatives: torch.Tensor, adjoint: torch.Tensor, number: int
    ) -> dict[str, Any]:
        """Return independent gradients of a metric, and how much the noise of the picture may turn them all."""
        products = torch.einsum("khwc,jshwc->ksjc", adjoint.double(), derivatives.double())
        products = products[..., 0, :] if slider.by_channel else products.sum(-1)
        rows = self._rows(slider, self.attributions[number]) if self.attributions else None
        rows = products[0] if rows is None else rows
        turned = (products[1] - products[2]).mean(0) / 2
        return {"rows": rows.tolist(), "turned": turned.tolist()}

    # ------------------------------------------------------------------------------------------ for the pages

    def _shown(self) -> list[str]:
        with self.channel.changed:
            return [key.removeprefix("slider ") for key in self.channel.latest if key.startswith("slider ")]

    def _publish_scene(self, recipe: Recipe) -> None:
        width, height = self.renderer.resolution
        names = {name: {"label": one.label, "kind": one.kind} for name, one in self._sliders.items()}
        self.channel.publish(
            "scene",
            {
                "type": "scene",
                "name": self.renderer.name,
                "width": width,
                "height": height,
                "metrics": [
                    {"title": title, **_measure_of(metric)}
                    for title, metric in zip(self.titles, self.targeted, strict=True)
                ],
                "parameters": names,
                "python": recipe.python,
                "command": recipe.command,
            },
        )
        self._publish_saved()

    def _publish_saved(self) -> None:
        self.channel.publish("saved", {"type": "saved", "designs": self._saved})

    def _publish_picture(self, key: str, message: dict[str, Any], image: torch.Tensor) -> None:
        scale, data = encode(image)
        height, width = image.shape[:2]
        self.channel.publish(key, {**message, "width": width, "height": height, "scales": [scale]}, [data])

    def _publish_slider(self, slider: Slider, rows: Any, pictures: Sequence[torch.Tensor]) -> None:
        encoded = [encode(picture) for picture in pictures]
        ranked = [
            next((row for row in attribution.ranking() if row.name == slider.name), None)
            for attribution in self.attributions
        ]
        message = {
            "type": "slider",
            "name": slider.name,
            "label": slider.label,
            "kind": slider.kind,
            "form": slider.form,
            "low": slider.low,
            "high": slider.high,
            "start": slider.start,
            "bounds": [n if math.isfinite(n) else None for n in slider.bounds],
            "effects": [None if row is None else [row.effect, row.effect_error] for row in ranked],
            "gradients": rows,
            "base": None if self._base is None else self._base.number,
            "scales": [scale for scale, _ in encoded],
        }
        self.channel.publish(f"slider {slider.name}", message, [data for _, data in encoded])


class _ClosedError(Exception):
    """The exploration has ended."""


class _SupersededError(Exception):
    """There is a newer design."""


@dataclass(frozen=True)
class _Measured:
    """Renders of a design, and the metrics."""

    design: Design
    images: torch.Tensor  # (replicates, H, W, 3)
    measured: torch.Tensor  # pseudo-values, (replicates, metrics)


@dataclass(frozen=True)
class _Base(_Measured):
    """What predictions start from."""

    number: int
    adjoints: list[torch.Tensor] = field(
        default_factory=list
    )  # of each metric: of all images, and of two halves


class FirstOrder:
    """Metrics to first order about a picture: linear, so that their gradients need no picture of their own."""

    def __init__(
        self, metrics: Sequence[TargetedMetric], adjoints: Sequence[torch.Tensor], base: _Base
    ) -> None:
        self._metrics, self._adjoints = metrics, torch.stack(list(adjoints))
        image = base.images.mean(0)
        self._constants = base.measured.mean(0) - torch.einsum(
            "mhwc,hwc->m", self._adjoints.double(), image.double()
        )

    def __call__(self, image: torch.Tensor) -> torch.Tensor:
        """Return the value of each metric, ``(metrics,)``."""
        return torch.einsum("mhwc,hwc->m", self._adjoints, image) + self._constants.to(image)

    def measure_of(self, target: int) -> Any:
        """Return what a metric measures."""
        return self._metrics[target].measure


class _Breathing:
    """A renderer that lets an exploration do what is due before every render."""

    def __init__(self, renderer: SceneRenderer, breathe: Callable[[], None]) -> None:
        self.renderer, self.breathe = renderer, breathe
        self.accepted_keywords = accepted_keywords(renderer)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.renderer, name)

    def __call__(self, inputs: Mapping[str, torch.Tensor], **options: Any) -> torch.Tensor:
        self.breathe()
        image: torch.Tensor = self.renderer(inputs, **options)
        return image


def _measure_of(metric: TargetedMetric) -> dict[str, Any]:
    """Return name, unit and classes of a metric as plain values."""
    measure = metric.measure
    if not isinstance(measure, Measure):
        return {"unit": "", "symbol": None, "bands": [], "above": ""}
    bands = [[band.upper, band.meaning] for band in measure.bands]
    return {"unit": measure.unit, "symbol": measure.symbol, "bands": bands, "above": measure.above}
