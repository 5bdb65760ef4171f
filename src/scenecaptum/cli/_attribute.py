"""``scenecaptum attribute``: the ranking, the map and the numbers."""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ..attr import AttributionInterrupted, SceneAttribution, VanillaSceneGradient
from ..attr._view import Denoise
from . import _arguments
from ._files import writable, write_each

REPORT = "report.html"

DENOISE: dict[str, Denoise] = {"auto": "auto", "on": True, "off": False}


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "attribute",
        help="rank the parameters of a scene by how much they move a metric",
        description="Render a scene, differentiate a metric through all bounces of light, and write the ranking, "
        "the map and the numbers.",
        epilog="example: scenecaptum attribute office --metric luminance --out out",
    )
    _arguments.add_scene(parser)
    _arguments.add_metric(parser, several=True)
    parser.add_argument(
        "--replicates",
        type=int,
        default=8,
        metavar="N",
        help="least number of passes that the error bars come from; 1 turns them off (default: 8)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        metavar="X",
        help="add samples until the 95 %% half-width of every parameter that may have 5 %% of all saliency is "
        "within X times its own, such as 0.05; the table says where that is out of reach",
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        metavar="SECONDS",
        help="the best for each metric in that time, without what compiling takes",
    )
    parser.add_argument(
        "--denoise",
        choices=DENOISE,
        default="auto",
        help="whether a metric that is not linear in the picture, such as a glare rating, sees it denoised; auto "
        "measures whether that brings it nearer to the truth (default: auto)",
    )
    parser.add_argument(
        "--picture-spp",
        type=int,
        metavar="N",
        help="samples per pixel of the picture that such a metric sees (default: 2 times --spp, or 4 times where "
        "the picture is denoised)",
    )
    _arguments.add_output(parser)
    add_report(parser)
    parser.set_defaults(run=attribute)


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add whether a report is written."""
    parser.add_argument(
        "--report",
        action="store_true",
        help="also write report.html: all metrics in one page to explore in a browser",
    )


def attribute(options: argparse.Namespace) -> int:
    """Run the command."""
    chosen = _arguments.find_metrics(options.metrics or ["luminance"], options.threshold_factor)
    with writable(options.out):
        renderer = _arguments.make_renderer(options)
        finished: list[SceneAttribution] = []
        for name, create in chosen.items():
            folder = options.out if len(chosen) == 1 else options.out / _folder_name(name)
            try:
                attribution = VanillaSceneGradient(renderer, create(renderer)).attribute(
                    target=options.target,
                    seed=options.seed,
                    picture_spp=options.picture_spp,
                    replicates=options.replicates,
                    denoise=DENOISE[options.denoise],
                    tolerance=options.tolerance,
                    time_limit=options.time_limit,
                    show_progress=_arguments.shows_progress(options),
                )
            except AttributionInterrupted as interruption:
                _report(interruption.partial, folder, as_json=options.json)
                _write_page([*finished, interruption.partial], options)
                raise
            _report(attribution, folder, as_json=options.json)
            finished.append(attribution)
            # After every metric, so that Ctrl-C during the next leaves what is finished.
            _write_page(finished, options)
        if not options.json:
            _arguments.say_resumed(renderer)
    return 0


def _folder_name(metric: str) -> str:
    return "".join(letter if letter.isalnum() else "-" for letter in metric).strip("-")


def _report(attribution: SceneAttribution, folder: Path, *, as_json: bool) -> None:
    """Write a result and print it."""
    write_each(folder, CONTENTS, partial(_write_file, attribution))
    if as_json:
        print(_json(attribution))
        return
    print(attribution)
    print()
    for name, content in CONTENTS.items():
        print(f"{folder / name}  {content}")


def _write_page(attributions: Sequence[SceneAttribution], options: argparse.Namespace) -> None:
    """Write the report of the results so far, where it was asked for."""
    if not options.report:
        return
    from ..visualization import write_report

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


def _write_file(attribution: SceneAttribution, name: str, path: Path) -> None:
    from ..visualization import save_render

    match name:
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
    picture = attribution.info.get("picture") or {}
    return {
        "metric": {
            "name": attribution.info["metric"],
            "value": attribution.metric_value,
            "standard_error": attribution.metric_standard_error,
            "bias": attribution.info["metric_bias"],
            "interval_95": attribution.metric_interval(0.95),
            "caution": picture.get("caution"),
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
        gradients = [f"gradient_{c + 1}" for c in channels] + [f"error_{c + 1}" for c in channels]
        writer.writerow([*columns, *gradients, "metric_caution"])
        caution = (attribution.info.get("picture") or {}).get("caution") or ""
        for row in rows:
            padding = [""] * (len(channels) - len(row.total))
            errors = ("",) * len(row.total) if row.total_error is None else row.total_error
            head = [row.rank, row.name, row.label, row.saliency, row.saliency_error]
            writer.writerow([*head, *row.total, *padding, *errors, *padding, caution])
