"""Draw the figure of the README: what causes the glare in the office, and what lowers it.

python examples/readme_picture.py [FILE]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from scenecaptum import SceneAttribution, SceneRenderer, metrics
from scenecaptum.attr import Explanation
from scenecaptum.explanation import explain
from scenecaptum.visualization import display_image, new_figure, shown_render

LABELS = 5
LIMIT = 19  # of UGR in offices, EN 12464-1


def main(path: Path, resolution: tuple[int, int] = (640, 360), spp: int = 64) -> None:
    renderer = SceneRenderer(
        "office", inputs=["materials", "emitters"], resolution=resolution, spp=spp, max_depth=6
    )
    metric = metrics.UnifiedGlareRating(renderer.camera)
    explanation = explain(renderer, metric, seed=0, changes=1, show_progress=sys.stderr.isatty())
    attribution = explanation.attribution
    figure = new_figure(11, 3.9)
    figure.suptitle(sentence(explanation), fontsize=14)
    left, right = figure.subplots(1, 2)
    left.imshow(display_image(shown_render(attribution)).numpy())
    left.set_axis_off()
    attribution.plot_heatmap(ax=right, signed=True)
    right.child_axes[0].remove()  # the colour bar: the largest effects are written on the objects
    label_objects(right, attribution)
    left.set_title("the office, rendered", fontsize=11)
    right.set_title("change of UGR, to first order: blue raises it, orange lowers it", fontsize=11)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)
    print(explanation)


def sentence(explanation: Explanation) -> str:
    """Return the answer: the cause of the glare, what less of it does, and what else lowers the glare."""
    rating, source = explanation.attribution.metric_value, explanation.sources[0]
    lowering = [row for row in explanation.attribution.ranking() if row.effect < 0][:3]
    *first, last = (row.label.partition(":")[0].replace("_", " ") for row in lowering)
    (change,) = explanation.changes
    less = 1 - (change.after.sum() / change.before.sum()).item()
    definition = explanation.definition  # of a rating whose source is near the threshold
    lowers = -change.measured if definition is None else definition.value - change.exact
    excess = "above" if rating > LIMIT else "below"
    return (
        f"The {source.name} causes {100 * source.share:.0f} % of this office's glare: UGR {rating:.1f}, {excess} "
        f"the limit of {LIMIT} for offices.\n{100 * less:.0f} % less {change.label.replace(':', '')} lowers it by "
        f"{lowers:.1f}; a lighter {', '.join(first)} or {last} by {-lowering[0].effect:.1f} at most."
    )


def label_objects(ax: Axes, attribution: SceneAttribution) -> None:
    """Write the largest effects on the visible objects that have them."""
    surfaces = attribution.surfaces
    height, width = surfaces.shape
    free = np.ones((height, width))
    for row in attribution.ranking(LABELS):
        shown = surfaces.shown([row.name])
        if shown.sum() < 0.002 * shown.size:
            continue
        name = row.label.partition(":")[0].replace("_", " ")
        rows, columns = int(0.12 * height), int(0.022 * width * len(name))
        y, x = fullest_place((shown > 0.5) * free, rows, columns)
        free[y - rows : y + rows, x - columns : x + columns] = 0  # no other label overlaps this one
        style = {"ha": "center", "va": "center", "fontsize": 11, "fontweight": "bold", "color": "black"}
        outline = [withStroke(linewidth=2.5, foreground="white")]
        ax.text(x, y, f"{name}\n{row.effect:+.1f}".replace("-", "−"), path_effects=outline, **style)
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


def fullest_place(mask: np.ndarray, rows: int, columns: int) -> tuple[int, int]:
    """Return row and column of the centre of the rectangle, inside the picture, that covers most of a mask."""
    given = torch.from_numpy(mask).float()[None, None]
    covered = torch.nn.functional.avg_pool2d(given, (rows, columns), stride=1)[0, 0]
    row, column = divmod(int(covered.argmax()), covered.shape[1])
    return row + rows // 2, column + columns // 2


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    picture = Path(__file__).parents[1] / "docs" / "pictures" / "office.png"
    parser.add_argument("file", type=Path, nargs="?", default=picture, help="output file")
    main(parser.parse_args().file)
