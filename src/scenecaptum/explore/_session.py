"""An exploration: what pages ask for, and the one thread that predicts and renders it."""

from __future__ import annotations

import re
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch

from ..attr import SceneAttribution, rating_in_words
from ..errors import SceneCaptumError, near_misses, whole_number
from ..estimation import Metric, TargetedMetric
from ..explanation import definition_of, photometric_premises, states_definition
from ..linearization import Derivative, Design, Designs, Linearization, Measured, Slider
from ..metrics import Measure
from ..rendering import SceneRenderer
from ..report import describe_objects
from ..scene import scene_heading
from ..visualization import (
    RANKED_LAST,
    automatic_exposure,
    findings,
    format_with_error,
    range_notes,
    unit_of_change,
)
from ._channel import Channel

MAX_NAME = 60  # characters of the name of a saved design
MAX_DESIGNS = 100
MAX_PROBLEM = 500  # characters
LARGEST = 32768.0  # half precision ends at 65504

# How a page writes a design as code, where it is not told: see ``cli/_explore.py``.
RECIPE: Mapping[str, Any] = {
    "python": "values = renderer.inputs  # {inputs}",
    "attribute": "values",
    "command": "scenecaptum attribute",
    "settings": [],
    "changed": [],
    "inputs": ["all"],
}


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
        How a page writes a design as code: lines of ``python`` that create ``renderer``, whose inputs are
        ``{inputs}``, and ``values``; an expression for each of the ``metrics``; the arguments of ``attribute``; a
        ``command``; its ``settings``, each with ``name``, ``operator`` and ``numbers``; the names of the
        parameters that these have ``changed`` already; and the ``inputs`` if the page changes none.
    premises
        What pages say of the picture of each metric, beside what the metric takes for granted.
    options
        ``inputs``, ``target``, ``seed``, ``spp`` and ``denoise``, as for ``linearization.Designs``.

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
        recipe: Mapping[str, Any] = RECIPE,
        premises: Sequence[str] = (),
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
        self._premises = premises
        # What was changed for the page may be moved on it, whatever its effect is.
        self._changed = [name for name in recipe["changed"] if name in self.designs.sliders]
        self._design: Design = {}
        self._version = self._confirmed = 0  # of the design: the latest, and the one that was rendered last
        self._rendering: int | None = None  # the version that is being rendered
        self._measured: Measured | None = None  # the design that was rendered last
        self._tasks: deque[Callable[[], object]] = deque([self._open])
        self._saved: list[dict[str, Any]] = []
        self._thread = threading.Thread(target=self._work, daemon=True, name="scenecaptum-explore")
        width, height = renderer.resolution
        self.channel.publish(
            "scene",
            name=scene_heading(renderer.name),
            width=width,
            height=height,
            metrics=[_describe(*pair) for pair in zip(named, self.designs.metrics, strict=True)],
            parameters={name: slider.label for name, slider in self.designs.sliders.items()},
            recipe={"metrics": [re.sub(r"\W", "_", name) or "metric" for name in named], **recipe},
        )

    def start(self) -> None:
        """Begin to work, as soon as there is a page."""
        self._thread.start()

    def linearize(self) -> Linearization:
        """Compute in this thread all that predictions need, without a page; for a report."""
        listener = self.channel.listen()
        try:
            return self._linearize()
        finally:
            self.channel.leave(listener)

    def close(self, timeout: float = 2.0) -> bool:
        """End the work, and return whether it has ended within ``timeout`` seconds."""
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
        match message:
            case {"type": "design", "design": dict(places)}:
                self._receive_design(places, str(message.get("origin"))[:MAX_NAME])
            case {"type": "add", "name": str(name)}:
                self._add(self._slider(name))
            case {"type": "start"}:
                self._order(self._linearize)
            case {"type": "save", "name": str(name)} if 0 < len(name.strip()) <= MAX_NAME:
                self._receive_save(name.strip())
            case {"type": "forget", "name": str(name)}:
                self._keep(name)
            case _:
                raise SceneCaptumError(
                    "A message has a type: design, with places by names; add, save or forget, with a name of at "
                    f"most {MAX_NAME} characters; or start."
                )

    def _receive_design(self, given: Mapping[str, Any], origin: str) -> None:
        places = {name: self._slider(name).checked(numbers) for name, numbers in given.items()}
        design = {name: place for name, place in places.items() if place != self._slider(name).start}
        with self.channel.changed:
            if design != self._design:
                self._design = design
                self._version += 1
        self.channel.publish("design", design=design, origin=origin)

    def _add(self, slider: Slider) -> None:
        if slider.name not in self._shown():
            self._publish_slider(slider)
            self._order(partial(self._derive, slider))

    def _receive_save(self, name: str) -> None:
        with self.channel.changed:
            design = dict(self._design)
            known = [self.channel.message(kind) for kind in ("rendered", "base")]
            metrics = next((one["metrics"] for one in known if one and one["design"] == design), None)
        self._keep(name, {"name": name, "design": design, "metrics": metrics})

    def _keep(self, name: str, *saved: dict[str, Any]) -> None:
        """Replace the saved design of a name."""
        with self.channel.changed:
            others = [one for one in self._saved if one["name"] != name]
            self._saved = [*others, *saved][-MAX_DESIGNS:]
            self.channel.publish("saved", designs=self._saved)

    def _slider(self, name: str) -> Slider:
        """Return the slider of a parameter; raise if the parameter does not exist, or cannot be moved."""
        if name not in self.designs.sliders:
            hint = near_misses(name[:MAX_PROBLEM], self.designs.sliders)
            raise SceneCaptumError(f"No slider can move {name[:MAX_NAME]!r}.{hint}")
        return self.designs.sliders[name]

    def _order(self, task: Callable[[], object]) -> None:
        with self.channel.changed:
            self._tasks.append(task)
            self.channel.changed.notify_all()

    def _work(self) -> None:
        """Do everything that is due until the exploration is closed."""
        while not self.channel.closed:
            with self.channel.changed:
                self.channel.changed.wait_for(lambda: self.channel.closed or self._tasks or self._is_due())
                task = self._tasks.popleft() if self._tasks else self._pause
            self._attempt(task)
            self._say("")

    def _is_due(self) -> bool:
        """Whether the design is to be rendered."""
        return self._rendering is None and self.about is not None and self._version != self._confirmed

    def _pause(self) -> None:
        """Between two pieces of work: wait for a page, end, or render the design if it has changed."""
        while True:
            with self.channel.changed:
                self.channel.changed.wait_for(lambda: self.channel.closed or self.channel.listeners)
            if self.channel.closed or self._rendering not in (None, self._version):
                raise _SupersededError
            if not self._is_due():
                return
            said = self.channel.message("status").get("text", "")
            self._attempt(self._confirm)
            self._say(said)

    def _attempt(self, task: Callable[[], object]) -> None:
        """Run a task; what it raises is shown on the pages until a render succeeds, and the work goes on."""
        try:
            task()
        except _SupersededError:
            pass
        except Exception as error:  # a metric may raise anything
            text = str(error) if isinstance(error, SceneCaptumError) else f"{type(error).__name__}: {error}"
            self.channel.publish("problem", text=" ".join(text.split())[:MAX_PROBLEM])

    def _open(self) -> None:
        self._pause()
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
        rough = self.designs.render_roughly(design)
        self._publish_picture("rendered", rough, design=design, rough=True, metrics=None)
        self._rendering = version
        try:
            measured = self.designs.measure(design)
        finally:
            self._rendering = None
        self._measured = measured
        self.channel.publish("problem", text="")
        metrics = self._numbers(measured)
        for number, one in enumerate(metrics):
            one["change"] = measured.change(number, self.about.start)
        fine = self.designs.denoised(measured.image, design)
        self._publish_picture(
            "rendered", fine, design=design, rough=False, metrics=metrics, base=self._starts
        )

    def _linearize(self) -> Linearization:
        """Take the design as the start: its picture, gradients of the metrics, and derivatives of the picture."""
        with self.channel.changed:
            design, measured = dict(self._design), self._measured
        self._say("Rendering the start")
        if measured is None or measured.design != design:
            measured = self.designs.measure(design)
        picture = self.designs.denoised(measured.image, design)
        numbers, exposure = self._numbers(measured), automatic_exposure(picture)
        about = self.about = Linearization(self.designs, measured)
        self._starts += 1
        self.channel.publish("problem", text="")
        self._publish_picture(
            "base", picture, number=self._starts, design=design, metrics=numbers, exposure=exposure
        )
        self._say("Ranking the parameters")
        about.rank()
        objects = describe_objects(about.surfaces, self.designs.sliders, about.attributions)
        self.channel.publish("objects", **objects)
        names = dict.fromkeys([*about.leading(self._top), *self._changed, *self._shown()])
        sliders = [self._slider(name) for name in names]
        for slider in sliders:
            self._publish_slider(slider)
        for slider in sliders:
            self._attempt(partial(self._derive, slider))
        return about

    def _derive(self, slider: Slider) -> None:
        if self.about is not None:
            self._say(f"Derivatives: {slider.label}")
            self._publish_slider(slider, self.about.derive(slider))

    def _say(self, text: str) -> None:
        self.channel.publish("status", text=text)

    def _numbers(self, measured: Measured) -> list[dict[str, Any]]:
        """Return value, error and meaning of each metric, and what that takes for granted of the picture."""
        values = map(measured.value, range(len(self.designs.metrics)))
        # Denoising takes longer than all else that is said of a picture.
        metrics = [
            one.with_transform(one.transform.remembering())
            for one in self.designs.metrics_of(measured.design)
        ]
        return [
            {
                "value": value,
                "error": error,
                **_meaning(metric, value, error, measured.images),
                "premises": [
                    *self._premises,
                    *photometric_premises(
                        metric.metric,
                        measured.image,
                        value,
                        error,
                        metric.transform(measured.image),
                        self.designs.renderer,
                        self.designs.values(measured.design),
                    ),
                ],
            }
            for metric, (value, error) in zip(metrics, values, strict=True)
        ]

    def _shown(self) -> list[str]:
        """Return the names of the parameters that have a slider on the pages."""
        return [key.removeprefix("slider ") for key in list(self.channel.latest) if key.startswith("slider ")]

    def _publish_picture(self, kind: str, image: torch.Tensor, **message: Any) -> None:
        scale, data = _encode(image)
        height, width = image.shape[:2]
        self.channel.publish(kind, [data], width=width, height=height, scales=[scale], **message)

    def _publish_slider(self, slider: Slider, derivative: Derivative | None = None) -> None:
        """Publish a slider, which can be moved once its derivatives are known."""
        attributions = [] if self.about is None else self.about.attributions
        ranked = [{row.name: row for row in attribution.ranking()} for attribution in attributions]
        rows = [by_name.get(slider.name) for by_name in ranked]
        encoded = [] if derivative is None else [_encode(image) for image in derivative.images]
        gradients = [] if derivative is None else derivative.gradients
        self.channel.publish(
            f"slider {slider.name}",
            [data for _, data in encoded],
            **{key: getattr(slider, key) for key in ("name", "label", "form", "low", "high", "start")},
            effects=[None if row is None else [row.effect, row.effect_error] for row in rows],
            doubts=[doubts_about(attribution, slider.name) for attribution in attributions],
            isLast=[slider.name in attribution.ranked_last() for attribution in attributions],
            gradients=[{"rows": one.rows.tolist(), "turned": one.turned.tolist()} for one in gradients],
            scales=[scale for scale, _ in encoded],
        )


def doubts_about(attribution: SceneAttribution, name: str) -> str:
    """Return why the effect of a parameter may not hold over its range; empty if it may.

    Without advice, and without what it means for rankings and bars, which a page of sliders does not have.
    """
    label = attribution.labels.get(name, name)
    notes = findings(range_notes(attribution, among=[name]))
    reasons = [re.sub(f"[,;] {RANKED_LAST}$", "", note.removeprefix(f"{label}: ")) for note in notes]
    return "; ".join(reasons)


class _SupersededError(Exception):
    """There is a newer design, or the exploration has ended."""


def _encode(image: torch.Tensor) -> tuple[float, bytes]:
    """Return a factor, and an image divided by it in half precision (little-endian)."""
    scale = image.abs().max().item() / LARGEST or 1.0
    return scale, (image / scale).half().numpy(force=True).astype("<f2").tobytes()


def _meaning(metric: TargetedMetric, value: float, error: float, images: torch.Tensor) -> dict[str, str]:
    """Return what a value means: where it is relaxed, what that by the definition means, and why it is hidden.

    ``images`` are the replicates of the picture.
    """
    image = images.mean(0)
    exact = definition_of(metric, images) if states_definition(metric, image) else None
    means = rating_in_words(metric.describe(value, image), value, error, exact)
    if exact is None:
        return {"verdict": means, "relaxed": ""}
    stated = f"{format_with_error(exact.value, exact.error)} by the definition"
    return {
        "verdict": ": ".join(filter(None, [stated, means])),
        "relaxed": "predictions need the derivatives of the relaxed value",
    }


def _describe(name: str, metric: TargetedMetric) -> dict[str, Any]:
    """Return title, unit, abbreviation and definition of a metric, and whether it has classes, as plain values."""
    measure = metric.measure
    if not isinstance(measure, Measure):
        return {
            "title": name or metric.label,
            "unit": "",
            "changeUnit": "",
            "symbol": None,
            "definition": "",
            "hasClasses": False,
        }
    return {
        "title": measure.name,
        "unit": measure.unit,
        "changeUnit": unit_of_change(measure.unit),
        "symbol": measure.symbol,
        "definition": f"{measure.symbol or measure.name}: {measure.definition}" if measure.definition else "",
        "hasClasses": bool(measure.bands),
    }
