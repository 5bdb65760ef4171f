"""The command line: ``scenecaptum attribute``, ``scenecaptum demo`` and ``scenecaptum doctor``."""

from __future__ import annotations

import argparse
import contextlib
import csv
import importlib
import importlib.util
import json
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from . import __version__, backend, metrics
from .attr import AttributionInterrupted, SceneAttribution, VanillaSceneGradient
from .attr._metric import Metric
from .errors import SceneCaptumError, near_misses
from .rendering import SceneRenderer

GLARE = {
    "ugr": metrics.UnifiedGlareRating,
    "dgp": metrics.DaylightGlareProbability,
    "dgi": metrics.DaylightGlareIndex,
}
METRICS = ("luminance", *GLARE)

REPORT = "report.html"

BAD_INPUT, INTERRUPTED = 2, 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0 done, 2 bad input, 130 stopped by Ctrl-C."""
    options = _parser().parse_args(arguments)
    try:
        status: int = options.run(options)
    except SceneCaptumError as error:
        print(f"scenecaptum: error: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("scenecaptum: interrupted; what was finished is on disk.", file=sys.stderr)
        return INTERRUPTED
    return status


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="scenecaptum",
        description="Attribute any metric of a rendered image to the parameters of the scene.",
    )
    parser.add_argument("--version", action="version", version=f"scenecaptum {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    attribute = commands.add_parser(
        "attribute",
        help="rank the parameters of a scene by how much they move a metric",
        description="Render a scene, differentiate a metric through all bounces of light, and write the ranking, "
        "the map and the numbers.",
        epilog="example: scenecaptum attribute office --metric luminance --out out",
    )
    attribute.add_argument("scene", help="a Mitsuba XML file, or a bundled scene: office, cornell-box")
    attribute.add_argument(
        "--metric",
        action="append",
        dest="metrics",
        metavar="METRIC",
        help=f"{', '.join(METRICS)}, or a function of yours as FILE.py:NAME or MODULE:NAME; "
        "give it several times for several metrics (default: luminance)",
    )
    attribute.add_argument(
        "--inputs",
        action="append",
        metavar="SELECTION",
        help="what is differentiated: materials, reflectance, roughness, ior, opacity, textures, emitters, media, "
        "all, a glob or a name; may be repeated (default: all)",
    )
    attribute.add_argument(
        "--threshold-factor",
        type=float,
        metavar="X",
        help="for glare ratings: a source is brighter than X times the mean luminance (default: than 2000 cd/m²)",
    )
    attribute.add_argument(
        "--sensor",
        default="0",
        metavar="SENSOR",
        help="index of the scene's sensor, or fisheye: a 180° fisheye in its place (default: 0)",
    )
    attribute.add_argument(
        "--target", type=int, help="which element, where the metric returns a vector", metavar="INDEX"
    )
    attribute.add_argument(
        "--resolution", type=_resolution, metavar="WxH", help="for example 320x180 (default: the scene's own)"
    )
    attribute.add_argument(
        "--spp", type=int, metavar="N", help="samples per pixel in all (default: the scene's own)"
    )
    attribute.add_argument(
        "--max-depth",
        type=int,
        default=6,
        metavar="N",
        help="longest path in segments, -1 for no limit (default: 6)",
    )
    attribute.add_argument("--seed", type=int, default=0, metavar="N", help="(default: 0)")
    attribute.add_argument(
        "--replicates",
        type=int,
        default=8,
        metavar="N",
        help="least number of passes that the error bars come from; 1 turns them off (default: 8)",
    )
    attribute.set_defaults(run=_attribute)

    demo = commands.add_parser("demo", help="attribute the brightness of a bundled office in about a minute")
    demo.set_defaults(
        run=_attribute,
        scene="office",
        metrics=None,
        inputs=None,
        threshold_factor=None,
        sensor="0",
        target=None,
        resolution=(320, 180),
        spp=64,
        max_depth=6,
        seed=0,
        replicates=8,
    )
    for command in (attribute, demo):
        command.add_argument(
            "--out",
            type=Path,
            default=Path("out"),
            metavar="DIR",
            help="folder for the results (default: out)",
        )
        command.add_argument(
            "--json", action="store_true", help="print the numbers as JSON instead of a table"
        )
        command.add_argument(
            "--report",
            action="store_true",
            help="also write report.html: all metrics in one page to explore in a browser",
        )
        command.add_argument("--no-progress", action="store_true", help="show no progress bar")

    doctor = commands.add_parser("doctor", help="say whether this machine can render, and what to do if not")
    doctor.set_defaults(run=lambda _: backend.main())
    return parser


def _resolution(text: str) -> tuple[int, int]:
    width, separator, height = text.lower().partition("x")
    if not (separator and width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, such as 320x180")
    return int(width), int(height)


def _attribute(options: argparse.Namespace) -> int:
    names = options.metrics or ["luminance"]
    if options.threshold_factor is not None and not GLARE.keys() & set(names):
        raise SceneCaptumError(
            f"--threshold-factor belongs to a glare rating: add --metric {' or '.join(GLARE)}, or leave it out."
        )
    chosen = {name: _metric(name, options.threshold_factor) for name in names}
    with _writable(options.out):
        renderer = SceneRenderer(
            options.scene,
            options.inputs or "all",
            resolution=options.resolution,
            spp=options.spp,
            max_depth=options.max_depth,
            sensor=int(options.sensor) if options.sensor.isdigit() else options.sensor,
        )
        finished: list[SceneAttribution] = []
        for name, create in chosen.items():
            folder = options.out if len(chosen) == 1 else options.out / _folder_name(name)
            try:
                attribution = VanillaSceneGradient(renderer, create(renderer)).attribute(
                    target=options.target,
                    seed=options.seed,
                    replicates=options.replicates,
                    show_progress=sys.stderr.isatty() and not options.no_progress,
                )
            except AttributionInterrupted as interruption:
                _report(interruption.partial, folder, as_json=options.json)
                _write_page([*finished, interruption.partial], options)
                raise
            _report(attribution, folder, as_json=options.json)
            finished.append(attribution)
            # After every metric, so that Ctrl-C during the next leaves what is finished.
            _write_page(finished, options)
    return 0


def _metric(name: str, threshold_factor: float | None) -> Callable[[SceneRenderer], Metric]:
    """Return what creates a metric for a renderer, by the metric's name, or a function of the user's."""
    if name in GLARE:
        return lambda renderer: GLARE[name](renderer.camera, threshold_factor=threshold_factor)
    if name == "luminance":
        return lambda _: metrics.MeanLuminance()
    place, separator, attribute = name.rpartition(":")
    if not separator:
        raise SceneCaptumError(
            f"There is no metric {name!r}.{near_misses(name, METRICS)} "
            f"Metrics are {', '.join(METRICS)}; your own goes by FILE.py:NAME or MODULE:NAME."
        )
    try:
        found = getattr(_import(place), attribute)
    except Exception as error:  # whatever the user's file raises, it is the user's file that is named
        raise SceneCaptumError(
            f"The metric {name!r} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    metric: Metric = found() if isinstance(found, type) else found
    if not callable(metric):
        raise SceneCaptumError(f"The metric {name!r} is {type(metric).__name__}, not a function of an image.")
    return lambda _: metric


def _import(place: str) -> Any:
    if not place.endswith(".py"):
        return importlib.import_module(place)
    spec = importlib.util.spec_from_file_location(Path(place).stem, place)
    if spec is None or spec.loader is None:
        raise ImportError(place)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _folder_name(metric: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in metric).strip("-")


@contextlib.contextmanager
def _writable(folder: Path) -> Iterator[None]:
    """Make the output folder before hours of rendering, and leave none behind where nothing was written."""
    existed = folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Permissions do not tell the whole story (a read-only file system): only writing does.
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise SceneCaptumError(
            f"The output folder {folder} cannot be written: {error.strerror or error}. Choose another with --out."
        ) from error
    try:
        yield
    finally:
        if not existed and not any(folder.iterdir()):
            folder.rmdir()


def _report(attribution: SceneAttribution, folder: Path, *, as_json: bool) -> None:
    """Write a result and print it."""
    written = _write(attribution, folder)
    if as_json:
        print(_json(attribution))
        return
    print(attribution)
    print()
    for path, content in written.items():
        print(f"{path}  {content}")


def _write_page(attributions: Sequence[SceneAttribution], options: argparse.Namespace) -> None:
    """Write the report of the results so far, where it was asked for."""
    if not options.report:
        return
    from .visualization import write_report

    path = options.out / REPORT
    write_report(attributions, path)
    if not options.json:
        print(f"{path}  all results, to explore in a browser")


# In the order in which they are written: the numbers first, so that Ctrl-C while drawing leaves them.
CONTENTS = {
    "attribution.json": "the numbers and how they were computed",
    "attribution.csv": "the numbers as a table",
    "attribution.npz": "everything, for SceneAttribution.load",
    "render.png": "the picture",
    "heatmap.png": "each pixel painted with the saliency of what it shows, beside the picture",
    "bars.png": "the ranking with error bars",
}


def _write(attribution: SceneAttribution, folder: Path) -> dict[Path, str]:
    """Write each file of a result elsewhere first, so that none is ever half-written."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".scenecaptum-", dir=folder) as scratch:
        for name in CONTENTS:
            _write_file(attribution, Path(scratch, name))
            os.replace(Path(scratch, name), folder / name)
    return {folder / name: content for name, content in CONTENTS.items()}


def _write_file(attribution: SceneAttribution, path: Path) -> None:
    from .visualization import save_render

    match path.name:
        case "attribution.json":
            path.write_text(_json(attribution) + "\n", encoding="utf-8")
        case "attribution.csv":
            _write_csv(attribution, path)
        case "attribution.npz":
            attribution.save(path)
        case "render.png":
            assert attribution.image is not None, "every attribution of a SceneRenderer has its image"
            save_render(attribution.image, path)
        case "heatmap.png":
            attribution.plot_heatmap().savefig(path, dpi=150)
        case "bars.png":
            attribution.plot_bars().savefig(path, dpi=150)


def _json(attribution: SceneAttribution) -> str:
    return json.dumps(_numbers(attribution), indent=1, ensure_ascii=False, allow_nan=False)


def _numbers(attribution: SceneAttribution) -> dict[str, Any]:
    return {
        "metric": {
            "name": attribution.info["metric"],
            "value": attribution.metric_value,
            "standard_error": attribution.metric_standard_error,
            "bias": attribution.info["metric_bias"],
        },
        "ranking": [row._asdict() for row in attribution.ranking()],
        "info": dict(attribution.info),
    }


def _write_csv(attribution: SceneAttribution, path: Path) -> None:
    rows = attribution.ranking()
    channels = range(max(len(row.total) for row in rows))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        columns = ["rank", "name", "label", "saliency", "saliency_error"]
        writer.writerow(
            columns + [f"gradient_{c + 1}" for c in channels] + [f"error_{c + 1}" for c in channels]
        )
        for row in rows:
            padding = [""] * (len(channels) - len(row.total))
            errors = ("",) * len(row.total) if row.total_error is None else row.total_error
            head = [row.rank, row.name, row.label, row.saliency, row.saliency_error]
            writer.writerow([*head, *row.total, *padding, *errors, *padding])


if __name__ == "__main__":
    sys.exit(main())
