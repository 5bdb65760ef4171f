"""Captum's own classes on the bridge: each against its definition, by autograd or renders without the bridge."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from refusals import message
from seeds import shifted
from toy import ToyRenderer

from scenecaptum import SmoothGradScene
from scenecaptum.errors import SceneCaptumError
from scenecaptum.rendering import SceneRenderer
from scenecaptum.rendering._captum import as_captum
from scenecaptum.scene import OPEN_MARGIN
from scenecaptum.scene.bundled import cornell_box

captum = pytest.importorskip("captum.attr", reason="captum is not installed")

pytestmark = pytest.mark.filterwarnings("ignore:Input Tensor .* did not already require gradients")

Values = dict[str, torch.Tensor]
Row = tuple[torch.Tensor, ...]

# Two backward passes over the same samples differ only by atomic additions, 1e-6 relative.
SAME = 1e-5


class ToyRoom:
    """A colour, a roughness with open bounds, and the texels of a light: every shape and kind of bound."""

    spp = 4

    def __init__(self, roughness: float = 0.4) -> None:
        self.bounds = {"colour": (0.0, 1.0), "roughness": (0.0, 1.0), "light": (0.0, math.inf)}
        self.inputs = {
            "colour": torch.tensor([0.5, 0.3, 0.8]),
            "roughness": torch.tensor(roughness),
            "light": torch.linspace(0.5, 2.0, 12).reshape(2, 2, 3),
        }
        self.own = {name: value.clone() for name, value in self.inputs.items()}
        self.noise = ToyRenderer()
        self.calls: list[tuple[Values, int, int]] = []

    def parameters_table(self) -> dict[str, Any]:
        opened = {name: SimpleNamespace(open_low=name == "roughness") for name in self.inputs}
        return {name: SimpleNamespace(bounds=bounds) for name, bounds in opened.items()}

    def __call__(self, inputs: Mapping[str, torch.Tensor], *, seed: int, spp: int) -> torch.Tensor:
        self.calls.append(({name: value.detach().clone() for name, value in inputs.items()}, seed, spp))
        for name, value in inputs.items():
            low, high = self.bounds[name]
            bad = value.min() < low or value.max() > high or (name == "roughness" and value <= low)
            if bad and not torch.equal(value, self.own[name]):
                raise SceneCaptumError(f"{name!r} is outside the physical range.")
        bounced = 1 + inputs["colour"] ** 2 + torch.sqrt(inputs["roughness"] + 0.1)
        colour = bounced * inputs["light"].mean((0, 1))
        return self.noise.sampled(seed, spp) @ colour.float()


@pytest.fixture(scope="module")
def box(mi: Any) -> SceneRenderer:
    """The Cornell box at 16 × 16 with a floor of rough plastic."""
    scene = cornell_box()
    scene["sensor"]["film"].update(width=16, height=16)
    scene["floor"] = {"type": "roughplastic", "alpha": 0.3}
    names = ["left_wall.reflectance.value", "floor.alpha", "light.emitter.radiance.value"]
    return SceneRenderer(scene, inputs=names, spp=4, max_depth=3)


@pytest.fixture(params=["toy", "box"])
def renderer(request: pytest.FixtureRequest) -> Any:
    return ToyRoom() if request.param == "toy" else request.getfixturevalue("box")


def brightness(image: torch.Tensor) -> torch.Tensor:
    """A non-linear metric, so that no method is right because of linearity."""
    return (image + 0.1).log().mean()


def channels(image: torch.Tensor) -> torch.Tensor:
    return image.mean((0, 1))


def measured(renderer: Any, row: Row, metric: Any = brightness, seed: int | None = None) -> torch.Tensor:
    values = dict(zip(renderer.inputs, row, strict=True))
    seed = shifted() if seed is None else seed
    output: torch.Tensor = metric(renderer(values, seed=seed, spp=renderer.spp))
    return output


def gradient(renderer: Any, row: Row, metric: Any = brightness, seed: int | None = None) -> Row:
    """Differentiate one render with plain autograd, without the bridge."""
    leaves = tuple(value.detach().clone().requires_grad_() for value in row)
    return torch.autograd.grad(measured(renderer, leaves, metric, seed), leaves)


def own(renderer: Any) -> Row:
    return tuple(renderer.inputs.values())


def halved(renderer: Any) -> Row:
    return tuple(0.5 * value for value in own(renderer))


def batch(*rows: Row) -> Row:
    return tuple(torch.stack(column) for column in zip(*rows, strict=True))


def assert_same(found: Any, *expected_rows: Row, allowed: float = SAME) -> None:
    """Compare attributions with one row of tensors per element of the batch, relative to the largest number."""
    assert isinstance(found, tuple)
    expected = batch(*expected_rows)
    assert [tuple(value.shape) for value in found] == [tuple(value.shape) for value in expected]
    for index, (value, right) in enumerate(zip(found, expected, strict=True)):
        error = (value.double() - right.double()).abs().max().item()
        scale = right.abs().max().item() or 1.0
        assert error <= allowed * scale, f"input {index}: off by {error:.2g} of {scale:.2g}"


def reflected(value: torch.Tensor, low: float, high: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Reflect each number until it is inside; return it with the sign of the derivative."""
    found, signs = [], []
    for number in value.flatten().tolist():
        place, sign = number, 1.0
        while not low <= place <= high:
            place = 2 * low - place if place < low else 2 * high - place
            sign = -sign
        found.append(place)
        signs.append(sign)
    return torch.tensor(found).reshape(value.shape), torch.tensor(signs).reshape(value.shape)


class Recorded:
    """A forward function that records the rows it was called with."""

    def __init__(self, forward: Callable[..., torch.Tensor]) -> None:
        self.forward = forward
        self.rows: list[Row] = []

    def __call__(self, *tensors: torch.Tensor) -> torch.Tensor:
        self.rows += [tuple(t.detach().clone() for t in row) for row in zip(*tensors, strict=True)]
        return self.forward(*tensors)


# --- The two things that it returns ----------------------------------------------------------------


def test_inputs_are_the_renderers_with_a_batch_dimension(renderer: Any) -> None:
    _, inputs = as_captum(renderer, brightness)
    assert all(value.shape[0] == 1 and not value.requires_grad for value in inputs)
    assert [tuple(value.shape[1:]) for value in inputs] == [tuple(v.shape) for v in own(renderer)]
    assert all(torch.equal(value[0], v) for value, v in zip(inputs, own(renderer), strict=True))


def test_the_method_of_the_renderer_is_the_bridge(box: SceneRenderer) -> None:
    forward, inputs = box.as_captum(brightness, seed=shifted(3), bounds="reflect")
    assert forward(*inputs).item() == pytest.approx(measured(box, own(box), seed=shifted(3)).item(), rel=1e-6)


@pytest.mark.parametrize("bounds", ["raise", "reflect"])
def test_forward_measures_each_row_with_the_seed(renderer: Any, bounds: str) -> None:
    rows = [own(renderer), halved(renderer), own(renderer)]
    for metric, shape in ((brightness, (3,)), (channels, (3, 3)), (lambda i: i.mean().reshape(1), (3, 1))):
        forward, _ = as_captum(renderer, metric, seed=shifted(5), bounds=bounds)
        found = forward(*batch(*rows))
        assert found.shape == shape
        torch.testing.assert_close(
            found, torch.stack([measured(renderer, row, metric, shifted(5)) for row in rows])
        )


def test_rows_may_be_views_of_one_another(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness)
    found = forward(*(value.expand(3, *value.shape[1:]) for value in inputs))
    torch.testing.assert_close(found, forward(*inputs).expand(3))


def test_changing_the_inputs_does_not_change_the_renderer() -> None:
    toy = ToyRoom()
    forward, inputs = as_captum(toy, brightness, bounds="reflect")
    before = forward(*inputs)
    for value in inputs:
        value.mul_(0.5)
    assert torch.equal(forward(*(value[None] for value in own(toy))), before)


# --- Gradients -------------------------------------------------------------------------------------


@pytest.mark.parametrize("bounds", ["raise", "reflect"])
def test_saliency_is_the_gradient(renderer: Any, bounds: str) -> None:
    forward, inputs = as_captum(renderer, brightness, seed=shifted(7), bounds=bounds)
    expected = gradient(renderer, own(renderer), seed=shifted(7))
    assert_same(captum.Saliency(forward).attribute(inputs, abs=False), expected)
    assert_same(captum.Saliency(forward).attribute(inputs), tuple(g.abs() for g in expected))


def test_saliency_of_a_batch_is_that_of_each_row(renderer: Any) -> None:
    forward, _ = as_captum(renderer, brightness, seed=shifted(7))
    rows = [own(renderer), halved(renderer)]
    found = captum.Saliency(forward).attribute(batch(*rows), abs=False)
    assert_same(found, *(gradient(renderer, row, seed=shifted(7)) for row in rows))


def test_input_x_gradient(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness, seed=shifted(2))
    gradients = gradient(renderer, own(renderer), seed=shifted(2))
    expected = tuple(x * g for x, g in zip(own(renderer), gradients, strict=True))
    assert_same(captum.InputXGradient(forward).attribute(inputs), expected)


@pytest.mark.parametrize("target", [0, 2, [1, 2], torch.tensor([2, 0])])
def test_target_names_an_element_of_a_vector(renderer: Any, target: Any) -> None:
    forward, _ = as_captum(renderer, channels, seed=shifted(1))
    rows = [own(renderer), halved(renderer)]
    found = captum.Saliency(forward).attribute(batch(*rows), target=target, abs=False)
    elements = [target, target] if isinstance(target, int) else [int(t) for t in target]
    expected = (
        gradient(renderer, row, lambda image, k=k: channels(image)[k], seed=shifted(1))
        for row, k in zip(rows, elements, strict=True)
    )
    assert_same(found, *expected)


# --- Integrated Gradients --------------------------------------------------------------------------


def integrated(renderer: Any, row: Row, start: Row, n_steps: int) -> Row:
    """Integrate along the straight path by Gauss–Legendre quadrature, with a separate render for each step."""
    nodes, weights = np.polynomial.legendre.leggauss(n_steps)
    steps = []
    for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        point = tuple(s + node * (x - s) for x, s in zip(row, start, strict=True))
        steps.append(tuple(weight * g for g in gradient(renderer, point)))
    means = (torch.stack(column).sum(0) for column in zip(*steps, strict=True))
    return tuple((x - s) * mean for x, s, mean in zip(row, start, means, strict=True))


@pytest.mark.parametrize(("examples", "internal_batch_size"), [(1, None), (1, 1), (2, None), (2, 2), (2, 5)])
def test_integrated_gradients_however_they_are_batched(
    renderer: Any, examples: int, internal_batch_size: int | None
) -> None:
    forward, _ = as_captum(renderer, brightness)
    rows = [own(renderer), tuple(0.8 * value for value in own(renderer))][:examples]
    found = captum.IntegratedGradients(forward).attribute(
        batch(*rows), batch(halved(renderer)), n_steps=3, internal_batch_size=internal_batch_size
    )
    assert_same(found, *(integrated(renderer, row, halved(renderer), 3) for row in rows))


def test_the_convergence_delta_is_that_of_the_metric(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness)
    found, delta = captum.IntegratedGradients(forward).attribute(
        inputs, batch(halved(renderer)), n_steps=3, return_convergence_delta=True
    )
    change = measured(renderer, own(renderer)) - measured(renderer, halved(renderer))
    total = sum(value.sum().item() for value in found)
    assert delta.item() == pytest.approx(total - change.item(), abs=1e-5)


# --- Noise -----------------------------------------------------------------------------------------


def test_noise_beyond_the_bounds_is_reflected(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness, bounds="reflect")
    recorded = Recorded(forward)
    torch.manual_seed(shifted(4))
    found = captum.NoiseTunnel(captum.Saliency(recorded)).attribute(
        inputs, nt_samples=4, stdevs=(1.0, 0.6, 2.0), abs=False
    )
    assert len(recorded.rows) == 4
    limits = list(renderer.bounds.values())
    per_row = []
    for row in recorded.rows:
        landed = [reflected(value, *limit) for value, limit in zip(row, limits, strict=True)]
        assert not all(torch.equal(value, where) for value, (where, _) in zip(row, landed, strict=True))
        gradients = gradient(renderer, tuple(where for where, _ in landed))
        per_row.append(tuple(sign * g for (_, sign), g in zip(landed, gradients, strict=True)))
    expected = tuple(torch.stack(column).mean(0) for column in zip(*per_row, strict=True))
    # Rounding differs in the reflected values, and the gradient depends on them.
    assert_same(found, expected, allowed=1e-4)


def test_only_captum_counts_draws_that_were_reflected_with_the_opposite_sign() -> None:
    class NearBound(ToyRenderer):
        bounds: ClassVar = {"x": (0.0, 1.0)}

        def __init__(self) -> None:
            super().__init__(noise=0.0)
            self.inputs = {"x": torch.tensor([0.01, 0.5, 0.5])}

    toy = NearBound()
    slopes = gradient(toy, own(toy), torch.mean)[0]
    forward, inputs = as_captum(toy, torch.mean, bounds="reflect")
    recorded = Recorded(forward)
    torch.manual_seed(shifted(4))
    (theirs,) = captum.NoiseTunnel(captum.Saliency(recorded)).attribute(
        inputs, nt_samples=64, stdevs=0.05, abs=False
    )
    signs = torch.stack([row[0] for row in recorded.rows]).sign().mean(0)
    assert signs[0] < 0.6
    torch.testing.assert_close(theirs[0], signs * slopes)
    ours = SmoothGradScene(toy, torch.mean).attribute(stdevs=0.05, seed=0)
    torch.testing.assert_close(ours["x"], slopes)


def test_noise_beyond_the_bounds_is_refused_on_request(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness, bounds="raise")
    torch.manual_seed(shifted(4))
    with pytest.raises(SceneCaptumError, match="outside the physical range"):
        captum.NoiseTunnel(captum.Saliency(forward)).attribute(inputs, nt_samples=4, stdevs=1.0)


def test_noise_tunnel_in_batches(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness, bounds="reflect")
    tunnel = captum.NoiseTunnel(captum.IntegratedGradients(forward))
    for kind in ("smoothgrad", "smoothgrad_sq", "vargrad"):
        found = tunnel.attribute(
            inputs, nt_type=kind, nt_samples=3, nt_samples_batch_size=2, stdevs=0.5, n_steps=2
        )
        assert [value.shape for value in found] == [value.shape for value in inputs]
        assert all(value.isfinite().all() for value in found)


def test_gradient_shap_of_a_linear_input_is_exact(renderer: Any) -> None:
    """An image is linear in its light: the gradient is the same everywhere between baseline and input."""
    forward, inputs = as_captum(renderer, torch.mean)
    start = (*own(renderer)[:2], 0.25 * own(renderer)[2])
    found = captum.GradientShap(forward).attribute(inputs, batch(start, start), n_samples=3, stdevs=0.0)
    change = measured(renderer, own(renderer), torch.mean) - measured(renderer, start, torch.mean)
    assert found[2].sum().item() == pytest.approx(change.item(), rel=1e-4)
    assert all(torch.equal(value, torch.zeros_like(value)) for value in found[:2])


def test_gradient_shap_with_noise(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, channels, bounds="reflect")
    found, delta = captum.GradientShap(forward).attribute(
        inputs, batch(halved(renderer)), n_samples=3, stdevs=0.5, target=1, return_convergence_delta=True
    )
    assert [value.shape for value in found] == [value.shape for value in inputs]
    assert delta.shape == (3,)
    assert all(value.isfinite().all() for value in (*found, delta))


# --- Taking inputs away ----------------------------------------------------------------------------


@pytest.mark.parametrize("perturbations_per_eval", [1, 3])
def test_feature_ablation_is_the_difference_of_two_renders(
    renderer: Any, perturbations_per_eval: int
) -> None:
    forward, inputs = as_captum(renderer, brightness, seed=shifted(6), bounds="reflect")
    full = measured(renderer, own(renderer), seed=shifted(6))
    expected = []
    for index, value in enumerate(own(renderer)):
        removed = OPEN_MARGIN if value.ndim == 0 else 0.0  # a roughness of 0 is not physical
        changes = []
        for element in range(value.numel()):
            ablated = [v.clone() for v in own(renderer)]
            ablated[index].view(-1)[element] = removed
            changes.append(full - measured(renderer, tuple(ablated), seed=shifted(6)))
        expected.append(torch.stack(changes).reshape(value.shape))
    found = captum.FeatureAblation(forward).attribute(inputs, perturbations_per_eval=perturbations_per_eval)
    # The difference of two numbers of magnitude 1.
    for value, right in zip(found, expected, strict=True):
        torch.testing.assert_close(value[0], right, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("perturbations_per_eval", [1, 3])
def test_shapley_value_sampling_is_complete(renderer: Any, perturbations_per_eval: int) -> None:
    forward, inputs = as_captum(renderer, channels, bounds="reflect")
    whole = tuple(torch.full((1, *value.shape[1:]), i) for i, value in enumerate(inputs))
    torch.manual_seed(shifted())
    found = captum.ShapleyValueSampling(forward).attribute(
        inputs,
        batch(halved(renderer)),
        target=1,
        feature_mask=whole,  # one feature per input, which keeps the test quick
        n_samples=3,
        perturbations_per_eval=perturbations_per_eval,
    )
    assert [value.shape for value in found] == [value.shape for value in inputs]
    change = measured(renderer, own(renderer), channels) - measured(renderer, halved(renderer), channels)
    total = sum(value.flatten()[0].item() for value in found)  # all elements of a feature share its value
    assert total == pytest.approx(change[1].item(), rel=1e-4)


def test_shapley_value_sampling_of_single_numbers() -> None:
    toy = ToyRoom()
    forward, inputs = as_captum(toy, brightness, bounds="reflect")
    found = captum.ShapleyValueSampling(forward).attribute(inputs, n_samples=2)
    nothing = (torch.zeros(3), torch.tensor(OPEN_MARGIN), torch.zeros(2, 2, 3))
    change = measured(toy, own(toy)) - measured(toy, nothing)
    assert sum(value.sum().item() for value in found) == pytest.approx(change.item(), rel=1e-4)


def test_occlusion(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness, bounds="reflect")
    windows = tuple((1,) * (value.ndim - 1) for value in inputs)
    found = captum.Occlusion(forward).attribute(inputs, windows)
    expected = captum.FeatureAblation(forward).attribute(inputs)
    for value, right in zip(found, expected, strict=True):
        torch.testing.assert_close(value, right, rtol=1e-4, atol=1e-6)


# --- Seeds -----------------------------------------------------------------------------------------


def test_a_seed_repeats_and_does_not_touch_torchs_generator(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness, seed=shifted(9))
    state = torch.get_rng_state()
    first, second = forward(*inputs), forward(*(torch.cat([value, value]) for value in inputs))
    torch.testing.assert_close(second, first.expand(2), rtol=1e-6, atol=0)
    assert torch.equal(torch.get_rng_state(), state)


def test_without_a_seed_every_row_of_every_call_has_a_new_one(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness, seed=None)
    doubled = tuple(torch.cat([value, value]) for value in inputs)
    torch.manual_seed(shifted(1))
    drawn = torch.cat([forward(*doubled), forward(*doubled)])
    assert len(set(drawn.tolist())) == 4
    torch.manual_seed(shifted(1))
    torch.testing.assert_close(torch.cat([forward(*doubled), forward(*doubled)]), drawn, rtol=1e-6, atol=0)


def test_every_row_is_rendered_once_with_the_renderers_own_sample_count() -> None:
    toy = ToyRoom()
    forward, _ = as_captum(toy, brightness, seed=shifted(11))
    forward(*batch(own(toy), halved(toy)))
    assert [(seed, spp) for _, seed, spp in toy.calls] == [(shifted(11), 4)] * 2
    torch.testing.assert_close(toy.calls[1][0]["light"], 0.5 * toy.inputs["light"])


def test_a_random_seed_is_valid_for_mitsuba() -> None:
    toy = ToyRoom()
    forward, inputs = as_captum(toy, brightness, seed=None)
    for _ in range(50):
        forward(*inputs)
    seeds = [seed for _, seed, _ in toy.calls]
    assert all(type(seed) is int and 0 <= seed < 2**32 for seed in seeds)
    assert max(seeds) > 2**31


# --- Bounds ----------------------------------------------------------------------------------------


def test_the_scenes_own_value_is_kept_even_outside_the_bounds() -> None:
    toy = ToyRoom(roughness=0.0)  # as in principled materials, which Mitsuba accepts
    forward, inputs = as_captum(toy, brightness, bounds="reflect")
    forward(*(value.double() for value in inputs))
    forward(*(0.5 * value - 0.1 for value in inputs))
    first, second = (values for values, _, _ in toy.calls)
    assert first["roughness"].item() == 0
    assert second["roughness"].item() == pytest.approx(0.1)


def test_an_open_bound_is_never_rendered(renderer: Any) -> None:
    forward, inputs = as_captum(renderer, brightness, bounds="reflect")
    found = forward(*(torch.zeros_like(value) if value.ndim == 1 else value for value in inputs))
    colour, _, light = own(renderer)
    expected = measured(renderer, (colour, torch.tensor(OPEN_MARGIN), light))
    assert found.item() == pytest.approx(expected.item(), rel=1e-6)


def test_a_renderer_without_a_table_has_closed_bounds() -> None:
    class BoundedToy(ToyRenderer):
        @property
        def bounds(self) -> dict[str, tuple[float, float]]:
            return {"x": (0.0, 1.0)}

    forward, _ = as_captum(BoundedToy(), brightness, bounds="reflect")
    found = forward(torch.tensor([[0.0, -0.25, 1.25]]))
    assert found.item() == measured(BoundedToy(), (torch.tensor([0.0, 0.25, 0.75]),)).item()


# --- What is refused -------------------------------------------------------------------------------


def test_options_are_checked_at_construction() -> None:
    toy = ToyRoom()
    assert '"raise" or "reflect", not \'clip\'' in message(lambda: as_captum(toy, brightness, bounds="clip"))
    assert "seed must be" in message(lambda: as_captum(toy, brightness, seed=-1))
    assert "seed must be" in message(lambda: as_captum(toy, brightness, seed=2**32))
    assert "has bounds" in message(lambda: as_captum(ToyRenderer(), brightness, bounds="reflect"))
    assert "has no inputs" in message(lambda: as_captum(lambda inputs, *, seed, spp: None, brightness))


def test_tensors_that_are_not_a_batch_of_the_inputs_are_refused() -> None:
    forward, inputs = as_captum(ToyRoom(), brightness)
    colour, roughness, light = inputs
    assert "3 inputs, in their order, not 2" in message(lambda: forward(colour, roughness))
    assert "additional_forward_args" in message(
        lambda: captum.Saliency(forward).attribute(inputs, additional_forward_args=(torch.zeros(1),))
    )
    unequal = message(lambda: forward(colour, roughness.expand(2), light))
    assert "'colour' has 1 and 'roughness' 2" in unequal
    assert "not a 0-d tensor" in message(lambda: forward(colour, roughness[0], light))
    assert "not float" in message(lambda: forward(colour, 0.5, light))
    assert "no rows" in message(lambda: forward(*(value[:0] for value in inputs)))


def test_a_row_of_the_wrong_shape_is_refused_by_the_renderer(box: SceneRenderer) -> None:
    forward, inputs = box.as_captum(brightness)
    assert "has shape (2,)" in message(lambda: forward(inputs[0][:, :2], *inputs[1:]))


@pytest.mark.parametrize(
    ("metric", "said"),
    [
        (lambda image: image, "returned shape (4, 4, 3)"),
        (lambda image: image.mean(2), "returned shape (4, 4)"),
        (lambda image: image.new_zeros(0), "returned shape (0,)"),
        (lambda image: float(image.mean()), "not float"),
        (lambda image: image.detach().numpy().mean(), "not float32"),
    ],
)
def test_metrics_that_return_neither_scalar_nor_vector_are_refused(metric: Any, said: str) -> None:
    forward, inputs = as_captum(ToyRoom(), metric)
    assert said in message(lambda: forward(*inputs))
