"""Growth of memory over 500 attributions by one renderer, and over new renderers."""

from __future__ import annotations

import gc
import subprocess
import sys
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from seeds import shifted

from scenecaptum import VanillaSceneGradient, metrics

from .scenes import small_box

MEBIBYTE = 2**20

# In a separate process, so that the memory of other tests has no effect.
GROWTH = """
import sys
import torch
from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics

torch.set_num_threads(1)

def resident():
    return int(open("/proc/self/statm").read().split()[1]) * 4096

def box():
    return SceneRenderer("cornell-box", ["reflectance", "emitters"], resolution=(8, 8), spp=4, max_depth=3)

how, count, first, seed = sys.argv[1], *map(int, sys.argv[2:])
renderer = box()
for number in range(1, count + 1):
    if how == "new renderers":
        renderer = box()
    VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=seed + number, replicates=2)
    if number == first:
        start = resident()
print(resident() - start, start)
"""


def growth(how: str, count: int, first: int) -> float:
    """Return by how many MiB resident memory grows from the ``first`` to the last of ``count`` attributions."""
    command = [sys.executable, "-c", GROWTH, how, str(count), str(first), str(shifted())]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    grown, start = (int(number) / MEBIBYTE for number in ran.stdout.split())
    print(f"{count} attributions, {how}: {start:.0f} MiB after {first}, {grown:+.1f} MiB since")
    return grown


needs_proc = pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc"
)


@pytest.mark.long
@needs_proc
def test_five_hundred_attributions_leave_nothing_behind(mi: Any) -> None:
    assert growth("the same renderer", 500, 50) < 20


@pytest.mark.long
@needs_proc
def test_new_renderers_leave_nothing_behind(mi: Any) -> None:
    assert growth("new renderers", 150, 50) < 20


def test_a_renderer_is_freed_with_its_last_reference(mi: Any) -> None:
    """If scenes waited for the garbage collector, they would accumulate, and every kernel includes them all."""
    gc.collect()
    gc.disable()
    try:
        renderer = small_box()
        VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(replicates=2)
        gone = [
            weakref.ref(one)
            for one in (renderer, renderer._views[0].engine, renderer._state, renderer._graph)
        ]
        del renderer
        assert [one() for one in gone] == [None] * 4
    finally:
        gc.enable()


def test_a_graph_outlives_its_renderer(mi: Any) -> None:
    leaves = small_box().leaves()
    metric = small_box()(leaves, seed=shifted(1), seed_grad=shifted(2)).mean()
    metric.backward()
    assert leaves["floor.reflectance.value"].grad is not None


def test_renderers_may_be_freed_in_any_thread_while_others_render(mi: Any) -> None:
    """Freeing a scene while a kernel is being recorded would end the process: it has to wait."""

    def work(seed: int) -> float:
        return float(small_box()(seed=shifted(seed % 2)).mean())

    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(work, range(16)))
    assert found == [found[0], found[1]] * 8
