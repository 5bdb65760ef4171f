"""What rooms know of each other: renderers and results by what they can do, not by their class."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Generic, Literal, Protocol, TypeAlias, TypeVar, cast, runtime_checkable

import torch

T = TypeVar("T")

# How parameters are compared: by the effect of a change over their ranges, by one unit, or relative to them.
Scale: TypeAlias = Literal["range", "unit", "value"]


def accepted_keywords(function: Any) -> frozenset[str]:
    """Return the keywords that a callable names in its signature.

    A wrapper passes on those of what it wraps in an attribute ``accepted_keywords``; for anything else they are
    read from the signature, of a module that of its ``forward``.
    """
    declared: frozenset[str] | None = getattr(function, "accepted_keywords", None)
    if declared is not None:
        return declared
    try:
        parameters = inspect.signature(getattr(function, "forward", function)).parameters
    except (TypeError, ValueError):  # not callable, or built in
        return frozenset()
    return frozenset(
        name for name, parameter in parameters.items() if parameter.kind is not parameter.VAR_KEYWORD
    )


def takes_keyword(function: Any, keyword: str) -> bool:
    """Whether a callable names a keyword argument in its signature."""
    return keyword in accepted_keywords(function)


class Renderer(Protocol):
    """The one thing that every renderer does. What else it may offer is in ``Capabilities``."""

    def __call__(self, inputs: Mapping[str, torch.Tensor], /, *, seed: int, spp: int | None) -> torch.Tensor:
        """Render ``inputs`` with a seed and a number of samples per pixel; with None the renderer chooses it."""


class WithSensor(Protocol):
    """A renderer with a sensor that metrics need to know."""

    @property
    def camera(self) -> Any:
        """Directions and solid angles of the pixels of a view."""

    @property
    def grid(self) -> Any:
        """The points of a sensor grid."""

    @property
    def has_grid(self) -> bool:
        """Whether its pixels are the points of a sensor grid."""

    @property
    def shows_a_view(self) -> bool:
        """Whether its pixels are those of a picture."""


class Adjustable(Protocol):
    """A renderer whose inputs have physical bounds."""

    @property
    def inputs(self) -> Mapping[str, torch.Tensor]:
        """The scene's own values, in copies."""

    def clamp_(self, leaves: Mapping[str, torch.Tensor], /) -> None:
        """Move values beyond the bounds back to these, in place."""


@dataclass(frozen=True)
class RenderPass:
    """A render, or the backward pass of one: its options, the adjoint image, and the inputs to differentiate."""

    options: Mapping[str, Any]
    adjoint: torch.Tensor | None = None
    tracked: tuple[str, ...] = ()


@runtime_checkable
class Checkpointable(Protocol):
    """A renderer that stores its renders itself; others are wrapped (``checkpoint.with_checkpoint``)."""

    def with_checkpoint(self, checkpoint: Any, /) -> Any:
        """Return the same renderer with a checkpoint, or without one for None."""


class _Offer(Generic[T]):
    """An attribute of a renderer, or None if it has none of this name."""

    def __init__(self, doc: str) -> None:
        self.__doc__ = doc

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, capabilities: Capabilities, owner: type) -> T | None:
        found: T | None = getattr(capabilities.renderer, self._name, None)
        return found


class Capabilities:
    """What a renderer may offer beside rendering, each None if it does not; ``SceneRenderer`` offers all of it.

    An attribute is read from the renderer when it is asked for: some of them take a render.
    """

    inputs = _Offer[Mapping[str, torch.Tensor]]("The scene's own values.")
    bounds = _Offer[Mapping[str, tuple[float, float]]]("The physical range of each input.")
    ranges = _Offer[Mapping[str, tuple[float, float]]](
        "The interval of each input over which effects are compared; by default its bounds."
    )
    labels = _Offer[Mapping[str, str]]("Readable names of the inputs.")
    step_changes = _Offer[Callable[..., dict[str, torch.Tensor]]](
        "Changes of the gradients of poses if the steps of their differences are doubled."
    )
    range_changes = _Offer[Callable[..., dict[str, torch.Tensor]]](
        "Mean gradients over the ranges of poses whose gradients are those at their values."
    )
    collisions = _Offer[Callable[[Mapping[str, torch.Tensor]], Iterable[tuple[str, str]]]](
        "The poses that move objects into others, each with the name of the other."
    )
    touching = _Offer[Callable[[str], list[str]]]("The objects near to one that a pose moves.")
    shown_moves = _Offer[Callable[[Iterable[str], Mapping[str, torch.Tensor]], Mapping[str, Any]]](
        "Where the picture shows the objects of translations, and how these move them, where all are moved."
    )
    rendered_separately = _Offer[Collection[str]]("The inputs whose derivatives take renders of their own.")
    vectors = _Offer[Collection[str]]("The inputs that are vectors in space, compared by their lengths.")
    info = _Offer[Mapping[str, Any]]("How it renders, for the ``info`` of results.")
    info_of = _Offer[Callable[[Mapping[str, torch.Tensor]], Mapping[str, Any]]](
        "The same where objects and the camera are moved."
    )
    name = _Offer[str]("The name of the scene.")
    spp = _Offer[int]("Samples per pixel where none are asked for.")
    resolution = _Offer[tuple[int, int]]("Width and height of the images.")
    plan = _Offer[Any]("Integrator, depth and derivatives.")
    up = _Offer[int]("The axis of the scene that points up: 0, 1 or 2.")
    shows_a_view = _Offer[bool]("Whether neighbouring pixels show neighbouring directions.")
    guides = _Offer[Any]("Noise-free albedo, normals and emission for the denoiser.")
    surfaces = _Offer[Any]("What each pixel shows.")
    checkpoint = _Offer[Any]("Where finished renders are stored.")
    parameters_table = _Offer[Callable[[], Mapping[str, Any]]]("Describes every parameter of the scene.")
    guides_of = _Offer[Callable[[Mapping[str, torch.Tensor]], Any]](
        "The guides where objects and the camera are moved."
    )
    surfaces_with_texels = _Offer[Callable[[Iterable[str], Mapping[str, torch.Tensor]], Any]](
        "What each pixel shows, with the texels of textures, where objects and the camera are moved."
    )
    see_through = _Offer[Callable[[Iterable[str], Mapping[str, torch.Tensor]], Any]](
        "What each pixel shows in mirrors and behind glass, where objects and the camera are moved."
    )
    effective_samples = _Offer[Callable[..., dict[str, float]]]("Counts the samples behind each variance.")
    require_memory = _Offer[Callable[..., None]]("Raises if images do not fit into memory.")
    held_values = _Offer[Callable[..., Mapping[str, torch.Tensor]]](
        "The same values in tensors that many renders take faster."
    )
    replace = _Offer[Callable[..., Any]]("The same renderer with other options.")
    recipe = _Offer[Callable[[], Any]]("Makes the same renderer in another process; it can be pickled.")
    begin = _Offer[Callable[[Mapping[str, torch.Tensor], Sequence[RenderPass]], list[Callable[[], None]]]](
        "Begins passes in other processes; what it returns waits for each of them."
    )

    def __init__(self, renderer: object) -> None:
        self.renderer = cast(Any, renderer)

    @property
    def fingerprint(self) -> str | None:
        """Changes whenever the images change; not one that a wrapper passes on from what it wraps."""
        if inspect.getattr_static(self.renderer, "fingerprint", None) is None:
            return None
        found: str | None = self.renderer.fingerprint
        return found

    @property
    def with_seed_grad(self) -> Callable[..., torch.Tensor] | None:
        """The renderer itself, if ``seed_grad`` gives its backward pass a seed of its own."""
        return self.renderer if takes_keyword(self.renderer, "seed_grad") else None

    @property
    def with_spp_grad(self) -> Callable[..., torch.Tensor] | None:
        """The renderer itself, if ``spp_grad`` gives its backward pass samples of its own."""
        return self.renderer if takes_keyword(self.renderer, "spp_grad") else None


class ResultKind(str, Enum):
    """The quantity that an attribution consists of.

    Its value is the name in tables, figures and files. ``axis_label`` is for figures, with ``{}`` for the metric;
    so are ``finding``, which the names of the largest follow, and ``finding_of_none``, where all are 0.
    """

    axis_label: str
    finding: str
    finding_of_none: str

    def __new__(
        cls,
        name: str,
        axis_label: str = "",
        finding: str = "{} depends most on",
        finding_of_none: str = "{} depends on none of these parameters",
    ) -> ResultKind:
        """Return the kind with this name as its value."""
        kind = str.__new__(cls, name)
        kind._value_ = name
        kind.axis_label, kind.finding, kind.finding_of_none = axis_label, finding, finding_of_none
        return kind

    GRADIENT = "gradient per unit", "change of {} per unit of the parameter"
    EFFECT = "effect over the range", "first-order change of {} over the range of the parameter"
    RELATIVE_EFFECT = "effect per relative change", "change of {} per relative change of the parameter"
    INPUT_X_GRADIENT = "input × gradient", "value of the parameter × gradient of {}"
    MEAN_GRADIENT = "mean gradient per unit", "mean change of {} per unit of the parameter"
    MEAN_SQUARED_GRADIENT = (
        "mean squared gradient per unit",
        "mean squared change of {} per unit of the parameter",
        "the mean squared gradient of {} is largest for",
    )
    GRADIENT_VARIANCE = (
        "variance of the gradient per unit",
        "variance of the change of {} per unit of the parameter",
        "the gradient of {} varies most with",  # which is not what the metric depends on most
        "the gradient of {} varies with none of these parameters",
    )
    CONTRIBUTION = "contribution", "contribution to {}"
    ABLATION = "effect of ablation", "loss of {} by ablation"
    OCCLUSION = "effect of occlusion", "loss of {} by occlusion"
    SHAPLEY_VALUE = "Shapley value", "Shapley value for {}"

    @property
    def is_gradient_per_unit(self) -> bool:
        """Whether it is a derivative, or a mean of derivatives."""
        return self in (ResultKind.GRADIENT, ResultKind.MEAN_GRADIENT)

    @property
    def has_sign(self) -> bool:
        """Whether positive and negative values differ in meaning."""
        return self not in (ResultKind.MEAN_SQUARED_GRADIENT, ResultKind.GRADIENT_VARIANCE)

    @property
    def is_contribution(self) -> bool:
        """Whether it describes the presence of the parameter's value, not a change of it."""
        return self.has_sign and not self.is_gradient_per_unit and self != ResultKind.EFFECT

    def in_scale(self, scale: Scale) -> ResultKind:
        """Return the kind of the numbers that are compared in a scale."""
        if not self.is_gradient_per_unit or scale == "unit":
            return self
        return ResultKind.EFFECT if scale == "range" else ResultKind.RELATIVE_EFFECT


class Measure(Protocol):
    """What a metric measures; see ``metrics.Measure``."""

    @property
    def name(self) -> str:
        """In words, such as ``"mean luminance"``."""

    @property
    def half_class(self) -> float | None:
        """Half the width of its narrowest class."""

    def verdict(self, value: float) -> str:
        """Return the meaning of a value."""

    def describe(self) -> dict[str, object]:
        """Return name, unit and classes as plain values."""


class RankedParameter(Protocol):
    """One row of a ranking."""

    @property
    def rank(self) -> int:
        """Position, from 1."""

    @property
    def name(self) -> str:
        """The parameter's name."""

    @property
    def label(self) -> str:
        """The parameter's readable name."""

    @property
    def effect(self) -> float:
        """Signed effect of changing all channels together."""

    @property
    def effect_error(self) -> float | None:
        """Standard error of the effect."""

    @property
    def saliency(self) -> float:
        """Magnitude by which the parameters are ranked."""

    @property
    def saliency_error(self) -> float | None:
        """Standard error of the saliency."""

    @property
    def total(self) -> tuple[float, ...]:
        """The channel totals."""

    @property
    def total_error(self) -> tuple[float, ...] | None:
        """Their standard errors."""


class Attribution(Protocol):
    """A mapping from parameters to signed tensors, with errors and a description of how it was computed.

    ``scenecaptum.attr.SceneAttribution`` is the one that the attribution methods return; it documents the
    attributes.
    """

    def __getitem__(self, name: str, /) -> torch.Tensor: ...

    def __iter__(self) -> Iterator[str]: ...

    def __len__(self) -> int: ...

    def __contains__(self, name: object, /) -> bool: ...

    @property
    def metric_value(self) -> float:
        """The metric at the metric image."""

    @property
    def metric_standard_error(self) -> float | None:
        """Its standard error."""

    @property
    def convergence_delta(self) -> float | None:
        """Sum of the attributions minus what they explain, for methods that have it."""

    @property
    def convergence_delta_error(self) -> float | None:
        """Its standard error."""

    @property
    def covariance(self) -> Mapping[str, torch.Tensor] | None:
        """Covariance of the channel totals of each parameter."""

    @property
    def parameter_values(self) -> Mapping[str, torch.Tensor]:
        """Values of the parameters."""

    @property
    def extents(self) -> Mapping[str, torch.Tensor]:
        """The lengths of the ranges over which effects are compared, by channel; empty if they are unknown."""

    @property
    def labels(self) -> Mapping[str, str]:
        """Readable names of the parameters."""

    @property
    def image(self) -> torch.Tensor | None:
        """The render, ``(H, W, 3)`` linear radiance."""

    @property
    def surfaces(self) -> Any:
        """The objects visible in each pixel."""

    @property
    def kind(self) -> ResultKind:
        """The attributed quantity."""

    @property
    def info(self) -> Mapping[str, Any]:
        """How it was computed."""

    def factors(self, scale: Scale | None = None) -> Mapping[str, torch.Tensor]:
        """Return what turns the channels of each parameter into effects."""

    def weights(self, scale: Scale | None = None) -> Mapping[str, torch.Tensor]:
        """Return the same, along the largest effect for a vector in space: the change that an effect is of."""

    def effects(self, scale: Scale | None = None) -> dict[str, float]:
        """Return the signed effect of each parameter."""

    def ranks_by_norm(self, scale: Scale | None = None) -> bool:
        """Whether parameters are ranked by the norm over their channels, which have no common unit."""

    def scale_or_default(self, scale: Scale | None = None) -> Scale:
        """Return the scale, by default that of rankings; raise if it is unknown."""

    def saliency(self, scale: Scale | None = None) -> dict[str, float]:
        """Return each parameter's magnitude."""

    def saliency_error(self, scale: Scale | None = None) -> dict[str, float] | None:
        """Return the standard error of each magnitude."""

    def ranking(self, top: int | None = None, *, scale: Scale | None = None) -> Sequence[RankedParameter]:
        """Return the parameters by descending saliency, those of ``ranked_last`` after the others."""

    def ranked_last(self, scale: Scale | None = None) -> frozenset[str]:
        """Return the parameters whose effects say little of their ranges: no bar, and no colour on a map."""

    def untrusted_errors(self) -> dict[str, str]:
        """Return the parameters whose standard error is unreliable, each with the reason."""
