"""The page's figures: grids of maps, of ablation tests, and of accuracies over samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from scenecaptum import SceneAttribution
from scenecaptum.denoising import denoise
from scenecaptum.validation import AblationTest
from scenecaptum.visualization import display_image, diverging, log_axis, new_figure

MAPS = "grid-maps.webp"  # the picture at the top of the page
WIDTH = 8.1  # inches: the width of a page
TITLE, TEXT, SMALL = 10.0, 8.0, 7.0  # points
# Readable on white and on black.
BLUE, ORANGE, GREY = "#2b84c6", "#dd6a1f", "#8c8c8c"  # raises, lowers, within the noise
GREEN, PINK, INK = "#2f9e6e", "#c2649b", "#757f89"  # as predicted, not as predicted, the prediction
LINE = 0.14  # inches, of small text
GAP = 0.1  # inches
NUMBER = 0.48  # inches, of an effect before a name
ROOM_STYLES = (("#2f9e6e", "o"), ("#c2649b", "s"), ("#b8860b", "^"), ("#4f9fd0", "D"))
# Larger than the dots, so that a cross is seen behind one, and as heavy in the legend.
CROSS = {"marker": "x", "color": INK, "linestyle": "none", "markersize": 7, "markeredgewidth": 1.3}
OUTCOMES = {"as predicted": GREEN, "not as predicted": PINK, "below the noise": GREY}


@dataclass
class MapRow:
    """A room's row in a grid of maps: its render, the lines below it, and a result for each metric."""

    render: torch.Tensor
    lines: Sequence[str]
    results: Sequence[SceneAttribution]


def clean_render(renderer: Any, samples: int) -> torch.Tensor:
    """Return a render at twice the resolution of the maps, denoised and tone-mapped.

    It is the mean of 2×2 finer pixels: a wide pixel filter correlates the noise of neighbours, which a denoiser
    does not remove.
    """
    width, height = renderer.resolution
    twice, finer = (renderer.replace(resolution=(k * width, k * height)) for k in (2, 4))
    with torch.no_grad():
        image = finer(seed=2, spp=max(1, samples // 4))
    mean = image.reshape(2 * height, 2, 2 * width, 2, 3).mean((1, 3))
    return display_image(denoise(mean, twice.guides))


def map_grid(rows: Sequence[MapRow], metrics: Sequence[str], title: str, leaders: int) -> Any:
    """Draw renders and signed maps, one row for each room, with the leading parameters below each map."""
    columns = 1 + len(metrics)
    width = (WIDTH - GAP * (columns + 1)) / columns
    height = width * rows[0].render.shape[0] / rows[0].render.shape[1]
    block = height + LINE * leaders + 0.22
    top, bottom = 0.62, 0.62
    whole = top + block * len(rows) + bottom
    figure = new_figure(WIDTH, whole, layout="none")
    figure.text(GAP / WIDTH, 1 - 0.1 / whole, title, va="top", fontsize=TITLE)
    for index, heading in enumerate(("render, denoised", *metrics)):
        x = GAP + index * (width + GAP)
        figure.text(x / WIDTH, 1 - (top - 0.06) / whole, heading, va="bottom", fontsize=TEXT)
    for number, row in enumerate(rows):
        y = whole - top - block * number - height
        for index, result in enumerate((None, *row.results)):
            box = (GAP + index * (width + GAP), y, width, height)
            ax = figure.add_axes(tuple(value / (WIDTH, whole)[i % 2] for i, value in enumerate(box)))
            ax.set_axis_off()
            if result is None:
                ax.imshow(row.render.numpy())
                _write_lines(ax, [("", INK, line) for line in row.lines], height)
            else:
                ax.imshow(result.heatmap(signed=True).numpy(), cmap=diverging(), vmin=-1, vmax=1)
                _write_lines(ax, _leaders(result, leaders, width), height)
    _draw_scale(figure, whole)
    return figure


def _leaders(result: SceneAttribution, count: int, width: float) -> list[tuple[str, str, str]]:
    """Return effect, colour and name of each leading parameter."""
    visible = result.surfaces.visible_parameters()
    characters = int((width - NUMBER) * 72 / (0.56 * SMALL))
    lines = []
    for row in result.ranking(top=count):
        clear = abs(row.effect) > 2 * (row.effect_error or 0.0)
        color = (BLUE if row.effect > 0 else ORANGE) if clear else GREY
        note = "" if row.name in visible else " (not in the image)"
        number = f"{row.effect:+.2g}" if abs(row.effect) < 100 else f"{row.effect:+.0f}"
        lines.append((number.replace("-", "−"), color, _shortened(row.label, characters - len(note)) + note))
    return lines


def _shortened(label: str, width: int) -> str:
    """Shorten the name of the object in a label, not that of the property."""
    owner, colon, rest = label.partition(": ")
    space = max(width - len(colon + rest), 6)
    return (owner if len(owner) <= space else f"{owner[: space - 1]}…") + colon + rest


def _write_lines(ax: Any, lines: Sequence[tuple[str, str, str]], height: float) -> None:
    """Write lines below a picture, with numbers in colour before them."""
    for number, (value, color, text) in enumerate(lines):
        y = -(0.04 + LINE * number) / height
        style = {"transform": ax.transAxes, "va": "top", "fontsize": SMALL, "parse_math": False}
        ax.text(0, y, value, color=color, weight="bold", **style)
        inches = ax.get_position().width * WIDTH
        ax.text(NUMBER / inches if value else 0, y, text, **style)


def _draw_scale(figure: Any, whole: float) -> None:
    """Draw one colour bar for all maps, with its meaning on both sides."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    ax = figure.add_axes((0.36, 0.38 / whole, 0.28, 0.12 / whole))
    bar = figure.colorbar(ScalarMappable(Normalize(-1, 1), diverging()), cax=ax, orientation="horizontal")
    values = (-1, -0.4, -0.1, 0, 0.1, 0.4, 1)
    places = [(abs(value) ** 0.5) * (1 if value > 0 else -1) for value in values]
    bar.set_ticks(places, labels=[f"{value:g}".replace("-", "−") for value in values])
    ax.tick_params(labelsize=SMALL)
    ax.set_xlabel("effect, relative to the largest in each map (√ scale)", fontsize=SMALL)
    style = {"transform": ax.transAxes, "va": "center", "fontsize": TEXT, "weight": "bold"}
    ax.text(-0.03, 0.5, "raising it lowers the metric", color=ORANGE, ha="right", **style)
    ax.text(1.03, 0.5, "raising it raises the metric", color=BLUE, ha="left", **style)


def ablation_grid(tests: Mapping[tuple[str, str], AblationTest], units: Mapping[str, str], title: str) -> Any:
    """Draw predicted and measured changes over the computed ranking, a column for each room."""
    rooms, metrics = (list(dict.fromkeys(key[k] for key in tests)) for k in (0, 1))
    figure = new_figure(WIDTH, 0.9 + 1.75 * len(metrics))
    axes = figure.subplots(len(metrics), len(rooms), squeeze=False, sharex=True)
    for (row, metric), (column, room) in ((a, b) for a in enumerate(metrics) for b in enumerate(rooms)):
        ax = axes[row][column]
        _draw_ablation(ax, tests[room, metric])
        _style(ax, room if row == 0 else "", x="rank by saliency" if row == len(metrics) - 1 else "")
        if column == 0:
            unit = f" in {units[metric]}" if units[metric] else ""
            ax.set_ylabel(f"change of {metric}{unit}\nper unit of the parameter", fontsize=TEXT)
    _finish(figure, title, *_ablation_legend())
    return figure


def _ablation_legend() -> tuple[list[Any], list[str]]:
    """Return the handles and labels of a legend for all tests."""
    from matplotlib.lines import Line2D

    dot = {"marker": "o", "linestyle": "none", "markersize": 4}
    styles: dict[str, dict[str, Any]] = {"predicted": {"color": INK}}
    styles |= {f"measured, {kind}": {"color": color, **dot} for kind, color in OUTCOMES.items()}
    styles["measured, fixed step"] = CROSS
    lines = [Line2D([], [], **style) for style in styles.values()]
    return lines, list(styles)


def _draw_ablation(ax: Any, test: AblationTest) -> None:
    """Draw one test: the prediction as a line, measurements as dots, those with a fixed step as crosses."""
    ranks = range(1, len(test.rows) + 1)
    ax.plot(ranks, [row.predicted for row in test.rows], color=INK, linewidth=1.1, zorder=1)
    for rank, row in zip(ranks, test.rows, strict=True):
        outcome = "as predicted" if row.agrees else "not as predicted"
        color = OUTCOMES[outcome if row.above_noise else "below the noise"]
        size = abs(row.measured)
        error = [[min(row.measured_error, 0.9 * size)], [row.measured_error]]
        ax.errorbar(rank, size, error, fmt="o", color=color, markersize=4, elinewidth=1, zorder=3)
        if row.fixed:
            ax.plot(rank, abs(row.fixed), zorder=2, **CROSS)
    ax.set_xticks(list(ranks))
    _make_logarithmic(ax, "y")


class Accuracy(NamedTuple):
    """How exact a ranking is: samples per pixel, Kendall's τ of the resolved pairs, and the gradient's error."""

    samples: int
    order: float
    error: float  # relative


def stability_grid(rooms: Mapping[tuple[str, str], Sequence[Accuracy]], title: str) -> Any:
    """Draw the order of the ranking and the error of the gradient over samples, a column for each metric."""
    names, metrics = (list(dict.fromkeys(key[k] for key in rooms)) for k in (0, 1))
    figure = new_figure(WIDTH, 4.6)
    axes = figure.subplots(2, len(metrics), squeeze=False, sharey="row", sharex=True)
    for column, metric in enumerate(metrics):
        upper, lower = axes[0][column], axes[1][column]
        for name, (color, marker) in zip(names, ROOM_STYLES, strict=False):
            samples, orders, errors = zip(*rooms[name, metric], strict=True)
            style = {"color": color, "marker": marker, "markersize": 4, "linewidth": 1.2, "label": name}
            upper.plot(samples, orders, **style)
            lower.plot(samples, [100 * error for error in errors], **style)
        _style(upper, metric, y="Kendall's τ, resolved pairs" if column == 0 else "")
        _style(lower, x="samples per pixel", y="error of the gradient in %" if column == 0 else "")
        for which in ("x", "y"):
            _make_logarithmic(lower, which)
        lower.set_xticks(samples, [f"{count}" for count in samples])
    handles, labels = axes[0][0].get_legend_handles_labels()
    _finish(figure, title, handles, labels)
    return figure


def _make_logarithmic(ax: Any, which: str) -> None:
    """Make an axis logarithmic around its data, with plain numbers."""
    low, high = getattr(ax.dataLim, f"interval{which}")
    margin = (high / low) ** 0.08 if high > low else 1.5
    log_axis(ax, which, low / margin, high * margin)


def _style(ax: Any, title: str = "", *, x: str = "", y: str = "") -> None:
    """Write title and labels, and remove two sides of the frame."""
    ax.set_title(title, loc="left", fontsize=TEXT)
    ax.set_xlabel(x, fontsize=TEXT)
    ax.set_ylabel(y, fontsize=TEXT)
    ax.tick_params(labelsize=SMALL)
    ax.spines[["top", "right"]].set_visible(False)


def _finish(figure: Any, title: str, handles: Sequence[Any], labels: Sequence[str]) -> None:
    """Write the title above, and one legend below."""
    figure.suptitle(title, x=0.01, ha="left", fontsize=TITLE)
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(handles), fontsize=SMALL, frameon=False
    )
