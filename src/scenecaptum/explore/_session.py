"""An exploration: what pages ask for, and the one thread that predicts and renders it."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch

from ..errors import SceneCaptumError, near_misses, whole_number
from ..estimation import Metric, TargetedMetric
from ..linearization import Derivative, Design, Designs, Linearization, Measured, Slider
from ..metrics import Measure
from ..rendering import SceneRenderer
from ..visualization import automatic_exposure
from ._channel import Channel
from ._pictures import describe_objects, encode

MAX_NAME = 60  # characters of the name of a saved design
MAX_DESIGNS = 100
MAX_PROBLEM = 500  # characters


@dataclass(frozen=True)
class Recipe:
    """How a page writes a design as code.

    Attributes
    ----------
    python
        Lines that create ``renderer``, whose inputs are ``{inputs}``, ``metric`` and ``values``.
    attribute
        The arguments of ``VanillaSceneGradient.attribute``.
    command
        A command line, to which the page adds ``--inputs`` and ``--set``.
    changed
        The names of the parameters that these have changed already.
    inputs
        The inputs of the renderer if the page changes none.
    """

    python: str = "# renderer and metric: those that are explored; inputs={inputs}\nvalues = renderer.inputs"
    attribute: str = "values"
    command: str = "scenecaptum attribute SCENE --metric METRIC"
    changed: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ("all",)


class Exploration:
    """A scene that pages explore: it predicts what a change does, renders it, and says where both differ.

    Pages are notebook widgets and browser tabs; ``serve`` and ``widget`` open them. One thread does all the work,
    and only while a page is open. All pages move the same design.

    Parameters
    ----------
    renderer
        A ``SceneRenderer`` with one camera.
    metrics
        A metric of its images, or several by name.
    top
        Number of parameters that get a slider at once, those with the largest effects.
    recipe
        How a page writes a design as code; by default it writes the changed values alone.
    options
        ``inputs``, ``target``, ``seed``, ``spp`` and ``denoise``, as for ``Designs``.

    Raises
    ------
    SceneCaptumError
        If the renderer has no single picture, or an option is invalid.
    """

    def __init__(
        self,
        renderer: SceneRenderer,
        metrics: Metric | Mapping[str, Metric],
        *,
        top: int = 12,
        recipe: Recipe | None = None,
        **options: Any,
    ) -> None:
        named = metrics if isinstance(metrics, Mapping) else {"": metrics}
        if not named:
            raise SceneCaptumError("An exploration needs at least one metric; the mapping is empty.")
        self.designs = Designs(renderer, list(named.values()), pause=self._pause, **options)
        self.channel = Channel()
        self.about: Linearization | None = None  # what predictions come from
        self._starts = 0  # how many there have been
        self._top = whole_number("top", top)
        self._design: Design = {}
        self._version = self._confirmed = 0  # of the design: the latest, and the one that was rendered last
        self._rendering: int | None = None  # the version that is being rendered
        self._measured: Measured | None = None  # the design that was rendered last
        self._tasks: deque[Callable[[], None]] = deque([self._open])
        self._saved: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._work, daemon=True, name="scenecaptum-explore")
        pairs = zip(named, self.designs.metrics, strict=True)
        titles = [name if metric.measure is None and name else metric.label for name, metric in pairs]
        self._publish_scene(titles, recipe or Recipe())

    # ------------------------------------------------------------------------------------------- from the pages

    def start(self) -> None:
        """Begin to work, as soon as there is a page."""
        self._thread.start()

    def linearize(self) -> Linearization:
        """Compute in this thread all that predictions need, without a page; for a report.

        Raises
        ------
        SceneCaptumError
            If the scene cannot be rendered, or a metric cannot be differentiated.
        """
        listener = self.channel.listen()
        try:
            self._linearize()
        finally:
            self.channel.leave(listener)
        assert self.about is not None
        return self.about

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
        actions = {
            "design": self._receive_design,
            "add": self._receive_add,
            "start": self._receive_start,
            "save": self._receive_save,
            "forget": self._receive_forget,
        }
        action = actions.get(message["type"])
        if action is None:
            raise SceneCaptumError(f"There is no message of type {message['type'][:MAX_NAME]!r}.")
        action(message)

    def _receive_design(self, message: Mapping[str, Any]) -> None:
        given, origin = message.get("design"), message.get("origin")
        if not isinstance(given, dict):
            raise SceneCaptumError("A design must be an object of names with lists of numbers.")
        sliders = {name: self.slider(name) for name in given}
        places = {name: sliders[name].checked(numbers) for name, numbers in given.items()}
        design = {name: place for name, place in places.items() if place != sliders[name].start}
        with self.channel.changed:
            if design != self._design:
                self._design = design
                self._version += 1
        self.channel.publish("design", type="design", design=design, origin=str(origin)[:MAX_NAME])

    def _receive_add(self, message: Mapping[str, Any]) -> None:
        slider = self.slider(message.get("name"))
        if slider.name not in self._shown():
            self._publish_slider(slider)
            self._order(partial(self._derive, slider))

    def _receive_start(self, _: Mapping[str, Any]) -> None:
        self._order(self._linearize)

    def _receive_save(self, message: Mapping[str, Any]) -> None:
        name = message.get("name")
        if not isinstance(name, str) or not name.strip() or len(name) > MAX_NAME:
            raise SceneCaptumError(f"A design needs a name of at most {MAX_NAME} characters.")
        with self.channel.changed:
            design, measured = dict(self._design), self._measured
            numbers = self._describe(measured) if measured is not None and measured.design == design else None
            saved = {"name": name.strip(), "design": design, "metrics": numbers}
            others = [one for one in self._saved if one["name"] != saved["name"]]
            self._saved = [*others, saved][-MAX_DESIGNS:]
        self.channel.publish("saved", type="saved", designs=self._saved)

    def _receive_forget(self, message: Mapping[str, Any]) -> None:
        with self.channel.changed:
            self._saved = [one for one in self._saved if one["name"] != message.get("name")]
        self.channel.publish("saved", type="saved", designs=self._saved)

    def slider(self, name: Any) -> Slider:
        """Return the slider of a parameter.

        Raises
        ------
        SceneCaptumError
            If the parameter does not exist, or cannot be moved.
        """
        sliders = self.designs.sliders
        if not isinstance(name, str) or name not in sliders:
            hint = near_misses(name[:MAX_PROBLEM], sliders) if isinstance(name, str) else ""
            raise SceneCaptumError(f"No slider can move {str(name)[:MAX_NAME]!r}.{hint}")
        return sliders[name]

    def _order(self, task: Callable[[], None]) -> None:
        with self.channel.changed:
            self._tasks.append(task)
            self.channel.changed.notify_all()

    # ------------------------------------------------------------------------------------------------- the work

    def _work(self) -> None:
        """Do everything that is due until the exploration is closed."""
        try:
            while True:
                with self.channel.changed:
                    self.channel.changed.wait_for(
                        lambda: self.channel.closed or self._tasks or self._version != self._confirmed
                    )
                self._pause()
                with self.channel.changed:
                    task = self._tasks.popleft() if self._tasks else None
                if task is not None:
                    self._attempt(task)
                    self._say("")
        except _ClosedError:
            pass

    def _pause(self) -> None:
        """Between two pieces of work: wait for a page, end, or render the design if it has changed."""
        while True:
            with self.channel.changed:
                self.channel.changed.wait_for(lambda: self.channel.closed or self.channel.listeners)
                said = self.channel.message("status")
            if self.channel.closed:
                raise _ClosedError
            if self._rendering not in (None, self._version):
                raise _SupersededError
            if self._rendering is not None or self.about is None or self._version == self._confirmed:
                return
            self._attempt(self._confirm)
            self._say(str(said.get("text", "")))

    def _attempt(self, task: Callable[[], None]) -> None:
        """Run a task; what it raises is shown on the pages, and the work goes on."""
        try:
            task()
        except _ClosedError:
            raise
        except Exception as error:  # a metric may raise anything
            text = str(error) if isinstance(error, SceneCaptumError) else f"{type(error).__name__}: {error}"
            self._complain(" ".join(text.split())[:MAX_PROBLEM])

    def _open(self) -> None:
        self._say("Rendering the first picture")
        image = self.designs.render_roughly({})
        self._publish_picture("preview", image, exposure=automatic_exposure(image))
        self._linearize()

    def _confirm(self) -> None:
        """Render the design, first roughly and then well, unless there is a newer one by then."""
        with self.channel.changed:
            version, design = self._version, dict(self._design)
        self._confirmed = version  # also if it cannot be rendered
        if self.about is None or design == self.about.start.design:
            return
        self._say("Rendering")
        self._publish_picture(
            "render", self.designs.render_roughly(design), design=design, rough=True, metrics=None
        )
        self._rendering = version
        try:
            measured = self.designs.measure(design)
        except _SupersededError:
            return
        finally:
            self._rendering = None
        self._measured = measured
        self._complain("")
        metrics = self._describe(measured)
        for number, described in enumerate(metrics):
            described["change"] = measured.change(number, self.about.start)
        picture = self.designs.denoised(measured.image)
        self._publish_picture(
            "render", picture, design=design, rough=False, metrics=metrics, base=self._starts
        )

    def _linearize(self) -> None:
        """Take the design as the start: its picture, gradients of the metrics, and derivatives of the picture."""
        with self.channel.changed:
            design, measured = dict(self._design), self._measured
        self._say("Rendering the start")
        if measured is None or measured.design != design:
            measured = self.designs.measure(design)
        about = Linearization(self.designs, measured)
        picture = self.designs.denoised(measured.image)
        self.about = about
        self._starts += 1
        self._complain("")
        self.channel.withdraw("preview")
        self._publish_picture(
            "base",
            picture,
            number=self._starts,
            design=design,
            metrics=self._describe(measured),
            exposure=automatic_exposure(picture),
        )
        self._say("Ranking the parameters")
        about.rank()
        objects = describe_objects(self.designs.surfaces, self.designs.sliders, about.attributions)
        self.channel.publish("objects", type="objects", **objects)
        names = dict.fromkeys([*about.leading(self._top), *self._shown()])
        for name in names:
            self._publish_slider(self.slider(name))
        for name in names:
            self._attempt(partial(self._derive, self.slider(name)))

    def _derive(self, slider: Slider) -> None:
        if self.about is not None:
            self._say(f"Derivatives: {slider.label}")
            self._publish_slider(slider, self.about.derive(slider))

    def _describe(self, measured: Measured) -> list[dict[str, Any]]:
        described = []
        for number, metric in enumerate(self.designs.metrics):
            value, error = measured.value(number)
            verdict = metric.verdict(value, measured.image)
            described.append({"value": value, "error": error, "verdict": verdict})
        return described

    # ------------------------------------------------------------------------------------------ for the pages

    def _say(self, text: str) -> None:
        self.channel.publish("status", type="status", text=text)

    def _complain(self, text: str) -> None:
        """Show what went wrong, until a render succeeds."""
        self.channel.publish("problem", type="problem", text=text)

    def _shown(self) -> list[str]:
        """Return the names of the parameters that have a slider on the pages."""
        return [key.removeprefix("slider ") for key in self.channel.known() if key.startswith("slider ")]

    def _publish_scene(self, titles: Sequence[str], recipe: Recipe) -> None:
        width, height = self.designs.renderer.resolution
        self.channel.publish(
            "scene",
            type="scene",
            name=self.designs.renderer.name,
            width=width,
            height=height,
            metrics=[
                {"title": title, **_measure_of(metric)}
                for title, metric in zip(titles, self.designs.metrics, strict=True)
            ],
            parameters={name: slider.label for name, slider in self.designs.sliders.items()},
            recipe=vars(recipe),
        )

    def _publish_picture(self, kind: str, image: torch.Tensor, **message: Any) -> None:
        scale, data = encode(image)
        height, width = image.shape[:2]
        self.channel.publish(kind, [data], type=kind, width=width, height=height, scales=[scale], **message)

    def _publish_slider(self, slider: Slider, derivative: Derivative | None = None) -> None:
        """Publish a slider, which can be moved once its derivatives are known."""
        attributions = [] if self.about is None else self.about.attributions
        ranked = [{row.name: row for row in attribution.ranking()} for attribution in attributions]
        rows = [by_name.get(slider.name) for by_name in ranked]
        encoded = [] if derivative is None else [encode(image) for image in derivative.images]
        self.channel.publish(
            f"slider {slider.name}",
            [data for _, data in encoded],
            type="slider",
            name=slider.name,
            label=slider.label,
            form=slider.form,
            low=slider.low,
            high=slider.high,
            start=slider.start,
            bounds=[bound if math.isfinite(bound) else None for bound in slider.bounds],
            effects=[None if row is None else [row.effect, row.effect_error] for row in rows],
            gradients=None
            if derivative is None
            else [{"rows": g.rows.tolist(), "turned": g.turned.tolist()} for g in derivative.gradients],
            scales=[scale for scale, _ in encoded],
        )


class _ClosedError(Exception):
    """The exploration has ended."""


class _SupersededError(Exception):
    """There is a newer design."""


def _measure_of(metric: TargetedMetric) -> dict[str, Any]:
    """Return unit, abbreviation and classes of a metric as plain values."""
    measure = metric.measure
    if not isinstance(measure, Measure):
        return {"unit": "", "symbol": None, "bands": [], "above": ""}
    bands = [[band.upper, band.meaning] for band in measure.bands]
    return {"unit": measure.unit, "symbol": measure.symbol, "bands": bands, "above": measure.above}
