"""Compare two designs of the office: as it is, and with lighter walls and a lighter floor.

Both are rendered with the same seeds, so that the difference of the two results has smaller errors than either.
Prints the glare ratings of both designs, and the parameters whose attribution changes most; draws both rooms, and
their rankings, joined by lines.

    python examples/two_designs.py [--out out/two-designs] [--resolution 160x90] [--spp 128]
"""

from __future__ import annotations

from pathlib import Path

from _options import parser
from matplotlib.figure import Figure

from scenecaptum import SceneAttribution, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.visualization import (
    automatic_exposure,
    display_image,
    new_figure,
    plot_rank_comparison,
    shown_render,
)


def main(folder: Path, resolution: tuple[int, int] = (160, 90), spp: int = 128) -> SceneAttribution:
    renderer = SceneRenderer(
        "office", ["reflectance", "emitters"], resolution=resolution, spp=spp, max_depth=6
    )
    glare = metrics.UnifiedGlareRating(renderer.camera)
    method = VanillaSceneGradient(renderer, glare)
    before = method.attribute(seed=0)
    lighter = {
        name: (1.5 * value).clamp(max=0.85)
        for name, value in renderer.inputs.items()
        if name.startswith(("wall_", "floor."))
    }
    after = method.attribute({**renderer.inputs, **lighter}, seed=0)
    change = after - before
    for name, design in (("as it is", before), ("with lighter walls and floor", after)):
        print(f"UGR {design.metric_value:.2f} ± {design.metric_standard_error:.1g} {name}")
    print("\nLargest changes of the effects, over the range of each parameter:")
    for row in change.ranking(top=5):
        print(f"  {row.label:28s} {row.effect:+.2f} ± {row.effect_error:.1g}")
    folder.mkdir(parents=True, exist_ok=True)
    draw(before, after).savefig(folder / "two-designs.png")
    plot_rank_comparison(before, after).savefig(folder / "ranks.png")
    print(f"\n{folder / 'two-designs.png'}  both designs\n{folder / 'ranks.png'}  their rankings")
    return change


def draw(before: SceneAttribution, after: SceneAttribution) -> Figure:
    """Draw both rooms at the same exposure, with their ratings."""
    figure = new_figure(9, 3)
    difference = after.metric_value - before.metric_value
    verb = "lower" if difference < 0 else "raise"
    figure.suptitle(f"Lighter walls and a lighter floor {verb} UGR by {abs(difference):.1f}")
    exposure = automatic_exposure(before.image)
    names = ("as it is", "with lighter walls and floor")
    for ax, found, name in zip(figure.subplots(1, 2), (before, after), names, strict=True):
        ax.imshow(display_image(shown_render(found), exposure).numpy())
        ax.set_title(f"{name}: UGR {found.metric_value:.1f}", fontsize=10)
        ax.set_axis_off()
    return figure


if __name__ == "__main__":
    options = parser(__doc__, resolution="160x90", spp=128, out="out/two-designs").parse_args()
    main(options.out, options.resolution, options.spp)
