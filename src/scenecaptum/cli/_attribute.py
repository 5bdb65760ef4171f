"""``scenecaptum attribute``: compute attributions and write the ranking, the heatmap and the numbers."""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from ..attr import AttributionInterrupted, SceneAttribution, VanillaSceneGradient
from ..estimation import Denoise
from . import _arguments
from ._files import writable, write_each
from ._metrics import DEFAULT, add_metric, find_metrics

REPORT = "report.html"

DENOISE: dict[str, Denoise] = {"auto": "auto", "on": True, "off": False}


def add(commands: Any) -> None:
    """Add the command to the parser's."""
    parser = commands.add_parser(
        "attribute",
        help="rank the parameters of a scene by their effect on a metric",
        description="Render a scene, differentiate a metric through all light bounces, and write the ranking, the "
        "heatmap and the numbers.",
        epilog="example: scenecaptum attribute office --metric luminance --out out",
    )
    _arguments.add_scene(parser)
    add_metric(parser, several=True)
    parser.add_argument(
        "--replicates",
        type=int,
        default=8,
        metavar="N",
        help="minimum number of independent replicates for the error bars; 1 for no error bars (default: 8)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        metavar="X",
        help="sample until the 95 %% confidence half-width is at most X times the saliency, such as 0.05, for "
        "each parameter that may have 5 %% of the total saliency; the table shows the half-width achieved",
    )
    parser.add_argument(
        "--time-limit",
        type=float,
        metavar="SECONDS",
        help="stop after SECONDS per metric, not counting kernel compilation, and report the best estimate",
    )
    parser.add_argument(
        "--denoise",
        choices=DENOISE,
        default="auto",
        help="denoise the image for a non-linear metric, such as a glare rating; auto: if that reduces the "
        "measured error (default: auto)",
    )
    parser.add_argument(
        "--picture-spp",
        type=int,
        metavar="N",
        help="samples per pixel of the image for a non-linear metric (default: 2 times --spp, or 4 times if the "
        "image is denoised)",
    )
    _arguments.add_output(parser)
    add_report(parser)
    parser.set_defaults(run=attribute)


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add the option for a report."""
    parser.add_argument(
        "--report",
        action="store_true",
        help="also write report.html, an interactive page with all metrics",
    )


def attribute(options: argparse.Namespace) -> int:
    """Run the command."""
    metrics = find_metrics(options.metrics or [DEFAULT], options)
    with writable(options.out):
        renderer = _arguments.make_renderer(options)
        finished: list[SceneAttribution] = []
        for name, create in metrics.items():
            folder = options.out if len(metrics) == 1 else options.out / _folder_name(name)
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
                _write_result(interruption.partial, folder, as_json=options.json)
                _write_report([*finished, interruption.partial], options)
                raise
            _write_result(attribution, folder, as_json=options.json)
            finished.append(attribution)
            # After every metric, so that an interruption of the next one leaves a report.
            _write_report(finished, options)
        if not options.json:
            _arguments.print_resumed(renderer)
    return 0


def _folder_name(metric: str) -> str:
    return "".join(c if c.isalnum() else "-" for c in metric).strip("-")


def _write_result(attribution: SceneAttribution, folder: Path, *, as_json: bool) -> None:
    """Write the files of a result and print it."""
    write_each(folder, CONTENTS, partial(_write_file, attribution))
    if as_json:
        print(_json(attribution))
        return
    print(attribution)
    print()
    for name, content in CONTENTS.items():
        print(f"{folder / name}  {content}")


def _write_report(attributions: Sequence[SceneAttribution], options: argparse.Namespace) -> None:
    """Write the report of the results so far, if requested."""
    if not options.report:
        return
    from ..report import write_report

    path = options.out / REPORT
    write_report(attributions, path)
    if not options.json:
        print(f"{path}  interactive page with all results")


# Written in this order: numbers first, so that an interruption while plotting leaves them.
CONTENTS = {
    "attribution.json": "numbers and settings",
    "attribution.csv": "table of the numbers",
    "attribution.npz": "complete result, for SceneAttribution.load",
    "render.png": "render",
    "heatmap.png": "render and saliency map",
    "bars.png": "ranking with error bars",
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
