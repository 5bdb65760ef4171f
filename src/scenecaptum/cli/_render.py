"""``scenecaptum render``: a picture of a scene."""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import Any

import torch

from ..denoising import denoise
from ..errors import SceneCaptumError
from ..files import write_error
from ..projection import export
from ..rendering import SceneRenderer
from ..visualization import save_render
from . import _arguments
from ._design import add_design, designed_values


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "render",
        help="render a scene to a PNG or EXR file",
        description="Render a scene. A PNG is tone-mapped for display; an EXR has the linear radiance.",
        epilog="example: scenecaptum render office --resolution 320x180 --spp 64 --denoise --to office.png",
    )
    _arguments.add_view(parser)
    add_design(parser)
    _arguments.add_no_progress(parser)
    parser.add_argument("--denoise", action="store_true", help="denoise the picture (Open Image Denoise)")
    parser.add_argument(
        "--to",
        type=Path,
        default=Path("render.png"),
        metavar="FILE",
        help="a .png or .exr file (default: %(default)s)",
    )
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.to.suffix not in (".png", ".exr"):
        raise SceneCaptumError(f"{options.to} must end in .png or .exr.")
    renderer = _arguments.make_renderer(options)
    if options.to.suffix == ".png" and renderer.has_grid:
        raise SceneCaptumError(
            "A sensor grid measures light at points and has no picture: scenecaptum explain --sensor grid "
            "--metric mean-illuminance writes plan.png, a map with a scale; an .exr file has the irradiances."
        )
    with torch.no_grad():
        values = designed_values(options, renderer) or {}
        image = renderer(values, seed=options.seed)
    if options.denoise:
        _warn_of_filter(renderer)
        image = denoise(image, renderer.guides_of(values))
    try:
        options.to.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise write_error(options.to.parent, error) from error
    if options.to.suffix == ".png":
        save_render(image, options.to)
    else:
        export(image, options.to)
    print(options.to)
    return 0


def _warn_of_filter(renderer: SceneRenderer) -> None:
    """Warn that a film filter spreads noise over pixels, where the denoiser cannot tell it from the scene."""
    for decision, reason in renderer.plan.reasons:
        if decision.startswith("film filter "):
            warnings.warn(f"{decision}, {reason}", stacklevel=2)
