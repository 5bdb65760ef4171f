"""The renderer as a torch function: correct derivatives under any use of the graph, and no side effects."""

from __future__ import annotations

import copy
import io
import math
import pickle
import subprocess
import sys
from collections import OrderedDict
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
import torch
from chance import allowed
from refusals import message
from seeds import seeds, shifted
from torch.autograd import forward_ad, functional, gradcheck

from scenecaptum.errors import SceneCaptumError
from scenecaptum.rendering import RenderPlan, SceneRenderer
from scenecaptum.scene.bundled import cornell_box

Config = dict[str, Any]
Values = dict[str, torch.Tensor]
Metric = Callable[[torch.Tensor], torch.Tensor]

LEFT, FLOOR, LIGHT = "left_wall.reflectance.value", "floor.reflectance.value", "light.emitter.radiance.value"
REC709 = torch.tensor([0.2126, 0.7152, 0.0722])

# Because of atomic additions, two runs of a gradient differ by 1e-6; sums of several by more.
REPEATS = 1e-4


def mean_luminance(image: torch.Tensor) -> torch.Tensor:
    return (image @ REC709).mean()


def left_half(image: torch.Tensor) -> torch.Tensor:
    return image[:, : image.shape[1] // 2, 0].mean()


def gradient(
    renderer: SceneRenderer, values: Values, metric: Metric = mean_luminance, **options: Any
) -> Values:
    """Differentiate a single render, the simplest use, as the reference for the others."""
    leaves = {name: value.detach().clone().requires_grad_() for name, value in values.items()}
    metric(renderer(leaves, **options)).backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def assert_same(measured: Values, expected: Values, allowed: float = REPEATS) -> None:
    assert measured.keys() == expected.keys()
    errors = {name: relative(measured[name], expected[name]) for name in expected}
    beyond = {name: f"{error:.2g}" for name, error in errors.items() if not error <= allowed}
    assert not beyond, f"relative errors {beyond}; allowed {allowed:g}"


def relative(measured: torch.Tensor, expected: torch.Tensor) -> float:
    assert measured.shape == expected.shape
    scale = expected.double().norm().item()
    return (measured.double() - expected.double()).norm().item() / (scale or 1.0)


def small_cornell(**changes: Any) -> Config:
    """Return the Cornell box at 24 × 16 pixels and 4 samples, with other objects where they are given."""
    scene = cornell_box()
    scene["sensor"]["film"].update(width=24, height=16)
    scene["sensor"]["sampler"]["sample_count"] = 4
    scene["integrator"]["max_depth"] = 3
    return {**scene, **changes}


def film(**changes: Any) -> Config:
    """Return the small Cornell box with another film."""
    scene = small_cornell()
    scene["sensor"]["film"].update(changes)
    return scene


@pytest.fixture(scope="module", params=["cornell", "stage"])
def renderer(request: pytest.FixtureRequest) -> SceneRenderer:
    """Both kinds of parameters: those that a plugin reads directly, and those it derives arrays from."""
    found: SceneRenderer = request.getfixturevalue(request.param)
    return found


@pytest.fixture(scope="module")
def other_values(renderer: SceneRenderer) -> Values:
    return {name: 0.8 * value for name, value in renderer.inputs.items() if not name.endswith("eta")}


# --- Graphs that overlap ---------------------------------------------------------------------------


def test_the_image_is_what_mitsuba_renders(mi: Any, cornell: SceneRenderer) -> None:
    scene = cornell_box()
    scene["sensor"]["film"].update(width=32, height=32)
    integrator = mi.load_dict({"type": "prb", "max_depth": 4})
    expected = mi.render(mi.load_dict(scene), integrator=integrator, spp=16, seed=shifted(3)).torch()
    error = relative(cornell(seed=shifted(3)), expected)
    assert error < 1e-5, f"relative error {error:.2g}; allowed 1e-5"


def test_two_renders_and_one_backward_give_the_sum_of_both(renderer: SceneRenderer) -> None:
    leaves = renderer.leaves()
    total = mean_luminance(renderer(leaves, seed=shifted(1))) + 2 * left_half(
        renderer(leaves, seed=shifted(2))
    )
    total.backward()
    one = gradient(renderer, renderer.inputs, seed=shifted(1))
    two = gradient(renderer, renderer.inputs, left_half, seed=shifted(2))
    assert_same({n: leaf.grad for n, leaf in leaves.items()}, {n: one[n] + 2 * two[n] for n in one})


def test_a_later_render_does_not_change_an_earlier_graph(
    renderer: SceneRenderer, other_values: Values
) -> None:
    leaves = renderer.leaves()
    first = renderer(leaves, seed=shifted(1))
    gradient(renderer, other_values, left_half, seed=shifted(2))
    renderer(other_values, seed=shifted(3))
    renderer()
    mean_luminance(first).backward()
    expected = gradient(renderer, renderer.inputs, seed=shifted(1))
    assert_same({name: leaf.grad for name, leaf in leaves.items()}, expected)


def test_a_second_backward_is_for_the_second_adjoint(renderer: SceneRenderer) -> None:
    leaves = renderer.leaves()
    image = renderer(leaves, seed=shifted(1))
    for metric in (mean_luminance, left_half, mean_luminance):
        found = torch.autograd.grad(metric(image), list(leaves.values()), retain_graph=True)
        expected = gradient(renderer, renderer.inputs, metric, seed=shifted(1))
        assert_same(dict(zip(leaves, found, strict=True)), expected)
    # The two adjoints have different gradients, or the test would prove nothing.
    one, two = (gradient(renderer, renderer.inputs, m, seed=shifted(1)) for m in (mean_luminance, left_half))
    assert min(relative(one[name], two[name]) for name in one) > 1e-3


def test_renders_of_different_values_can_be_interleaved(renderer: SceneRenderer) -> None:
    first = renderer.inputs
    shares = (1.0, 0.9, 0.7, 0.95)
    batch = [{name: share * value for name, value in first.items()} for share in shares]
    leaves = [{n: v.clone().requires_grad_() for n, v in values.items()} for values in batch]
    images = [renderer(x, seed=shifted(i)) for i, x in enumerate(leaves)]
    for i in (2, 0, 3, 1):
        mean_luminance(images[i]).backward()
    for i, values in enumerate(batch):
        expected = gradient(renderer, values, seed=shifted(i))
        assert_same({name: leaf.grad for name, leaf in leaves[i].items()}, expected)


def test_inputs_may_differ_between_calls(renderer: SceneRenderer) -> None:
    full = gradient(renderer, renderer.inputs, seed=shifted(1))
    name = list(renderer.inputs)[-1]
    alone = gradient(renderer, {name: renderer.inputs[name]}, seed=shifted(1))
    assert_same(alone, {name: full[name]})
    assert_same(gradient(renderer, renderer.inputs, seed=shifted(1)), full)


def test_forward_mode_is_not_disturbed_by_another_scene_in_the_process(
    stage: SceneRenderer, cornell: SceneRenderer
) -> None:
    # Dr.Jit dispatches a call to every material of the process, those of other scenes included.
    f, value = floor_to_colour(cornell), cornell.inputs[FLOOR]
    gradient(stage, stage.inputs)
    tangent = torch.func.jvp(f, (value,), (torch.ones(3),))[1]
    expected = gradient(cornell, {FLOOR: value}, lambda image: image.mean(dim=(0, 1)).sum(), seed=shifted(5))
    assert_same({FLOOR: tangent}, expected)


def test_only_what_requires_grad_is_differentiated(cornell: SceneRenderer) -> None:
    leaves = cornell.inputs
    leaves[FLOOR].requires_grad_()
    mean_luminance(cornell(leaves, seed=shifted(1))).backward()
    assert leaves[LEFT].grad is None
    assert_same(
        {FLOOR: leaves[FLOOR].grad}, {FLOOR: gradient(cornell, cornell.inputs, seed=shifted(1))[FLOOR]}
    )
    assert not cornell(cornell.inputs).requires_grad


class OneReflectance(torch.nn.Module):
    """The forward function of Captum: from a batch of inputs to a batch of numbers."""

    def __init__(self, renderer: SceneRenderer) -> None:
        super().__init__()
        self.renderer = renderer

    def forward(self, batch: torch.Tensor) -> torch.Tensor:
        return torch.stack([mean_luminance(self.renderer({FLOOR: row}, seed=shifted(7))) for row in batch])


def test_captums_integrated_gradients_agree_in_any_batches(cornell: SceneRenderer) -> None:
    captum = pytest.importorskip("captum.attr", reason="captum is not installed")
    model = OneReflectance(cornell)
    method = captum.IntegratedGradients(model)
    inputs, baseline = torch.tensor([[0.8, 0.5, 0.3], [0.2, 0.6, 0.9]]), torch.full((2, 3), 0.01)
    batched = method.attribute(inputs, baseline, n_steps=6)
    rows = zip(inputs.split(1), baseline.split(1), strict=True)
    single = torch.cat([method.attribute(x, b, n_steps=6, internal_batch_size=1) for x, b in rows])
    assert_same({"floor": batched.float()}, {"floor": single.float()})
    # At one seed the image is a cubic in a reflectance, which six Gauss–Legendre points integrate exactly.
    change = (model(inputs) - model(baseline)).detach()
    assert_same({"sum": batched.sum(1).float()}, {"sum": change}, allowed=1e-3)


# --- Derivatives against finite differences --------------------------------------------------------


def channel_means(image: torch.Tensor) -> torch.Tensor:
    """Sum in double precision, because a central difference loses three digits."""
    return image.detach().double().mean(dim=(0, 1))


def test_every_gradient_agrees_with_finite_differences_at_each_seed(cornell: SceneRenderer) -> None:
    # A colour channel of the image depends on that channel of a parameter only, so one step gives all three.
    step, drawn = 1e-2, seeds(6)
    differences: dict[str, list[torch.Tensor]] = {}
    found: dict[str, list[torch.Tensor]] = {}
    for seed in drawn:
        for name, value in gradient(cornell, cornell.inputs, seed=seed).items():
            own = cornell.inputs[name]
            high, low = (channel_means(cornell({name: own + h}, seed=seed)) for h in (step, -step))
            differences.setdefault(name, []).append(REC709 * (high - low) / (2 * step))
            found.setdefault(name, []).append(value.double())
    assert len(found) == 9
    for name, gradients in found.items():
        measured, expected = torch.stack(gradients), torch.stack(differences[name])
        off = measured - expected
        worst = max(relative(m, e) for m, e in zip(measured, expected, strict=True))
        assert worst < 0.01, f"{name}: relative error {worst:.2g} at one seed; allowed 0.01"
        error = off.std(0) / math.sqrt(len(drawn))
        bias, scale = off.mean(0).abs(), expected.mean(0).norm()
        fine = (bias < 3 * error) | (bias / scale < 1e-3)
        assert fine.all(), f"{name}: bias {bias.tolist()}, 3 se {(3 * error).tolist()}, scale {scale:.3g}"


def test_the_image_is_linear_in_its_only_light(cornell: SceneRenderer) -> None:
    radiance = cornell.inputs[LIGHT]
    m = mean_luminance(cornell(seed=shifted(4))).item()
    attributed = (radiance * gradient(cornell, cornell.inputs, seed=shifted(4))[LIGHT]).sum().item()
    assert attributed == pytest.approx(m, rel=1e-4)


def test_an_independent_gradient_seed_agrees_within_its_error(cornell: SceneRenderer) -> None:
    radiance = cornell.inputs[LIGHT]
    off = torch.tensor(
        [
            (radiance * gradient(cornell, cornell.inputs, seed=s, seed_grad=s + 100)[LIGHT]).sum()
            - mean_luminance(cornell(seed=s))
            for s in seeds(8)
        ]
    )
    error = off.std() / math.sqrt(len(off))
    assert off.std() > 0, "the seed of the gradient made no difference"
    assert off.mean().abs() < allowed(8) * error, f"bias {off.mean():.3g}; standard error {error:.3g}"


def test_the_gradient_seed_chooses_the_samples_of_the_backward_pass(cornell: SceneRenderer) -> None:
    # A linear metric's gradient depends on the backward pass's samples only.
    expected = gradient(cornell, cornell.inputs, seed=shifted(1), seed_grad=shifted(9))
    assert_same(gradient(cornell, cornell.inputs, seed=shifted(5), seed_grad=shifted(9)), expected)
    assert relative(gradient(cornell, cornell.inputs, seed=shifted(1))[FLOOR], expected[FLOOR]) > 1e-3
    # With the image's own seed, the samples are those of the image.
    own = gradient(cornell, cornell.inputs, seed=shifted(9))
    assert_same(gradient(cornell, cornell.inputs, seed=shifted(9), seed_grad=shifted(9)), own)


@pytest.mark.filterwarnings("ignore:Input #0 requires gradient and is not a double")
def test_gradcheck_passes(cornell: SceneRenderer) -> None:
    value = cornell.inputs[FLOOR].requires_grad_()
    assert gradcheck(
        lambda v: cornell({FLOOR: v}, seed=shifted(2)).mean(dim=(0, 1)),
        value,
        eps=1e-2,
        atol=1e-4,
        rtol=1e-2,
        nondet_tol=1e-5,
        check_forward_ad=True,
    )


def test_a_mediums_albedo_agrees_with_finite_differences(mi: Any) -> None:
    fog = {
        "type": "sphere",
        "radius": 0.8,
        "bsdf": {"type": "null"},
        "interior": {
            "type": "homogeneous",
            "albedo": {"type": "rgb", "value": [0.5, 0.6, 0.7]},
            "sigma_t": 1.5,
        },
    }
    foggy = SceneRenderer(small_cornell(fog=fog), "media", max_depth=4, spp=16)
    assert foggy.plan.integrator == "scenecaptum_volumetric_replay"
    assert "participating medium" in str(foggy.plan)
    name = "fog.interior_medium.albedo.value.value"
    step, off, scale = 0.05, [], []
    own = foggy.inputs[name]
    for seed in seeds(8):
        high, low = (channel_means(foggy({name: own + h}, seed=seed)) for h in (step, -step))
        expected = ((high - low) @ REC709.double()).item() / (2 * step)
        off.append(gradient(foggy, {name: own}, seed=seed)[name].sum().item() - expected)
        scale.append(expected)
    bias, error = abs(np.mean(off)), np.std(off, ddof=1) / math.sqrt(len(off))
    assert bias < 3 * error or bias < 0.01 * abs(np.mean(scale)), (
        f"bias {bias:.3g} on a derivative of {np.mean(scale):.3g}; allowed 3 × {error:.3g} or 1 %"
    )
    assert abs(np.mean(scale)) > 20 * error, "too noisy to show anything"


# --- torch's transforms and input forms ------------------------------------------------------------


def floor_to_colour(cornell: SceneRenderer) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda value: cornell({FLOOR: value}, seed=shifted(5)).mean(dim=(0, 1))


@pytest.fixture(scope="module")
def colour_jacobian(cornell: SceneRenderer) -> torch.Tensor:
    rows = [
        gradient(cornell, {FLOOR: cornell.inputs[FLOOR]}, channel(c), seed=shifted(5))[FLOOR]
        for c in range(3)
    ]
    return torch.stack(rows)


def channel(c: int) -> Metric:
    return lambda image: image[..., c].mean()


@pytest.mark.parametrize(
    "jacobian",
    [
        functional.jacobian,
        lambda f, x: torch.func.jacrev(f)(x),
        lambda f, x: torch.func.jacfwd(f)(x),
        lambda f, x: torch.stack([torch.func.jvp(f, (x,), (t,))[1] for t in torch.eye(3)], dim=1),
        lambda f, x: torch.stack([torch.func.vjp(f, x)[1](t)[0] for t in torch.eye(3)]),
        lambda f, x: torch.stack([torch.func.grad(lambda v, c=c: f(v)[c])(x) for c in range(3)]),
    ],
    ids=["functional.jacobian", "jacrev", "jacfwd", "jvp", "vjp", "grad"],
)
def test_every_way_to_a_jacobian_agrees(
    cornell: SceneRenderer, colour_jacobian: torch.Tensor, jacobian: Callable[..., torch.Tensor]
) -> None:
    found = jacobian(floor_to_colour(cornell), cornell.inputs[FLOOR])
    assert_same({FLOOR: found}, {FLOOR: colour_jacobian})


def test_vmap_renders_and_differentiates_each_element(cornell: SceneRenderer) -> None:
    f = floor_to_colour(cornell)
    batch = torch.stack([share * cornell.inputs[FLOOR] for share in (1.0, 0.5, 0.2)])
    rendered = torch.stack([f(row) for row in batch])
    assert_same({FLOOR: torch.func.vmap(f)(batch)}, {FLOOR: rendered}, allowed=1e-5)
    assert_same({FLOOR: torch.func.vmap(f, in_dims=1)(batch.T)}, {FLOOR: rendered}, allowed=1e-5)

    def total(value: torch.Tensor) -> torch.Tensor:
        return f(value) @ REC709

    each = torch.stack([torch.func.grad(total)(row) for row in batch])
    assert_same({FLOOR: torch.func.vmap(torch.func.grad(total))(batch)}, {FLOOR: each})
    jacobians = torch.stack([torch.func.jacrev(f)(row) for row in batch])
    assert_same({FLOOR: torch.func.vmap(torch.func.jacrev(f))(batch)}, {FLOOR: jacobians})


def test_vmap_over_one_of_two_inputs(cornell: SceneRenderer) -> None:
    light, floors = cornell.inputs[LIGHT], torch.tensor([[0.1, 0.2, 0.3], [0.6, 0.5, 0.4]])

    def f(floor: torch.Tensor, radiance: torch.Tensor) -> torch.Tensor:
        return mean_luminance(cornell({FLOOR: floor, LIGHT: radiance}, seed=shifted(3)))

    found = torch.func.vmap(torch.func.grad(f, argnums=(0, 1)), in_dims=(0, None))(floors, light)
    for i, floor in enumerate(floors):
        expected = gradient(cornell, {FLOOR: floor, LIGHT: light}, seed=shifted(3))
        assert_same({FLOOR: found[0][i], LIGHT: found[1][i]}, expected)


def test_forward_mode_is_the_transpose_of_reverse_mode(renderer: SceneRenderer) -> None:
    # The stage has a bitmap, an environment map and a rough plastic's roughness and index among its inputs.
    random = torch.Generator().manual_seed(shifted())
    values = renderer.inputs
    adjoint = torch.rand(renderer(seed=shifted(1)).shape, generator=random)
    back = gradient(renderer, values, lambda image: (image * adjoint).sum(), seed=shifted(1))
    for name, value in values.items():
        tangent = torch.rand(value.shape, generator=random)
        with forward_ad.dual_level():
            image = renderer({**values, name: forward_ad.make_dual(value, tangent)}, seed=shifted(1))
            forward = forward_ad.unpack_dual(image).tangent
        one, other = (forward * adjoint).sum().item(), (back[name] * tangent).sum().item()
        assert one == pytest.approx(other, rel=1e-3), name
    # The forward pass leaves no state behind.
    assert_same(gradient(renderer, values, lambda image: (image * adjoint).sum(), seed=shifted(1)), back)


def test_tangents_of_several_inputs_add(stage: SceneRenderer) -> None:
    names = ["ground.bsdf.reflectance.data", "sky.scale"]
    values = {name: stage.inputs[name] for name in names}

    def f(*tensors: torch.Tensor) -> torch.Tensor:
        return stage(dict(zip(names, tensors, strict=True)), seed=shifted(1))

    tangents = tuple(torch.ones_like(v) for v in values.values())
    together = torch.func.jvp(f, tuple(values.values()), tangents)[1]
    apart = [
        torch.func.jvp(lambda v, n=name: stage({n: v}, seed=shifted(1)), (value,), (torch.ones_like(value),))[
            1
        ]
        for name, value in values.items()
    ]
    assert_same({"sum": together}, {"sum": torch.stack(apart).sum(0)})


def strided(value: torch.Tensor) -> torch.Tensor:
    return torch.stack([value, -value], dim=-1)[..., 0]


@pytest.mark.parametrize(
    "form",
    [torch.nn.Parameter, torch.Tensor.double, torch.Tensor.half, strided],
    ids=["Parameter", "float64", "float16", "strided"],
)
def test_gradients_have_the_form_of_their_inputs(
    renderer: SceneRenderer, form: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    # Numbers that are exact in half precision, so that all forms have the same value.
    values = {name: value.half().float() for name, value in renderer.inputs.items()}
    expected = gradient(renderer, values, seed=shifted(1))
    leaves = OrderedDict((name, form(value).detach().requires_grad_()) for name, value in values.items())
    if form is torch.nn.Parameter:
        leaves = OrderedDict((name, torch.nn.Parameter(value)) for name, value in values.items())
    image = renderer(leaves, seed=shifted(1))
    assert image.dtype == torch.float32
    mean_luminance(image).backward()
    for name, leaf in leaves.items():
        assert (leaf.grad.dtype, leaf.grad.shape) == (leaf.dtype, values[name].shape)
    allowed = 2e-3 if leaf.dtype == torch.float16 else REPEATS  # half precision has 11 bits
    assert_same({name: leaf.grad for name, leaf in leaves.items()}, expected, allowed)


def test_an_expanded_number_is_a_colour(cornell: SceneRenderer) -> None:
    grey = torch.tensor(0.5, requires_grad=True)
    mean_luminance(cornell({FLOOR: grey.expand(3)}, seed=shifted(1))).backward()
    expected = gradient(cornell, {FLOOR: torch.full((3,), 0.5)}, seed=shifted(1))[FLOOR]
    assert_same({FLOOR: grey.grad}, {FLOOR: expected.sum()})


def test_no_inputs_at_all_render_the_scene_as_it_is(cornell: SceneRenderer) -> None:
    for inputs in (None, {}, cornell.inputs):
        assert_same(
            {"image": cornell(inputs, seed=shifted(2))}, {"image": cornell(seed=shifted(2))}, allowed=1e-5
        )


def test_renders_without_grad_and_in_inference_mode_do_not_change_later_gradients(
    cornell: SceneRenderer,
) -> None:
    expected = gradient(cornell, cornell.inputs, seed=shifted(1))
    with torch.no_grad():
        assert not cornell(cornell.leaves(), seed=shifted(1)).requires_grad
    with torch.inference_mode():
        cornell({FLOOR: torch.full((3,), 0.3)}, seed=shifted(1))
    assert_same(gradient(cornell, cornell.inputs, seed=shifted(1)), expected)


def test_gradients_do_not_share_memory_with_the_renderer(cornell: SceneRenderer) -> None:
    leaves = cornell.leaves()
    image = cornell(leaves, seed=shifted(1))
    mean_luminance(image).backward()
    expected = {name: leaf.grad.clone() for name, leaf in leaves.items()}
    leaves[FLOOR].grad.zero_()
    image.detach().zero_()
    others = {name: leaf.grad for name, leaf in leaves.items() if name != FLOOR}
    assert_same(others, {name: expected[name] for name in others})
    assert_same(gradient(cornell, cornell.inputs, seed=shifted(1)), expected)


# --- Second derivatives and torch's old batching are refused ---------------------------------------


@pytest.mark.parametrize(
    "second",
    [
        functional.hessian,
        lambda f, x: functional.jvp(f, x, torch.ones(3)),
        lambda f, x: functional.vhp(f, x, torch.ones(3)),
        lambda f, x: torch.func.hessian(f)(x),
        lambda f, x: torch.func.jacrev(torch.func.grad(f))(x),
        lambda f, x: torch.func.jacfwd(torch.func.jacfwd(f))(x),
        lambda f, x: torch.func.jvp(torch.func.grad(f), (x,), (torch.ones(3),)),
    ],
    ids=["hessian", "jvp", "vhp", "func.hessian", "jacrev(grad)", "jacfwd(jacfwd)", "jvp(grad)"],
)
def test_second_derivatives_raise_instead_of_being_zero(
    cornell: SceneRenderer, second: Callable[..., Any]
) -> None:
    def f(value: torch.Tensor) -> torch.Tensor:
        return mean_luminance(cornell({FLOOR: value}, seed=shifted(1)))

    said = message(lambda: second(f, cornell.inputs[FLOOR]))
    assert "once, not twice" in said
    assert "For a directional derivative use torch.func.jvp or renderer.derivative_image" in said


def test_create_graph_gives_the_gradient_but_refuses_to_differentiate_it(cornell: SceneRenderer) -> None:
    value = cornell.inputs[FLOOR].requires_grad_()
    (first,) = torch.autograd.grad(
        mean_luminance(cornell({FLOOR: value}, seed=shifted(1))), value, create_graph=True
    )
    assert_same({FLOOR: first.detach()}, gradient(cornell, {FLOOR: cornell.inputs[FLOOR]}, seed=shifted(1)))
    assert "once, not twice" in message(lambda: torch.autograd.grad(first.sum(), value))


def test_torchs_old_batching_is_refused_with_the_alternative(cornell: SceneRenderer) -> None:
    f, x = floor_to_colour(cornell), cornell.inputs[FLOOR]
    assert "jacrev" in message(lambda: functional.jacobian(f, x, vectorize=True))
    x.requires_grad_()
    colour = f(x)
    assert "jacrev" in message(lambda: torch.autograd.grad(colour, x, torch.eye(3), is_grads_batched=True))


# --- Purity ----------------------------------------------------------------------------------------


def test_changing_a_tensor_after_the_call_is_safe(cornell: SceneRenderer) -> None:
    expected = gradient(cornell, cornell.inputs, seed=shifted(1))
    leaf, passive = cornell.inputs[FLOOR].requires_grad_(), cornell.inputs[LEFT]
    image = cornell({FLOOR: leaf, LEFT: passive}, seed=shifted(1))
    passive.mul_(0.1)
    # torch may detect that a saved tensor changed; the changed one must not be used.
    noticed = ""
    try:
        mean_luminance(image).backward()
    except RuntimeError as error:
        noticed = str(error)
    if noticed:
        assert "modified by an inplace operation" in noticed
    else:
        assert_same({FLOOR: leaf.grad}, {FLOOR: expected[FLOOR]})
    assert_same(gradient(cornell, cornell.inputs, seed=shifted(1)), expected)


def test_changing_a_leaf_before_backward_is_detected(cornell: SceneRenderer) -> None:
    leaf = cornell.inputs[FLOOR].requires_grad_()
    loss = mean_luminance(cornell({FLOOR: leaf}, seed=shifted(1)))
    with torch.no_grad():
        leaf.mul_(0.5)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
    assert_same(
        gradient(cornell, {FLOOR: leaf}, seed=shifted(1)),
        gradient(cornell, {FLOOR: 0.5 * cornell.inputs[FLOOR]}, seed=shifted(1)),
    )


def test_memory_changed_without_torchs_knowledge_does_not_affect_later_renders(
    cornell: SceneRenderer,
) -> None:
    memory = np.full(3, 0.25, np.float32)
    value = torch.from_numpy(memory)
    before = cornell({FLOOR: value}, seed=shifted(1))
    memory[:] = 0.75
    after = cornell({FLOOR: value}, seed=shifted(1))
    assert_same({"a": before}, {"a": cornell({FLOOR: torch.full((3,), 0.25)}, seed=shifted(1))}, allowed=1e-5)
    assert_same({"a": after}, {"a": cornell({FLOOR: torch.full((3,), 0.75)}, seed=shifted(1))}, allowed=1e-5)


def test_the_image_does_not_share_memory_with_the_renderer(cornell: SceneRenderer) -> None:
    image = cornell(seed=shifted(1))
    expected = image.clone()
    image.zero_()
    assert_same({"image": cornell(seed=shifted(1))}, {"image": expected}, allowed=1e-5)


def test_inputs_are_fresh_copies(cornell: SceneRenderer) -> None:
    image, own = cornell(cornell.inputs, seed=shifted(1)), cornell.inputs
    changed = cornell.inputs
    for value in changed.values():
        value.zero_()
    with torch.no_grad():
        for value in cornell.leaves().values():
            value.zero_()
    assert all(torch.equal(cornell.inputs[name], own[name]) for name in own)
    assert_same({"image": cornell(seed=shifted(1))}, {"image": image}, allowed=1e-5)
    assert not any(value.requires_grad for value in own.values())
    assert all(leaf.requires_grad and leaf.is_leaf for leaf in cornell.leaves().values())
    assert all(v.dtype == torch.float32 for v in own.values())


def test_the_seed_decides_the_image(cornell: SceneRenderer) -> None:
    one, again, other = cornell(seed=shifted(1)), cornell(seed=shifted(1)), cornell(seed=shifted(2))
    assert relative(again, one) <= 1e-5
    assert relative(other, one) > 0.01
    assert relative(cornell(), cornell(seed=shifted())) <= 1e-5
    cornell(seed=2**32 - 1)


class Snapshot:
    """Everything that users can see of their own scene."""

    def __init__(self, mi: Any, scene: Any) -> None:
        import drjit as dr

        params = mi.traverse(scene)
        self.values = {name: str(params[name]) for name in params.keys()}  # noqa: SIM118, not a dict
        self.tracked = [name for name in self.values if dr.grad_enabled(params[name])]
        self.image = np.array(mi.render(scene, spp=4, seed=shifted(1)))

    def assert_equal(self, other: Snapshot) -> None:
        changed = {n: (v, other.values[n]) for n, v in self.values.items() if v != other.values[n]}
        assert not changed
        assert other.tracked == self.tracked
        error = np.abs(self.image - other.image).max()
        assert error <= 1e-5 * self.image.max(), f"the picture changed by {error:.2g}"


@pytest.fixture
def own_scene(mi: Any) -> Any:
    return mi.load_dict(small_cornell(), optimize=False)


def uses(renderer: SceneRenderer) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Everything that touches the scene, errors included."""
    name, value = FLOOR, torch.full((3,), 0.2)

    def jvp() -> Any:
        return torch.func.jvp(lambda v: renderer({name: v}), (value,), (torch.ones(3),))

    def refused() -> None:
        message(lambda: renderer({name: 10 * value}))

    yield "forward", lambda: renderer({name: value})
    yield "backward", lambda: gradient(renderer, {name: value})
    yield "jvp", jvp
    yield "refused", refused
    yield "surfaces", lambda: renderer.surfaces


def test_the_users_scene_is_not_changed(mi: Any, own_scene: Any) -> None:
    before = Snapshot(mi, own_scene)
    renderer = SceneRenderer(own_scene, "reflectance", resolution=(20, 12))
    before.assert_equal(Snapshot(mi, own_scene))
    for _, use in uses(renderer):
        use()
        before.assert_equal(Snapshot(mi, own_scene))


def test_a_failing_render_does_not_change_the_users_scene(
    mi: Any, own_scene: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = Snapshot(mi, own_scene)
    renderer = SceneRenderer(own_scene, "reflectance", resolution=(20, 12))

    def fail(*_: Any) -> None:
        raise RuntimeError("out of memory")

    engine = renderer._views[0].engine
    for kernel in ("render_samples", "render_backward"):
        with monkeypatch.context() as patch:
            patch.setattr(engine, "_kernels", engine._kernels._replace(**{kernel: fail}))
            with pytest.raises(RuntimeError, match="out of memory"):
                gradient(renderer, {FLOOR: torch.full((3,), 0.2)})
        before.assert_equal(Snapshot(mi, own_scene))
    assert torch.isfinite(gradient(renderer, {FLOOR: torch.full((3,), 0.2)})[FLOOR]).all()


def test_the_users_changes_to_the_scene_survive_a_render(mi: Any, own_scene: Any) -> None:
    renderer = SceneRenderer(own_scene, "reflectance")
    params = mi.traverse(own_scene)
    params[FLOOR] = mi.Color3f(0.1, 0.2, 0.3)
    params.update()
    torch.testing.assert_close(renderer.inputs[FLOOR], torch.tensor([0.1, 0.2, 0.3]))
    gradient(renderer, {FLOOR: torch.full((3,), 0.5)})
    found = np.array(mi.traverse(own_scene)[FLOOR]).ravel()
    assert np.allclose(found, [0.1, 0.2, 0.3]), f"the user's 0.1, 0.2, 0.3 became {found}"


def test_two_renderers_on_one_scene_do_not_disturb_each_other(own_scene: Any) -> None:
    one = SceneRenderer(own_scene, "reflectance", resolution=(16, 8))
    other = SceneRenderer(own_scene, "emitters", resolution=(8, 16), max_depth=2)
    expected, others = (
        gradient(one, one.inputs, seed=shifted(1)),
        gradient(other, other.inputs, seed=shifted(1)),
    )
    leaves, more = one.leaves(), other.leaves()
    image, second = one(leaves, seed=shifted(1)), other(more, seed=shifted(1))
    assert (image.shape, second.shape) == ((8, 16, 3), (16, 8, 3))
    mean_luminance(image).backward()
    mean_luminance(second).backward()
    assert_same({name: leaf.grad for name, leaf in leaves.items()}, expected)
    assert_same({name: leaf.grad for name, leaf in more.items()}, others)


COLLECTED_WHILE_RECORDING = """
import gc
from scenecaptum import SceneRenderer, activate

gc.set_threshold(10**9)
build = lambda: SceneRenderer("cornell-box", "reflectance", resolution=(4, 4), spp=1, max_depth=2)
gone, kept = build(), build()
gone.itself = gone  # a cycle, so that only the collector frees it
Integrator = type(activate().load_dict({"type": "prb"}))
render = Integrator.render

def allocate(*args, **options):
    gc.set_threshold(1)  # the collection that Python runs sooner or later, at a moment of our choice
    junk = [[] for _ in range(1000)]
    return render(*args, **options)

Integrator.render = allocate
del gone
kept()
"""


def test_a_renderer_may_be_garbage_collected_while_another_renders(mi: Any) -> None:
    # In a separate process, because a failure aborts. The variables that a scene frees while a
    # kernel is being recorded cannot be recorded.
    ran = subprocess.run(
        [sys.executable, "-c", COLLECTED_WHILE_RECORDING], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr[-400:]


def test_threads_give_the_results_of_sequential_calls(cornell: SceneRenderer) -> None:
    batch = [{FLOOR: torch.full((3,), 0.2 + 0.2 * i), LIGHT: torch.full((3,), 5.0 + i)} for i in range(4)]
    expected = [gradient(cornell, values, seed=shifted(i)) for i, values in enumerate(batch)]

    def work(i: int) -> Values:
        results = [gradient(cornell, batch[i], seed=shifted(i)) for _ in range(3)]
        return {name: torch.stack([r[name] for r in results]).mean(0) for name in results[0]}

    with ThreadPoolExecutor(4) as pool:
        for found, one in zip(pool.map(work, range(4)), expected, strict=True):
            assert_same(found, one)


# --- What is refused, before anything is rendered --------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        (FLOOR, torch.tensor([0.5, 0.5, 1.4]), [FLOOR, "1.4", "[0, 1]", "reflectance"]),
        (FLOOR, torch.tensor([-0.1, 0.5, 0.5]), [FLOOR, "-0.1", "[0, 1]"]),
        (FLOOR, torch.tensor([math.nan, 0.5, 0.5]), [FLOOR, "not finite"]),
        (LIGHT, torch.tensor([math.inf, 0.5, 0.5]), [LIGHT, "not finite"]),
        (LIGHT, torch.tensor([-1.0, 0.5, 0.5]), [LIGHT, "-1", "[0, ∞)"]),
        (FLOOR, torch.tensor(0.5), [FLOOR, "()", "(3,)"]),
        (FLOOR, torch.full((1, 3), 0.5), [FLOOR, "(1, 3)", "(3,)"]),
        (FLOOR, torch.ones(3, dtype=torch.int64), [FLOOR, "floating point", "int64"]),
        (FLOOR, torch.ones(3, dtype=torch.complex64), [FLOOR, "floating point", "complex64"]),
        (FLOOR, [0.5, 0.5, 0.5], [FLOOR, "floating point tensor", "list", "torch.full((3,), 0.2)"]),
        ("ball.bsdf.alpha", 0.2, ["ball.bsdf.alpha", "float:", "torch.tensor(0.2)"]),
        (FLOOR, np.full(3, 0.5, np.float32), [FLOOR, "tensor", "ndarray"]),
        ("flor.reflectance.value", torch.full((3,), 0.5), ["flor", "Did you mean", FLOOR]),
        ("short_box_shape.vertex_positions", torch.zeros(72), ["cannot be set", "changes visibility"]),
        ("ball.bsdf.alpha", torch.tensor(0.0), ["ball.bsdf.alpha", "(0, 1]", "roughness"]),
        ("ball.bsdf.eta", torch.tensor(-1.0), ["ball.bsdf.eta", "-1", "(0, ∞)", "ior"]),
    ],
)
def test_an_unphysical_or_malformed_input_raises_before_anything_is_rendered(
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    value: Any,
    words: list[str],
) -> None:
    renderer: SceneRenderer = request.getfixturevalue("stage" if name.startswith("ball") else "cornell")

    def rendered(*_: Any, **__: Any) -> None:
        pytest.fail("something was rendered")

    for method in ("primal", "vjp", "jvp"):
        monkeypatch.setattr(renderer._views[0].engine, method, rendered)
    said = message(lambda: renderer({name: value}))
    assert [word for word in words if word not in said] == [], said


@pytest.mark.parametrize(
    "transform",
    [torch.func.jacrev, torch.func.jacfwd, lambda f: lambda x: torch.func.vmap(f)(x[None])],
    ids=["jacrev", "jacfwd", "vmap"],
)
def test_an_unphysical_value_is_refused_inside_a_transform_too(
    cornell: SceneRenderer, transform: Callable[..., Any]
) -> None:
    f = transform(floor_to_colour(cornell))
    assert "physical range" in message(lambda: f(torch.full((3,), 1.4)))


def test_the_scenes_own_values_can_always_be_rendered(mi: Any) -> None:
    # A roughness of 0 is common in published files, and Mitsuba renders it.
    polished = {"type": "principled", "roughness": 0.0}
    renderer = SceneRenderer(small_cornell(floor=polished), ["floor.roughness.*", "floor.base_color.*"])
    assert torch.isfinite(renderer(renderer.inputs)).all()


BAD_COUNTS = [0, -1, 1.5, True, "16", "many", None, math.nan, math.inf, [16]]


@pytest.mark.parametrize("seed", [-1, 2**32, 1.5, True, "1", "one", None, math.nan, [1]])
def test_a_bad_seed_is_refused(cornell: SceneRenderer, seed: Any) -> None:
    assert "seed" in message(lambda: cornell(seed=seed))
    if seed is not None:
        assert "seed_grad" in message(lambda: cornell(seed_grad=seed))


@pytest.mark.parametrize("spp", [bad for bad in BAD_COUNTS if bad is not None])
def test_a_bad_sample_count_is_refused(cornell: SceneRenderer, spp: Any) -> None:
    assert "spp" in message(lambda: cornell(spp=spp))
    assert "spp" in message(lambda: SceneRenderer("cornell-box", spp=spp))


@pytest.mark.parametrize(
    "resolution", [(0, 8), (8, -1), (8.5, 8), (8,), (8, 8, 3), 8, "8x8", "ab", (None, 8), (True, 8)]
)
def test_a_bad_resolution_is_refused(mi: Any, resolution: Any) -> None:
    assert "resolution" in (said := message(lambda: SceneRenderer("cornell-box", resolution=resolution))) or (
        "width" in said or "height" in said
    )


@pytest.mark.parametrize("max_depth", [0, -2, 2.5, True, "4", "deep"])
def test_a_bad_depth_is_refused(mi: Any, max_depth: Any) -> None:
    assert "max_depth" in message(lambda: SceneRenderer("cornell-box", max_depth=max_depth))


@pytest.mark.parametrize("sensor", [1, -1, 0.5, "0", None])
def test_a_bad_sensor_is_refused(mi: Any, sensor: Any) -> None:
    assert "sensor" in message(lambda: SceneRenderer("cornell-box", sensor=sensor))


@pytest.mark.parametrize(
    "copying",
    [pickle.dumps, copy.deepcopy, copy.copy, lambda r: torch.save(r, io.BytesIO())],
    ids=["pickle", "deepcopy", "copy", "torch.save"],
)
def test_copies_are_refused_with_the_reason(cornell: SceneRenderer, copying: Callable[..., Any]) -> None:
    assert "neither copied nor pickled" in message(lambda: copying(cornell))


# --- The plan --------------------------------------------------------------------------------------

GOLD, SILVER = {"type": "conductor", "material": "Au"}, {"type": "conductor", "material": "Ag"}


def test_inputs_without_a_derivative_route_raise_instead_of_giving_zero(
    mi: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Stock path replay as an example: it finds no derivative through a mirror.
    monkeypatch.setattr(RenderPlan, "create_integrator", lambda self: mi.load_dict({"type": "prb"}))
    renderer = SceneRenderer(small_cornell(floor=GOLD), "floor.*")
    assert torch.isfinite(renderer()).all()
    name = "floor.eta.value"

    def f(value: torch.Tensor) -> torch.Tensor:
        return renderer({name: value})

    value = renderer.inputs[name]
    for _ in range(2):
        assert "No derivative reaches" in message(lambda: gradient(renderer, renderer.inputs))
    assert "No derivative reaches" in message(lambda: torch.func.jvp(f, (value,), (torch.ones(3),)))


def test_finite_differences_are_listed_in_the_plan(mi: Any) -> None:
    plan = SceneRenderer(small_cornell(floor={"type": "dielectric"}), ["floor.*", "ceiling.*"]).plan
    assert [name for name, _ in plan.differences] == ["floor.eta"]
    assert "finite difference for floor.eta: it turns refracted light" in str(plan)


@pytest.mark.parametrize(
    ("changed", "differences"),
    [
        ({}, set()),
        ({"type": "thinlens", "aperture_radius": 0.01, "focus_distance": 3.0}, {"rotation", "fov"}),
        ({"sampler": {"type": "stratified", "sample_count": 4}}, {"rotation", "fov"}),
    ],
)
def test_the_plan_takes_a_difference_for_the_camera_where_the_engine_does(
    mi: Any, changed: dict[str, Any], differences: set[str]
) -> None:
    box = mi.cornell_box()
    box["sensor"] |= changed
    renderer = SceneRenderer(box, ["camera.pose.rotation", "camera.fov"], resolution=(8, 8))
    plan = renderer.plan
    assert {name.rpartition(".")[2] for name, _ in plan.differences} == differences
    assert set(dict(plan.differences)) == set(renderer.rendered_separately)
    assert ("4 numbers of the camera by moving the film" in str(plan)) is not bool(differences)
    assert ("4 numbers of 2 poses by differences of renders" in str(plan)) is bool(differences)


def test_a_textured_mask_over_glass_carries_a_caution(mi: Any) -> None:
    holes = {"type": "bitmap", "bitmap": mi.Bitmap(np.full((2, 2, 1), 0.5, np.float32)), "raw": True}
    mask = {"type": "mask", "opacity": holes, "glass": {"type": "dielectric"}}
    plan = SceneRenderer(small_cornell(floor=mask), "floor.opacity.*").plan
    assert [name for name, _ in plan.cautions] == ["floor.opacity.data"]
    assert "caution: floor.opacity.data: it blends a perfectly specular lobe" in str(plan)


def test_a_black_texture_has_the_derivative_of_a_black_colour(mi: Any) -> None:
    black = {"type": "bitmap", "bitmap": mi.Bitmap(np.zeros((2, 2, 3), np.float32)), "raw": True}
    colour = {"type": "rgb", "value": [0.0, 0.0, 0.0]}
    totals = []
    for reflectance in (black, colour):
        scene = small_cornell(floor={"type": "diffuse", "reflectance": reflectance})
        renderer = SceneRenderer(scene, "floor.*")
        assert renderer.plan.cautions == ()
        x = renderer.leaves()
        renderer(x, seed=shifted(1), spp=64).mean().backward()
        totals.append(next(iter(x.values())).grad.reshape(-1, 3).sum(0))
    torch.testing.assert_close(*totals, rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("own", ["path", "prb", "volpath"])
@pytest.mark.parametrize(
    ("in_scene", "argument", "expected", "words"),
    [
        (5, None, 5, "max_depth 5 as set by the scene's integrator"),
        (5, 3, 3, "max_depth 3 as requested; the scene's integrator sets 5"),
        (5, -1, -1, "max_depth unlimited as requested; the scene's integrator sets 5"),
        (-1, 3, 3, "max_depth 3 as requested; the scene's integrator sets unlimited"),
        (-1, None, -1, "max_depth unlimited"),
    ],
)
def test_the_depth_comes_from_the_argument_or_the_scene(
    mi: Any, own: str, in_scene: int, argument: int | None, expected: int, words: str
) -> None:
    scene = small_cornell(integrator={"type": own, "max_depth": in_scene})
    plan = SceneRenderer(scene, max_depth=argument).plan
    assert plan.max_depth == expected
    assert words in " ".join(str(plan).split())
    assert ("no Russian roulette" in str(plan)) == (expected != -1)


def test_the_plan_gives_every_choice_with_its_reason(cornell: SceneRenderer) -> None:
    lines = str(cornell.plan).splitlines()
    assert lines[0].startswith("integrator scenecaptum_replay ")
    assert "no medium" in lines[0]
    assert any(line.startswith("9 inputs tracked") for line in lines)
    assert "caution" not in str(cornell.plan)
    one = SceneRenderer("cornell-box", "floor.reflectance.value", resolution=(8, 8), spp=1)
    assert "\n1 input tracked " in str(one.plan)
    assert " 1 input, " in repr(one)


PATH = {"type": "path", "max_depth": 3}
INTEGRATORS = {
    "aov": {"type": "aov", "aovs": "z:depth", "image": PATH},
    "moment": {"type": "moment", "image": PATH},
    "depth": {"type": "depth"},
    "ptracer": {"type": "ptracer", "max_depth": 3},
    "volpath": {"type": "volpath", "max_depth": 3},
    "volpathmis": {"type": "volpathmis", "max_depth": 3},
    "prbvolpath": {"type": "prbvolpath", "max_depth": 3},
    "prb_projective": {"type": "prb_projective", "max_depth": 3},
    "path": PATH,
    "direct": {"type": "direct"},
    "prb": {"type": "prb", "max_depth": 3},
}


@pytest.mark.parametrize("own", INTEGRATORS)
def test_the_plan_says_that_the_scenes_integrator_is_not_used(mi: Any, own: str) -> None:
    plan = SceneRenderer(small_cornell(integrator=INTEGRATORS[own])).plan
    said = f"the scene's integrator '{own}' is not used" in str(plan)
    assert said == (own not in ("path", "direct", "prb"))
    depths = {"depth": 6, "direct": 2}
    assert plan.max_depth == depths.get(own, 3)


@pytest.mark.parametrize("own", ["path", "prb"])
def test_the_plan_says_that_media_are_rendered_that_the_scenes_integrator_leaves_out(
    mi: Any, own: str
) -> None:
    fog = {"type": "cube", "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 0.1}}
    plan = SceneRenderer({**small_cornell(integrator=INTEGRATORS[own]), "fog": fog}).plan
    assert dict(plan.decisions)[f"the scene's integrator '{own}' is not used"].startswith(
        "it leaves the scene's media out"
    )


def test_an_integrator_of_a_user_with_the_name_of_one_of_mitsuba_is_said_not_to_be_used(mi: Any) -> None:
    from scenecaptum.rendering.integrators.path import ReplayIntegrator

    class DirectIntegrator(ReplayIntegrator):
        pass

    mi.register_integrator("own_direct", DirectIntegrator)
    plan = SceneRenderer(small_cornell(integrator={"type": "own_direct"})).plan
    assert "the scene's integrator 'own_direct' is not used" in str(plan)
    plan = SceneRenderer(small_cornell(integrator={"type": "scenecaptum_replay"})).plan
    assert "is not used" not in str(plan)


def test_an_integrator_of_a_user_needs_no_description(mi: Any) -> None:
    class Silent(mi.SamplingIntegrator):
        def sample(self, *_: Any, **__: Any) -> Any:
            raise NotImplementedError

    mi.register_integrator("silent", Silent)
    plan = SceneRenderer(small_cornell(integrator={"type": "silent"})).plan
    assert "the scene's integrator 'silent' is not used" in str(plan)
    # A loaded scene does not say by which name it was created.
    loaded = SceneRenderer(mi.load_dict(small_cornell(integrator={"type": "silent"}))).plan
    assert "the scene's integrator 'Silent' is not used" in str(loaded)
    assert plan.max_depth == 6
    assert (
        dict(plan.decisions)["max_depth 6"]
        == "the scene's integrator does not say its depth: give max_depth="
    )


def test_the_depth_of_an_integrator_of_a_user_is_that_of_its_attribute(mi: Any) -> None:
    class Deep(mi.SamplingIntegrator):
        def __init__(self, props: Any) -> None:
            super().__init__(props)
            self.max_depth = props.get("max_depth", 3)

        def sample(self, *_: Any, **__: Any) -> Any:
            raise NotImplementedError

    mi.register_integrator("deep", Deep)
    for own, depth in (({}, 3), ({"max_depth": 2}, 2), ({"max_depth": -1}, -1)):
        plan = SceneRenderer(small_cornell(integrator={"type": "deep", **own})).plan
        assert plan.max_depth == depth
        assert "as set by the scene's integrator" in str(plan)


@pytest.mark.parametrize(("kind", "said"), [("box", None), ("gaussian", "film filter GaussianFilter")])
def test_the_plan_says_that_a_filter_hides_noise_from_the_denoiser(
    mi: Any, kind: str, said: str | None
) -> None:
    scene = small_cornell()
    scene["sensor"]["film"]["rfilter"] = {"type": kind}
    decisions = dict(SceneRenderer(scene, "reflectance", resolution=(8, 8), spp=1).plan.decisions)
    assert [name for name in decisions if name.startswith("film filter")] == ([said] if said else [])


def test_a_scene_without_an_integrator_gets_a_default_depth(mi: Any) -> None:
    scene = small_cornell()
    del scene["integrator"]
    plan = SceneRenderer(scene).plan
    assert (plan.max_depth, "the scene sets no depth" in str(plan)) == (6, True)


def test_lights_hidden_from_the_camera_stay_hidden(mi: Any) -> None:
    # Paths of one segment hit the lamp or nothing.
    own = {"type": "path", "max_depth": 1, "hide_emitters": True}
    renderer = SceneRenderer(small_cornell(integrator=own), "emitters")
    assert renderer.plan.hide_emitters
    assert visible(renderer)["light"] > 0
    assert not renderer().any()


def test_the_repr_names_scene_inputs_resolution_and_samples(cornell: SceneRenderer) -> None:
    assert repr(cornell) == "SceneRenderer('cornell-box', 9 inputs, 32×32, 16 spp)"


def test_bounds_and_labels_belong_to_the_inputs(cornell: SceneRenderer) -> None:
    assert list(cornell.bounds) == list(cornell.labels) == list(cornell.inputs)
    assert cornell.bounds[FLOOR] == (0.0, 1.0)
    assert cornell.bounds[LIGHT] == (0.0, math.inf)
    assert list(cornell.state_dict()) == []


# --- Resolution, samples, sensors, films -----------------------------------------------------------


def test_resolution_samples_and_sensor_are_used(mi: Any) -> None:
    second = copy.deepcopy({k: v for k, v in small_cornell()["sensor"].items() if k != "to_world"})
    second["film"].update(width=10, height=6)
    second["sampler"]["sample_count"] = 9
    second["to_world"] = mi.ScalarTransform4f().look_at(origin=(0, -2, 0), target=(0, 0, 0), up=(0, 0, 1))
    scene = small_cornell(second=second)
    one, two = SceneRenderer(scene), SceneRenderer(scene, sensor=1)
    wide = SceneRenderer(scene, sensor=1, resolution=(12, 5), spp=2)
    assert (one.spp, one.resolution) == (4, (24, 16))
    assert (two.spp, two.resolution) == (9, (10, 6))
    assert (wide().shape, wide.spp, wide.surfaces.shape) == ((5, 12, 3), 2, (5, 12))
    # The second camera is closer, so the lamp covers another share of the image.
    assert "light" in visible(one)
    assert visible(one) != visible(two)


def test_spp_of_a_call_equals_spp_of_the_renderer(cornell: SceneRenderer) -> None:
    built = SceneRenderer("cornell-box", ["reflectance"], resolution=(32, 32), spp=4, max_depth=4)
    assert_same({"image": cornell(seed=shifted(1), spp=4)}, {"image": built(seed=shifted(1))}, allowed=1e-5)
    assert relative(cornell(seed=shifted(1), spp=4), cornell(seed=shifted(1))) > 0.01


@pytest.fixture(scope="module")
def small_image(mi: Any) -> torch.Tensor:
    return SceneRenderer(film())()


@pytest.mark.parametrize("pixel_format", ["rgba", "luminance", "xyz"])
def test_a_film_of_other_channels_is_refused_or_converted_to_rgb(
    small_image: torch.Tensor, pixel_format: str
) -> None:
    # The public contract is an (H, W, 3) image of linear RGB, on which every metric relies.
    expected = small_image
    refusal = ""
    try:
        image = SceneRenderer(film(pixel_format=pixel_format))()
    except SceneCaptumError as error:
        refusal = str(error)
    if refusal:
        assert pixel_format in refusal
    else:
        assert image.shape == expected.shape
        error = relative(image, expected)
        assert error < 1e-5, f"the image differs from the RGB one by {error:.2g}; allowed 1e-5"


def test_a_crop_is_the_corresponding_part_of_the_image(mi: Any) -> None:
    whole = SceneRenderer(film())
    part = SceneRenderer(film(crop_offset_x=5, crop_offset_y=3, crop_width=8, crop_height=6))
    assert part.resolution == (8, 6)
    # One of the 16 rays of a pixel may pass exactly through an edge, where rounding decides.
    error = np.abs(dense(part) - dense(whole)[3:9, 5:13]).max()
    assert error <= 1 / 16, f"shares differ by {error}; allowed 1/16"
    # The samples differ, so the images agree within their noise.
    off = torch.stack(
        [part(seed=s, spp=16).mean() - whole(seed=s, spp=16)[3:9, 5:13].mean() for s in seeds(8)]
    )
    error = off.std() / math.sqrt(len(off))
    assert off.mean().abs() < allowed(8) * error, f"difference {off.mean():.3g}; standard error {error:.3g}"
    assert "crop" in message(lambda: SceneRenderer(film(crop_width=8, crop_height=6), resolution=(8, 6)))


# --- Which surface each pixel shows ----------------------------------------------------------------


def dense(renderer: SceneRenderer) -> np.ndarray:
    """(H, W, objects): the share of each pixel that each object covers."""
    found = renderer.surfaces
    shares = np.zeros((*found.shape, len(found.objects)))
    np.add.at(shares.reshape(-1, len(found.objects)), (found.pixel, found.object_index), found.fraction)
    return shares


def visible(renderer: SceneRenderer) -> dict[str, float]:
    shares = dense(renderer)
    mean = shares.mean(axis=(0, 1))
    return {name: float(share) for name, share in zip(renderer.surfaces.objects, mean, strict=True) if share}


def shown_by(renderer: SceneRenderer, name: str) -> set[str]:
    found = renderer.surfaces
    return set(found.parameters[found.objects.index(name)])


@pytest.mark.parametrize("name", ["cornell", "stage"])
def test_the_shares_of_a_pixel_sum_to_one(request: pytest.FixtureRequest, name: str) -> None:
    renderer: SceneRenderer = request.getfixturevalue(name)
    total = dense(renderer).sum(axis=2)
    assert np.array_equal(total, np.ones(renderer.surfaces.shape))
    assert renderer.surfaces.fraction.min() > 0
    assert len(renderer.surfaces.objects) == len(renderer.surfaces.parameters)


def test_surfaces_agree_with_a_ray_through_each_pixel_centre(mi: Any, cornell: SceneRenderer) -> None:
    config = cornell_box()
    config["sensor"]["film"].update(width=32, height=32)
    scene = mi.load_dict(config, optimize=False)
    row, column = np.mgrid[0:32, 0:32].reshape(2, -1).astype(np.float32)
    centre = mi.Point2f((column + 0.5) / 32, (row + 0.5) / 32)
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, centre, mi.Point2f(0.5))
    hit = scene.ray_intersect(ray)
    shares, objects = dense(cornell).reshape(32 * 32, -1), cornell.surfaces.objects
    compared = 0
    for shape in scene.shapes():
        met = np.array(hit.shape == mi.ShapePtr(shape))
        share = shares[:, objects.index(shape.id())]
        certain = (share == 0) | (share == 1)
        assert np.array_equal(met[certain], share[certain] == 1), shape.id()
        compared += int((share == 1).sum())
    assert compared > 600
    # The box is open at the front and no wider than the view: only the rim shows something else.
    missed = ~np.array(hit.is_valid())
    assert np.all(shares[missed][:, -1] > 0)


def test_an_object_lists_the_parameters_that_it_uses(cornell: SceneRenderer) -> None:
    assert shown_by(cornell, "floor_shape") == {FLOOR, *poses("floor_shape")}
    assert shown_by(cornell, "light") == {"light.bsdf.reflectance.value", LIGHT, *poses("light")}


def poses(name: str) -> set[str]:
    return {f"{name}.pose.{component}" for component in ("translation", "rotation", "scale")}


def test_shared_nested_and_twosided_materials_are_listed_on_every_shape_that_uses_them(mi: Any) -> None:
    paint = {"type": "ref", "id": "paint"}
    scene = small_cornell(
        paint={"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.3, 0.4]}},
        plain={"type": "sphere", "bsdf": paint},
        both={"type": "sphere", "bsdf": {"type": "twosided", "bsdf": paint}},
        cut={"type": "sphere", "bsdf": {"type": "mask", "opacity": 0.5, "bsdf": paint}},
        mixed={
            "type": "sphere",
            "bsdf": {"type": "blendbsdf", "weight": 0.5, "a": paint, "b": {"type": "diffuse"}},
        },
    )
    renderer = SceneRenderer(scene)
    name = "paint.reflectance.value"
    users = {shape for shape in renderer.surfaces.objects if name in shown_by(renderer, shape)}
    assert users == {"plain", "both", "cut", "mixed"}
    assert "cut.bsdf.opacity.value" in shown_by(renderer, "cut")
    assert "mixed.bsdf.weight.value" in shown_by(renderer, "mixed")
    # All are listed, whatever was selected as an input; what cannot be differentiated is not.
    table = renderer.parameters_table()
    assert [p for shown in renderer.surfaces.parameters for p in shown if table[p].problem] == []


def test_rays_that_hit_nothing_see_the_environment(stage: SceneRenderer) -> None:
    assert stage.surfaces.objects[-1] == "background"
    assert shown_by(stage, "background") == {"sky.data", "sky.scale", "sky.pose.rotation"}
    assert visible(stage).keys() == {"ball", "ground", "background"}


def test_without_an_environment_the_background_shows_nothing(cornell: SceneRenderer) -> None:
    assert shown_by(cornell, "background") == set()


def test_an_instance_is_not_the_background(mi: Any) -> None:
    group = {"type": "shapegroup", "part": {"type": "sphere", "bsdf": {"type": "diffuse"}}}
    placed = {
        "type": "instance",
        "group": {"type": "ref", "id": "group"},
        "to_world": mi.ScalarTransform4f().translate([0, -0.5, 0]).scale(0.5),
    }
    renderer = SceneRenderer(small_cornell(group=group, placed=placed))
    centre = dense(renderer)[8, 12]
    seen = {o: share for o, share in zip(renderer.surfaces.objects, centre, strict=True) if share}
    assert seen.keys() == {"placed"}, f"the pixel in front of the instance shows {seen}"


def edge_scene(mi: Any, cover: float) -> Config:
    """A rectangle that covers the left half of an 8 × 8 image, and the share ``cover`` of column 4."""
    edge = -1 + 2 * (4 + cover) / 8
    transform = mi.ScalarTransform4f
    # This camera looks along +z, so its x axis points left in the image; the half turn reverses that.
    view = transform().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "scene",
        "camera": {
            "type": "orthographic",
            "to_world": view,
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
            "sampler": {"type": "independent", "sample_count": 4},
        },
        "card": {
            "type": "rectangle",
            "bsdf": {"type": "diffuse"},
            "to_world": transform().translate([(edge - 3) / 2, 0, 0]).scale([(edge + 3) / 2, 3, 1]),
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [1, 2, 3]}},
    }


@pytest.mark.parametrize("cover", [0.5, 0.25, 0.75, 0.3, 0.45])
def test_a_partly_covered_pixel_has_its_share(mi: Any, cover: float) -> None:
    renderer = SceneRenderer(edge_scene(mi, cover), "all")
    shares = dense(renderer)[..., renderer.surfaces.objects.index("card")]
    expected = np.array([1, 1, 1, 1, cover, 0, 0, 0])
    error = np.abs(shares - expected).max()
    assert error <= 1 / 16, f"covered {shares[0]}, expected {expected}; allowed 1/16"
    assert shown_by(renderer, "background") == {"sky.radiance.value"}


def test_an_edge_along_the_grid_is_off_by_half_a_column_at_most(mi: Any) -> None:
    # A 4 × 4 grid resolves a vertical edge only by its four columns.
    errors = []
    for cover in (0.1, 0.37, 0.63, 0.9):
        renderer = SceneRenderer(edge_scene(mi, cover), "all")
        errors.append(abs(dense(renderer)[0, 4, renderer.surfaces.objects.index("card")] - cover))
    assert max(errors) <= 1 / 8, f"errors {errors}; allowed 1/8"


# --------------------------------------------------------------------------------------------- as a torch module


def test_parameters_are_the_scenes_and_a_module_without_weights(cornell: SceneRenderer) -> None:
    assert cornell.parameters is cornell.parameters_table()
    assert set(cornell.inputs) <= set(cornell.parameters)
    assert list(cornell.parameters()) == list(torch.nn.Sequential(cornell).parameters()) == []
    assert "left_wall.reflectance.value" in str(cornell.parameters)


def test_what_does_not_change_type_or_device_is_allowed(cornell: SceneRenderer) -> None:
    assert cornell.to("cpu") is cornell.float() is cornell.to(torch.float32) is cornell.cpu() is cornell


@pytest.mark.parametrize("change", ["double", "half", "bfloat16"])
def test_another_type_is_refused(cornell: SceneRenderer, change: str) -> None:
    with pytest.raises(SceneCaptumError, match=r"renders in torch\.float32 on cpu, not in"):
        getattr(cornell, change)()
    with pytest.raises(SceneCaptumError, match=r"not in torch\.float64"):
        torch.nn.Sequential(cornell).to(torch.float64)
    assert cornell(seed=1).dtype == torch.float32


def test_another_device_is_refused(cornell: SceneRenderer) -> None:
    with pytest.raises(SceneCaptumError, match="on meta"):
        cornell.to("meta")
