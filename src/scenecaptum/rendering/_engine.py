"""The one place where torch meets Dr.Jit: primal, adjoint and tangent renders as pure functions of tensors.

Imported only once a variant is active (see ``SceneRenderer``). ``dr.wrap`` carries arrays across, but no
derivative graph ever outlives one call: each call writes its own values into the scene, and what it returns
depends on nothing that happens to the scene afterwards.
"""

from __future__ import annotations

import contextlib
import gc
import operator
import weakref
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import torch

from ..backend import device, dispose, exclusively
from ..errors import SceneCaptumError
from ..scene import SceneParameters, SurfaceMap
from ..scene._graph import SceneGraph
from . import (
    _integrator,  # noqa: F401 -- registers the plugin
    _volumetric,
)
from ._backward import FilmFilter, film_filter
from ._choice import choose_pixels, sample_shares
from ._from_surfaces import Receiver, Surfaces, find_surfaces, propagate_from_surfaces
from ._passes import Pass, passes
from ._pilot import Pilot, find_rows, take_pilot
from ._plan import RenderPlan
from ._routes import Difference, difference, is_constant, lifted, shiny_ones
from ._state import SceneState, flat, owned

Values = Mapping[str, torch.Tensor]

# How many times fewer samples a finite difference takes where a backward pass has samples of its own.
CHEAPER = 4

# Of the samples that choose their pixels, this share goes where pixels are noisy, and this one to each tracked
# surface alike; the rest is spread evenly.
NOISY, ALIKE = 0.35, 0.35
PILOTS, PILOT_SPP = 8, 2

# How many samples tell where the derivative of a low roughness is noisy: in all, and in a pixel at most.
PILOT_SAMPLES, MOST_PILOTS = 2**20, 64

# How many times the samples of an estimate are looked at one by one, to tell how rare what it is made of is; and
# how many samples at most.
CLOSER, MOST_CLOSER = 4, 2**17

# The engine whose scene is tracked, if any. A call through a virtual function reaches the objects of every scene
# in the process, so what another scene tracks would become part of this one's derivatives.
_tracking: weakref.ref[Engine] | None = None


class Engine:
    """Renders a scene and its derivatives for given parameter values.

    Parameters
    ----------
    graph, sensor
        The live scene and one of its sensors.
    state
        The scene's values.
    parameters
        What they are.
    plan
        How to render.
    resolution
        ``(width, height)`` in pixels.
    look_at
        Returns what each pixel shows.
    borrowed
        Whether the scene belongs to the caller and must be left as it was found.

    Attributes
    ----------
    device
        Where its pictures and gradients are.
    """

    def __init__(
        self,
        graph: SceneGraph,
        sensor: Any,
        state: SceneState,
        parameters: SceneParameters,
        plan: RenderPlan,
        resolution: tuple[int, int],
        look_at: Callable[[], SurfaceMap],
        *,
        borrowed: bool,
    ) -> None:
        self._graph = graph
        self._scene = graph.scene
        self._sensor = sensor
        self._state = state
        self._parameters = parameters
        self._resolution = resolution
        self._borrowed = borrowed
        self._variant, self.device = mi.variant(), device()
        self._is_at_hand = False
        self._plan = plan
        self._look_at = look_at
        self._starts: dict[tuple[str, ...], Surfaces | None] = {}
        self._interest: dict[Any, Sequence[tuple[float, torch.Tensor]]] = {}
        self._noise_of: Values = {}
        self._pilots: dict[int, Pilot] = {}
        self._integrator = plan.create_integrator()
        self._render, self._render_backward, self._propagate = _frozen(
            self._integrator, sensor, state.forget_gradients
        )
        # Whoever drops the last reference may do so while another thread records a kernel.
        weakref.finalize(self, dispose, self.__dict__).atexit = False
        # Decoding textures leaves Dr.Jit with as much memory again that it would keep for later.
        dr.flush_malloc_cache()

    @property
    def original(self) -> dict[str, torch.Tensor]:
        """The scene's own values."""
        return self._state.original

    @cached_property
    def _film_filter(self) -> FilmFilter | None:
        return film_filter(self._sensor.film())

    def look(self) -> None:
        """Read a borrowed scene's own values again: its owner may have changed them."""
        if self._borrowed:
            with exclusively(self._variant):
                self._state.look()

    def shows(self, pixels: torch.Tensor) -> str:
        """Say in a sentence what a mask of pixels ``(H, W)`` shows."""
        names = self._look_at().objects_on(pixels.numpy(force=True))
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return f" They show {', '.join(names[:3])}{more}: look for a value at an extreme there, or in the lights."

    def primal(self, values: Values, seed: int, spp: int) -> torch.Tensor:
        """Render: ``(H, W, 3)`` linear radiance."""
        with self.at_hand():
            # What an earlier adjoint left tracked does no harm here, and writing it again would cost.
            tracked = self._state.leaves.keys()
            stale = self._state.stale(values, tracked)

            def render(*arrays: Any) -> Any:
                self._state.write(stale, arrays, tracked)
                with dr.suspend_grad():
                    return _sum(
                        _done(
                            self._render(
                                self._scene, dr.opaque(mi.UInt32, one.seed), one.spp, self._state.scalars
                            )
                            * one.share
                        )
                        for one in self._passes(seed, spp)
                    )

            image: torch.Tensor = _call(render, *stale.values())
            return image

    def adjoint(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        seed: int,
        spp: int,
        *,
        choose: bool = False,
    ) -> tuple[torch.Tensor, ...]:
        """Return the vector–Jacobian product: for each tracked parameter ``Σ adjoint · ∂image/∂parameter``.

        With ``choose`` the samples go to pixels by their adjoint; otherwise they are those of the primal of the
        same seed, which makes it the derivative of that very picture.
        """
        replayed = [name for name in tracked if self._difference(name, values) is None]
        shiny = shiny_ones(self._parameters, {n: values[n] for n in replayed}) if choose else []
        surfaces = self._surfaces(tuple(shiny)) if shiny else None
        if surfaces is None:
            found = self._replay(values, replayed, adjoint, seed, spp, choose=choose)
        else:
            rest = [name for name in replayed if name not in shiny]
            found = self._replay(values, rest, adjoint, seed, spp, choose=choose)
            found |= self._replay(values, shiny, adjoint, seed, spp, choose=choose, surfaces=surfaces)
        # Samples of its own need not be as many: a shared seed takes most of the noise out of a difference.
        fewer = max(1, spp // CHEAPER) if choose else spp
        for name in tracked:
            if name not in found:
                product = (adjoint * self._slope(name, values, seed, fewer)).sum((0, 1))
                # The channels of a picture are those of a colour: none sees another's.
                found[name] = product if values[name].ndim else product.sum()
            if is_constant(self._parameters[name], {**self.original, **values}):
                found[name] = torch.zeros_like(values[name])
        return tuple(found[name].to(values[name]) for name in tracked)

    def tangent(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        """Return the Jacobian–vector product: the derivative image along ``tangents``."""
        replayed = {name: t for name, t in tangents.items() if self._difference(name, values) is None}
        width, height = self._resolution
        image = torch.zeros((height, width, 3), device=self.device)
        moving = {n for n in tangents if not is_constant(self._parameters[n], {**self.original, **values})}
        replayed = {name: tangent for name, tangent in replayed.items() if name in moving}
        if replayed:
            image = image + self._replay_forward(values, replayed, seed, spp)
        for name in moving - replayed.keys():
            image = image + (self._slope(name, values, seed, spp) * tangents[name]).to(image)
        return image

    def spread(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        spp: int,
        replicates: int,
    ) -> dict[str, tuple[float, float]]:
        """Return variance and fourth cumulant of what replicates of ``adjoint`` find on average.

        They are those of the light that each tracked parameter acts on, as a pilot tells them from the scene's own
        values. What has no such light is left out, and so is what has samples of its own.
        """
        replayed = [name for name in tracked if self._difference(name, values) is None]
        shiny = shiny_ones(self._parameters, {n: values[n] for n in replayed})
        if shiny and self._surfaces(tuple(shiny)) is not None:
            replayed = [name for name in replayed if name not in shiny]
        else:
            shiny = []
        adjoint = adjoint.detach().float()
        width, height = self._resolution
        with self.at_hand():
            film = self._film_filter
            strength = film.strength(adjoint) if film else adjoint.norm(dim=-1)
            interests = self._interests(values, replayed, None) if film else []
            chosen = sample_shares(strength, interests) * (width * height * spp)
            pilot = self._pilot(max(1, min(CLOSER * spp * replicates, MOST_CLOSER // (width * height))))
        size = strength.cpu().double().numpy().ravel()
        found = {}
        for name in tracked:
            evenly = np.full_like(size, max(1, spp // CHEAPER))
            samples = replicates * (chosen if name in replayed else evenly)
            if name not in shiny and (spread := pilot.spread(name, size, samples)) is not None:
                found[name] = spread
        return found

    def _difference(self, name: str, values: Values) -> Difference | None:
        return difference(self._parameters[name], values[name])

    def _slope(self, name: str, values: Values, seed: int, spp: int) -> torch.Tensor:
        """Return by how much the picture changes per unit of a scalar or colour: a finite difference, float64."""
        chosen = self._difference(name, values)
        assert chosen is not None
        value = values[name]
        off = {other: torch.zeros_like(self.original[other]) for other in chosen.off}
        slope: torch.Tensor = _sum(
            self.primal({**values, **off, name: value + shift}, seed, spp).double() * weight
            for shift, weight in chosen.points
        )
        return slope

    def _replay(
        self,
        values: Values,
        tracked: Sequence[str],
        adjoint: torch.Tensor,
        seed: int,
        spp: int,
        *,
        choose: bool,
        surfaces: Surfaces | None = None,
    ) -> dict[str, torch.Tensor]:
        if not tracked:
            return {}
        with self.at_hand():
            chosen_by = self._film_filter if choose else None
            interests = self._interests(values, tracked, surfaces) if chosen_by else []
            stale = self._state.stale(_lift(values, tracked, self._parameters), tracked)

            def backward(*arrays: Any) -> Any:
                self._state.write(stale, arrays, tracked)
                for one in self._passes(seed, spp):
                    number, scalars = dr.opaque(mi.UInt32, one.seed), self._state.scalars
                    weighted = one.share * adjoint
                    if chosen_by is None:
                        whole = owned(mi.TensorXf(weighted))
                        self._render_backward(self._scene, whole, number, one.spp, scalars)
                    else:
                        strength = chosen_by.strength(adjoint)
                        pixel, weight = choose_pixels(strength, interests, one.spp, one.seed)
                        samples = owned(mi.UInt32(pixel)), owned(mi.Float(weight))
                        profile = owned(mi.Float(chosen_by.profile.to(weight))), chosen_by.reach
                        scaled = owned(mi.TensorXf(weighted / chosen_by.caught.to(weight)))
                        self._propagate(self._scene, scaled, number, scalars, samples, profile, surfaces)
                    _done()
                return [flat(dr.grad(self._state.leaves[name])) for name in tracked]

            adjoint = adjoint.detach().float()
            gradients = _call(backward, *stale.values())
            return {n: g.reshape(values[n].shape) for g, n in zip(gradients, tracked, strict=True)}

    def _surfaces(self, shiny: tuple[str, ...]) -> Surfaces | None:
        with self.at_hand():
            if shiny not in self._starts:
                worn = self._look_at().parameters
                self._starts[shiny] = find_surfaces(self._graph, worn, self._sensor, self._plan, shiny)
            return self._starts[shiny]

    def _interests(
        self, values: Values, tracked: Sequence[str], surfaces: Surfaces | None
    ) -> Sequence[tuple[float, torch.Tensor]]:
        """Return shares of the samples and where each goes: to noisy pixels, and as many to each surface."""
        # Where highlights are depends on the roughness, but not finely.
        octaves = {n: values[n].clamp_min(1e-4).log2().round().exp2() for n in tracked} if surfaces else {}
        if not _equal(self._noise_of, self.original):
            self._noise_of = self.original
            self._interest.clear()
            self._pilots.clear()
            self.__dict__.pop("_noise", None)
        key = tuple(tracked), tuple(value.numpy(force=True).tobytes() for value in octaves.values())
        if key not in self._interest:
            noise = self._noise_left_by(surfaces, octaves) if surfaces else self._noise
            self._interest[key] = ((NOISY, noise), (ALIKE, self._for_each_surface(noise, tracked)))
        return self._interest[key]

    def _pilot(self, spp: int) -> Pilot:
        if spp not in self._pilots:
            rows = find_rows(self._graph, self._parameters)
            with self.holding({}):
                self._pilots[spp] = take_pilot(self._integrator, self._scene, self._sensor, rows, spp, 0)
        return self._pilots[spp]

    def _for_each_surface(self, noise: torch.Tensor, tracked: Sequence[str]) -> torch.Tensor:
        """Return the noise of the pixels, scaled to the same sum for every tracked parameter that they show.

        What a small object adds would otherwise be lost beside the walls.
        """
        surfaces = [n for n in tracked if self._parameters[n].kind not in ("emitters", "media")]
        shown = (torch.from_numpy(self._look_at().shown([name])) for name in surfaces)
        seen = [noise * one for one in shown]
        return sum((one / one.sum() for one in seen if one.any()), torch.zeros_like(noise))

    def _noise_left_by(self, surfaces: Surfaces, values: Values) -> torch.Tensor:
        """Roughly how noisy the derivatives of each pixel are where only some samples start on surfaces."""
        width, height = self._resolution
        spp = max(1, min(MOST_PILOTS, PILOT_SAMPLES // (width * height)))
        stale = self._state.stale({**self.original, **values}, values.keys())

        def pilot(*arrays: Any) -> Any:
            self._state.write(stale, arrays, values.keys())
            self._state.set_tangents({name: mi.TensorXf(1.0, value.shape) for name, value in values.items()})
            strength = self._integrator.strength
            return _done(strength(self._scene, self._sensor, spp, dr.opaque(mi.UInt32, 0), surfaces.among))

        return _smooth(_call(pilot, *stale.values()))

    @cached_property
    def _noise(self) -> torch.Tensor:
        """Roughly how noisy each pixel is: the spread of pilot pictures without the lights themselves.

        The noise of a pixel's derivatives goes with it, while a light that is seen directly has none. It is
        that of the scene's own values, whatever was rendered before: the same seed shall choose the same pixels.
        """
        integrator = self._plan.create_integrator(hide_emitters=True)
        render, *_ = _frozen(integrator, self._sensor, self._state.forget_gradients)

        def luminance(seed: int) -> torch.Tensor:
            fixed = dr.opaque(mi.UInt32, seed), PILOT_SPP, self._state.scalars
            image = _call(lambda: _done(render(self._scene, *fixed)))
            brightness: torch.Tensor = image.double().sum(-1)  # whose squares may overflow float32
            return brightness

        with self.holding({}):
            spread = torch.stack([luminance(seed) for seed in range(PILOTS)]).std(0)
        return _smooth(spread)

    def _replay_forward(self, values: Values, tangents: Values, seed: int, spp: int) -> torch.Tensor:
        with self.at_hand():
            tracked = tuple(tangents)
            stale = self._state.stale(_lift(values, tracked, self._parameters), tracked)
            split = len(tangents)

            def forward(*arrays: Any) -> Any:
                self._state.write(stale, arrays[split:], tracked)
                self._state.set_tangents(dict(zip(tracked, arrays[:split], strict=True)))
                return _sum(
                    _done(
                        self._integrator.render_forward(
                            self._scene, None, self._sensor, seed=dr.opaque(mi.UInt32, one.seed), spp=one.spp
                        )
                        * one.share
                    )
                    for one in self._passes(seed, spp)
                )

            image: torch.Tensor = _call(forward, *tangents.values(), *stale.values())
            return image

    def _passes(self, seed: int, spp: int) -> Iterator[Pass]:
        return passes(seed, spp, self._resolution)

    @contextlib.contextmanager
    def holding(self, values: Values) -> Iterator[None]:
        """Have the scene hold values, untracked, and the process to ourselves."""
        with self.at_hand():
            stale = self._state.stale(values, ())

            def write(*arrays: Any) -> None:
                self._state.write(stale, arrays, ())

            _call(write, *stale.values())
            yield

    @contextlib.contextmanager
    def at_hand(self) -> Iterator[None]:
        """Have the process to ourselves, and leave a borrowed scene as it was found."""
        with exclusively(self._variant), _collector_paused():
            if self._is_at_hand:
                yield
                return
            self._take_over_tracking()
            self.look()
            size = _film_size(self._sensor)
            _resize(self._sensor, self._resolution)
            self._is_at_hand = True
            try:
                yield
            finally:
                self._is_at_hand = False
                if self._borrowed:
                    self._state.restore()
                    _resize(self._sensor, size)

    def _take_over_tracking(self) -> None:
        global _tracking  # noqa: PLW0603 -- there is one Dr.Jit, and it tracks for the whole process
        previous = _tracking() if _tracking is not None else None
        # The cameras of one renderer share their state.
        if previous is not None and previous._state is not self._state:
            previous._state.release()
        _tracking = weakref.ref(self)


def _equal(one: Values, other: Values) -> bool:
    return one is other or (one.keys() == other.keys() and all(torch.equal(one[n], other[n]) for n in one))


def _smooth(image: torch.Tensor) -> torch.Tensor:
    """Average each pixel of an ``(H, W)`` image and its neighbours."""
    smooth: torch.Tensor = torch.nn.functional.avg_pool2d(image[None, None], 3, 1, 1, count_include_pad=False)
    return smooth[0, 0]


def _frozen(integrator: Any, sensor: Any, forget: Callable[[], None]) -> tuple[Callable[..., Any], ...]:
    """Return primal render, its backward pass and one of chosen pixels, as frozen functions where that is safe.

    Tracing a room with dozens of materials takes 0.2 s, the same for every pass: so it is done once. Numbers that
    Mitsuba writes into kernels (``scalars``) are arguments for others to be traced anew.
    """

    def render(scene: Any, seed: Any, spp: int, scalars: tuple[float, ...]) -> Any:
        return integrator.render(scene, sensor, seed=seed, spp=spp)

    def render_backward(scene: Any, adjoint: Any, seed: Any, spp: int, scalars: tuple[float, ...]) -> None:
        integrator.render_backward(scene, None, adjoint, sensor, seed=seed, spp=spp)

    def propagate(
        scene: Any,
        adjoint: Any,
        seed: Any,
        scalars: tuple[float, ...],
        samples: tuple[Any, Any],
        profile: tuple[Any, int],
        surfaces: Surfaces | None,
    ) -> None:
        seen = surfaces.among if surfaces else None
        integrator.propagate(scene, sensor, adjoint, samples, profile, seed, seen)
        if surfaces is not None:
            receiver = Receiver(sensor, adjoint, profile)
            propagate_from_surfaces(integrator, scene, receiver, surfaces, seed, dr.width(samples[0]))

    functions = (render, render_backward, propagate)
    # Freezing does not see phase functions: a picture would stay that of the first.
    if isinstance(integrator, _volumetric.VolumetricReplayIntegrator):
        return functions
    return tuple(_Frozen(function, forget) for function in functions)


class _Frozen:
    """A frozen function, or the function itself where a plugin hides objects that freezing must see."""

    def __init__(self, function: Callable[..., Any], forget: Callable[[], None]) -> None:
        self._function = function
        self._forget = forget
        self._call = dr.freeze(function, warn_after=1000, limit=8)

    def __call__(self, *arguments: Any) -> Any:
        try:
            return self._call(*arguments)
        except RuntimeError as error:
            if "record()" not in _whole(error) or _nothing_attached(error):
                raise
            # What the failed recording has accumulated would count twice.
            self._forget()
            self._call = self._function
            return self._function(*arguments)


def _whole(error: BaseException | None) -> str:
    """Return the messages of an error and of its causes."""
    return "" if error is None else f"{error} {_whole(error.__cause__)}"


def _done(*pictures: Any) -> Any:
    """Wait for a pass: Dr.Jit would begin others beside it, each with memory of its own."""
    dr.eval(*pictures)
    dr.sync_thread()
    return pictures[0] if pictures else None


def _sum(terms: Iterable[Any]) -> Any:
    """Add up pictures one after the other: there is no empty picture to start from."""
    return reduce(operator.add, terms)


def _lift(values: Values, tracked: Collection[str], parameters: SceneParameters) -> Values:
    return {**values, **{name: lifted(parameters[name], values[name]) for name in tracked}}


def _call(function: Callable[..., Any], *tensors: torch.Tensor) -> Any:
    """Call a function of Dr.Jit tensors with torch tensors."""
    try:
        return dr.wrap(source="torch", target="drjit")(function)(
            *(tensor.detach().to(torch.float32).contiguous() for tensor in tensors)
        )
    except RuntimeError as error:
        if _nothing_attached(error):
            raise SceneCaptumError(NOTHING_ATTACHED) from error
        raise


@contextlib.contextmanager
def _collector_paused() -> Iterator[None]:
    """Keep Python from collecting a scene while Dr.Jit records a frozen function: that aborts the process."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _film_size(sensor: Any) -> tuple[int, int]:
    width, height = sensor.film().crop_size()
    return int(width), int(height)


def _resize(sensor: Any, size: tuple[int, int]) -> None:
    if _film_size(sensor) != size:
        film = mi.traverse(sensor)
        film["film.size"] = list(size)
        film.update()


NOTHING_ATTACHED = (
    "No derivative reaches any of the inputs: none of them takes part in a path that can be differentiated. Look "
    "at renderer.plan for cautions, and add an input that the picture depends on, such as a light."
)


def _nothing_attached(error: BaseException) -> bool:
    """Whether Mitsuba's complaint that nothing is tracked lies at the root of an error."""
    return "not attached to the AD graph" in _whole(error)
