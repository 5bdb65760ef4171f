"""``scenecaptum explore``: a page on which parameters are dragged."""

from __future__ import annotations

import argparse
import inspect
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..designs import CHANGES
from ..estimation import Metric
from ..explanation import depth_premises
from ..explore import Exploration, section, serve
from ..linearization import Designs
from ..metrics import BY_NAME
from ..rendering import SceneRenderer
from ..report import write_section
from . import _arguments
from ._design import add_design, design_settings, designed_values
from ._interrupt import leave
from ._metrics import DEFAULT, OPTIONS, add_metric, find_metrics
from ._points import chosen_sensor

WIDTH = 320  # pixels of the picture where no resolution is given


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "explore",
        help="drag a parameter and see the picture and the metric move, in a browser",
        description="Open a page that predicts what a change of the scene does to the picture and to the metric, "
        "and then renders it. The page is on this machine only; Ctrl-C ends it.",
        epilog="example: scenecaptum explore office --metric ugr",
    )
    _arguments.add_scene(parser)
    add_metric(parser, several=True)
    add_design(parser)
    parser.add_argument(
        "--top",
        type=int,
        default=_arguments.default_of(Exploration, "top"),
        metavar="N",
        help="number of parameters that have a slider from the beginning (default: %(default)s)",
    )
    parser.add_argument("--port", type=int, default=0, metavar="N", help="port of the page (default: any)")
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.add_argument(
        "--to",
        type=Path,
        metavar="FILE",
        help="write the predictions to an HTML file, which needs no server, instead of opening a page",
    )
    _arguments.add_no_progress(parser)
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    metrics = find_metrics(options.metrics or [DEFAULT], options)
    renderer = _arguments.make_renderer(options)
    if options.resolution is None and renderer.shows_a_view:
        renderer = renderer.replace(resolution=_small(renderer.resolution))
    created = {name: create(renderer) for name, create in metrics.items()}
    exploration = Exploration(
        renderer,
        created if len(created) > 1 else next(iter(created.values())),
        inputs=designed_values(options, renderer),
        target=options.target,
        seed=options.seed,
        top=options.top,
        recipe=_recipe(options, renderer, created),
        spp=_spp(options),
        premises=depth_premises(renderer),
    )
    if options.to is not None:
        exploration.linearize()
        write_section(section(exploration), options.to, renderer.name)
        print(f"{options.to}  interactive page with predictions")
        return 0
    ended = serve(exploration, port=options.port, open_browser=not options.no_browser)
    print("\nexplore: ended")
    if not ended:
        leave(0)  # a kernel still runs
    return 0


def _small(resolution: tuple[int, int]) -> tuple[int, int]:
    """Return a resolution of the same shape that renders quickly."""
    width, height = resolution
    factor = min(1.0, WIDTH / width)
    return max(1, round(width * factor)), max(1, round(height * factor))


def _spp(options: argparse.Namespace) -> int:
    spp: int = _arguments.default_of(Designs, "spp") if options.spp is None else options.spp
    return spp


def _recipe(
    options: argparse.Namespace, renderer: SceneRenderer, metrics: Mapping[str, Metric]
) -> dict[str, Any]:
    """Return the renderer, the metrics by name and the given design as code and as a command."""
    width, height = renderer.resolution
    settings = design_settings(options)
    renderer_options = {
        "resolution": (width, height),
        "spp": _spp(options),
        "max_depth": renderer.plan.max_depth,
        "sensor": chosen_sensor(options, None),
        "parameters": dict(options.parameters or ()),
        "objects": dict(options.objects or ()),
    }
    arguments = "".join(f", {name}={value!r}" for name, value in renderer_options.items() if value)
    own = [name.rpartition(":")[0] for name in metrics if name not in BY_NAME]
    needed = sorted({"runpy" if module.endswith(".py") else "importlib" for module in own})
    setting = [_setting_code(key, value, options.design) for key, value in settings.items()]
    reads = any("read_design" in line for line in setting)
    python = [
        *(f"import {module}\n" for module in needed),
        *(["from pathlib import Path\n"] if reads else []),
        "import torch",
        "",
        f"from scenecaptum import SceneRenderer, VanillaSceneGradient, {'designs, ' if reads else ''}metrics",
        "",
        f"renderer = SceneRenderer({options.scene!r}, {{inputs}}{arguments})",
        "values = renderer.inputs",
        *setting,
    ]
    flags = {
        "--resolution": f"{width}x{height}",
        "--spp": _spp(options),
        "--max-depth": renderer.plan.max_depth,
        "--sensor": options.sensor,
        "--target": options.target,
        "--design": options.design,
        **{_flag(name): getattr(options, name) for name in OPTIONS},
    }
    words = ["scenecaptum", "attribute", options.scene]
    words += [word for name in metrics for word in ("--metric", name)]
    words += [word for name, value in flags.items() if value is not None for word in (name, str(value))]
    words += [word for pair in options.parameters or () for word in ("-D", "=".join(pair))]
    words += [
        word for name, shapes in options.objects or () for word in ("--object", f"{name}={','.join(shapes)}")
    ]
    return {
        "python": "\n".join(python),
        "metrics": [_metric_code(name, metric, options) for name, metric in metrics.items()],
        "attribute": f"values, target={options.target!r}" if options.target is not None else "values",
        "command": shlex.join(words),
        "settings": [_setting(key, value) for key, value in options.settings or ()],
        "changed": [_parts(key)[0] for key in settings],
        "inputs": _arguments.selection(options),
    }


def _metric_code(name: str, created: Metric, options: argparse.Namespace) -> str:
    """Return an expression that creates the metric of this name for ``renderer``."""
    if name not in BY_NAME:
        module, _, attribute = name.rpartition(":")
        call = "()" if type(created).__name__ == attribute else ""  # a class
        if module.endswith(".py"):
            return f"runpy.run_path({module!r})[{attribute!r}]{call}"
        return f"importlib.import_module({module!r}).{attribute}{call}"
    metric = BY_NAME[name]
    known = {option: getattr(options, option) for option in OPTIONS if option in metric.parameters}
    arguments = [f"{option}={value!r}" for option, value in known.items() if value is not None]
    arguments += ["camera=renderer.camera"] if "camera" in metric.parameters else []
    create = metric.create.__name__ if inspect.isclass(metric.create) else f"BY_NAME[{name!r}].create"
    return f"metrics.{create}({', '.join(arguments)})"


def _setting_code(key: str, value: Any, design: Path | None) -> str:
    """Return code for a value of a design; a texture is read from the file."""
    is_texture = isinstance(value, list) and any(isinstance(one, list) for one in value)
    written = f"designs.read_design(Path({str(design)!r}))[{key!r}]" if is_texture else repr(value)
    of, operator = _parts(key)
    name, given = f"values[{of!r}]", f"torch.tensor({written})"
    return (
        f"{name} = {name} {operator} {given}" if operator else f"{name} = torch.zeros_like({name}) + {given}"
    )


def _setting(key: str, value: Any) -> dict[str, Any]:
    """Return a ``--set`` in parts, for a page that moves its parameter further."""
    name, operator = _parts(key)
    return {"name": name, "operator": operator, "numbers": value}


def _parts(key: str) -> tuple[str, str]:
    """Return the name and the operator of a change: ``"lamp.radiance.value*"`` has ``"*"``."""
    operator = key[-1] if key[-1:] in CHANGES else ""
    return key.removesuffix(operator), operator


def _flag(option: str) -> str:
    return f"--{option.replace('_', '-')}"
