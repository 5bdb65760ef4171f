"""Measure extreme light, materials, geometry, settings and metrics against exact values.

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
    """Attribute the mean with some values changed, the same for all channels."""
    given = {
        n: torch.full_like(v, values.get(n, 0.0)) if n in values else v for n, v in renderer.inputs.items()
    }
    return VanillaSceneGradient(renderer, metric).attribute(given, seed=0, spp=spp)


def relative_deviation(found: Any, name: str, expected: float) -> str:
    """Format the relative deviation of a derivative, with its standard error."""
    value, error = found[name].double().sum().item(), found.covariance[name].sum().sqrt().item()
    return f"{100 * (value / expected - 1):+.2g} ± {100 * error / abs(expected):.1g} %"


def worst(changes: list[torch.Tensor]) -> str:
    """Format the largest relative change."""
    return f"{max(change.abs().max().item() for change in changes):.1g}"


def light_strength(mi: Any) -> str:
    """Compare gradients and their errors under light from 1e-30 to 1e34 with those under light of 1."""
    renderer = SceneRenderer(room(mi, lamp=1.0), inputs="all")
    base = attribute(renderer, 16)
    changes: tuple[list[torch.Tensor], list[torch.Tensor]] = ([], [])
    for exponent in range(-30, 35, 8):
        found = attribute(renderer, 16, **{RADIANCE: 10.0**exponent})
        for ratios, scaled, unscaled in (
            (changes[0], found, base),
            (changes[1], found.standard_error, base.standard_error),
        ):
            ratios.append(scaled[BALL].double() / 10.0**exponent / unscaled[BALL].double() - 1)
    return f"relative change at most {worst(changes[0])} (gradients), {worst(changes[1])} (errors)"


def metric_scale(mi: Any) -> str:
    """Compare the same for a metric of 1e-30 to 1e36 times the mean."""
    renderer = SceneRenderer(room(mi), inputs="all")
    base, changes = attribute(renderer, 16), []
    for exponent in range(-30, 37, 3):
        found = attribute(renderer, 16, lambda image, factor=10.0**exponent: image.mean() * factor)
        changes.append(
            torch.tensor([found.saliency()[n] / 10.0**exponent / base.saliency()[n] - 1 for n in (BALL,)])
        )
        changes.append(
            torch.tensor([found.saliency_error()[BALL] / 10.0**exponent / base.saliency_error()[BALL] - 1])
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
            f"{100 * found.metric_standard_error / light:.1g} %, "
            f"its derivative {relative_deviation(found, GLOW, light)}, "
            f"that of the reflectance {relative_deviation(found, WALLS, slope)}"
        )

    return compare


def deep_furnace(mi: Any) -> str:
    """Compare with the series of a furnace at depth 100, reflectance 0.9."""
    found = attribute(SceneRenderer(furnace(mi, GREY, depth=100), inputs="all"), 4096, **{WALLS: 0.9})
    light, slope = 10 * (1 - 0.9**100), sum(k * 0.9 ** (k - 1) for k in range(1, 100))
    return (
        f"light {100 * (found.metric_value / light - 1):+.2g} ± "
        f"{100 * found.metric_standard_error / light:.1g} %, "
        f"derivative of the reflectance {relative_deviation(found, WALLS, slope)}"
    )


def mirror_box(mi: Any) -> str:
    """Compare with the series of a box of mirrors, whose image has no noise."""
    walls = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.7)}
    name = "walls.bsdf.specular_reflectance.value"
    found = attribute(SceneRenderer(furnace(mi, walls, depth=7), inputs=[name, GLOW]), 16)
    light, slope = sum(0.7**k for k in range(7)), sum(k * 0.7 ** (k - 1) for k in range(1, 7))
    return (
        f"error of the light {abs(found.metric_value / light - 1):.1g}, "
        f"derivative {relative_deviation(found, name, slope)}"
    )


def clear_glass(mi: Any) -> str:
    """Render glass of several indices under a uniform sky, where it is invisible."""
    worst_light, worst_slope = 0.0, ""
    largest = 0.0
    for index in (1 / 3, 1 - 1e-6, 1.0, 1 + 1e-6, 1.5, 3.0):
        glass = {"type": "dielectric", "int_ior": index, "ext_ior": 1.0}
        found = attribute(SceneRenderer(in_the_sky(mi, glass, depth=16), inputs="ior"), 256)
        worst_light = max(worst_light, abs(found.metric_value - 1))
        slope, error = found["ball.bsdf.eta"].item(), found.standard_error["ball.bsdf.eta"].item()
        if abs(slope) >= largest:
            largest, worst_slope = abs(slope), f"{slope:+.1g} ± {error:.1g}"
    return f"error of the light at most {worst_light:.1g}, derivative at most {worst_slope}"


def black_texture(mi: Any) -> str:
    """Compare the derivative of a black texture with the coverage of its ball."""
    renderer = SceneRenderer(in_the_sky(mi, texture(mi, np.zeros((4, 4, 3)))), inputs="textures")
    found = attribute(renderer, 4096)
    return f"derivative {relative_deviation(found, 'ball.bsdf.reflectance.data', coverage(renderer))}"


def inside_glass(mi: Any) -> str:
    """Compare the light inside glass with η², and its derivative with 2η."""
    from extremes.scenes import camera

    scene = in_the_sky(mi, {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.0}, depth=16)
    scene["camera"] = camera(mi, [0.1, 0, 0], [0, 1, 0])
    found = attribute(SceneRenderer(scene, inputs="ior"), 256)
    return (
        f"light {100 * (found.metric_value / 2.25 - 1):+.1g} %, "
        f"derivative {relative_deviation(found, 'ball.bsdf.eta', 3.0)}"
    )


def scale_of(scale: float = 1.0, shift: float = 0.0) -> Callable[[Any], str]:
    """Return a comparison of Mitsuba's renders of a scaled or shifted room."""

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
    """Fit the convergence rate of the error from 1 to 4096 samples per pixel."""
    renderer, counts, errors = SceneRenderer(furnace(mi, GREY), inputs="all"), [4**k for k in range(7)], []
    for spp in counts:
        images = torch.stack([renderer(seed=seed, spp=spp)[..., 0] for seed in range(16)]).double()
        errors.append((images - 1.875).square().mean().sqrt().item())
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    first, last = (100 * errors[index] / 1.875 for index in (0, -1))
    return f"error ∝ spp^{slope:.3f}, {first:.2g} % at 1 and {last:.2g} % at 4096"


def one_pixel(mi: Any) -> str:
    """Compare a single pixel with a million samples with the series."""
    renderer = SceneRenderer(furnace(mi, GREY), inputs="all", resolution=(1, 1))
    values = torch.stack([renderer(seed=seed, spp=2**20).mean() for seed in range(4)]).double()
    return f"light {100 * (values.mean() / 1.875 - 1):+.1g} ± {100 * values.std() / 2 / 1.875:.1g} %"


ROWS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "lamp of radiance 1e-30 to 1e34": ("results scale linearly", light_strength),
    "metric times 1e-30 to 1e36": ("results scale linearly", metric_scale),
    "furnace of black walls": ("series; derivatives at 0.001", furnace_of(0.0)),
    "furnace of white walls": ("series", furnace_of(1.0)),
    "furnace of depth 100": ("series", deep_furnace),
    "closed box of mirrors": ("series", mirror_box),
    "index 1/3, 1 ± 1e-6, 1, 1.5, 3": ("clear glass is invisible", clear_glass),
    "black texture": ("derivative of a black colour", black_texture),
    "camera inside glass": ("η² and 2η", inside_glass),
    "scale 1e6": ("same as scale 1", scale_of(1e6)),
    "scale 0.01": ("same as scale 1", scale_of(1e-2)),
    "scale 0.001": ("refused above 1 %", scale_of(1e-3)),
    "scale 0.0001": ("refused above 1 %", scale_of(1e-4)),
    "scale 1e-6": ("refused above 1 %", scale_of(1e-6)),
    "1e6 from the origin": ("refused above 1 %", scale_of(shift=1e6)),
    "1 to 4096 samples": ("error falls as 1/√spp", samples),
    "one pixel, a million samples": ("unbiased", one_pixel),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="*", help="glob over the first column")
    parser.add_argument("--write", type=Path, help="replace the table in this page")
    options = parser.parse_args()
    mi, rows = activate(), [["extreme", "expected", "measured"]]
    for name, (expected, measure) in ROWS.items():
        if fnmatch.fnmatch(name, options.only):
            rows.append([name, expected, measure(mi)])
            print("  ".join(rows[-1]), flush=True)
    if options.write:
        replace_table(options.write, "extremes", rows)


if __name__ == "__main__":
    main()
