"""Measure light, materials, geometry, settings and metrics at their extremes against what is known exactly.

python benchmarks/extremes.py [--only 'scale*'] [--write docs/extremes.md]
"""

from __future__ import annotations

import argparse
import fnmatch
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _pages import replace_table

from scenecaptum import SceneRenderer, VanillaSceneGradient, activate

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from extremes.scenes import GREY, coverage, furnace, in_the_sky, mean, rgb, room, texture

RADIANCE, BALL = "lamp.emitter.radiance.value", "ball.bsdf.reflectance.value"
WALLS, GLOW = "walls.bsdf.reflectance.value", "walls.emitter.radiance.value"


def attribute(renderer: SceneRenderer, spp: int, metric: Any = mean, **values: float) -> Any:
    """Attribute the mean with some values changed, all of their channels alike."""
    given = {
        n: torch.full_like(v, values.get(n, 0.0)) if n in values else v for n, v in renderer.inputs.items()
    }
    return VanillaSceneGradient(renderer, metric).attribute(given, seed=0, spp=spp)


def off(found: Any, name: str, expected: float) -> str:
    """Say by how much a slope is off, with its standard error."""
    value, error = found[name].double().sum().item(), found.covariance[name].sum().sqrt().item()
    return f"{100 * (value / expected - 1):+.2g} ± {100 * error / abs(expected):.1g} %"


def worst(changes: list[torch.Tensor]) -> str:
    """Write the largest relative change."""
    return f"{max(one.abs().max().item() for one in changes):.1g}"


def light_strength(mi: Any) -> str:
    """Compare gradients and their errors under light from 1e-30 to 1e34 with those under light of 1."""
    renderer = SceneRenderer(room(mi, lamp=1.0), inputs="all")
    one = attribute(renderer, 16)
    changes: tuple[list[torch.Tensor], list[torch.Tensor]] = ([], [])
    for exponent in range(-30, 35, 8):
        found = attribute(renderer, 16, **{RADIANCE: 10.0**exponent})
        for kept, ours, theirs in (
            (changes[0], found, one),
            (changes[1], found.standard_error, one.standard_error),
        ):
            kept.append(ours[BALL].double() / 10.0**exponent / theirs[BALL].double() - 1)
    return f"relative change at most {worst(changes[0])} (gradients), {worst(changes[1])} (errors)"


def metric_scale(mi: Any) -> str:
    """Compare the same under a metric of 1e-30 to 1e36 times the mean."""
    renderer = SceneRenderer(room(mi), inputs="all")
    one, changes = attribute(renderer, 16), []
    for exponent in range(-30, 37, 3):
        found = attribute(renderer, 16, lambda image, factor=10.0**exponent: image.mean() * factor)
        changes.append(
            torch.tensor([found.saliency()[n] / 10.0**exponent / one.saliency()[n] - 1 for n in (BALL,)])
        )
        changes.append(
            torch.tensor([found.saliency_error()[BALL] / 10.0**exponent / one.saliency_error()[BALL] - 1])
        )
    return f"relative change at most {worst(changes)}"


def furnace_of(reflectance: float) -> Callable[[Any], str]:
    """Return a comparison with the series of a furnace at depth 4."""

    def compare(mi: Any) -> str:
        found = attribute(SceneRenderer(furnace(mi, GREY), inputs="all"), 4096, **{WALLS: reflectance})
        light = sum(reflectance**k for k in range(4))
        slope = sum(k * reflectance ** (k - 1) for k in range(1, 4))
        return (
            f"light {100 * (found.metric_value / light - 1):+.2g} ± "
            f"{100 * found.metric_standard_error / light:.1g} %, its slope {off(found, GLOW, light)}, "
            f"that of the reflectance {off(found, WALLS, slope)}"
        )

    return compare


def deep_furnace(mi: Any) -> str:
    """Compare with the series of a furnace at depth 100, reflectance 0.9."""
    found = attribute(SceneRenderer(furnace(mi, GREY, depth=100), inputs="all"), 4096, **{WALLS: 0.9})
    light, slope = 10 * (1 - 0.9**100), sum(k * 0.9 ** (k - 1) for k in range(1, 100))
    return (
        f"light {100 * (found.metric_value / light - 1):+.2g} ± "
        f"{100 * found.metric_standard_error / light:.1g} %, slope of the reflectance {off(found, WALLS, slope)}"
    )


def mirror_box(mi: Any) -> str:
    """Compare with the series of a box of mirrors, whose light has no noise."""
    walls = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.7)}
    name = "walls.bsdf.specular_reflectance.value"
    found = attribute(SceneRenderer(furnace(mi, walls, depth=7), inputs=[name, GLOW]), 16)
    light, slope = sum(0.7**k for k in range(7)), sum(k * 0.7 ** (k - 1) for k in range(1, 7))
    return f"light off by {abs(found.metric_value / light - 1):.1g}, slope {off(found, name, slope)}"


def clear_glass(mi: Any) -> str:
    """Look at glass of several indices in an even sky, where it is invisible."""
    worst_light, worst_slope = 0.0, ""
    largest = 0.0
    for index in (1 / 3, 1 - 1e-6, 1.0, 1 + 1e-6, 1.5, 3.0):
        glass = {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}
        found = attribute(SceneRenderer(in_the_sky(mi, glass, depth=16), inputs="ior"), 256)
        worst_light = max(worst_light, abs(found.metric_value - 1))
        slope, error = found["ball.bsdf.eta"].item(), found.standard_error["ball.bsdf.eta"].item()
        if abs(slope) >= largest:
            largest, worst_slope = abs(slope), f"{slope:+.1g} ± {error:.1g}"
    return f"light off by at most {worst_light:.1g}, slope at most {worst_slope}"


def black_texture(mi: Any) -> str:
    """Compare a black texture with what its ball covers."""
    renderer = SceneRenderer(in_the_sky(mi, texture(mi, np.zeros((4, 4, 3)))), inputs="textures")
    return f"slope {off(attribute(renderer, 4096), 'ball.bsdf.reflectance.data', coverage(renderer))}"


def inside_glass(mi: Any) -> str:
    """Compare the light inside glass with η², and its slope with 2η."""
    from extremes.scenes import camera

    scene = in_the_sky(mi, {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}, depth=16)
    scene["camera"] = camera(mi, [0.1, 0, 0], [0, 1, 0])
    found = attribute(SceneRenderer(scene, inputs="ior"), 256)
    return f"light {100 * (found.metric_value / 2.25 - 1):+.1g} %, slope {off(found, 'ball.bsdf.eta', 3.0)}"


def scale_of(scale: float = 1.0, shift: float = 0.0) -> Callable[[Any], str]:
    """Return a comparison of the light in a room of another size or place, as Mitsuba renders it."""

    def compare(mi: Any) -> str:
        def light(**where: float) -> float:
            scene = mi.load_dict(room(mi, **where))
            return float(
                np.mean([np.array(mi.render(scene, seed=seed, spp=4096)).mean() for seed in range(4)])
            )

        try:
            SceneRenderer(room(mi, scale=scale, shift=shift))
            verdict = "accepted"
        except Exception:
            verdict = "refused"
        return f"{100 * (light(scale=scale, shift=shift) / light() - 1):+.2g} % of the light; {verdict}"

    return compare


def samples(mi: Any) -> str:
    """Fit the fall of the error from 1 to 4096 samples per pixel."""
    oven, counts, errors = SceneRenderer(furnace(mi, GREY), inputs="all"), [4**k for k in range(7)], []
    for spp in counts:
        images = torch.stack([oven(seed=seed, spp=spp)[..., 0] for seed in range(16)]).double()
        errors.append((images - 1.875).square().mean().sqrt().item())
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    first, last = (100 * errors[index] / 1.875 for index in (0, -1))
    return f"error ∝ spp^{slope:.3f}, {first:.2g} % at 1 and {last:.2g} % at 4096"


def one_pixel(mi: Any) -> str:
    """Add up a million samples of one pixel."""
    dot = SceneRenderer(furnace(mi, GREY), inputs="all", resolution=(1, 1))
    values = torch.stack([dot(seed=seed, spp=2**20).mean() for seed in range(4)]).double()
    return f"light {100 * (values.mean() / 1.875 - 1):+.1g} ± {100 * values.std() / 2 / 1.875:.1g} %"


ROWS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "lamp of radiance 1e-30 to 1e34": ("all scales with it", light_strength),
    "metric times 1e-30 to 1e36": ("all scales with it", metric_scale),
    "furnace of black walls": ("series; slopes are those at 0.001", furnace_of(0.0)),
    "furnace of white walls": ("series", furnace_of(1.0)),
    "furnace of depth 100": ("series", deep_furnace),
    "closed box of mirrors": ("series", mirror_box),
    "index 1/3, 1 ± 1e-6, 1, 1.5, 3": ("clear glass is invisible", clear_glass),
    "black texture": ("slope of a black colour", black_texture),
    "camera inside glass": ("η² and 2η", inside_glass),
    "scale 1e6": ("as at 1", scale_of(1e6)),
    "scale 0.01": ("as at 1", scale_of(1e-2)),
    "scale 0.001": ("refused from 1 % on", scale_of(1e-3)),
    "scale 0.0001": ("refused from 1 % on", scale_of(1e-4)),
    "scale 1e-6": ("refused from 1 % on", scale_of(1e-6)),
    "1e6 from the origin": ("refused from 1 % on", scale_of(shift=1e6)),
    "1 to 4096 samples": ("error falls as 1/√spp", samples),
    "one pixel, a million samples": ("they add up", one_pixel),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="*", help="glob over the first column")
    parser.add_argument("--write", type=Path, help="the page whose table is replaced")
    options = parser.parse_args()
    mi, rows = activate(), [["extreme", "expected", "measured"]]
    for name, (promise, measure) in ROWS.items():
        if fnmatch.fnmatch(name, options.only):
            rows.append([name, promise, measure(mi)])
            print("  ".join(rows[-1]), flush=True)
    if options.write:
        replace_table(options.write, "extremes", rows)


if __name__ == "__main__":
    main()
