"""Threads, worker processes, forks, other variants, and the user's own rendering in between."""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import subprocess
import sys
import warnings
import weakref
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, wait
from multiprocessing.connection import Connection
from typing import Any

import pytest
import torch
from seeds import shifted

from scenecaptum import SceneCaptumError, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.backend import exclusively
from scenecaptum.scene import SceneGraph

from .scenes import small_box

FLOOR = "floor.reflectance.value"
PATIENCE = 100.0  # seconds, after which a process counts as hanging

# Atomic additions happen in varying order: a gradient repeats to about 1e-6 of its size.
SAME = {"rtol": 2e-5, "atol": 1e-9}


def attribution_of(seed: int) -> dict[str, torch.Tensor]:
    """Load, attribute, and return plain tensors: the task of a worker process."""
    torch.set_num_threads(1)
    found = VanillaSceneGradient(small_box(), metrics.MeanLuminance()).attribute(
        seed=shifted(seed), replicates=2
    )
    return dict(found)


def assert_same(found: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert list(found) == list(expected)
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, **SAME)


@pytest.fixture(scope="module")
def expected(mi: Any) -> list[dict[str, torch.Tensor]]:
    return [attribution_of(seed) for seed in range(3)]


# --- Threads --------------------------------------------------------------------------------------


def test_attributions_from_several_threads_are_those_of_one(expected: list[Any]) -> None:
    # Each loads a scene as well, because loading writes to state that the whole process shares.
    with ThreadPoolExecutor(3) as pool:
        for found, one in zip(pool.map(attribution_of, range(3)), expected, strict=True):
            assert_same(found, one)


def test_threads_may_share_a_renderer(expected: list[Any]) -> None:
    method = VanillaSceneGradient(small_box(), metrics.MeanLuminance())
    with ThreadPoolExecutor(3) as pool:
        runs = pool.map(lambda seed: dict(method.attribute(seed=shifted(seed), replicates=2)), range(3))
        for found, one in zip(runs, expected, strict=True):
            assert_same(found, one)


def variables() -> int:
    """Return how many variables Dr.Jit has, of all scenes."""
    import drjit as dr

    return len(dr.whos(as_string=True).splitlines())


def test_results_are_not_in_dr_jits_memory(mi: Any) -> None:
    """Whoever drops them last would free Dr.Jit's arrays while another thread renders, and both would hang."""
    renderer = small_box()
    leaves = renderer.leaves()
    image = renderer(leaves, seed=shifted())
    gradients = torch.autograd.grad(image.mean(), list(leaves.values()))
    gc.collect()  # of what earlier tests have left
    before = variables()
    del image, gradients
    assert variables() == before


@contextlib.contextmanager
def another_thread_renders() -> Iterator[Callable[[], int]]:
    """Let another thread hold the lock, and yield a function that asks it for the number of variables."""
    with ThreadPoolExecutor(1) as pool:
        lock = contextlib.ExitStack()
        pool.submit(lock.enter_context, exclusively()).result(PATIENCE)
        try:
            yield lambda: pool.submit(variables).result(PATIENCE)
        finally:
            pool.submit(lock.close).result(PATIENCE)


def test_a_renderer_is_freed_when_no_other_thread_renders(mi: Any) -> None:
    renderer = small_box()
    renderer(renderer.leaves(), seed=shifted()).mean().backward()
    gc.collect()
    with another_thread_renders() as count:
        before = count()
        del renderer
        assert count() == before
    gc.collect()  # frozen functions are cycles
    assert variables() < before


def test_garbage_is_collected_when_no_other_thread_renders(mi: Any) -> None:
    with ThreadPoolExecutor(1) as collector:
        with another_thread_renders():
            collected = collector.submit(gc.collect)
            assert not wait([collected], timeout=0.5).done
        collected.result(PATIENCE)


RENDERING_AT_EXIT = """
import threading
from scenecaptum.backend import exclusively

def render_forever(started):
    with exclusively():
        started.set()
        threading.Event().wait()

started = threading.Event()
threading.Thread(target=render_forever, args=[started], daemon=True).start()
started.wait()
"""


def test_python_ends_although_a_thread_renders() -> None:
    """It collects garbage at the end, when that thread does not run any more."""
    subprocess.run([sys.executable, "-c", RENDERING_AT_EXIT], check=True, timeout=PATIENCE)


def test_a_refused_scene_is_freed_before_its_error_is_handled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Freed later, it might go while another thread renders, whose kernels reach every live object."""
    loaded: list[weakref.ref[Any]] = []
    construct = SceneGraph.__init__

    def watched(graph: SceneGraph, scene: Any) -> None:
        construct(graph, scene)
        loaded.append(weakref.ref(graph))

    monkeypatch.setattr(SceneGraph, "__init__", watched)
    with pytest.raises(SceneCaptumError, match=r"nothing\.such") as caught:
        SceneRenderer("cornell-box", "nothing.such")
    assert caught.value.__traceback__ is not None, "it holds the frames in which the scene was loaded"
    assert [one() for one in loaded] == [None]


# --- Processes ------------------------------------------------------------------------------------


class Attributions(torch.utils.data.Dataset[Any]):
    """A dataset for a DataLoader: each item is the attribution of a seed."""

    def __len__(self) -> int:
        return 1

    def __getitem__(self, seed: int) -> dict[str, torch.Tensor]:
        return attribution_of(seed)


@pytest.mark.long
def test_a_pool_of_spawned_processes_agrees(expected: list[Any]) -> None:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert_same(pool.submit(attribution_of, 1).result(PATIENCE), expected[1])


def test_a_data_loader_with_spawned_workers_agrees(expected: list[Any]) -> None:
    loader = torch.utils.data.DataLoader(
        Attributions(),
        batch_size=None,
        num_workers=1,
        multiprocessing_context="spawn",
        timeout=PATIENCE,
    )
    for found, one in zip(loader, expected[:1], strict=True):
        assert_same(found, one)


FORKS = [
    pytest.param(lambda renderer: renderer(seed=shifted()), id="render"),
    pytest.param(lambda _: attribution_of(0), id="load"),
    pytest.param(lambda renderer: renderer.surfaces, id="surfaces"),
    pytest.param(lambda renderer: renderer.replace(max_depth=2), id="replace"),
]


def in_a_fork(call: Any) -> str:
    """Call a function in a forked process, and return the message of what it raises."""

    def child(connection: Connection) -> None:
        try:
            call()
            connection.send("nothing was raised")
        except SceneCaptumError as error:
            connection.send(str(error))

    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    process = context.Process(target=child, args=(there,), daemon=True)
    process.start()
    try:
        said: str = here.recv() if here.poll(PATIENCE) else "it hangs"
        return said
    finally:
        process.kill()
        process.join()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.parametrize("call", FORKS)
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_forked_process_is_refused_instead_of_hanging(expected: list[Any], call: Any) -> None:
    renderer = small_box()
    renderer(renderer.leaves(), seed=shifted()).mean().backward()  # now Dr.Jit has threads
    said = in_a_fork(lambda: call(renderer))
    assert "forked" in said, said
    assert "spawn" in said
    renderer(seed=shifted())  # the parent still works


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_backward_pass_across_a_fork_is_refused(expected: list[Any]) -> None:
    renderer = small_box()
    metric = renderer(renderer.leaves(), seed=shifted()).mean()
    assert "forked" in in_a_fork(metric.backward)


FORKED_BEFORE = """
import os, sys
import scenecaptum
child = os.fork()
if child:
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
renderer = scenecaptum.SceneRenderer("cornell-box", resolution=(4, 4), spp=1, max_depth=2)
renderer(renderer.leaves()).mean().backward()
os._exit(7)
"""


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
def test_a_fork_before_mitsuba_is_ready_may_render(mi: Any) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", FORKED_BEFORE], capture_output=True, text=True, check=False, timeout=PATIENCE
    )
    assert ran.returncode == 7, ran.stderr[-400:]


# --- Other variants -------------------------------------------------------------------------------


@pytest.fixture
def scalar(mi: Any) -> Any:
    """The user's own code has set a variant without derivatives."""
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    yield mi
    mi.set_variant(before)


def test_the_users_variant_is_restored(scalar: Any, expected: list[Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it is RGB, too: nothing to say
        assert_same(attribution_of(0), expected[0])
    assert scalar.variant() == "scalar_rgb"


def test_plugins_registered_under_another_variant_are_found_later() -> None:
    """In a separate process, because a module is imported, and its plugin registered, only once."""
    code = (
        "import scenecaptum as sc\n"
        "mi = sc.activate()\n"
        "renderer = sc.SceneRenderer('cornell-box', resolution=(8, 8), spp=1)\n"
        "mi.set_variant('scalar_rgb')\n"
        "renderer.camera\n"
        "print(sc.SceneRenderer('cornell-box', sensor='fisheye', resolution=(8, 8), spp=1)().shape)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "torch.Size([8, 8, 3])", run.stderr


def test_a_renderer_keeps_its_variant_whatever_is_set_later(
    mi: Any, scalar: Any, expected: list[Any]
) -> None:
    mi.set_variant("llvm_ad_rgb")
    renderer = small_box()
    graph = renderer(leaves := renderer.leaves(), seed=shifted(3)).mean()
    alone = torch.autograd.grad(graph, leaves[FLOOR], retain_graph=True)[0]
    mi.set_variant("scalar_rgb")
    torch.testing.assert_close(torch.autograd.grad(graph, leaves[FLOOR])[0], alone, **SAME)
    found = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=shifted(1), replicates=2)
    assert_same(dict(found), expected[1])
    found.heatmap()
    assert renderer.camera.width == 8
    assert renderer.replace(max_depth=2)(seed=shifted()).isfinite().all()
    assert found.info["variant"] == "llvm_ad_rgb"
    assert mi.variant() == "scalar_rgb"


def test_the_users_variant_is_restored_after_an_error(scalar: Any) -> None:
    with pytest.raises(SceneCaptumError):
        SceneRenderer("cornell-box", "no such input")
    assert scalar.variant() == "scalar_rgb"


def test_a_scene_of_a_variant_without_derivatives_is_refused_by_name(scalar: Any) -> None:
    scene = scalar.load_dict(scalar.cornell_box())
    with pytest.raises(SceneCaptumError, match="scalar_rgb"):
        SceneRenderer(scene)
    assert scalar.variant() == "scalar_rgb"


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_colour_modes_are_replaced_or_refused(mi: Any, variant: str, expected: list[Any]) -> None:
    before = mi.variant()
    mi.set_variant(variant)
    try:
        with pytest.warns(
            UserWarning, match=f"variant {variant} is active, but a SceneRenderer renders in RGB"
        ):
            assert_same(attribution_of(0), expected[0])
        with pytest.raises(SceneCaptumError, match=f"loaded under {variant}"):
            SceneRenderer(mi.load_dict(mi.cornell_box()))
        assert mi.variant() == variant
    finally:
        mi.set_variant(before)


# --- The user's own rendering ---------------------------------------------------------------------


def test_the_users_own_rendering_and_ours_do_not_interfere(mi: Any) -> None:
    """The user's image, parameters and gradients stay the same, and so does the attribution."""
    import drjit as dr

    box = mi.cornell_box()
    box["sensor"]["film"] |= {"width": 12, "height": 12}
    box["integrator"] = {"type": "prb", "max_depth": 3}
    scene = mi.load_dict(box, optimize=False)
    params = mi.traverse(scene)
    key = "white.reflectance.value"

    def users_picture() -> torch.Tensor:
        picture: torch.Tensor = mi.render(scene, spp=4, seed=shifted(5)).torch()
        return picture

    def users_gradient() -> float:
        value = mi.Color3f(params[key])
        dr.enable_grad(value)
        params[key] = value
        params.update()
        dr.backward(dr.mean(mi.render(scene, params, spp=4, seed=shifted(5)), axis=None))
        gradient = float(dr.sum(dr.grad(value))[0])
        params[key] = dr.detach(value)
        params.update()
        return gradient

    picture, gradient = users_picture(), users_gradient()
    renderer = SceneRenderer(scene, "reflectance", resolution=(8, 8), spp=4, max_depth=3)
    method = VanillaSceneGradient(renderer, metrics.MeanLuminance())
    undisturbed = method.attribute(seed=shifted(), replicates=2)
    torch.testing.assert_close(users_picture(), picture, **SAME)
    pending = renderer(renderer.leaves(), seed=shifted(4)).mean()  # a graph of ours is pending meanwhile
    assert users_gradient() == pytest.approx(gradient, rel=1e-4)
    pending.backward()
    assert_same(dict(method.attribute(seed=shifted(), replicates=2)), dict(undisturbed))
    assert tuple(scene.sensors()[0].film().crop_size()) == (12, 12)

    params[key] = mi.Color3f(0.2)
    params.update()
    darker = method.attribute(seed=shifted(), replicates=2)
    assert darker.metric_value < undisturbed.metric_value
    torch.testing.assert_close(darker.parameter_values[key], torch.full((3,), 0.2))
