from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import textwrap
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bitmaps import read_bitmap
from PIL import Image

from scenecaptum import SceneAttribution, SceneCaptumError, VanillaSceneGradient, metrics
from scenecaptum.projection import (
    SurfaceMap,
    TexelMap,
    export,
    heatmap,
    objects_of_unclear_sign,
    shared_maximum,
)
from scenecaptum.projection._cryptomatte import identifier, murmur3
from scenecaptum.protocols import ResultKind

relative = partial(heatmap, norm="linear")  # in proportion to the saliencies


def attribution(parameters: tuple[tuple[str, ...], ...], **saliency: float) -> SceneAttribution:
    """A 1×2 picture: the left pixel shows object 0, the right one half object 0 and half object 1."""
    surfaces = SurfaceMap(
        shape=(1, 2),
        pixel=np.array([0, 1, 1], np.int32),
        object_index=np.array([0, 0, 1], np.int32),
        fraction=np.array([1.0, 0.5, 0.5], np.float32),
        objects=tuple(f"object_{i}" for i in range(len(parameters))),
        parameters=parameters,
    )
    values = {name: torch.tensor(value) for name, value in saliency.items()}
    return SceneAttribution(values, standard_error=None, metric_value=1.0, surfaces=surfaces)


def test_pixels_average_objects_by_coverage():
    painted = relative(attribution((("a",), ("b",)), a=2.0, b=-1.0))
    torch.testing.assert_close(painted, torch.tensor([[1.0, 0.75]]))


def test_an_object_with_several_parameters_shows_their_norm():
    painted = relative(attribution((("a", "b"), ("c",)), a=3.0, b=4.0, c=5.0))
    torch.testing.assert_close(painted, torch.tensor([[1.0, 1.0]]))


def test_a_light_that_is_off_has_no_colour_and_sets_no_scale():
    one = attribution((("a", "lamp"), ("b",), ("lamp",)), a=2.0, b=-1.0, lamp=50.0)
    ranged = dataclasses.replace(one, extents={name: torch.ones(1) for name in one})
    off = dataclasses.replace(ranged, info={"lights_off": ["lamp"]})
    torch.testing.assert_close(relative(off), torch.tensor([[1.0, 0.75]]))
    assert shared_maximum([off]) == 2.0
    assert shared_maximum([ranged]) > 50
    assert relative(ranged).max() == 1
    torch.testing.assert_close(relative(off, parameter="lamp"), torch.tensor([[1.0, 0.5]]))


SKY = {"sky.scale": 3.0, "sky.data": [[[3.0]]], "floor": 4.0}


def test_a_map_of_light_is_left_out_beside_its_scale():
    """Both effects are those of the same light: together it would count √2 times."""
    result = attribution((("sky.scale", "sky.data"), ("floor",)), **SKY)
    torch.testing.assert_close(relative(result), torch.tensor([[0.75, 0.875]]))
    brighter = attribution((("sky.scale", "sky.data"), ("floor",)), **SKY | {"sky.data": [[[9.0]]]})
    assert shared_maximum([brighter]) == 4
    alone = relative(brighter, parameter=["sky.data", "floor"])
    torch.testing.assert_close(alone, torch.tensor([[1.0, 13 / 18]]))


def test_contributions_of_a_map_of_light_and_its_scale_add_up():
    result = attribution((("sky.scale", "sky.data"), ("floor",)), **SKY | {"sky.data": [[[4.0]]]})
    shares = dataclasses.replace(result, info={"quantity": ResultKind.CONTRIBUTION.value})
    torch.testing.assert_close(relative(shares), torch.tensor([[1.0, 0.9]]))


def test_texels_of_a_map_of_light_are_shown_beside_its_scale():
    result = attribution((("sky.scale", "sky.data"), ("floor",)), **SKY | {"sky.data": [[[4.0], [0.0]]]})
    one = np.array([0, 1], np.int32)
    texels = {"sky.data": TexelMap(entry=one, texel=one, weight=np.ones(2, np.float32))}
    shown = dataclasses.replace(result, surfaces=dataclasses.replace(result.surfaces, texels=texels))
    torch.testing.assert_close(relative(shown, texels=True), torch.tensor([[1.0, (0.6 + 0.8) / 2]]))


def test_a_shared_parameter_paints_every_object_that_uses_it():
    painted = relative(attribution((("a",), ("a",)), a=0.5))
    torch.testing.assert_close(painted, torch.ones(1, 2))


def test_invisible_objects_count_for_scale_and_ranking():
    result = attribution((("a",), ("b",), ("hidden",)), a=1.0, b=2.0, hidden=4.0)
    torch.testing.assert_close(relative(result), torch.tensor([[0.25, 0.375]]))
    assert result.ranking()[0].name == "hidden"


def test_a_parameter_of_no_object_sets_the_scale_too():
    painted = relative(attribution((("a",), ("b",)), a=1.0, b=1.0, point_light=2.0))
    torch.testing.assert_close(painted, torch.full((1, 2), 0.5))


def test_parameters_that_were_not_attributed_are_not_painted():
    painted = relative(attribution((("a",), ("not an input",)), a=1.0))
    torch.testing.assert_close(painted, torch.tensor([[1.0, 0.5]]))


def test_attributions_of_zero_give_a_black_map():
    assert not relative(attribution((("a",), ("b",)), a=0.0, b=0.0)).any()


def test_without_a_scene_there_is_no_map():
    with pytest.raises(SceneCaptumError, match="which object each pixel shows"):
        SceneAttribution({"a": torch.ones(())}, standard_error=None, metric_value=1.0).heatmap()


def test_map_of_a_real_scene_equals_the_saliency_of_the_object_at_each_pixel(cornell):
    result = VanillaSceneGradient(cornell, metrics.MeanLuminance()).attribute(replicates=1)
    painted, surfaces = result.heatmap(norm="linear"), cornell.surfaces
    assert painted.shape == (32, 32)
    assert 0 <= painted.min() < painted.max() <= 1
    saliency = result.saliency()
    (floor,) = (n for n in saliency if n.startswith("floor."))
    whole = (surfaces.object_index == surfaces.objects.index("floor_shape")) & (surfaces.fraction == 1)
    expected = saliency[floor] / shared_maximum([result])
    np.testing.assert_allclose(painted.flatten()[surfaces.pixel[whole]], expected, rtol=1e-5)
    assert whole.sum() > 20


# --- Choosing, signs and scales --------------------------------------------------------------------


def test_a_name_or_a_glob_chooses_what_is_painted_and_sets_the_scale():
    result = attribution((("a", "b"), ("c",)), a=3.0, b=4.0, c=2.0)
    torch.testing.assert_close(relative(result, parameter="b"), torch.tensor([[1.0, 0.5]]))
    torch.testing.assert_close(relative(result, parameter=["a", "c"]), torch.tensor([[1.0, 5 / 6]]))
    torch.testing.assert_close(relative(result, parameter="[ab]"), torch.tensor([[1.0, 0.5]]))
    with pytest.raises(SceneCaptumError, match="matches none of the 3 parameters"):
        relative(result, parameter="d*")


def test_a_signed_map_has_the_sign_of_the_summed_effects():
    result = attribution((("a", "b"), ("c",)), a=3.0, b=-4.0, c=5.0)
    torch.testing.assert_close(relative(result, signed=True), torch.tensor([[-1.0, 0.0]]))
    colours = {"a": torch.tensor([0.0, 3.0, -4.0]), "b": torch.zeros(3), "c": torch.tensor([0.0, 0.0, 2.5])}
    result = dataclasses.replace(result, attributions=colours)
    torch.testing.assert_close(relative(result, signed=True), torch.tensor([[-1.0, -0.25]]))
    assert torch.equal(relative(result), relative(result).abs())


def test_a_signed_map_is_zero_where_the_sign_is_lost_in_the_noise():
    result = attribution((("a", "b"), ("c",)), a=3.0, b=4.0, c=-8.0)
    for error, right, unclear in ((3.9, (5 - 8) / 16, []), (4.1, 5 / 16, ["object_1"])):
        errors = {"a": 2.0, "b": 2.0, "c": error}
        noisy = dataclasses.replace(
            result,
            standard_error={name: torch.tensor(one) for name, one in errors.items()},
            covariance={name: torch.tensor([[one**2]]) for name, one in errors.items()},
        )
        torch.testing.assert_close(relative(noisy, signed=True), torch.tensor([[5 / 8, right]]))
        torch.testing.assert_close(relative(noisy), torch.tensor([[5 / 8, (5 + 8) / 16]]))
        assert objects_of_unclear_sign(noisy) == unclear


def test_a_logarithmic_map_shows_the_decades_below_its_maximum():
    result = attribution((("a",), ("b",), ("hidden",)), a=1.0, b=-0.98, hidden=100.0)
    expected = torch.tensor([[1 / 3, 0.0]])
    torch.testing.assert_close(
        relative(result, norm="log", signed=True, decades=3), expected, atol=1e-5, rtol=0
    )
    torch.testing.assert_close(relative(result, norm="log", decades=4)[0, 0], torch.tensor(0.5))
    minus = dataclasses.replace(result, attributions={n: -v for n, v in result.items()})
    torch.testing.assert_close(
        relative(minus, norm="log", signed=True), -relative(result, norm="log", signed=True)
    )
    nothing = attribution((("a",), ("b",)), a=0.0, b=0.0)
    assert not relative(nothing, norm="log", signed=True).any()


def test_maps_with_a_shared_maximum_can_be_compared():
    before, after = (attribution((("a",), ("b",)), a=a, b=1.0) for a in (2.0, 8.0))
    top = shared_maximum([before, after])
    assert top == 8.0
    torch.testing.assert_close(relative(before, maximum=top), torch.tensor([[0.25, 0.1875]]))
    torch.testing.assert_close(relative(after, maximum=top), relative(after))
    torch.testing.assert_close(relative(after, maximum=4.0)[0, 0], torch.tensor(1.0))  # and nothing else
    assert shared_maximum([before, after], parameter="b") == 1.0
    assert shared_maximum([]) == 0.0
    nothing = attribution((("a",), ("b",)), a=0.0, b=0.0)
    assert not relative(nothing, maximum=shared_maximum([nothing, nothing])).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"norm": "cubic"}, "norm must be one of 'sqrt', 'linear', 'log', not 'cubic'"),
        ({"scale": "cubic"}, 'scale must be "range", "unit" or "value", not'),
        ({"norm": "log", "decades": 0}, "decades must be positive"),
        ({"maximum": -1.0}, "maximum must be finite and not negative"),
        ({"maximum": float("nan")}, "maximum must be finite and not negative"),
    ],
)
def test_an_unknown_scale_is_refused(options: dict[str, Any], message: str):
    with pytest.raises(SceneCaptumError, match=message):
        relative(attribution((("a",), ("b",)), a=1.0, b=2.0), **options)


def test_groups_are_chosen_and_signed_like_parameters():
    result = attribution((("a", "b"), ("c",)), pair=-2.0, c=1.0)
    result = dataclasses.replace(result, info={"groups": {"pair": ["a", "b"], "c": ["c"]}})
    torch.testing.assert_close(relative(result, signed=True), torch.tensor([[-1.0, -0.25]]))
    torch.testing.assert_close(relative(result, parameter="pair"), torch.tensor([[1.0, 0.5]]))


# --- Texels ----------------------------------------------------------------------------------------


def textured() -> SceneAttribution:
    """The left pixel shows both texels of a texture equally, the right one only the second."""
    result = attribution((("t", "a"), ("b",)), a=0.0, b=0.0)
    shown = TexelMap(
        entry=np.array([0, 0, 1], np.int32),
        texel=np.array([0, 1, 1], np.int32),
        weight=np.array([1.0, 1.0, 2.0], np.float32),
    )
    values = {**result.attributions, "t": torch.tensor([[[3.0, 0.0], [-1.0, 2.0]]])}
    surfaces = dataclasses.replace(result.surfaces, texels={"t": shown})
    return dataclasses.replace(result, attributions=values, surfaces=surfaces)


def test_texels_paint_the_gradient_per_unit_of_texture():
    result = textured()
    # Mean gradients per unit of texture: (2, 2) on the left, 2 × (-1, 2) on the right.
    left, right = 8**0.5, 20**0.5
    torch.testing.assert_close(relative(result, texels=True), torch.tensor([[left / right, 0.5]]))
    torch.testing.assert_close(relative(result), torch.tensor([[1.0, 0.5]]))
    assert shared_maximum([result], texels=True) == pytest.approx(right)
    assert shared_maximum([result]) == pytest.approx(left)


def test_texels_join_the_other_parameters_of_their_object():
    result = textured()
    result = dataclasses.replace(result, attributions={**result.attributions, "a": torch.tensor(-12.0)})
    right = (20 + 144) ** 0.5
    expected = -torch.tensor([[(8 + 144) ** 0.5 / right, 0.5]])
    torch.testing.assert_close(relative(result, texels=True, signed=True), expected)


def test_a_texture_without_texel_map_is_refused():
    result = textured()
    bare = dataclasses.replace(result, surfaces=dataclasses.replace(result.surfaces, texels={}))
    with pytest.raises(SceneCaptumError, match="not known which texels the pixels show"):
        relative(bare, texels=True)
    torch.testing.assert_close(relative(bare, texels=True, parameter="a"), relative(bare, parameter="a"))


def test_texels_are_saved_and_loaded(tmp_path: Path):
    result = textured()
    result.save(tmp_path / "result.npz")
    loaded = SceneAttribution.load(tmp_path / "result.npz")
    torch.testing.assert_close(loaded.heatmap(texels=True), result.heatmap(texels=True))


# --- Files -----------------------------------------------------------------------------------------


def test_an_exported_array_holds_the_numbers(tmp_path: Path):
    result = attribution((("a",), ("b",)), a=2.0, b=-1.0)
    export(result, tmp_path / "map.npy", signed=True)
    np.testing.assert_array_equal(np.load(tmp_path / "map.npy"), heatmap(result, signed=True))


def test_an_exported_picture_has_eight_bits(tmp_path: Path):
    result = attribution((("a",), ("b",)), a=2.0, b=-1.0)
    export(result, tmp_path / "map.png")
    assert np.array(Image.open(tmp_path / "map.png")).tolist() == [[255, 221]]
    export(result, tmp_path / "signed.png", signed=True)
    assert np.array(Image.open(tmp_path / "signed.png")).tolist() == [[255, 191]]
    export(result, tmp_path / "colours.png", colours="gray_r")
    assert np.array(Image.open(tmp_path / "colours.png"))[0, 0].tolist() == [0, 0, 0]
    export(torch.tensor([[0.0, 3.0]]), tmp_path / "limits.png", limits=(0, 4))
    assert np.array(Image.open(tmp_path / "limits.png")).tolist() == [[0, 191]]


@pytest.mark.parametrize(
    ("what", "name", "options", "message"),
    [
        (torch.zeros(2, 3), "map.jpg", {}, "must end in .png, .exr or .npy"),
        (torch.zeros(2, 3, 4), "map.png", {}, r"not \(2, 3, 4\)"),
        (torch.zeros(2, 3), "map.png", {"signed": True}, "signed: only for an attribution"),
        (torch.zeros(2, 3), "map.png", {"colours": "viridiss"}, "Did you mean 'viridis'"),
        (torch.zeros(2, 3), "map.png", {"limits": (1, 1)}, "limits must be two numbers"),
        (torch.zeros(2, 3), "nowhere/map.npy", {}, "cannot be written: create its folder .*nowhere"),
    ],
)
def test_invalid_exports_are_refused(
    tmp_path: Path, what: torch.Tensor, name: str, options: dict[str, Any], message: str
):
    with pytest.raises(SceneCaptumError, match=message):
        export(what, tmp_path / name, **options)


def test_names_are_hashed_as_cryptomatte_does():
    # From the specification, and from MurmurHash3's reference implementation.
    known = {
        "bunny": 0x13851A76,
        "default": 0x42C9679F,
        "hello": 0x248BFA47,
        "": 0,
        "hello, world": 0x149BBB7F,
    }
    assert {name: murmur3(name) for name in known} == known
    floats = np.array([identifier(f"object {n}") for n in range(3000)] + [identifier("")], np.uint32)
    assert len(set(floats.tolist())) == 3001
    values = floats.view(np.float32)
    assert np.isfinite(values).all()
    assert (np.abs(values) >= np.finfo(np.float32).tiny).all()


def test_an_exported_cryptomatte_can_be_decoded(mi: Any, tmp_path: Path):
    result = dataclasses.replace(attribution((("a",), ("b",), ()), a=2.0, b=-1.0), image=torch.rand(1, 2, 3))
    surfaces = dataclasses.replace(
        result.surfaces,
        pixel=np.array([0, 0, 1, 1], np.int32),
        object_index=np.array([0, 1, 0, 2], np.int32),
        fraction=np.array([0.25, 0.75, 0.5, 0.5], np.float32),
    )
    result = dataclasses.replace(result, surfaces=surfaces)
    export(result, tmp_path / "map.exr")
    bitmap = read_bitmap(tmp_path / "map.exr")
    names = [field.name for field in bitmap.struct_()]
    planes = dict(zip(names, np.moveaxis(np.array(bitmap), -1, 0), strict=True))
    np.testing.assert_array_equal(planes["saliency"], heatmap(result))
    np.testing.assert_array_equal(np.stack([planes[c] for c in "RGB"], -1), result.image)

    metadata = bitmap.metadata()
    (key,) = {k.split("/")[1] for k in metadata.keys() if k.startswith("cryptomatte/")}  # noqa: SIM118
    assert key == f"{murmur3('CryptoObject'):08x}"[:7]
    assert metadata[f"cryptomatte/{key}/hash"] == "MurmurHash3_32"
    assert metadata[f"cryptomatte/{key}/conversion"] == "uint32_to_float32"
    manifest = json.loads(metadata[f"cryptomatte/{key}/manifest"])
    assert manifest.keys() == {"object_0", "object_1"}  # the last is the background
    name_of = {np.uint32(int(bits, 16)).view(np.float32): name for name, bits in manifest.items()}
    layer = metadata[f"cryptomatte/{key}/name"]
    ranks = [(planes[f"{layer}00.{i}"][0], planes[f"{layer}00.{c}"][0]) for i, c in ("RG", "BA")]
    decoded = [[(name_of.get(ids[pixel]), cover[pixel]) for ids, cover in ranks] for pixel in (0, 1)]
    assert decoded == [[("object_1", 0.75), ("object_0", 0.25)], [("object_0", 0.5), (None, 0.0)]]


def test_an_exr_file_is_written_with_a_single_thread(tmp_path: Path):
    code = """
        import sys
        from pathlib import Path
        import torch
        from scenecaptum import projection
        from scenecaptum.backend import use_threads
        use_threads(1)
        projection.export(torch.ones(4, 4), Path(sys.argv[1]))
    """
    command = [sys.executable, "-c", textwrap.dedent(code), str(tmp_path / "map.exr")]
    subprocess.run(command, check=True, timeout=60)
    assert (tmp_path / "map.exr").is_file()


def test_a_map_without_objects_is_an_exr_of_one_channel(mi: Any, tmp_path: Path):
    values = torch.rand(3, 4) * 1000 - 500
    export(values, tmp_path / "map.exr")
    np.testing.assert_array_equal(np.array(read_bitmap(tmp_path / "map.exr")).squeeze(), values)
