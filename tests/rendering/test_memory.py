"""The memory of a job is predicted, and a job that does not fit is refused with settings that do."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from seeds import shifted
from toy import ToyRenderer

from scenecaptum import (
    FeatureAblationScene,
    SceneCaptumError,
    SceneRenderer,
    SmoothGradScene,
    VanillaSceneGradient,
    metrics,
    tradeoff,
)
from scenecaptum.rendering import _memory, _renderer
from scenecaptum.rendering._memory import MAX_FRACTION, available, predict, require

GIGABYTE = 2**30
SIZES = [3, 3, 97]  # of the inputs


def test_available_memory_is_known_here() -> None:
    if not Path("/proc/meminfo").exists():
        pytest.skip("no /proc/meminfo: available memory is known on Linux only")
    total = int(re.search(r"MemTotal: *(\d+)", Path("/proc/meminfo").read_text())[1]) * 1024  # type: ignore[index]
    found = available()
    assert found is not None
    assert 0 < found <= total


def test_limits_of_containers_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The smallest limit of all cgroups that contain the process."""
    (tmp_path / "job" / "step").mkdir(parents=True)
    for place, limit, used in (("job", "5000", "1000"), ("job/step", "max", "900"), ("", "9000", "1000")):
        (tmp_path / place / "memory.max").write_text(f"{limit}\n")
        (tmp_path / place / "memory.current").write_text(f"{used}\n")
    (tmp_path / "own").write_text("0::/job/step\n")
    monkeypatch.setattr(_memory, "CGROUPS", (tmp_path / "own", tmp_path))
    assert available() == 4000


@pytest.mark.parametrize(("pictures", "spp"), [(8, 64), (64, 1), (1, 4096)])
def test_suggested_settings_fit(pictures: int, spp: int) -> None:
    """And the next larger ones do not."""
    size = (3840, 2160)
    for free in (GIGABYTE, 3 * GIGABYTE, 5 * GIGABYTE):
        needed = predict(size, spp, pictures, SIZES)
        if needed <= MAX_FRACTION * free:
            require(size, spp, pictures, SIZES, free)
            continue
        with pytest.raises(
            SceneCaptumError, match=r"would take about .* of memory .* are available"
        ) as caught:
            require(size, spp, pictures, SIZES, free)
        message = str(caught.value)
        if found := re.search(r"replicates=(\d+)", message):
            count = int(found[1])
            fitting, not_fitting = (
                predict(size, -(-spp * pictures // n), n, SIZES) for n in (count, count + 1)
            )
            assert fitting <= MAX_FRACTION * free < not_fitting
        if found := re.search(r"(\d+) samples per pixel in a replicate", message):
            samples = int(found[1])
            assert predict(size, samples, pictures, SIZES) <= MAX_FRACTION * free
        width, height = map(int, re.search(r"resolution=\((\d+), (\d+)\)", message).groups())  # type: ignore[union-attr]
        assert predict((width, height), spp, pictures, SIZES) <= MAX_FRACTION * free


def test_nothing_is_refused_if_the_available_memory_is_unknown() -> None:
    require((10**5, 10**5), 10**5, 10**3, [], None)


def test_jobs_are_refused_before_they_start(monkeypatch: pytest.MonkeyPatch, mi: Any) -> None:
    renderer = SceneRenderer("cornell-box", "reflectance", resolution=(4096, 4096), spp=64)
    picture = renderer.memory()
    assert f"at most {_memory.format_bytes(picture)} of memory" in str(renderer.plan)

    def rendered(*_: Any) -> None:
        raise AssertionError("it was rendered")

    monkeypatch.setattr(renderer._views[0].engine, "primal", rendered)
    monkeypatch.setattr(_renderer, "available", lambda: int(picture / MAX_FRACTION) - GIGABYTE)
    with pytest.raises(SceneCaptumError, match="1 image of 4096×4096 pixels at 64 spp"):
        renderer(seed=shifted())
    # One image would fit, but not those of all replicates.
    monkeypatch.setattr(_renderer, "available", lambda: int(picture / MAX_FRACTION) + 4 * GIGABYTE)
    for method in (VanillaSceneGradient, FeatureAblationScene):
        with pytest.raises(
            SceneCaptumError, match=r"8 images of 4096×4096 pixels .* that fit: replicates=\d"
        ):
            method(renderer, metrics.MeanLuminance()).attribute()
    with pytest.raises(AssertionError, match="it was rendered"):
        SmoothGradScene(renderer, metrics.MeanLuminance()).attribute(replicates=1)


class SmallToy(ToyRenderer):
    """Has memory for a hundred images, and counts the samples that it renders."""

    samples = 0

    def require_memory(self, *, spp: int, pictures: int) -> None:
        require((4, 4), spp, pictures, [3], predict((4, 4), 1, 100, [3]) * 2 if pictures < 100 else 0)

    def __call__(self, inputs: Any, *, seed: int, spp: int) -> Any:
        self.samples += spp
        return super().__call__(inputs, seed=seed, spp=spp)


def test_a_tradeoff_is_refused_before_its_first_run() -> None:
    """Also if only its last setting does not fit: before the check one sample of each is rendered."""
    toy = SmallToy()
    with pytest.raises(SceneCaptumError, match="5000 images of 4×4 pixels"):
        tradeoff.measure(toy, metrics.MeanLuminance(), vary={"replicates": [4, 5000]})
    assert toy.samples <= 4


def test_memory_granted_once_is_granted_again(monkeypatch: pytest.MonkeyPatch, mi: Any) -> None:
    """The memory that the renderer already holds no longer counts as available."""
    renderer = SceneRenderer("cornell-box", "reflectance", resolution=(64, 64), spp=1)
    renderer.require_memory(pictures=4)
    monkeypatch.setattr(_renderer, "available", lambda: 0)
    renderer.require_memory(pictures=4)
    with pytest.raises(SceneCaptumError, match="No smaller setting fits"):
        renderer.require_memory(pictures=5)


@pytest.mark.long
def test_predictions_are_between_the_measured_memory_and_two_and_a_half_times_as_much() -> None:
    """An accepted job must not be killed for its memory, and one that fits must not be refused."""
    script = Path(__file__).parents[2] / "benchmarks" / "memory.py"
    cases = [
        "cornell-box 64x64 64 8",
        "cornell-box 1280x720 8 8",
        "office 320x180 16 8",
        "wall-2048 64x64 16 8",
    ]
    done = subprocess.run(
        [sys.executable, str(script), "--predict", *cases], capture_output=True, text=True, check=True
    )
    print(f"\n{done.stdout}")
    ratios = [float(line.split()[-1]) for line in done.stdout.splitlines()]
    assert len(ratios) == len(cases)
    assert min(ratios) >= 1
    assert max(ratios) <= 2.5
