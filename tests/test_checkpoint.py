"""Interrupted and resumed jobs: the same numbers, and only the render that was lost is repeated."""

from __future__ import annotations

import dataclasses
import json
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from seeds import shifted
from toy import ReplayingToyRenderer, ToyRenderer

from scenecaptum import (
    FeatureAblationScene,
    GradientShapScene,
    InputXGradientScene,
    IntegratedGradientsScene,
    SceneAttribution,
    SceneCaptumError,
    ShapleyValueScene,
    SmoothGradScene,
    VanillaSceneGradient,
    tradeoff,
    validation,
)
from scenecaptum.checkpoint import Checkpoint, digest, with_checkpoint

WHERE = {"x": (0.0, 1.0)}


class Killed(BaseException):
    """An exception that nothing in the library catches."""


class MortalToy(ToyRenderer):
    """Raises ``Killed`` during a call, if a number of calls is given."""

    fingerprint = "toy"
    bounds = WHERE

    def __init__(self, dies_in: int | None = None) -> None:
        super().__init__()
        self.dies_in = dies_in
        self.calls = 0

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        self.calls += 1
        if self.calls == self.dies_in:
            raise Killed
        return super().__call__(inputs, seed=seed, spp=spp)


class MortalReplayingToy(ReplayingToyRenderer):
    fingerprint = "replaying toy"
    bounds = WHERE


def metric(image: torch.Tensor) -> torch.Tensor:
    return image.exp().mean()


def attribute(method: Any, **options: Any) -> Callable[[Any, Any], Any]:
    def run(renderer: Any, folder: Any) -> Any:
        return method(renderer, metric).attribute(checkpoint=folder, **options)

    return run


def validate(function: Any, **options: Any) -> Callable[[Any, Any], Any]:
    def run(renderer: Any, folder: Any) -> Any:
        return function(renderer, metric, checkpoint=folder, **options)

    return run


JOBS = {
    "vanilla": attribute(VanillaSceneGradient),
    "planned": attribute(VanillaSceneGradient, tolerance=0.05),
    "input x gradient": attribute(InputXGradientScene),
    "integrated gradients": attribute(IntegratedGradientsScene, n_steps=4, baselines=0.1),
    "smoothgrad": attribute(SmoothGradScene, nt_samples=4),
    "gradient shap": attribute(GradientShapScene, n_samples=4, baselines=0.1),
    "feature ablation": attribute(FeatureAblationScene, baselines=0.1),
    "shapley": attribute(ShapleyValueScene, baselines=0.1, groups={"all": ["x"]}),
    "ablation test": validate(validation.ablation_test),
    "interactions": validate(validation.interactions),
    "hessian": validate(validation.hessian_vector_product, direction={"x": torch.ones(3)}),
    "dgsm": validate(validation.dgsm, points=4),
    "infidelity": validate(validation.infidelity, n_perturb_samples=4),
    "tradeoff": validate(tradeoff.measure, vary={"spp": [4]}, runs=2),
}


def numbers(what: Any) -> Any:
    """All numbers of a result but the measured times."""
    if isinstance(what, torch.Tensor):
        return what.tolist()
    if isinstance(what, SceneAttribution):
        info = {k: v for k, v in what.info.items() if k not in ("seconds", "checkpoint", "planner")}
        fields = (what.attributions, what.standard_error, what.replicates, what.bias, what.image, info)
        return [what.metric_value, *map(numbers, fields)]
    if dataclasses.is_dataclass(what):
        names = [one.name for one in dataclasses.fields(what) if one.name != "seconds"]
        return {name: numbers(getattr(what, name)) for name in names}
    if isinstance(what, Mapping):
        return {key: numbers(value) for key, value in what.items()}
    if isinstance(what, (list, tuple)):
        return [numbers(one) for one in what]
    return what


@pytest.mark.parametrize("job", JOBS)
def test_a_killed_job_is_resumed(job: str, tmp_path: Path) -> None:
    """Three runs are killed, each at a different call; the fourth finishes, and a fifth renders nothing."""
    run = JOBS[job]
    whole = MortalToy()
    expected = run(whole, None)
    for moment in (0.2, 0.5, 0.8):
        kept = len(os.listdir(tmp_path))
        mortal = MortalToy(dies_in=max(1, int(moment * (whole.calls - kept))))
        with pytest.raises(Killed):
            run(mortal, tmp_path)
        # An image is rendered again if its backward pass was not finished; nothing else is lost.
        assert len(os.listdir(tmp_path)) >= kept + 1 or mortal.calls == 1
    found = run(MortalToy(), tmp_path)
    assert repr(numbers(found)) == repr(numbers(expected))
    idle = MortalToy(dies_in=1)
    assert repr(numbers(run(idle, tmp_path))) == repr(numbers(expected))
    assert idle.calls == 0


def test_only_calls_with_the_same_arguments_are_reused(tmp_path: Path) -> None:
    def counts(toy: Any = None, of: Any = metric, **options: Any) -> tuple[int, int]:
        toy = MortalReplayingToy() if toy is None else toy
        options = {"replicates": 4, "spp": 16, "seed": shifted(1), **options}
        usage = VanillaSceneGradient(toy, of).attribute(checkpoint=tmp_path, **options).info["checkpoint"]
        return usage["reused"], usage["passes"]

    # 4 pictures in two parts each, 4 backward passes and one for the bias.
    assert counts() == (0, 13)
    assert counts() == (13, 13)
    assert counts(of=lambda image: image.mean()) == (4, 8)  # the pictures are the same
    assert counts(seed=shifted(2)) == (0, 13)
    assert counts(spp=32) == (0, 13)
    assert counts(inputs={"x": torch.tensor([0.5, 0.3, 0.7])}) == (0, 13)
    other = MortalReplayingToy()
    other.fingerprint = "another toy"
    assert counts(other) == (0, 13)
    assert counts() == (13, 13)


@pytest.mark.parametrize("damage", ["truncated", "emptied", "flipped", "renamed"])
def test_damaged_entries_are_detected_and_rendered_again(damage: str, tmp_path: Path) -> None:
    run = JOBS["vanilla"]
    expected = numbers(run(MortalToy(), tmp_path))
    one, other, *_ = sorted(tmp_path.iterdir())
    content = one.read_bytes()
    middle = len(content) // 2
    one.write_bytes(
        {
            "truncated": content[:middle],
            "emptied": b"",
            "flipped": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
            "renamed": other.read_bytes(),
        }[damage]
    )
    with pytest.warns(UserWarning, match=f"{one.name} is damaged"):
        found = run(MortalToy(), tmp_path)
    assert numbers(found) == expected
    assert found.info["checkpoint"]["passes"] - found.info["checkpoint"]["reused"] == 1
    assert numbers(run(MortalToy(dies_in=1), tmp_path)) == expected  # it was repaired


class _Wrapper:
    """Delegates attributes, as wrappers of renderers do."""

    def __init__(self, renderer: Any) -> None:
        self.renderer = renderer

    def __getattr__(self, name: str) -> Any:
        return getattr(self.renderer, name)

    def __call__(self, inputs: Any, **options: Any) -> torch.Tensor:
        return 2 * self.renderer(inputs, **options)


@pytest.mark.parametrize("renderer", [ToyRenderer(), _Wrapper(MortalToy())])
def test_a_renderer_without_a_fingerprint_is_refused(renderer: Any, tmp_path: Path) -> None:
    with pytest.raises(SceneCaptumError, match="give it an attribute fingerprint"):
        with_checkpoint(renderer, tmp_path)


def test_a_folder_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    with pytest.raises(SceneCaptumError, match="cannot be written"):
        JOBS["vanilla"](MortalToy(), tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"


def test_partially_written_files_are_deleted_once_they_are_old(tmp_path: Path) -> None:
    old, new = (tmp_path / f".{name}-1-ab.pass" for name in (1, 2))
    for one in (old, new):
        one.write_bytes(b"half")
    os.utime(old, (time.time() - 7200,) * 2)
    Checkpoint(tmp_path)
    assert [one.name for one in tmp_path.iterdir()] == [new.name]


class SlowToy(MortalReplayingToy):
    """Takes a measurable time for each call."""

    def __call__(self, inputs: Any, *, seed: int, spp: int, seed_grad: int | None = None) -> torch.Tensor:
        time.sleep(0.002 + 0.0001 * spp)
        return super().__call__(inputs, seed=seed, spp=spp, seed_grad=seed_grad)


def test_a_time_limit_counts_the_time_of_earlier_runs(tmp_path: Path) -> None:
    """A second run counts the first one's time: it asks for the same rounds, and renders none of them."""

    def run() -> tuple[Any, Checkpoint]:
        renderer = with_checkpoint(SlowToy(), tmp_path)
        return VanillaSceneGradient(renderer, metric).attribute(time_limit=0.4), renderer.checkpoint

    (first, _), (second, kept) = run(), run()
    assert first.info["checkpoint"]["reused"] == 0
    assert second.info["checkpoint"]["reused"] == first.info["checkpoint"]["passes"]
    rounds, again = (
        [one["spp_per_replicate"] for one in found.info["planner"]["rounds"]] for found in (first, second)
    )
    assert again == rounds
    assert torch.equal(second["x"], first["x"])
    # The time of the first run is included: each image took at least 2 ms.
    assert kept.seconds_saved > 0.002 * first.info["checkpoint"]["passes"] / 3
    assert second.info["seconds"] > kept.seconds_saved


def test_digests_of_similar_values_differ() -> None:
    alike: list[Any] = [
        1,
        1.0,
        "1",
        True,
        (1,),
        ((1,),),
        torch.tensor(1),
        torch.tensor(1.0),
        None,
        "None",
        (),
    ]
    alike += [{"a": 1}, {"b": 1}, ("a", 1), ("ab", "c"), ("a", "bc"), torch.tensor([1.0]), torch.tensor(-0.0)]
    assert len({digest(one) for one in alike}) == len(alike)
    with pytest.raises(SceneCaptumError, match="not set"):
        digest({1, 2})


# With Mitsuba -----------------------------------------------------------------------------------------------


@pytest.fixture
def fresh(mi: Any) -> Callable[..., Any]:
    """A renderer as another process would load it; its renders are counted, and one of them may raise."""
    from scenecaptum import SceneRenderer

    def make(dies_in: int | None = None, **options: Any) -> Any:
        renderer = SceneRenderer(
            "cornell-box", "reflectance", resolution=(8, 8), spp=8, max_depth=3, **options
        )
        renderer.renders = 0
        for engine in (view.engine for view in renderer._views):
            for name in ("primal", "vjp"):
                setattr(engine, name, _counted(renderer, getattr(engine, name), dies_in))
        return renderer

    return make


def _counted(renderer: Any, render: Any, dies_in: int | None) -> Any:
    def counted(*arguments: Any, **options: Any) -> Any:
        renderer.renders += 1
        if renderer.renders == dies_in:
            raise Killed
        return render(*arguments, **options)

    return counted


def test_a_scene_renderer_loses_only_the_render_in_progress(fresh: Any, tmp_path: Path) -> None:
    """At values other than the scene's: the importance sampling of pixels must not depend on earlier renders."""
    from scenecaptum import metrics

    def run(renderer: Any, folder: Any = None) -> SceneAttribution:
        method = IntegratedGradientsScene(renderer, metrics.MeanLuminance())
        return method.attribute(n_steps=3, replicates=4, baselines=0.05, checkpoint=folder)

    whole = fresh()
    expected = run(whole)
    done = 0
    for dies_in in (2, 5, 4):
        with pytest.raises(Killed):
            run(fresh(dies_in), tmp_path)
        done += dies_in - 1
        assert len(list(tmp_path.iterdir())) == done
    last = fresh()
    found = run(last, tmp_path)
    assert last.renders == whole.renders - done
    assert found.info["checkpoint"] == {"folder": str(tmp_path), "reused": done, "passes": whole.renders}
    for name, value in expected.items():
        # Gradients repeat to about 1e-6, because threads add them in varying order.
        torch.testing.assert_close(found[name], value, rtol=1e-5, atol=1e-5 * float(value.abs().max()))


def test_plain_torch_and_other_settings(fresh: Any, tmp_path: Path) -> None:
    renderer = fresh().with_checkpoint(tmp_path)
    name = next(iter(renderer.inputs))

    def gradient(of: Any) -> torch.Tensor:
        leaves = of.leaves()
        image = of(leaves, seed=shifted(3))
        (found,) = torch.autograd.grad(image.mean(), [leaves[name]])
        return found

    first, again = gradient(renderer), gradient(renderer)
    assert torch.equal(first, again)
    assert (renderer.checkpoint.rendered, renderer.checkpoint.reused) == (2, 2)
    derivative = renderer.derivative_image(name, seed=shifted(3))
    assert torch.equal(derivative, renderer.derivative_image(name, seed=shifted(3)))
    shallow = renderer.replace(max_depth=2)
    assert shallow.checkpoint is renderer.checkpoint
    assert not torch.equal(gradient(shallow), first)
    gradient(renderer.with_checkpoint(None))
    assert renderer.checkpoint.reused == 2 + 2  # the derivative image has rendered its image as well


def test_fingerprints(mi: Any, stage_dict: dict[str, Any]) -> None:
    """They differ between scenes that differ in anything, and are equal for equal scenes."""
    from scenecaptum import SceneRenderer

    def of(scene: Any, **options: Any) -> str:
        return str(SceneRenderer(scene, "all", **options)._fingerprints()[0])

    ball, camera, ground = stage_dict["ball"], stage_dict["camera"], stage_dict["ground"]
    bsdf, bitmap = ball["bsdf"], ground["bsdf"]["reflectance"]
    film = {**camera["film"], "rfilter": {"type": "gaussian"}}
    nearest = {**ground, "bsdf": {"type": "diffuse", "reflectance": {**bitmap, "filter_type": "nearest"}}}
    changed = [
        {"ball": {**ball, "radius": 1.001}},
        {"ball": {**ball, "bsdf": {**bsdf, "alpha": 0.2501}}},
        {"ball": {**ball, "bsdf": {**bsdf, "distribution": "ggx"}}},
        {"ball": {**ball, "bsdf": {**bsdf, "nonlinear": True}}},
        {"ball": {**ball, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}}},
        {"camera": {**camera, "fov": 45.1}},
        {"camera": {**camera, "film": film}},
        {"ground": nearest},
        {"integrator": {"type": "prb", "max_depth": 4}},
        {"lamp": {"type": "point", "position": [0, 0, 3]}},
    ]
    own = of(stage_dict)
    assert of(stage_dict) == own
    prints = [own, *(of({**stage_dict, **change}) for change in changed)]
    prints += [
        of(stage_dict, resolution=(16, 8)),
        of(stage_dict, max_depth=2),
        of(stage_dict, sensor="fisheye"),
    ]
    assert len(set(prints)) == len(prints)

    renderer = SceneRenderer(stage_dict, "all", spp=1)
    x = {name: value * 0.9 for name, value in renderer.leaves().items()}
    renderer(x, seed=shifted(1)).mean().backward()
    assert renderer._fingerprints()[0] == own


def test_command_line(tmp_path: Path, capsys: Any, mi: Any) -> None:
    from scenecaptum.cli import main

    words = [
        "validate",
        "cornell-box",
        "--inputs",
        "emitters",
        "--resolution",
        "8x8",
        "--spp",
        "128",  # so that the change exceeds its noise
        "--top",
        "1",
    ]
    words += ["--checkpoint", str(tmp_path / "kept"), "--out", str(tmp_path / "out")]
    printed = []
    for _ in range(2):
        assert main(words) == 0
        printed.append(capsys.readouterr().out.splitlines()[-1])
    entries = len(list((tmp_path / "kept").iterdir()))
    assert printed[0].endswith(f" of {printed[0].split()[3]} passes from {tmp_path / 'kept'}")
    total = int(printed[0].split()[3])
    assert entries <= total
    assert printed[1] == f"resumed: {total} of {total} passes from {tmp_path / 'kept'}"
    assert json.loads((tmp_path / "out" / "validation.json").read_text())["confirmed"]
