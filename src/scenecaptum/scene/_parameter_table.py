"""The parameters of a scene, and their table for terminals and notebooks."""

from __future__ import annotations

import dataclasses
import html
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch

from ..errors import UnknownNameError, near_misses
from ..visualization import (
    STYLE,
    columns,
    cut,
    grid,
    group_by_text,
    html_cells,
    pluralize,
    shorten,
    terminal_width,
    wrap,
)
from ._bounds import Bounds
from ._hints import hint

SURFACE_KINDS = ("reflectance", "roughness", "ior", "opacity", "surface")
POSES, CAMERA = "poses", "camera"
# Kinds that move something. Each of their numbers takes renders of its own.
MOVING_KINDS = (POSES, CAMERA)

# Of the poses; lengths are in the units of the scene, which has no name for them.
UNITS = {"rotation": "rad", "fov": "°"}
_COLUMNS = ("name", "kind", "shape", "bounds", "owner", "status")
_MIN_NAME_WIDTH, _OWNER_WIDTH = 30, 12
# Columns that are omitted in narrow terminals, in this order.
_OPTIONAL_COLUMNS = ("owner", "bounds", "shape", "kind")


IN_BYTES = (
    "its texels are stored in 8 bits and have no derivatives; load the scene from its file or dict, or give the "
    'bitmap format="variant"'
)


@dataclass(frozen=True)
class Parameter:
    """One parameter of a scene.

    Attributes
    ----------
    name
        Its ``mi.traverse`` key under ``optimize=False``, used everywhere; poses have names of their own.
    label
        A readable name for tables and figures.
    kind
        ``"reflectance"``, ``"roughness"``, ``"ior"``, ``"opacity"``, ``"surface"`` (any other property of a
        material), ``"emitters"``, ``"media"``, ``"poses"``, ``"geometry"``, ``"camera"`` or ``"scene"``.
    plugin
        The Mitsuba class of the material, emitter, medium, shape or sensor that uses it.
    role
        The Mitsuba property that it is used for: ``"diffuse_reflectance"``, ``"eta"``, …
    shape
        Shape of its tensor: ``()`` for a scalar, ``(3,)`` for a colour, ``(H, W, C)`` for a texture, ``(4, 4)``
        for a transformation. Where Mitsuba reads a colour as one number, such as an opacity, ``()`` for a colour
        and ``(H, W, 1)`` for a texture.
    bounds
        The physically meaningful interval.
    range
        The interval over which effects are compared: the bounds where they are finite, and that of real glass for
        an index of refraction. Unbounded (a radiance, a metal's index, a density) means from 0 to its
        value, or to 1 if that is 0.
    owners
        The materials, emitters or media that it belongs to.
    tracked
        Whether Dr.Jit can track its derivative; otherwise finite differences are used.
    mixes_specular
        Whether it is the share of a perfectly specular lobe, in a plugin whose choice of lobes has no derivative.
    unknown_sampling
        Whether it belongs to such a plugin of the user, whose sampling may depend on it in unknown ways.
    is_used
        Whether any shape uses its material; True for what is not part of a material.
    lobe_weight
        Whether it weighs a lobe that is skipped where the weight is at a bound.
    shapes
        The shapes that it moves, for a pose; those that use its material, for a property of one.
    fault
        Why the scene's own value is invalid (not finite or physically impossible), or None.
    problem
        Why it cannot be differentiated, or None.
    caution
        A known error of its derivative, or None.
    """

    name: str
    label: str
    kind: str
    plugin: str
    role: str
    shape: tuple[int, ...]
    bounds: Bounds
    range: Bounds
    owners: tuple[str, ...]
    tracked: bool = True
    mixes_specular: bool = False
    unknown_sampling: bool = False
    is_used: bool = True
    lobe_weight: bool = False
    shapes: tuple[str, ...] = ()
    fault: str | None = None
    problem: str | None = None
    caution: str | None = None

    @property
    def moves(self) -> bool:
        """Whether it moves an object, a light or the camera, and can be set."""
        return self.kind in MOVING_KINDS and self.plugin == "Pose"

    @property
    def unit(self) -> str:
        """The unit of a pose, such as ``"rad"``; empty for what has no unit, or that of the scene."""
        return UNITS.get(self.role, "") if self.moves else ""

    @property
    def is_of_surface(self) -> bool:
        """Whether it belongs to the material of a surface."""
        return self.kind in SURFACE_KINDS

    @property
    def is_texture(self) -> bool:
        """Whether its value varies over a surface."""
        return len(self.shape) in (2, 3) and self.is_of_surface and not self.name.endswith(".to_uv")

    @property
    def repeats_columns(self) -> bool:
        """Whether its first and last column are copies of those at the other side, as Mitsuba stores sky maps."""
        return self.plugin == "EnvironmentMapEmitter" and len(self.shape) == 3

    @property
    def why_left_out(self) -> str | None:
        """Why kinds and globs leave it out although a user may expect it; None for all others."""
        return self.problem if self.problem == IN_BYTES else self.fault

    @property
    def status(self) -> str:
        """One line: differentiable, differentiable with a caution, or the reason why not."""
        if self.problem:
            return f"not differentiable: {self.problem}"
        return f"differentiable, but {self.caution}" if self.caution else "differentiable"


class SceneParameters(Mapping[str, Parameter]):
    """The ``parameters`` of a scene by their unique names, in the scene's order; prints as a table."""

    def __init__(self, parameters: Iterable[Parameter]) -> None:
        self._by_name = {parameter.name: parameter for parameter in parameters}

    def with_ranges(self, ranges: Mapping[str, tuple[float, float]]) -> SceneParameters:
        """Return the parameters with other ranges of some of them."""
        return SceneParameters(
            dataclasses.replace(p, range=Bounds(*ranges[p.name])) if p.name in ranges else p
            for p in self.values()
        )

    def without_derivatives(self, kind: str, problem: str) -> SceneParameters:
        """Return the parameters with a reason why those of a kind cannot be differentiated.

        Parameters
        ----------
        kind
            That of the parameters which cannot.
        problem
            The reason, in place of any other.
        """
        return SceneParameters(
            dataclasses.replace(p, problem=problem) if p.kind == kind else p for p in self.values()
        )

    def hint(self, name: str) -> str:
        """Return in a sentence what a ``name`` means that no parameter has; empty if that is not known."""
        return hint(self, name)

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._by_name[name]
        except KeyError:
            raise UnknownNameError(
                f"The scene has no parameter {name!r}."
                f"{near_misses(name, self._by_name, instead=' Print parameters_table() for all names.')}"
            ) from None

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def __iter__(self) -> Iterator[str]:
        return iter(self._by_name)

    def __len__(self) -> int:
        return len(self._by_name)

    def __call__(self, recurse: bool = True) -> Iterator[torch.nn.Parameter]:
        """Return the weights of a renderer as a torch module, of which it has none."""
        return iter(())

    def __str__(self) -> str:
        return _text(list(self.values()))

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return _html(list(self.values()))


def _text(parameters: Sequence[Parameter]) -> str:
    """Format one line per parameter; in a terminal within its width, with the reasons as footnotes."""
    rows = [_row(parameter) for parameter in parameters]
    full = grid(_COLUMNS, rows)
    width = terminal_width()
    if width is None or not rows or max(map(columns, full)) <= width:
        return "\n".join(full)
    reasons = group_by_text((p.name, p.problem or p.caution) for p in parameters)
    numbers = {text: number for number, text in enumerate(reasons, start=1)}
    short = [[*row[:-1], _short_status(p, numbers)] for row, p in zip(rows, parameters, strict=True)]
    notes = [wrap(f"{number:>2}  {text}", width) for text, number in numbers.items()]
    return "\n".join([*_fit(short, width), "", *notes])


def _html(parameters: Sequence[Parameter]) -> str:
    """Format the differentiable parameters as a table, and the others in collapsed lists, grouped by reason."""
    differentiable = [parameter for parameter in parameters if not parameter.problem]
    reasons = group_by_text((parameter.name, parameter.problem) for parameter in parameters)
    collapsed = [
        f"<details><summary>{pluralize(len(names), 'parameter')} not differentiable: {html.escape(text)}"
        f"</summary><div>{html.escape(', '.join(names))}</div></details>"
        for text, names in reasons.items()
    ]
    rows = "\n".join(f"<tr>{html_cells(_row(parameter), 'td')}</tr>" for parameter in differentiable)
    return (
        f'<div class="scenecaptum">\n{STYLE}\n'
        f"<div><b>{pluralize(len(parameters), 'parameter')}</b>, {len(differentiable)} of them differentiable"
        "</div>\n"
        f"<table>\n<thead><tr>{html_cells(_COLUMNS, 'th')}</tr></thead>\n<tbody>\n{rows}\n</tbody>\n</table>\n"
        f'<div class="notes">{"".join(collapsed)}</div>\n</div>'
    )


def _row(p: Parameter) -> list[str]:
    shape = "×".join(map(str, p.shape)) or "scalar"
    return [p.name, p.kind, shape, f"{p.bounds} {p.unit}".rstrip(), ", ".join(p.owners), p.status]


def _short_status(parameter: Parameter, numbers: Mapping[str, int]) -> str:
    if parameter.problem:
        return f"no: {numbers[parameter.problem]}"
    return f"yes, but: {numbers[parameter.caution]}" if parameter.caution else "yes"


def _fit(rows: Sequence[Sequence[str]], width: int) -> list[str]:
    """Shorten names and owners, and omit columns, until lines fit into the width."""
    headers = (*_COLUMNS[:-1], "differentiable")
    kept = {
        header: [header, *column] for header, column in zip(headers, zip(*rows, strict=True), strict=True)
    }
    kept["owner"] = shorten(kept["owner"], _OWNER_WIDTH)
    for omitted in (None, *_OPTIONAL_COLUMNS):
        kept.pop(omitted or "", None)
        others = sum(2 + max(map(columns, column)) for header, column in kept.items() if header != "name")
        if width - others >= _MIN_NAME_WIDTH:
            break
    kept["name"] = shorten(kept["name"], max(width - others, 1))
    first, *rest = (list(row) for row in zip(*kept.values(), strict=True))
    return [cut(line, width, 0) for line in grid(first, rest)]
