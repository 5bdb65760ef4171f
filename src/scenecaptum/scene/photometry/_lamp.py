"""A lamp of an IES file as an entry of a scene dict."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...backend import activate
from ...errors import SceneCaptumError
from ._color import white_of
from ._file import read_ies


def ies_lamp(
    path: str | os.PathLike[str],
    *,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    aim: Sequence[float] = (0.0, 0.0, -1.0),
    to_world: Any = None,
    lumens: float | None = None,
    color: Sequence[float] | float = (1.0, 1.0, 1.0),
) -> dict[str, Any]:
    """Return the entry of a Mitsuba scene dict for a lamp with the distribution of light of an IES file.

    The lamp is a point: its illuminance is I(γ, C) cos θ / d², that of the luminaire from farther away than about
    five times its ``size``. Cameras and mirrors do not show it, so metrics of glare leave it out. It is dimmed in
    lumens:

    >>> import pathlib, tempfile, torch
    >>> from scenecaptum import SceneRenderer
    >>> from scenecaptum.scene import bundled, ies_lamp
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "downlight.ies"
    >>> _ = path.write_text('''IES:LM-63-2019
    ... TILT=NONE
    ... 1 -1 1 3 1 1 2 0 0 0 1 1 10
    ... 0 45 90
    ... 0
    ... 300 240 0''')
    >>> scene = {**bundled.cornell_box(), "downlight": ies_lamp(path, position=(0, 0, 0.9))}
    >>> renderer = SceneRenderer(scene, "*.lumens", resolution=(16, 16), spp=16)
    >>> renderer.inputs["downlight.lumens"].round()
    tensor(983.)
    >>> image = renderer({"downlight.lumens": torch.tensor(400.0)}, seed=0)

    In a scene in metres, radiances are in W·m⁻²·sr⁻¹: 179 lm/W times the Rec. 709 luminance of a pixel is its
    luminance in cd/m².

    Parameters
    ----------
    path
        An IES LM-63 file, see ``read_ies``.
    position
        The place in the scene.
    aim
        The direction of the file's nadir. The lamp is turned there from −z by the shortest way, and about the x
        axis if ``aim`` is +z.
    to_world
        A Mitsuba transformation of the lamp, without scale, in place of ``position`` and ``aim``: the nadir is
        −z, the plane C = 0 is that of +x.
    lumens
        The luminous flux; by default the file's own, ``read_ies(path).lumens``.
    color
        Linear RGB of any scale, or a color temperature in kelvin: the color of a black body.

    Raises
    ------
    SceneCaptumError
        If the file cannot be read, or an argument is out of its range.
    """
    mi = activate()
    from ._emitter import PLUGIN  # which needs a variant

    own = read_ies(path).lumens
    if to_world is None:
        to_world = mi.ScalarTransform4f(_pose(_vector("position", position), _vector("aim", aim)))
    elif any(position) or tuple(aim) != (0, 0, -1):
        raise SceneCaptumError("to_world replaces position and aim: give one or the other.")
    elif not isinstance(to_world, (mi.ScalarTransform4f, mi.ScalarTransform4d)):
        raise SceneCaptumError(f"to_world must be a Mitsuba transformation, not {type(to_world).__name__}.")
    return {
        "type": PLUGIN,
        "filename": str(Path(path).absolute()),
        "to_world": to_world,
        "lumens": own if lumens is None else _flux(lumens),
        "color": white_of(color),
    }


def _flux(lumens: float) -> float:
    if not (isinstance(lumens, Real) and 0 <= lumens < math.inf):
        raise SceneCaptumError(f"lumens must be a number of at least 0, not {lumens!r}.")
    return float(lumens)


def _vector(name: str, value: Sequence[float]) -> npt.NDArray[np.float64]:
    try:
        vector = np.array([float(x) for x in value])
    except (TypeError, ValueError):
        vector = np.empty(0)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise SceneCaptumError(f"{name} must be three finite numbers, not {value!r}.")
    return vector


def _pose(position: npt.NDArray[np.float64], aim: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the ``(4, 4)`` matrix that turns −z to ``aim`` by the shortest way, then moves."""
    length = np.linalg.norm(aim)
    if not length:
        raise SceneCaptumError(
            "aim must not be 0: it is the direction of the lamp's nadir, such as (0, 0, -1)."
        )
    start, end = np.array([0.0, 0.0, -1.0]), aim / length
    matrix = np.eye(4)
    if np.allclose(end, -start, atol=1e-12):
        matrix[:3, :3] = np.diag([1.0, -1.0, -1.0])
    else:
        half = (start + end) / np.linalg.norm(start + end)
        # Two reflections, at the plane across `start` and at that across the bisector, are a rotation.
        matrix[:3, :3] = (np.eye(3) - 2 * np.outer(half, half)) @ (np.eye(3) - 2 * np.outer(start, start))
    matrix[:3, 3] = position
    return matrix
