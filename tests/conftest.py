"""Renderers and scenes that several test files share, so that their kernels are compiled once per process."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import matplotlib  # noqa: F401 -- first imported by a page that runs in docs/, it would keep the style of docs/
import numpy as np
import pytest
import torch
from quick_llvm import use_quick_llvm
from rooms import large_scenes
from seeds import OFFSET, shift_defaults, shifted

# At the end: tests/extremes comes before benchmarks/extremes.py.
sys.path.append(str(Path(__file__).resolve().parents[1] / "benchmarks"))

# Tests run in three processes: more threads in each only wait for each other. Two of OpenMP on two busy cores took
# up to 30 times as long as one. Commands and notebooks inherit the variable.
os.environ["OMP_NUM_THREADS"] = "1"
# Tests render on the CPU, on every machine: a GPU has tests of its own, in backend/test_cuda.py.
os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")
torch.set_num_threads(1)

# The package is imported inside the fixtures, so that an error in one subpackage fails only the tests of that one.


_SEEDS = f"seeds: offset {OFFSET} (SCENECAPTUM_TEST_SEED)"
_LLVM = pytest.StashKey[str]()


def pytest_configure(config: pytest.Config) -> None:
    """Compile kernels quickly, but for the long tests: they measure what users run.

    The processes of xdist inherit the choice.
    """
    if hasattr(config, "workerinput") or config.option.markexpr == "long":
        return
    with contextlib.suppress(Exception):  # fails in each test that renders
        config.stash[_LLVM] = use_quick_llvm(config.cache.mkdir("kernels"))


def pytest_report_header(config: pytest.Config) -> list[str]:
    return [_SEEDS, f"kernels: compiled {config.stash.get(_LLVM, 'as installed')}"]


def pytest_terminal_summary(terminalreporter: Any) -> None:
    if terminalreporter.verbosity < 0:  # then there was no header
        for line in pytest_report_header(terminalreporter.config):
            terminalreporter.write_line(line)


@pytest.fixture(scope="session", autouse=True)
def own_seeds() -> None:
    """Shift the library's default seeds."""
    if OFFSET:
        shift_defaults()


@pytest.fixture(autouse=True)
def one_thread() -> None:
    """Give Dr.Jit one thread, also after a test of several.

    With two on two cores, three busy processes took 2.7 times as long: threads without work wait by spinning.
    """
    with contextlib.suppress(Exception):  # fails in each test that renders
        from scenecaptum.backend import use_threads

        use_threads(1)


@pytest.fixture(autouse=True)
def global_generators() -> None:
    """Seed the global generators, so that no test depends on those that ran before it."""
    torch.manual_seed(shifted())
    np.random.seed(shifted())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Generator[None, Any, Any]:
    """Free the scenes of a file when its last test has ended.

    Dr.Jit compiles the objects of all scenes in the process into each kernel, and renderers are in cycles. After
    each test this would take longer than it saves.
    """
    result = yield
    if nextitem is None or nextitem.path != item.path:
        gc.collect()
    return result


@pytest.fixture(scope="session")
def mi() -> Any:
    from scenecaptum.backend import activate

    return activate()


@pytest.fixture(scope="session")
def cornell(mi: Any) -> Any:
    """All surfaces are diffuse: path replay is exact there, and an image is linear in the light."""
    from scenecaptum.rendering import SceneRenderer

    return SceneRenderer(
        "cornell-box", inputs=["reflectance", "emitters"], resolution=(32, 32), spp=16, max_depth=4
    )


@pytest.fixture(scope="session")
def stage_dict(mi: Any) -> dict[str, Any]:
    """Plugins that derive their own arrays from a parameter: a rough plastic, a bitmap, an environment map."""
    rng = np.random.default_rng(shifted(5))
    texels = rng.uniform(0.2, 0.8, (4, 6, 3)).astype(np.float32)
    sky = rng.uniform(0.5, 1.5, (4, 8, 3)).astype(np.float32)
    transform = mi.ScalarTransform4f
    return {
        "type": "scene",
        "integrator": {"type": "prb", "max_depth": 3},
        "camera": {
            "type": "perspective",
            "fov": 45,
            "to_world": transform().look_at(origin=[0, -4, 1.5], target=[0, 0, 0], up=[0, 0, 1]),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": 16},
        },
        "ball": {
            "type": "sphere",
            "bsdf": {
                "type": "roughplastic",
                "alpha": 0.25,
                "diffuse_reflectance": {"type": "rgb", "value": [0.3, 0.4, 0.5]},
            },
        },
        "ground": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, -1]).scale(3),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True},
            },
        },
        "sky": {"type": "envmap", "bitmap": mi.Bitmap(sky)},
    }


@pytest.fixture(scope="session")
def stage(stage_dict: dict[str, Any]) -> Any:
    from scenecaptum.rendering import SceneRenderer

    return SceneRenderer(stage_dict, inputs="all")


@pytest.fixture(scope="session")
def shared_scenes() -> Path:
    """Scenes too big for the repository: $SCENECAPTUM_SCENES, or shared/scenes beside the repository."""
    folder = large_scenes()
    if not folder.is_dir():
        pytest.skip(f"no large scenes: {folder} does not exist (set SCENECAPTUM_SCENES)")
    return folder


@pytest.fixture(scope="session")
def torchvision() -> Any:
    """torchvision, also where its CUDA wheel stands beside a CPU-only torch."""
    import _torchvision

    try:
        return _torchvision.load()
    except ModuleNotFoundError as error:
        pytest.skip(f"torchvision is not installed: {error}")
