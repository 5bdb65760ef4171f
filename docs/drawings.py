"""Draw concepts as SVG: the way to an answer, the adjoint, replicates, the effect scale, significance, and so on.

The backgrounds are transparent and the colours of medium lightness, so that the drawings can be read on light and
on dark pages. Curves and pixels are toy examples, computed here; nothing is rendered.

    python docs/drawings.py [FOLDER]
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

INK, FAINT = "#757f89", "#98a1ab"
BLUE, ORANGE, GREEN = "#2b84c6", "#dd6a1f", "#2f9e6e"  # raises, lowers, the truth
GREYS = LinearSegmentedColormap.from_list("greys", ["#3d444c", "#f1e7c9"])
SIGNED = LinearSegmentedColormap.from_list("signed", [ORANGE, "#c9ccd0", BLUE])

STYLE = {
    "font.size": 11,
    "text.color": INK,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "svg.hashsalt": "scenecaptum",  # the same file from the same drawing
}


def toy_picture() -> np.ndarray[Any, Any]:
    """Return a 12 × 8 picture of a room in relative luminance: window, lamp, wall, and a darker floor and desk."""
    picture = np.full((8, 12), 0.32)
    picture[5:] = 0.18
    picture[1:4, 2:6] = 0.95
    picture[1, 9] = 0.85
    picture[4:6, 7:11] = 0.12
    return picture


def toy_objects() -> dict[str, Any]:
    """Return the parts of the room in the toy picture, each as the pixels that show it."""
    window, lamp, desk = (np.zeros((8, 12), bool) for _ in range(3))
    window[1:4, 2:6] = lamp[1, 9] = desk[4:6, 7:11] = True
    floor = ~desk & (np.arange(8) >= 5)[:, None]
    return {
        "window": window,
        "lamp": lamp,
        "floor": floor,
        "desk": desk,
        "wall": ~(window | lamp | floor | desk),
    }


def contrast(picture: np.ndarray[Any, Any]) -> float:
    """Return the metric of the drawing: standard deviation over mean."""
    return float(picture.std() / picture.mean())


def contrast_adjoint(picture: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """Return the derivative of ``contrast`` with respect to each pixel."""
    mean, deviation, count = picture.mean(), picture.std(), picture.size
    return (picture - mean) / (count * deviation * mean) - deviation / (count * mean**2)


def toy_effects(replicates: int = 8) -> tuple[dict[str, float], dict[str, float]]:
    """Return the effect of each object on the contrast, over its range from black, and its standard error."""
    rng = np.random.default_rng(3)
    noisy = [toy_picture() * rng.lognormal(0, 0.35, (8, 12)) for _ in range(replicates)]
    shares = np.array(
        [[(contrast_adjoint(one) * one)[at].sum() for at in toy_objects().values()] for one in noisy]
    )
    names, errors = list(toy_objects()), shares.std(axis=0, ddof=1) / np.sqrt(replicates)
    return dict(zip(names, shares.mean(axis=0), strict=True)), dict(zip(names, errors, strict=True))


# ------------------------------------------------------------------------------------------------ parts


def canvas(figure: Figure, width: float, height: float) -> Axes:
    """Return axes without ticks that cover the figure, in units of its inches."""
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    return axes


def box(axes: Axes, centre: tuple[float, float], text: str, size: tuple[float, float]) -> None:
    """Draw a rounded box with text."""
    (x, y), (width, height) = centre, size
    corner = (x - width / 2, y - height / 2)
    axes.add_patch(
        FancyBboxPatch(corner, width, height, boxstyle="round,pad=0,rounding_size=0.1", fill=False, ec=INK)
    )
    axes.text(x, y, text, ha="center", va="center", linespacing=1.4)


def arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], color: str = INK) -> None:
    """Draw an arrow from start to end."""
    axes.add_patch(
        FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=13, lw=1.5, color=color, shrinkA=0)
    )


def pixels(axes: Axes, values: np.ndarray[Any, Any], corner: tuple[float, float], **colours: Any) -> None:
    """Draw a picture as squares, with its lower left corner at the given place."""
    side = 0.11
    rows, columns = values.shape
    x, y = (corner[i] + side * np.arange(n + 1) for i, n in enumerate((columns, rows)))
    axes.pcolormesh(x, y, values[::-1], edgecolors="face", linewidth=0.5, **colours)  # no seams


# ------------------------------------------------------------------------------------------------ drawings


def draw_overview() -> Figure:
    """Draw the way from a scene to a number, back to a ranking and a map, and to a change of the scene."""
    width, height = 8.6, 4.1
    figure = Figure(figsize=(width, height))
    axes = canvas(figure, width, height)
    effects, errors = toy_effects()
    limit = max(map(abs, effects.values()))
    top, bottom = 3.3, 0.85

    box(axes, (1.1, top), "scene\nlamps, materials,\ntextures, positions", (2.0, 1.1))
    arrow(axes, (2.15, top), (3.2, top))
    axes.text(2.66, top + 0.15, "render", ha="center")
    pixels(axes, toy_picture(), (3.3, top - 0.44), cmap=GREYS, vmin=0, vmax=1)
    axes.text(3.96, top + 0.58, "image", ha="center")
    arrow(axes, (4.72, top), (6.2, top))
    axes.text(5.45, top + 0.15, "metric", ha="center")
    box(axes, (7.4, top), "one number\nglare, daylight, a logit,\nyour torch function", (2.3, 1.1))

    arrow(axes, (7.4, top - 0.62), (7.4, bottom + 0.95), BLUE)
    axes.text(7.27, (top + bottom) / 2 + 0.17, "one backward pass", ha="right", va="center")
    ranking(axes, effects, errors, (7.3, bottom), limit)
    arrow(axes, (5.75, bottom), (4.75, bottom), BLUE)
    painted = sum(value * toy_objects()[name] for name, value in effects.items())
    pixels(axes, painted, (3.3, bottom - 0.44), cmap=SIGNED, vmin=-limit, vmax=limit)
    axes.text(3.96, bottom + 0.58, "map", ha="center")
    arrow(axes, (3.2, bottom), (2.15, bottom), BLUE)
    box(axes, (1.1, bottom), "change\nsuggested, found,\nand rendered", (2.0, 1.1))
    arrow(axes, (1.1, bottom + 0.6), (1.1, top - 0.6), BLUE)
    axes.text(3.91, bottom - 0.68, "raises it", color=BLUE, ha="right")
    axes.text(4.01, bottom - 0.68, "lowers it", color=ORANGE, ha="left")
    return figure


def ranking(
    axes: Axes, effects: dict[str, float], errors: dict[str, float], centre: tuple[float, float], limit: float
) -> None:
    """Draw bars with error bars, the largest first; zero is at the centre."""
    x, y = centre
    names = sorted(effects, key=lambda name: -abs(effects[name]))
    axes.text(x, y + 0.72, "ranking, with error bars", ha="center")
    for place, name in enumerate(names):
        at, bar, half = y + 0.45 - 0.25 * place, 0.85 * effects[name] / limit, 0.85 * errors[name] / limit
        axes.barh(at, bar, 0.17, left=x, color=BLUE if bar > 0 else ORANGE)
        axes.errorbar(x + bar, at, xerr=half, color=INK, capsize=2.5, lw=1.2)
        axes.text(
            x + (-0.08 if bar > 0 else 0.08),
            at,
            name,
            ha="right" if bar > 0 else "left",
            va="center",
            size=10,
        )
    axes.plot([x, x], [y - 0.68, y + 0.58], color=INK, lw=1)


def draw_significance() -> Figure:
    """Draw confidence intervals of effects: apart from zero or not, apart from each other or not."""
    figure = Figure(figsize=(8.6, 2.7))
    axes = figure.add_axes((0.1, 0.2, 0.36, 0.74))
    rows = (
        ("window", 2.1, 0.3, BLUE, "significant: the interval excludes 0"),
        (
            "floor",
            -1.2,
            0.45,
            ORANGE,
            "both are significant, but not which of\nthem is larger: test their difference",
        ),
        ("wall", -1.0, 0.4, ORANGE, ""),
        ("lamp", 0.25, 0.55, FAINT, "not significant: the interval contains 0"),
    )
    for y, (name, effect, half, color, text) in enumerate(rows):
        axes.errorbar(effect, y, xerr=half, fmt="o", color=color, capsize=5, lw=2)
        axes.text(3.25, y + (0.5 if name == "floor" else 0), text, va="center")
    axes.plot([3.1, 3.1], [0.7, 2.3], color=FAINT, lw=1)  # groups two rows
    axes.axvline(0, color=INK, lw=1)
    axes.set(ylim=(3.5, -0.5), xlim=(-2, 3.2), xticks=[0], xlabel="effect, with its 95 % interval")
    axes.set_yticks(range(len(rows)), [row[0] for row in rows])
    axes.tick_params(left=False)
    axes.spines["left"].set_visible(False)
    for artist in (*axes.lines, *axes.texts):
        artist.set_clip_on(False)
    return figure


def draw_adjoint() -> Figure:
    """Draw the forward pass from parameters to the metric, and the backward pass through the adjoint."""
    width, height = 8.6, 3.5
    figure = Figure(figsize=(width, height))
    axes = canvas(figure, width, height)
    picture = toy_picture()
    adjoint = contrast_adjoint(picture)
    top, bottom = 2.45, 0.95
    for y, name in ((top + 0.75, "forward"), (bottom - 0.8, "backward")):
        axes.text(0.1, y, name, va="center", style="italic")

    box(axes, (0.95, top), "parameters θ\nwall: 0.62\nlamp: 18", (1.6, 1.05))
    arrow(axes, (1.8, top), (3.15, top))
    axes.text(2.47, top + 0.17, "render", ha="center")
    pixels(axes, picture, (3.25, top - 0.44), cmap=GREYS, vmin=0, vmax=1)
    axes.text(3.91, top + 0.6, "image I", ha="center")
    arrow(axes, (4.67, top), (6.35, top))
    axes.text(5.5, top + 0.17, "metric M", ha="center")
    box(axes, (7.4, top), f"M(I) = {contrast(picture):.2f}\na contrast", (1.9, 1.05))

    arrow(axes, (7.4, top - 0.6), (7.4, bottom + 0.5), BLUE)
    axes.text(7.52, (top + bottom) / 2, "torch", va="center")
    box(axes, (7.4, bottom), "how M changes\nwith each pixel", (1.9, 0.9))
    arrow(axes, (6.4, bottom), (4.75, bottom), BLUE)
    limit = np.abs(adjoint).max()
    pixels(axes, adjoint, (3.25, bottom - 0.44), cmap=SIGNED, vmin=-limit, vmax=limit)
    axes.text(3.91, bottom + 0.56, "adjoint ∂M/∂I", ha="center")
    arrow(axes, (3.15, bottom), (1.85, bottom), BLUE)
    axes.text(2.5, bottom + 0.17, "path replay", ha="center")
    box(axes, (0.95, bottom), "gradient ∂M/∂θ\nof all parameters\nat once", (1.6, 1.05))
    axes.text(3.86, bottom - 0.7, "raises M", color=BLUE, ha="right")
    axes.text(3.96, bottom - 0.7, "lowers M", color=ORANGE, ha="left")
    return figure


def draw_replicates() -> Figure:
    """Draw a budget of samples, its replicates, their estimates and the mean with its error bars."""
    count = 8
    figure = Figure(figsize=(8.6, 3.3))
    seeds, estimates = np.arange(count), np.random.default_rng(4).normal(2.0, 0.5, count)
    mean, error = estimates.mean(), estimates.std(ddof=1) / np.sqrt(count)
    student = 2.365  # 97.5 % quantile of Student's t with seven degrees of freedom

    budget = figure.add_axes((0.02, 0.14, 0.25, 0.68))
    budget.axis("off")
    budget.barh(seeds, np.ones(count), height=0.72, color=BLUE, alpha=0.2)
    for seed in seeds:
        budget.text(0.5, seed, f"replicate {seed + 1}: 8 spp", ha="center", va="center", size=9.5)
    budget.set(ylim=(count - 0.4, -0.6), xlim=(0, 1), title="a budget of 64 spp")

    axes = figure.add_axes((0.32, 0.14, 0.27, 0.68), sharey=budget)
    axes.axvline(2.0, color=GREEN, ls="--", lw=1.2)
    axes.plot(estimates, seeds, "o", color=BLUE)
    axes.set(xlim=(0.8, 3.2), title="each estimates the gradient", xticks=[2.0], xticklabels=["true value"])
    axes.get_xticklabels()[0].set_color(GREEN)
    axes.tick_params(left=False, labelleft=False, bottom=False)
    axes.spines["left"].set_visible(False)

    result = figure.add_axes((0.73, 0.14, 0.26, 0.68))
    result.axvline(2.0, color=GREEN, ls="--", lw=1.2)
    for y, half in ((0.7, error), (0.3, student * error)):
        result.errorbar(mean, y, xerr=half, fmt="o", color=BLUE, capsize=5, lw=2)
    result.set_yticks([0.7, 0.3], ["± 1 standard\nerror", "95 %\ninterval"])
    result.set(ylim=(0, 1), xlim=(0.8, 3.2), title="their mean and spread", xticks=[])
    result.tick_params(left=False)
    result.spines["left"].set_visible(False)
    return figure


def draw_effect_scale() -> Figure:
    """Draw the effects of a reflectance and of a lamp: slope times range."""
    figure = Figure(figsize=(8.6, 3.6))
    left = figure.add_axes((0.07, 0.17, 0.38, 0.66))
    right = figure.add_axes((0.58, 0.17, 0.38, 0.66))

    def wall(albedo: Any) -> Any:
        return 14 / (1 - 0.55 * albedo)

    x = np.linspace(0, 1, 101)
    value = 0.5
    slope = (wall(value + 1e-4) - wall(value - 1e-4)) / 2e-4
    tangent(left, x, value, wall(value), slope)
    left.plot(x, wall(x), color=FAINT, lw=2)
    left.text(0.9, wall(0.98), "the metric itself", ha="right", color=FAINT)
    left.set(title="reflectance of a wall: from 0 to 1", xticks=[0, value, 1], xticklabels=["0", "now", "1"])

    x = np.linspace(0, 1.25, 101)
    tangent(right, x[x <= 1], 1.0, 24, 18)
    right.plot(x, 6 + 18 * x, color=FAINT, lw=2, zorder=1)
    right.set(title="radiance of a lamp: from off to now", xticks=[0, 1.0], xticklabels=["off", "now"])
    for axes in (left, right):
        axes.set(ylim=(0, 34), ylabel="metric", yticks=[])
    return figure


def tangent(axes: Axes, x: Any, now: float, value: float, slope: float) -> None:
    """Draw the tangent at the current value over a range, and the effect as its rise."""
    line = value + slope * (x - now)
    start, end = line[0], line[-1]
    axes.axvspan(x[0], x[-1], color=BLUE, alpha=0.12, lw=0)
    axes.plot(x, line, color=BLUE, lw=2, zorder=2)
    axes.plot(now, value, "o", color=BLUE, ms=8, zorder=3)
    axes.plot([x[0], x[-1]], [start, start], color=BLUE, lw=1, ls=":")
    axes.annotate(
        "", (x[-1], end), (x[-1], start), arrowprops={"arrowstyle": "<->", "color": ORANGE, "lw": 2}
    )
    middle = (start + end) / 2
    axes.text(x[-1] - 0.03, middle - 2, "effect", color=ORANGE, ha="right", va="center", weight="bold")
    axes.text((x[0] + x[-1]) / 2, 1.2, "range", color=BLUE, ha="center")


def draw_denoised_metric() -> Figure:
    """Draw why a threshold misjudges a noisy picture, and how the metric is evaluated instead."""
    figure = Figure(figsize=(8.6, 3.6))
    x = np.arange(48)
    clean = np.where((x >= 30) & (x < 37), 2.9, 0.6)
    rng = np.random.default_rng(8)
    noisy = clean * rng.lognormal(-0.1, 0.45, x.size)
    noisy[[5, 14, 43]] = (2.6, 3.3, 2.9)  # single bright pixels, as rare light paths leave them
    smooth = np.convolve(np.pad(clean, 1, mode="edge"), [0.05, 0.9, 0.05], mode="valid")

    for place, values, title in (
        (0.57, noisy, "picture I: 3 false sources"),
        (0.1, smooth, "denoised picture S: the lamp alone"),
    ):
        axes = figure.add_axes((0.06, place, 0.46, 0.32))
        over = values > 2
        axes.bar(x, values, width=1.0, color=np.where(over, ORANGE, FAINT))
        axes.axhline(2, color=INK, ls="--", lw=1)
        axes.text(48.2, 2.0, "threshold", va="center", size=9.5)
        axes.set(xlim=(-0.6, 47.6), ylim=(0, 4.2), xticks=[], yticks=[], title=title)
        axes.set_ylabel("luminance", size=9.5)

    axes = figure.add_axes((0.66, 0.16, 0.31, 0.73))
    curve = np.linspace(0, 10, 200)

    def metric(value: Any) -> Any:
        return 1.5 + 0.055 * value**2

    at_s, at_i = 4.0, 8.5
    slope = 2 * 0.055 * at_s
    corrected = metric(at_s) + slope * (at_i - at_s)
    axes.plot(curve, metric(curve), color=FAINT, lw=2)
    axes.plot([at_s, at_i], [metric(at_s), corrected], color=BLUE, lw=2)
    axes.plot(at_s, metric(at_s), "o", color=BLUE)
    axes.plot(at_i, metric(at_i), "o", color=ORANGE)
    axes.plot(at_i, corrected, "o", color=BLUE)
    axes.plot([at_i, at_i], [corrected, metric(at_i)], color=INK, lw=1, ls=":")
    axes.text(at_s - 0.2, metric(at_s) + 0.25, "M(S)", color=BLUE, ha="right")
    axes.text(at_i - 0.35, metric(at_i) + 0.1, "M(I): biased", color=ORANGE, ha="right")
    axes.text(10.2, 1.3, "M(S) + ⟨∇M(S), I − S⟩", color=BLUE, ha="right")
    axes.plot([at_i, at_i], [1.8, corrected - 0.2], color=BLUE, lw=0.8)
    axes.set(xticks=[at_s, at_i], xticklabels=["S", "I"], yticks=[], ylim=(0, 7), xlim=(0, 10.2))
    axes.set(xlabel="picture", ylabel="metric M", title="the value that is used")
    return figure


def draw_checkpoint() -> Figure:
    """Draw a job that is killed, and how it is resumed from the files of its finished units."""
    width, height = 8.6, 2.3
    figure = Figure(figsize=(width, height))
    axes = canvas(figure, width, height)
    names = ["image", "backward"] * 4
    side, start, finished = 0.86, 1.55, 5
    for x, name in enumerate(names):
        for y, stored in ((1.5, True), (0.35, x < finished)):
            if y > 1 and x > finished:
                continue
            lost = y > 1 and x == finished
            color = ORANGE if lost else GREEN if stored else BLUE
            corner = (start + x * side, y - 0.25)
            part = 0.55 if lost else 0.92
            axes.add_patch(
                FancyBboxPatch(
                    corner,
                    part * side,
                    0.5,
                    boxstyle="round,pad=0,rounding_size=0.06",
                    facecolor=color,
                    alpha=0.25,
                    ec=color,
                )
            )
            if not lost:
                axes.text(corner[0] + 0.46 * side, y, name, ha="center", va="center", size=9)
    axes.text(0.1, 1.5, "first run", va="center")
    axes.text(0.1, 0.35, "started again", va="center")
    killed = start + (finished + 0.6) * side
    axes.text(killed + 0.05, 1.5, "killed: only this unit is lost", color=ORANGE, va="center")
    middle, end = start + finished * side / 2, start + len(names) * side
    axes.text(middle, 0.93, "in the folder: loaded, bit by bit", color=GREEN, ha="center", va="center")
    axes.text(
        (middle + finished * side / 2 + end) / 2, 0.93, "rendered", color=BLUE, ha="center", va="center"
    )
    axes.text(start, 2.05, "replicates, each an image and its backward pass", va="center", style="italic")
    return figure


DRAWINGS: dict[str, Callable[[], Figure]] = {
    "overview-answer": draw_overview,
    "questions-significance": draw_significance,
    "concepts-adjoint": draw_adjoint,
    "concepts-replicates": draw_replicates,
    "concepts-effect-scale": draw_effect_scale,
    "concepts-denoised-metric": draw_denoised_metric,
    "long-jobs-checkpoint": draw_checkpoint,
}


def main(folder: Path) -> None:
    """Write every drawing to a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, draw in DRAWINGS.items():
            path = folder / f"{name}.svg"
            draw().savefig(path, transparent=True, metadata={"Date": None})
            print(path)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "pictures")
