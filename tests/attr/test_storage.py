"""Files of results with large textures: what is exact, what is rounded, and that every figure is the same."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from scenecaptum import SceneAttribution
from scenecaptum.attr._data import covariances
from scenecaptum.attr._texel_blocks import MAX_BLOCKS, MAX_EXACT_TEXELS
from scenecaptum.projection import SurfaceMap, TexelMap

HEIGHT, WIDTH = 12, 20  # of the picture
SHAPES = {"small": (16, 16, 3), "wall": (300, 401, 3), "mesh": (40_000, 3), "gloss": (), "lamp": (3,)}
TEXTURES = ("small", "wall", "mesh")


def sparse(shape: tuple[int, ...], generator: torch.Generator) -> torch.Tensor:
    """Return values of very different magnitudes, many of them 0, as few paths leave them."""
    size = torch.exp(2 * torch.randn(shape, generator=generator))
    return size * torch.randn(shape, generator=generator) * (torch.rand(shape, generator=generator) < 0.3)


def texel_map(rows: int, rng: np.random.Generator) -> TexelMap:
    """Let each pixel show four random texels."""
    entry = np.repeat(np.arange(HEIGHT * WIDTH), 4)
    return TexelMap(
        entry=entry.astype(np.int32),
        texel=rng.integers(0, rows, len(entry)).astype(np.int32),
        weight=rng.uniform(0.5, 2.0, len(entry)).astype(np.float32),
    )


def make(seed: int = 0) -> SceneAttribution:
    generator, rng = torch.Generator().manual_seed(seed), np.random.default_rng(7)
    values = {name: sparse(shape, generator) for name, shape in SHAPES.items()}
    values["gloss"], values["lamp"] = torch.tensor(0.5), torch.tensor([0.1, -0.2, 40.0])
    channels = {name: math.prod(shape[-1:]) for name, shape in SHAPES.items()}
    replicates = {name: torch.randn(8, count, generator=generator) for name, count in channels.items()}
    pixels = HEIGHT * WIDTH
    surfaces = SurfaceMap(
        shape=(HEIGHT, WIDTH),
        pixel=np.arange(pixels, dtype=np.int32),
        object_index=rng.integers(0, 3, pixels).astype(np.int32),
        fraction=np.ones(pixels, np.float32),
        objects=("room", "desk", "background"),
        parameters=(("wall", "small"), ("mesh", "gloss"), ("lamp",)),
        texels={name: texel_map(math.prod(SHAPES[name][:-1]), rng) for name in TEXTURES},
    )
    return SceneAttribution(
        attributions=values,
        standard_error={name: 0.3 * value.abs() for name, value in values.items()},
        metric_value=1.0,
        metric_standard_error=0.1,
        bias={name: 0.01 * value for name, value in values.items()},
        replicates=replicates,
        covariance=covariances(replicates, None),
        image=torch.rand((HEIGHT, WIDTH, 3), generator=generator),
        surfaces=surfaces,
        info={"replicates": 8, "seed": seed, "metric": "mean"},
    )


@pytest.fixture(scope="module")
def original() -> SceneAttribution:
    return make()


@pytest.fixture(scope="module")
def loaded(original, tmp_path_factory) -> SceneAttribution:
    path = tmp_path_factory.mktemp("storage") / "result.npz"
    original.save(path)
    return SceneAttribution.load(path)


def visible(result: SceneAttribution, name: str) -> np.ndarray:
    return np.unique(result.surfaces.texels[name].texel)


def rows(tensor: torch.Tensor) -> np.ndarray:
    return tensor.reshape(-1, tensor.shape[-1]).numpy()


def test_the_specimen_has_a_texture_on_either_side_of_the_limit():
    assert math.prod(SHAPES["small"][:-1]) < MAX_EXACT_TEXELS < math.prod(SHAPES["mesh"][:-1])
    assert sum(math.prod(SHAPES[name][:-1]) for name in ("wall", "mesh")) > MAX_BLOCKS


@pytest.mark.parametrize("name", ["small", "gloss", "lamp"])
@pytest.mark.parametrize("field", ["attributions", "standard_error", "bias", "replicates", "covariance"])
def test_small_parameters_are_exact(original, loaded, field, name):
    assert torch.equal(getattr(loaded, field)[name], getattr(original, field)[name])


@pytest.mark.parametrize("name", ["wall", "mesh"])
def test_the_visible_texels_of_large_textures_are_exact(original, loaded, name):
    seen = visible(original, name)
    np.testing.assert_array_equal(rows(loaded[name])[seen], rows(original[name])[seen])
    np.testing.assert_allclose(
        rows(loaded.standard_error[name])[seen], rows(original.standard_error[name])[seen], rtol=2**-8
    )


@pytest.mark.parametrize("name", ["wall", "mesh"])
def test_hidden_texels_are_means_whose_errors_cover_the_distance_to_the_values(original, loaded, name):
    hidden = np.ones(len(rows(original[name])), bool)
    hidden[visible(original, name)] = False
    values, means = (rows(result[name])[hidden].astype(np.float64) for result in (original, loaded))
    assert len(np.unique(means, axis=0)) < len(means) / 4
    np.testing.assert_allclose(means.sum(0), values.sum(0), rtol=1e-6, atol=1e-6 * np.abs(values).sum())
    squares = rows(original.standard_error[name])[hidden] ** 2 + (values - means) ** 2
    expected = np.sqrt(squares.mean(0))
    found = np.sqrt((rows(loaded.standard_error[name])[hidden].astype(np.float64) ** 2).mean(0))
    np.testing.assert_allclose(found, expected, rtol=2**-7)


@pytest.mark.parametrize("texels", [False, True])
@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("norm", ["sqrt", "linear", "log"])
@pytest.mark.parametrize("parameter", [None, "wall"])
def test_maps_are_the_same(original, loaded, texels, signed, norm, parameter):
    options = {"texels": texels, "signed": signed, "norm": norm, "parameter": parameter}
    torch.testing.assert_close(loaded.heatmap(**options), original.heatmap(**options), rtol=0, atol=1e-6)


def test_the_ranking_and_the_table_are_the_same(original, loaded):
    pairs = list(zip(loaded.ranking(), original.ranking(), strict=True))
    assert [a.name for a, _ in pairs] == [b.name for _, b in pairs]
    for a, b in pairs:
        assert a.saliency == pytest.approx(b.saliency, rel=2e-6)
        assert a.total == pytest.approx(b.total, rel=2e-6, abs=2e-6 * b.saliency)
        assert a.total_error == b.total_error
    assert str(loaded) == str(original)


def test_a_difference_of_loaded_results_has_the_same_map(original, loaded, tmp_path):
    other = make(1)
    other.save(tmp_path / "other.npz")
    difference = loaded - SceneAttribution.load(tmp_path / "other.npz")
    expected = (original - other).heatmap(texels=True, signed=True)
    torch.testing.assert_close(difference.heatmap(texels=True, signed=True), expected, rtol=0, atol=1e-6)


def test_a_loaded_result_is_saved_again_without_further_loss(loaded, tmp_path):
    loaded.save(tmp_path / "again.npz")
    again = SceneAttribution.load(tmp_path / "again.npz")
    for name in loaded:
        assert torch.equal(again[name], loaded[name])
        assert torch.equal(again.standard_error[name], loaded.standard_error[name])


def test_exact_texels_are_stored_on_request(original, tmp_path):
    original.save(tmp_path / "exact.npz", exact_texels=True)
    original.save(tmp_path / "compact.npz")
    exact = SceneAttribution.load(tmp_path / "exact.npz")
    assert all(torch.equal(exact[name], original[name]) for name in original)
    assert all(torch.equal(exact.standard_error[name], original.standard_error[name]) for name in original)
    sizes = [(tmp_path / f"{name}.npz").stat().st_size for name in ("compact", "exact")]
    assert 3 * sizes[0] < sizes[1]


def test_texels_are_exact_where_it_is_not_known_which_ones_a_pixel_shows(original, tmp_path):
    bare = dataclasses.replace(original, surfaces=dataclasses.replace(original.surfaces, texels={}))
    for index, result in enumerate((bare, dataclasses.replace(original, surfaces=None))):
        result.save(tmp_path / f"{index}.npz")
        found = SceneAttribution.load(tmp_path / f"{index}.npz")
        assert all(torch.equal(found[name], original[name]) for name in original)
