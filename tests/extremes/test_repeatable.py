"""The same seed gives the same result: again, after anything else, on any number of threads, in any process.

On one thread images repeat bit by bit. Threads add samples in an order that no seed fixes: images and gradients
repeat to about 1e-6 of their size; 1e-5 is guaranteed.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from rooms import room
from seeds import shifted

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics

PROMISED = 1e-5
SEED = shifted(11)

Tensors = dict[str, torch.Tensor]


def make(scene: str) -> SceneRenderer:
    # In the office there are principled materials, metals and a mirror, some of them left to finite differences.
    size = {"office": (24, 14), "cornell-box": (16, 16)}[scene]
    return SceneRenderer(
        scene, "all" if scene == "cornell-box" else "materials", resolution=size, spp=8, max_depth=3
    )


def picture_and_gradients(renderer: SceneRenderer) -> tuple[torch.Tensor, Tensors, Tensors]:
    """Return an image, the gradients of the same samples, and those with importance-sampled pixels."""

    def gradients(seed_grad: int | None) -> Tensors:
        leaves = renderer.leaves()
        metrics.MeanLuminance()(renderer(leaves, seed=SEED, seed_grad=seed_grad)).backward()
        return {name: leaf.grad.clone() for name, leaf in leaves.items() if leaf.grad is not None}

    return renderer(seed=SEED), gradients(None), gradients(SEED + 1)


def in_a_process_of_its_own(scene: str, threads: int) -> tuple[torch.Tensor, Tensors, Tensors]:
    import scenecaptum

    scenecaptum.activate()
    import drjit as dr

    dr.set_thread_count(threads)
    return picture_and_gradients(make(scene))


def assert_same(
    found: tuple[torch.Tensor, Tensors, Tensors],
    expected: tuple[torch.Tensor, Tensors, Tensors],
    *,
    picture: float = 0.0,
) -> None:
    """Compare images to a relative precision, by default bit by bit, and gradients to the guaranteed one."""
    torch.testing.assert_close(found[0], expected[0], rtol=picture, atol=0.0)
    for gradients, reference in zip(found[1:], expected[1:], strict=True):
        # A sum that cancels is small beside its terms; the largest gradient shows their size.
        largest = max(one.norm() for one in reference.values())
        for name, one in reference.items():
            off = float((gradients[name] - one).norm() / (one.norm() + PROMISED * largest))
            assert off < PROMISED, f"{name}: {off:.1e} of its size away, {PROMISED:.0e} is promised"


@contextmanager
def threads(count: int) -> Iterator[None]:
    import drjit as dr

    before = dr.thread_count()
    dr.set_thread_count(count)
    try:
        yield
    finally:
        dr.set_thread_count(before)


@pytest.fixture(scope="module")
def expected(mi: Any) -> tuple[torch.Tensor, Tensors, Tensors]:
    return picture_and_gradients(make("cornell-box"))


@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.long), 4])
def test_on_any_number_of_threads(expected: Any, count: int) -> None:
    with threads(count):
        found = picture_and_gradients(make("cornell-box"))
    assert_same(found, expected, picture=PROMISED if count > 1 else 0.0)


def test_whatever_was_rendered_before(expected: Any) -> None:
    """A renderer that was first used in a dark room once sampled other pixels ever after: 20 % off."""
    used = make("cornell-box")
    dark = {
        name: (value * 0.02).requires_grad_() if name.endswith("reflectance.value") else value
        for name, value in used.inputs.items()
    }
    used(dark, seed=shifted(3), seed_grad=shifted(4)).mean().backward()
    assert_same(picture_and_gradients(used), expected)


def test_whatever_the_user_did_to_the_scene_before(mi: Any) -> None:
    """A shared scene is rendered in its present state, as by a new renderer."""
    scene = mi.load_dict(mi.cornell_box(), optimize=False)
    params = mi.traverse(scene)

    def borrowed() -> SceneRenderer:
        return SceneRenderer(scene, "reflectance", resolution=(12, 12), spp=8, max_depth=3)

    used = borrowed()
    own = picture_and_gradients(used)
    params["white.reflectance.value"] = mi.Color3f(0.05)
    params.update()
    darker = picture_and_gradients(borrowed())
    # Its film spreads samples over several pixels (a Gaussian), whose sums depend on their order.
    assert_same(picture_and_gradients(used), darker, picture=PROMISED)
    assert not torch.allclose(darker[0], own[0], rtol=0.01)


def test_the_first_call_of_a_renderer_is_like_later_ones(mi: Any) -> None:
    """Finite differences move a principled material away from its values and back, which must have no effect."""
    lacquer = {"type": "principled", "roughness": 0.4, "specular": 0.5, "clearcoat": 0.0, "metallic": 0.0}
    renderer = SceneRenderer(room(mi, lacquer), "materials", spp=8, max_depth=3)
    assert "finite difference" in str(renderer.plan)
    first = picture_and_gradients(renderer)
    assert_same(picture_and_gradients(renderer), first)


def test_a_whole_attribution_repeats(mi: Any) -> None:
    method = VanillaSceneGradient(make("cornell-box"), metrics.MeanLuminance())
    first, second = (method.attribute(seed=shifted(5), replicates=4) for _ in range(2))
    assert first.image is not None
    assert second.image is not None
    assert torch.equal(first.image, second.image)
    assert first.metric_value == second.metric_value
    largest = max(value.norm() for value in first.values())
    for name, value in first.items():
        off = float((second[name] - value).norm() / (value.norm() + PROMISED * largest))
        assert off < PROMISED, f"{name}: {off:.1e}"


@pytest.mark.long
@pytest.mark.parametrize("scene", ["cornell-box", "office"])
@pytest.mark.parametrize("count", [2, 4])
def test_in_a_fresh_process(mi: Any, scene: str, count: int) -> None:
    renderer = make(scene)
    picture_and_gradients(renderer)
    used = picture_and_gradients(renderer)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        found = pool.submit(in_a_process_of_its_own, scene, count).result()
    assert_same(found, used, picture=PROMISED)
