"""Cases of materials and their textures."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from scenecaptum import activate

from ._case import Case, Row, Scene, message_rows, row, rows
from ._scenes import Ball, ball, balls, bitmap, grazing, highlight, lens, picture, shelf

INDICES = (1.001, 1.33, 1.5, 2.4)
ORANGE = {"type": "rgb", "value": [0.8, 0.3, 0.1]}


def surface_cases() -> list[Case]:
    """Return every case whose rows belong to a material or a texture."""
    return [
        *_diffuse(),
        *_conductors(),
        *_dielectrics(),
        *_plastics(),
        *_principled(),
        *_principledthin(),
        *_hair(),
        *_masks(),
        *_blends(),
        *_twosided(),
        *_bumps(),
        *_polarised(),
        *_textures(),
    ]


def _highlight(plugin: str, role: str, value: float, width: float, **fixed: Any) -> Case:
    """Return a floor with a highlight of about this width, which depends on the shape of the lobe."""
    material, values = ball(plugin, {role: value}, **fixed)
    scene = partial(highlight, material, width)
    return Case(plugin, f"lamp in the floor, {role} {value:g}", scene, rows("ball0.bsdf", values))


def _alone(plugin: str, values: dict[str, float], **fixed: Any) -> Case:
    """Return a single ball under the sky."""
    material, _ = ball(plugin, values, **fixed)
    title = ", ".join(f"{role} {value:g}" for role, value in values.items())
    return Case(plugin, f"ball, {title}", partial(lens, material), rows("ball0.bsdf", values))


def _brushed(plugin: str, **fixed: Any) -> Case:
    material, values = ball(plugin, {"alpha_u": 0.1, "alpha_v": 0.3}, **fixed)
    return Case(
        plugin, "lamp in the floor, brushed", partial(highlight, material, 0.05), rows("ball0.bsdf", values)
    )


def _textured(plugin: str, role: str, low: float, high: float, **fixed: Any) -> Case:
    """Return a floor with a highlight, whose roughness is a bitmap of random texels; α is 0.15 on average."""

    def scene() -> Scene:
        return highlight({"type": plugin, role: picture(low, high, channels=1), **fixed}, 0.15)

    values = {role: (low + high) / 2}
    return Case(plugin, f"lamp in the floor, textured {role}", scene, rows("ball0.bsdf", values))


def _index_cases(plugin: str, **fixed: Any) -> list[Case]:
    """Return balls, and floors that reflect a lamp, for each index.

    Rough plugins do not accept an index of 1.
    """

    def alone(title: str, scene: Callable[[Scene], Scene], eta: float) -> Case:
        glass = {"type": plugin, "int_ior": eta, "ext_ior": 1.0, **fixed}
        return Case(
            plugin, f"{title}, index {eta:g}", partial(scene, glass), rows("ball0.bsdf", {"eta": eta})
        )

    indices = (1.001, 1.33, 1.5, 2.4) if "alpha" in fixed else (1.0, 1.001, 1.33, 1.5, 2.4)
    return [
        alone("ball over a floor", shelf, 1.5),
        *(alone("ball", lens, eta) for eta in indices),
        *(alone("lamp in the floor", partial(highlight, alpha=0.2), eta) for eta in (1.33, 1.5, 2.4)),
    ]


def _diffuse() -> list[Case]:
    return [balls("diffuse", "grey", *(ball("diffuse", {"reflectance": v}) for v in (0.0, 0.001, 0.5, 1.0)))]


def _conductors() -> list[Case]:
    def rough(values: dict[str, float], **fixed: Any) -> Ball:
        return ball("roughconductor", values, **{"eta": 1.2, "k": 3.0, **fixed})

    tinted = {"eta": 1.2, "k": 3.0, "specular_reflectance": 0.9}
    return [
        balls(
            "conductor",
            "mirrors",
            ball("conductor", tinted),
            ball("conductor", {"eta": 0.2, "k": 3.9, "specular_reflectance": 1.0}),
            ({"type": "conductor", "material": "none"}, {"eta": 0.0, "k": 1.0}),
            ball("conductor", {"specular_reflectance": 0.0}, eta=1.2, k=3.0),
        ),
        balls(
            "roughconductor",
            "roughness",
            *(ball("roughconductor", {"alpha": a, **tinted}) for a in (0.1, 0.3, 1.0)),
        ),
        balls(
            "roughconductor",
            "ends",
            rough({"specular_reflectance": 0.0}, alpha=0.3),
            ball("roughconductor", {"specular_reflectance": 1.0, "eta": 0.0, "k": 1.0}, alpha=0.3),
            rough({"alpha": 0.3}, distribution="ggx"),
        ),
        _textured("roughconductor", "alpha", 0.1, 0.2, eta=1.2, k=3.0),
        *(_highlight("roughconductor", "alpha", a, a, eta=1.2, k=3.0) for a in (0.001, 0.01, 0.05, 0.3)),
        _brushed("roughconductor", eta=1.2, k=3.0),
    ]


def _dielectrics() -> list[Case]:
    cases = []
    for plugin in ("dielectric", "thindielectric", "roughdielectric"):
        rough = {"alpha": 0.3} if plugin == "roughdielectric" else {}
        cases += [
            balls(
                plugin,
                "tinted",
                ball(plugin, {"specular_reflectance": 0.7, "specular_transmittance": 0.8, **rough}),
                ball(plugin, {"specular_reflectance": 0.0, "specular_transmittance": 1.0}, **rough),
                ball(plugin, {"specular_reflectance": 1.0, "specular_transmittance": 0.0}, **rough),
            ),
            *_index_cases(plugin, **rough),
        ]
    cases += [
        Case(
            plugin,
            "opaque pane",
            lambda plugin=plugin: _pane({"type": plugin, "specular_transmittance": 0.0}),
            rows("ball0.bsdf", {"specular_transmittance": 0.0}),
        )
        for plugin in ("dielectric", "thindielectric", "roughdielectric")
    ]
    return [
        *cases,
        balls(
            "roughdielectric",
            "roughness",
            *(ball("roughdielectric", {"alpha": a}) for a in (0.1, 0.3, 1.0)),
        ),
        _textured("roughdielectric", "alpha", 0.1, 0.2),
        *(_highlight("roughdielectric", "alpha", a, a) for a in (0.001, 0.01, 0.05, 0.3)),
        _brushed("roughdielectric"),
    ]


def _pane(material: Scene) -> Scene:
    """Return a sheet that is visible from one side and lit from both."""
    turn = activate().ScalarTransform4f().rotate([0.3, 0.2, 1], 40).rotate([1, 0, 0], 80)
    return {**shelf({"type": "diffuse"}), "ball0": {"type": "rectangle", "to_world": turn, "bsdf": material}}


def _plastics() -> list[Case]:
    cases = []
    for plugin in ("plastic", "roughplastic"):
        rough = {} if plugin == "plastic" else {"alpha": 0.2}
        lacquer = {"diffuse_reflectance": 0.4, "specular_reflectance": 0.9}
        cases += [
            balls(
                plugin,
                "reflectances",
                ball(plugin, lacquer, **rough),
                ball(plugin, {"diffuse_reflectance": 0.0, "specular_reflectance": 1.0}, **rough),
                ball(plugin, {"diffuse_reflectance": 1.0, "specular_reflectance": 0.0}, **rough),
                ball(plugin, lacquer, nonlinear=True, **rough),
            ),
            *_index_cases(plugin, diffuse_reflectance=0.4, **rough),
        ]
    return [
        *cases,
        balls(
            "roughplastic",
            "roughness",
            *(ball("roughplastic", {"alpha": a}, diffuse_reflectance=0.4) for a in (0.1, 0.3, 1.0)),
            ball("roughplastic", {"alpha": 0.3}, diffuse_reflectance=0.4, distribution="ggx", nonlinear=True),
        ),
        *(
            _highlight("roughplastic", "alpha", a, a, diffuse_reflectance=0.2)
            for a in (0.001, 0.01, 0.05, 0.3)
        ),
    ]


def _principled() -> list[Case]:
    lobes = {
        "base_color": 0.6,
        "roughness": 0.4,
        "metallic": 0.3,
        "spec_tint": 0.4,
        "sheen": 0.5,
        "sheen_tint": 0.3,
        "clearcoat": 0.6,
        "flatness": 0.2,
        "specular": 0.5,
    }
    plain = {"base_color": ORANGE, "roughness": 0.4}
    coloured = {"type": "principled", **lobes, "base_color": ORANGE}
    tints = {"sheen": 0.8, "clearcoat": 0.8}
    rates = ("main_specular", "clearcoat", "diffuse_reflectance")
    return [
        balls("principled", "every lobe", ({**coloured, "spec_trans": 0.3}, {**lobes, "spec_trans": 0.3})),
        balls("principled", "opaque", (coloured, lobes)),
        *(_highlight("principled", "clearcoat", v, 0.1, **plain) for v in (0.0, 1.0)),
        *(_highlight("principled", "anisotropic", v, 0.2, metallic=0.5, **plain) for v in (0.0, 0.4, 1.0)),
        *(
            _highlight("principled", "clearcoat_gloss", v, 0.05, clearcoat=0.8, **plain)
            for v in (0.0, 0.4, 0.9)
        ),
        *(_alone("principled", {"eta": eta}, **plain, spec_trans=0.7) for eta in INDICES),
        _alone("principled", {"specular": 0.5}, **plain, spec_trans=0.7),
        balls(
            "principled",
            "specular",
            *(ball("principled", {"specular": s}, **plain) for s in (0.02, 0.2, 0.5, 1.0)),
        ),
        balls(
            "principled",
            "roughness",
            *(ball("principled", {"roughness": r, "base_color": 0.6}, metallic=0.8) for r in (0.3, 0.5, 1.0)),
        ),
        balls(
            "principled",
            "at 0",
            ball(
                "principled",
                dict.fromkeys(("metallic", "sheen", "spec_trans", "flatness"), 0.0),
                **plain,
            ),
            ball("principled", {"base_color": 0.0}, roughness=0.4),
            ball("principled", dict.fromkeys(("spec_tint", "sheen_tint"), 0.0), **plain, **tints),
        ),
        balls(
            "principled",
            "at 1",
            ball("principled", {"metallic": 1.0, "base_color": 1.0}, roughness=0.4),
            ball("principled", {"spec_trans": 1.0}, **plain),
            ball("principled", dict.fromkeys(("sheen", "flatness"), 1.0), **plain),
            ball("principled", dict.fromkeys(("spec_tint", "sheen_tint"), 1.0), **plain, **tints),
        ),
        _textured("principled", "roughness", 0.33, 0.44, base_color=0.6, metallic=0.8),
        *(
            _highlight("principled", "roughness", r, r**2, base_color=0.6, metallic=0.8)
            for r in (0.03, 0.1, 0.3)
        ),
        Case(
            "principled",
            "sampling",
            lambda: shelf({"type": "principled", "clearcoat": 0.5}),
            message_rows(*(f"ball0.bsdf.{rate}_sampling_rate" for rate in rates)),
        ),
    ]


def _principledthin() -> list[Case]:
    lobes = {
        "base_color": 0.6,
        "roughness": 0.4,
        "spec_tint": 0.4,
        "sheen": 0.5,
        "sheen_tint": 0.3,
        "flatness": 0.2,
        "spec_trans": 0.3,
        "diff_trans": 0.6,
        "eta": 1.5,
    }
    plain = {"base_color": ORANGE, "roughness": 0.4}
    mixed = {"sheen": 0.8, "spec_trans": 0.5}
    rates = ("specular_reflectance", "diffuse_reflectance", "diffuse_transmittance", "specular_transmittance")
    return [
        balls(
            "principledthin", "every lobe", ({"type": "principledthin", **lobes, "base_color": ORANGE}, lobes)
        ),
        *(
            _highlight("principledthin", "anisotropic", v, 0.2, spec_trans=0.7, **plain)
            for v in (0.0, 0.4, 1.0)
        ),
        *(_alone("principledthin", {"eta": eta}, **plain, spec_trans=0.7) for eta in INDICES),
        *(_highlight("principledthin", "roughness", r, r**2, spec_trans=0.7) for r in (0.1, 0.3)),
        balls("principledthin", "roughness", ball("principledthin", {"roughness": 1.0}, spec_trans=0.7)),
        balls(
            "principledthin",
            "at 0",
            ball(
                "principledthin",
                dict.fromkeys(("sheen", "spec_trans", "flatness", "diff_trans"), 0.0),
                **plain,
            ),
            ball("principledthin", {"base_color": 0.0}, roughness=0.4, spec_trans=0.3),
            ball("principledthin", {"spec_tint": 0.0, "sheen_tint": 0.0}, **plain, **mixed),
        ),
        balls(
            "principledthin",
            "at 1",
            ball("principledthin", {"spec_trans": 1.0, "base_color": 1.0}, roughness=0.4),
            ball("principledthin", {"sheen": 1.0, "flatness": 1.0}, **plain),
            ball("principledthin", {"diff_trans": 2.0}, **plain),
            ball("principledthin", dict.fromkeys(("spec_tint", "sheen_tint"), 1.0), **plain, **mixed),
        ),
        Case(
            "principledthin",
            "sampling",
            lambda: shelf({"type": "principledthin", "spec_trans": 0.5}),
            message_rows(*(f"ball0.bsdf.{rate}_sampling_rate" for rate in rates)),
        ),
    ]


# Curves come from files only.
_FOLDER = tempfile.TemporaryDirectory()


def _strand(curve: str, material: Scene) -> Scene:
    """Return a thick strand of hair across the image."""
    file = Path(_FOLDER.name) / "strand.txt"
    file.write_text("".join(f"{x} {0.1 * x * x} {0.2 * x} 0.5\n" for x in np.linspace(-3, 3, 7)))
    scene = shelf({"type": "diffuse"})
    scene["ball0"] = {"type": curve, "filename": str(file), "bsdf": material}
    return scene


def _lit_strand(material: Scene) -> Scene:
    """Return a close-up of a strand under a small lamp, so that the image depends on the width of its lobes."""
    scene = _strand("bsplinecurve", material)
    del scene["sky"]
    scene["camera"]["fov"] = 8
    scene["lamp"].update(center=[0.3, -2.5, 3], radius=0.3)
    return scene


def _hair() -> list[Case]:
    pigments = {"eumelanin": 0.2, "pheomelanin": 0.3}
    index = {"int_ior": 1.55, "ext_ior": 1.0}
    brown = {"type": "hair", "scale_tilt": 3.0, **index, **pigments}
    colour = {"type": "rgb", "value": [0.2, 0.4, 0.7]}

    def case(title: str, scene: Callable[[], Scene], **values: float) -> Case:
        return Case("hair", title, scene, rows("ball0.bsdf", values))

    def across(roughness: float) -> Case:
        material = {**brown, "longitudinal_roughness": roughness}
        return case(
            f"lamp across, {roughness:g}", partial(_lit_strand, material), longitudinal_roughness=roughness
        )

    def around(roughness: float) -> Case:
        material = {**brown, "azimuthal_roughness": roughness}
        return case(
            f"all light, {roughness:g}",
            partial(_strand, "bsplinecurve", material),
            azimuthal_roughness=roughness,
        )

    return [
        case("B-spline", partial(_strand, "bsplinecurve", brown), scale_tilt=3.0, eta=1.55, **pigments),
        case("polyline", partial(_strand, "linearcurve", brown), eta=1.55, **pigments),
        case(
            "dyed",
            partial(_strand, "bsplinecurve", {"type": "hair", **index, "sigma_a": colour}),
            sigma_a=0.4,
        ),
        case(
            "white",
            partial(_strand, "bsplinecurve", {**brown, **dict.fromkeys(pigments, 0.0)}),
            **dict.fromkeys(pigments, 0.0),
        ),
        *map(across, (0.05, 0.3)),
        *map(around, (0.1, 0.4)),
    ]


def _nested(plugin: str, *nested: Scene, **properties: Any) -> Scene:
    return {"type": plugin, **properties, **{f"nested{i}": bsdf for i, bsdf in enumerate(nested)}}


def _masks() -> list[Case]:
    diffuse = {"type": "diffuse", "reflectance": 0.6}
    plastic = {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": 0.4}
    mirror = {"type": "conductor", "eta": 1.2, "k": 3.0}
    dark = {"type": "diffuse", "reflectance": 0.05}
    nested = {"nested_bsdf.reflectance": 0.6}
    return [
        balls(
            "mask",
            "over diffuse",
            *((_nested("mask", diffuse, opacity=o), {"opacity": o, **nested}) for o in (0.01, 0.6)),
            *((_nested("mask", dark, opacity=o), {"opacity": o}) for o in (0.0, 1.0)),
        ),
        balls(
            "mask",
            "over others",
            (_nested("mask", plastic, opacity=0.5), {"opacity": 0.5, "nested_bsdf.diffuse_reflectance": 0.4}),
            (_nested("mask", mirror, opacity=0.5), {"opacity": 0.5, "nested_bsdf.k": 3.0}),
            (lambda: _nested("mask", diffuse, opacity=picture(channels=1)), {"opacity": 0.5}),
        ),
        balls(
            "mask",
            "over twosided roughplastic",
            (
                _nested("mask", _nested("twosided", plastic), opacity=0.5),
                {
                    "opacity": 0.5,
                    "nested_bsdf.brdf_0.diffuse_reflectance": 0.4,
                    "nested_bsdf.brdf_0.alpha": 0.2,
                },
            ),
        ),
    ]


def _blends() -> list[Case]:
    dark = {"type": "diffuse", "reflectance": 0.2}
    bright = {"type": "diffuse", "reflectance": 0.8}
    rough = {"type": "roughconductor", "alpha": 0.3, "eta": 1.2, "k": 3.0}
    mirror = {"type": "conductor", "eta": 1.2, "k": 3.0}
    glass = {"type": "dielectric"}
    return [
        balls(
            "blendbsdf",
            "of two diffuse",
            *(
                (
                    _nested("blendbsdf", dark, bright, weight=w),
                    {"weight": w}
                    if w in (0, 1)
                    else {"weight": w, "bsdf_0.reflectance": 0.2, "bsdf_1.reflectance": 0.8},
                )
                for w in (0.0, 0.3, 1.0)
            ),
        ),
        balls(
            "blendbsdf",
            "of diffuse and rough conductor",
            *(
                (
                    _nested("blendbsdf", bright, rough, weight=w),
                    {"weight": w} if w in (0, 1) else {"weight": w, "bsdf_1.alpha": 0.3},
                )
                for w in (0.0, 0.4, 1.0)
            ),
        ),
        balls(
            "blendbsdf",
            "of diffuse and mirror",
            *(
                (
                    _nested("blendbsdf", bright, mirror, weight=w),
                    {"weight": w, "bsdf_0.reflectance": 0.8, "bsdf_1.specular_reflectance": 1.0},
                )
                for w in (0.4,)
            ),
            *((_nested("blendbsdf", bright, mirror, weight=w), {"weight": w}) for w in (0.0, 1.0)),
        ),
        balls(
            "blendbsdf",
            "of mirror and rough",
            (
                _nested("blendbsdf", mirror, {"type": "roughplastic", "alpha": 0.3}, weight=0.4),
                {"weight": 0.4, "bsdf_1.diffuse_reflectance": 0.5, "bsdf_1.eta": 1.49},
            ),
            (
                _nested("blendbsdf", mirror, {**rough, "specular_reflectance": 0.9}, weight=0.4),
                {"bsdf_1.specular_reflectance": 0.9},
            ),
        ),
        balls(
            "blendbsdf",
            "of others",
            (_nested("blendbsdf", mirror, glass, weight=0.4), {"weight": 0.4, "bsdf_0.k": 3.0}),
            (
                _nested("blendbsdf", bright, {"type": "null"}, weight=0.4),
                {"weight": 0.4, "bsdf_0.reflectance": 0.8},
            ),
            (lambda: _nested("blendbsdf", dark, bright, weight=picture(channels=1)), {"weight": 0.5}),
            (lambda: _nested("blendbsdf", bright, mirror, weight=picture(channels=1)), {"weight": 0.5}),
        ),
    ]


def _twosided() -> list[Case]:
    def two(front: Scene, *back: Scene) -> Scene:
        return _nested("twosided", front, *back)

    mirror = {"type": "conductor", "eta": 1.2, "k": 3.0, "specular_reflectance": 0.9}
    diffuse = {"type": "diffuse", "reflectance": 0.4}
    plastic = {"type": "plastic", "diffuse_reflectance": 0.4}
    rough = {"type": "roughconductor", "alpha": 0.3}
    return [
        balls(
            "twosided",
            "balls",
            (two(diffuse), {"brdf_0.reflectance": 0.4}),
            (two(mirror), {"brdf_0.specular_reflectance": 0.9, "brdf_0.k": 3.0}),
            (two(plastic), {"brdf_0.diffuse_reflectance": 0.4}),
            (two(rough), {"brdf_0.alpha": 0.3}),
        ),
        balls(
            "twosided",
            "of a blend",
            (
                two(_nested("blendbsdf", diffuse, rough, weight=0.4)),
                {"brdf_0.weight": 0.4, "brdf_0.bsdf_0.reflectance": 0.4, "brdf_0.bsdf_1.alpha": 0.3},
            ),
        ),
        Case(
            "twosided",
            "two sheets",
            lambda: _pane(two(diffuse, {**diffuse, "reflectance": 0.7})),
            rows("ball0.bsdf", {"brdf_0.reflectance": 0.4, "brdf_1.reflectance": 0.7}),
        ),
    ]


def _bumps() -> list[Case]:
    def bumped(nested: Scene, scale: float = 0.3) -> Scene:
        return _nested("bumpmap", nested, texture=picture(channels=1), scale=scale)

    def tilted(nested: Scene) -> Scene:
        rng = np.random.default_rng(5)
        texels = np.stack([*rng.uniform(0.4, 0.6, (2, 4, 6)), np.full((4, 6), 0.95)], -1)
        return _nested(
            "normalmap", nested, normalmap={"type": "bitmap", "bitmap": bitmap(texels), "raw": True}
        )

    diffuse = {"type": "diffuse", "reflectance": 0.6}
    rough = {"type": "roughconductor", "alpha": 0.3, "eta": 1.2, "k": 3.0}
    mirror = {"type": "conductor", "eta": 1.2, "k": 3.0}
    return [
        Case(
            "bumpmap",
            "balls",
            lambda: shelf(bumped(diffuse), bumped(rough), bumped(mirror)),
            (
                row("ball0.bsdf.nested_bsdf.reflectance", 0.6),
                Row("ball0.bsdf.nested_texture", 0.05, scaled=True),
                row("ball1.bsdf.nested_bsdf.k", 3.0),
                row("ball2.bsdf.nested_bsdf.k", 3.0),
            ),
        ),
        Case(
            "bumpmap",
            "seen from the side",
            lambda: grazing(bumped(diffuse)),
            (Row("ball0.bsdf.nested_texture", 0.05, scaled=True),),
        ),
        *(
            Case(
                "bumpmap",
                f"lamp in {title}",
                lambda nested=nested: highlight(bumped(nested), 0.3),
                (Row("ball0.bsdf.scale", 0.03), Row("ball0.bsdf.nested_texture", 0.05, scaled=True), *more),
            )
            for title, nested, more in (
                ("a rough floor", rough, rows("ball0.bsdf.nested_bsdf", {"alpha": 0.3})),
                ("a mirror", mirror, ()),
            )
        ),
        Case(
            "normalmap",
            "over roughplastic",
            lambda: shelf(tilted({"type": "roughplastic", "alpha": 0.3, "diffuse_reflectance": 0.4})),
            rows("ball0.bsdf.nested_bsdf", {"alpha": 0.3, "diffuse_reflectance": 0.4}),
        ),
        Case(
            "normalmap",
            "balls",
            lambda: shelf(tilted(diffuse), tilted(rough), tilted(mirror)),
            (
                row("ball0.bsdf.nested_bsdf.reflectance", 0.6),
                Row("ball0.bsdf.normalmap", 0.02),
                row("ball1.bsdf.nested_bsdf.k", 3.0),
                row("ball2.bsdf.nested_bsdf.k", 3.0),
                Row("ball2.bsdf.normalmap", 0.02),
            ),
        ),
        Case(
            "normalmap",
            "seen from the side",
            lambda: grazing(tilted(diffuse)),
            (Row("ball0.bsdf.normalmap", 0.02),),
        ),
        Case(
            "normalmap",
            "lamp in a rough floor",
            lambda: highlight(tilted(rough), 0.3),
            (row("ball0.bsdf.nested_bsdf.alpha", 0.3), Row("ball0.bsdf.normalmap", 0.01)),
        ),
    ]


def _polarised() -> list[Case]:
    return [
        balls("polarizer", "ball", ball("polarizer", {"theta": 30.0, "transmittance": 0.8})),
        balls("retarder", "ball", ball("retarder", {"theta": 30.0, "delta": 60.0, "transmittance": 0.8})),
        balls("circular", "ball", ball("circular", {"transmittance": 0.8})),
        balls(
            "pplastic",
            "ball",
            (
                {
                    "type": "pplastic",
                    "alpha": 0.2,
                    "int_ior": 1.5,
                    "ext_ior": 1.0,
                    "diffuse_reflectance": 0.4,
                    "specular_reflectance": 0.9,
                },
                {"diffuse_reflectance": 0.4, "specular_reflectance": 0.9, "alpha": 0.2, "eta": 1.5},
            ),
        ),
    ]


def _painted_mesh() -> Any:
    """Return a tetrahedron-like mesh with a colour for each vertex and each face."""
    mi = activate()
    corners = np.array([[-1, -1, -1], [1, -1, -1], [0, 1, -1], [0, -0.3, 1]], np.float32)
    faces = np.array([[0, 1, 3], [1, 2, 3], [2, 0, 3], [0, 2, 1]], np.uint32)
    material = {
        "type": "diffuse",
        "reflectance": {"type": "mesh_attribute", "name": "vertex_color", "scale": 0.8},
    }
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(material)
    mesh = mi.Mesh("painted", 4, 4, props=properties)
    params = mi.traverse(mesh)
    params["vertex_positions"] = corners.ravel()
    params["faces"] = faces.ravel()
    params.update()
    mesh.add_attribute("vertex_color", 3, np.random.default_rng(1).uniform(0.3, 0.7, 12).astype(np.float32))
    return mesh


def _textures() -> list[Case]:
    def grid(value: float) -> Scene:
        mi = activate()
        cells = np.random.default_rng(2).uniform(0.8 * value, 1.2 * value, (3, 3, 3, 3)).astype(np.float32)
        centred = mi.ScalarTransform4f().translate([-1.5, -1.5, -1.5]).scale(3)
        return {"type": "gridvolume", "grid": mi.VolumeGrid(cells), "raw": True, "to_world": centred}

    def painted(texture: Scene) -> Scene:
        return {"type": "diffuse", "reflectance": texture}

    squares = {"type": "checkerboard", "color0": 0.2, "color1": 0.7}
    extremes = {"type": "checkerboard", "color0": 0.0, "color1": 1.0}
    spectra = [
        {"type": "rgb", "value": [0.2, 0.5, 0.8]},
        {"type": "rawconstant", "value": 0.5},
        {"type": "uniform", "value": 0.5},
    ]
    return [
        Case(
            "bitmap",
            "balls",
            lambda: shelf(
                painted(picture()),
                painted({**picture(), "filter_type": "nearest"}),
                {"type": "roughconductor", "alpha": picture(0.2, 0.4, 1)},
                painted(
                    {
                        "type": "bitmap",
                        "bitmap": bitmap(np.random.default_rng(0).integers(0, 2, (4, 6, 3))),
                        "raw": True,
                    }
                ),
            ),
            (
                row("ball0.bsdf.reflectance.data", 0.5),
                row("ball1.bsdf.reflectance.data", 0.5),
                Row("ball2.bsdf.alpha.data", 0.015),
                Row("ball3.bsdf.reflectance.data", 0.05, 1),
                *message_rows("ball0.bsdf.reflectance.to_uv"),
            ),
        ),
        Case(
            "checkerboard",
            "balls",
            lambda: shelf(painted(squares), painted(extremes)),
            (
                row("ball0.bsdf.reflectance.color0", 0.2),
                row("ball0.bsdf.reflectance.color1", 0.7),
                row("ball1.bsdf.reflectance.color0", 0.0),
                row("ball1.bsdf.reflectance.color1", 1.0),
                *message_rows("ball0.bsdf.reflectance.to_uv"),
            ),
        ),
        Case(
            "mesh_attribute",
            "vertex colours",
            lambda: {**shelf({"type": "diffuse"}), "ball0": _painted_mesh()},
            (Row("ball0.vertex_color", 0.05), Row("ball0.bsdf.reflectance.scale", 0.05)),
        ),
        Case(
            "volume",
            "balls",
            lambda: shelf(
                painted({"type": "volume", "volume": grid(0.5)}),
                painted({"type": "volume", "volume": {"type": "constvolume", "value": 0.5}}),
            ),
            (
                Row("ball0.bsdf.reflectance.volume.data", 0.05),
                Row("ball1.bsdf.reflectance.volume.value", 0.05),
            ),
        ),
        Case(
            "spectra",
            "rgb, rawconstant, uniform",
            lambda: shelf(*map(painted, spectra)),
            tuple(row(f"ball{i}.bsdf.reflectance", 0.5) for i in range(3)),
        ),
    ]
