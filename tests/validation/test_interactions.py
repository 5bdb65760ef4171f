"""Second derivatives: against automatic differentiation, identities, and finite differences taken twice."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import IntegratedGradientsScene, SceneRenderer, VanillaSceneGradient, metrics
from scenecaptum.errors import SceneCaptumError
from scenecaptum.estimation import channel_totals, mean_and_error
from scenecaptum.validation import Interactions, _hessian, hessian_vector_product, interactions
from scenecaptum.validation._hessian import CENTRAL, ONE_SIDED
from scenecaptum.validation._interactions import _concise
from scenecaptum.validation._scenes import Scenes, unit_gradient

LAMP = "light.emitter.radiance.value"
PASSES = 8


class Bouncing:
    """``image = A·[light·wall, light·wall·floor, eᵗ·mean(texture)·light]`` with noise that falls as 1/√spp."""

    spp = 64

    def __init__(self, noise: float = 0.1) -> None:
        self.noise = noise
        self.matrix = torch.rand(5, 5, 3, 3, generator=torch.Generator().manual_seed(shifted(3))) + 0.2
        self.bounds = {
            "light": (0.0, math.inf),
            "wall": (0.0, 1.0),
            "floor": (0.0, 1.0),
            "texture": (0.0, 1.0),
        }
        self.inputs = {
            "light": torch.tensor([2.0, 3.0, 1.0]),
            "wall": torch.tensor([0.6, 0.3, 0.5]),
            "floor": torch.tensor(0.0),  # at its bound
            "texture": torch.linspace(0.2, 0.8, 12).reshape(2, 2, 3),
        }

    def exact(self, inputs):
        light, wall, floor, texture = (inputs[name] for name in ("light", "wall", "floor", "texture"))
        bounced = light * wall
        image = self.matrix[..., 0] * bounced + self.matrix[..., 1] * bounced * (floor + floor**2)
        return image + self.matrix[..., 2] * (texture**2).mean((0, 1)).exp() * light

    def __call__(self, inputs, *, seed, spp):
        noise = torch.randn(5, 5, 3, generator=torch.Generator().manual_seed(seed)) / math.sqrt(spp)
        return (1 + self.noise * noise) * self.exact(inputs)


def log_mean(image: torch.Tensor) -> torch.Tensor:
    return image.double().mean().log()


def exact_product(renderer, metric, direction):
    """Differentiate twice with torch."""
    leaves = {name: value.double().requires_grad_() for name, value in renderer.inputs.items()}
    gradients = torch.autograd.grad(metric(renderer.exact(leaves)), list(leaves.values()), create_graph=True)
    along = zip(leaves, gradients, strict=True)
    slope = sum((gradient * direction[name]).sum() for name, gradient in along if name in direction)
    found = torch.autograd.grad(slope, list(leaves.values()), allow_unused=True)
    return {
        name: torch.zeros_like(leaf) if one is None else one
        for (name, leaf), one in zip(leaves.items(), found, strict=True)
    }


DIRECTIONS = [
    {"light": torch.tensor([1.0, -0.5, 2.0])},
    {"floor": torch.tensor(1.0)},
    {"texture": torch.linspace(-1, 1, 12).reshape(2, 2, 3), "wall": torch.tensor(0.5)},
]


@pytest.mark.parametrize("metric", [torch.mean, log_mean])
@pytest.mark.parametrize("direction", DIRECTIONS, ids=["colour", "at a bound", "texture and colour"])
def test_products_without_noise_agree_with_automatic_differentiation(metric, direction):
    renderer = Bouncing(noise=0.0)
    product, exact = (
        hessian_vector_product(renderer, metric, direction),
        exact_product(renderer, metric, direction),
    )
    size = max(one.abs().max().item() for one in exact.values())
    for name, one in exact.items():
        # Single precision over a tenth of the range, and the truncation error of the stencil.
        torch.testing.assert_close(product[name].double(), one, rtol=2e-3, atol=1e-4 * size, msg=name)


@pytest.mark.parametrize("metric", [torch.mean, log_mean])
def test_products_with_noise_agree_within_their_errors(metric):
    renderer = Bouncing()
    direction = DIRECTIONS[0]
    product = hessian_vector_product(renderer, metric, direction, replicates=PASSES)
    for name, exact in exact_product(renderer, metric, direction).items():
        error = product.standard_error[name]
        assert (product[name].double() - exact).abs().max() < allowed(PASSES, 16) * error.max() + 1e-5, name
        assert error.max() < 0.2 * max(exact.abs().max(), 0.01), f"{name}: an error so large shows nothing"


def test_the_draws_of_a_smoothed_metric_are_split_among_the_replicates_and_in_the_errors():
    renderer, direction = Bouncing(noise=0.0), DIRECTIONS[0]
    evaluated = 0

    def counted(image: torch.Tensor) -> torch.Tensor:
        nonlocal evaluated
        evaluated += 1
        return log_mean(image)

    smoothed = metrics.Smoothed(counted, sigma=0.5, n=16)
    a, b = (
        hessian_vector_product(renderer, smoothed, direction, replicates=PASSES, seed=shifted(seed))
        for seed in (0, 1000)
    )
    assert evaluated < 2 * 16 * 100, "with all draws in each replicate it is 150 of them in each product"
    error = torch.hypot(a.standard_error["wall"], b.standard_error["wall"])
    assert error.min() > 1e-4 * a["wall"].abs().max(), "renders have no noise, but the draws have"
    assert ((a["wall"] - b["wall"]).abs() < allowed(PASSES, 3) * error).all()


def test_standard_errors_are_the_spread_of_repeats():
    renderer = Bouncing(noise=1.0)
    gradient = VanillaSceneGradient(Bouncing(noise=0.0), log_mean).attribute()
    exact = interactions(Bouncing(noise=0.0), log_mean, gradient, top=2).matrix
    z = []
    for seed in seeds(16):
        found = interactions(renderer, log_mean, gradient, top=2, seed=seed)
        z.append(((found.matrix - exact) / found.standard_error)[torch.triu_indices(2, 2).unbind()])
    each = torch.stack(z)
    # Student's t of 7 degrees of freedom has a spread of 1.18, here of 16 repeats.
    assert (each.mean(0).abs() < allowed(16, 3) * 1.18 / math.sqrt(16)).all(), each
    assert (each.std(0) > 0.6).all(), each
    assert (each.std(0) < 2.0).all(), each


@pytest.mark.parametrize("stencil", [CENTRAL, ONE_SIDED, ONE_SIDED.scaled(-2.0)])
def test_stencils_differentiate_cubics_exactly(stencil):
    def slope(weights, power):
        return sum(w * x**power for w, x in zip(weights, stencil.offsets, strict=True))

    assert [slope(stencil.weights, power) for power in range(4)] == pytest.approx([0, 1, 0, 0])
    assert [slope(stencil.lower_order, power) for power in range(3)] == pytest.approx([0, 1, 0])


def test_luminance_is_linear_in_the_light(mi, cornell):
    metric = metrics.MeanLuminance()
    product = hessian_vector_product(cornell, metric, {LAMP: cornell.inputs[LAMP]})
    gradient = VanillaSceneGradient(cornell, metric).attribute()
    # Both use the same samples, each of which is linear in the light: no error bars are needed.
    for name, one in gradient.items():
        expected = torch.zeros(3) if name == LAMP else one
        torch.testing.assert_close(product[name], expected, rtol=1e-3, atol=1e-4 * one.norm().item())
    assert product.metric_value == pytest.approx(gradient.metric_value, rel=1e-3)


@pytest.mark.long
def test_the_gradient_of_log_luminance_does_not_depend_on_the_light(mi, cornell):
    product = hessian_vector_product(cornell, log_mean, {LAMP: cornell.inputs[LAMP]})
    seen = product.info["picture"]["denoised"]
    gradient = VanillaSceneGradient(cornell, log_mean).attribute(denoise=seen)
    for name, one in gradient.items():
        if name != LAMP:
            torch.testing.assert_close(product[name], torch.zeros(3), rtol=0, atol=1e-3 * one.norm().item())
    # Both use the same samples, but estimate the effect of noise on the gradient separately.
    off = product[LAMP] + gradient[LAMP]
    assert (off.abs() <= product.standard_error[LAMP]).all()
    assert (product.standard_error[LAMP] < 0.1 * gradient[LAMP].abs()).all()


@pytest.fixture(scope="module")
def box(mi):
    inputs = ["back_wall.reflectance.value", "tall_box.reflectance.value", LAMP]
    return SceneRenderer("cornell-box", inputs, resolution=(16, 16), spp=128, max_depth=4)


@pytest.mark.parametrize("metric", [pytest.param(metrics.MeanLuminance(), marks=pytest.mark.long), log_mean])
def test_the_matrix_is_symmetric_and_agrees_with_finite_differences(box, metric):
    gradient = VanillaSceneGradient(box, metric).attribute(replicates=PASSES)
    found = interactions(box, metric, gradient, replicates=PASSES)
    assert found.is_symmetric, str(found)
    assert found.unit == ("cd/m²" if metric is not log_mean else "")
    assert found.significant.sum() > 4, f"too noisy to show anything:\n{found}"
    scenes = Scenes(box, metric, None, seed=shifted(7), spp=128, replicates=PASSES)
    ways = {name: unit_gradient(gradient[name], box.inputs[name]) for name in found.names}
    for (p, one), (q, two) in itertools.combinations_with_replacement(enumerate(found.names), 2):
        steps = {one: found.steps[p] / 2 * ways[one]}, {two: found.steps[q] / 2 * ways[two]}

        def at(first, second, steps=steps):
            moved = dict(box.inputs)
            for sign, step in zip((first, second), steps, strict=True):
                for name, way in step.items():
                    moved[name] = moved[name] + sign * way
            return scenes.measure(moved)

        twice = at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1)
        judge, error = mean_and_error(twice / (found.steps[p] * found.steps[q]))
        # Where a second derivative is exactly 0, only the rounding of pseudo-values is left.
        rounding = PASSES * 4 * 6e-8 / (found.steps[p] * found.steps[q])
        z = (judge - found.matrix[p, q].item()) / math.hypot(
            error, found.standard_error[p, q].item(), rounding
        )
        assert abs(z) < allowed(PASSES, 10), (
            f"{one} × {two}: {found.matrix[p, q]:.4g}, not {judge:.4g}, z = {z}"
        )


def test_wrong_derivatives_are_detected():
    class Wrong(Bouncing):
        def __call__(self, inputs, *, seed, spp):
            # The derivative with respect to the wall ignores the light.
            others = {name: value.detach() for name, value in inputs.items() if name != "wall"}
            dimmed = {**inputs, **others, "light": torch.ones(3)}
            right, wrong = (super(Wrong, self).__call__(one, seed=seed, spp=spp) for one in (inputs, dimmed))
            held = {**inputs, "wall": inputs["wall"].detach()}
            held_right = super().__call__(held, seed=seed, spp=spp)
            return right.detach() + held_right - held_right.detach() + wrong - wrong.detach()

    good, bad = (interactions(renderer, torch.mean, top=4) for renderer in (Bouncing(), Wrong()))
    assert good.is_symmetric
    assert not bad.is_symmetric
    assert "not symmetric" in bad.verdict


def test_directions_are_unit_gradients_and_the_scale_is_that_of_the_ranges():
    renderer = Bouncing(noise=0.0)
    gradient = VanillaSceneGradient(renderer, torch.mean).attribute()
    found = interactions(renderer, torch.mean, gradient, top=3)
    assert found.names == tuple(row.name for row in gradient.ranking(3))
    for p, one in enumerate(found.names):
        way = unit_gradient(gradient[one], renderer.inputs[one])
        product = exact_product(renderer, torch.mean, {one: way.double()})
        for q, two in enumerate(found.names):
            totals = channel_totals(gradient[two])
            exact = (channel_totals(product[two]) @ (totals / totals.norm()).double()).item()
            assert found.measured[p, q].item() == pytest.approx(exact, rel=2e-3, abs=1e-4)
    scaled = interactions(renderer, torch.mean, gradient, top=3, scale="range")
    lengths = torch.tensor([{"light": 3.0}.get(name, 1.0) for name in found.names]).double()
    torch.testing.assert_close(scaled.matrix, found.matrix * torch.outer(lengths, lengths))


def test_parameters_without_space_to_move_are_left_out():
    renderer = Bouncing()
    renderer.inputs["texture"] = torch.tensor([0.0, 1.0, 0.5, 0.5]).reshape(2, 2, 1).expand(2, 2, 3).clone()
    found = interactions(renderer, torch.mean, top=4)
    assert found.left_out == ("texture",)
    assert set(found.labels) == {"light", "wall", "floor"}
    assert "left out, being at both bounds: texture" in str(found)


def test_invalid_input_is_refused():
    renderer = Bouncing()
    with pytest.raises(SceneCaptumError, match=r"'wal'.*Did you mean 'wall'"):
        hessian_vector_product(renderer, torch.mean, {"wal": torch.tensor(1.0)})
    with pytest.raises(SceneCaptumError, match=r"shape \(2,\)"):
        hessian_vector_product(renderer, torch.mean, {"wall": torch.ones(2)})
    with pytest.raises(SceneCaptumError, match="direction is 0"):
        hessian_vector_product(renderer, torch.mean, {"wall": torch.zeros(3)})
    renderer.inputs["wall"] = torch.tensor([0.0, 1.0, 0.5])
    with pytest.raises(SceneCaptumError, match="out of the physical bounds either way"):
        hessian_vector_product(renderer, torch.mean, {"wall": torch.ones(3)})
    shares = IntegratedGradientsScene(renderer, torch.mean).attribute(n_steps=2)
    with pytest.raises(SceneCaptumError, match="plain gradients"):
        interactions(renderer, torch.mean, shares)
    with pytest.raises(SceneCaptumError, match="scale must be"):
        interactions(renderer, torch.mean, scale="value")


@pytest.fixture
def by_hand():
    """One element differs significantly from 0, one does not, and one is exactly 0."""
    spread = torch.tensor([[[0.0, 1.0], [1.0, 0.0]], [[0.0, -1.0], [-1.0, 0.0]]]).repeat(4, 1, 1).double()
    matrix = torch.tensor([[2.0, 0.1], [0.1, 0.0]]).double()
    return Interactions(
        names=("lamp", "wall"),
        labels=("lamp", "wall: reflectance"),
        replicates=matrix + spread,
        shared_error=torch.zeros(2, 2).double(),
        steps=(0.1, 0.1),
        metric="Glare",
        scale="unit",
    )


def test_table_and_figure_mark_insignificant_elements(by_hand):
    assert by_hand.significant.tolist() == [[True, False], [False, False]]
    assert str(by_hand).startswith(
        "second derivatives of Glare, per unit along each parameter's own gradient"
    )
    in_unit = dataclasses.replace(by_hand, metric="mean luminance", unit="cd/m²")
    assert str(in_unit).startswith("second derivatives of mean luminance (cd/m²), per unit along")
    assert "1 of 3 second derivatives of Glare differ from 0" in str(by_hand)
    (line,) = [line for line in str(by_hand).splitlines() if line.startswith("1 lamp")]
    assert line.split() == ["1", "lamp", "2.000", "0.1(4)?"]
    axes = by_hand.plot().axes[0]
    assert [text.get_text() for text in axes.texts][:4] == ["2.000", "0.1(4)", "0.1(4)", "0"]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["lamp  1", "wall: reflectance  2"]


def test_the_scenes_of_a_stencil_have_their_own_guides(mi):
    """A picture of a moved object is not denoised with the outlines of the old one."""
    name, offsets = "tall_box_shape.pose.translation", (0.0, 1.0)
    direction = {name: torch.tensor([0.3, 0.0, 0.0])}
    renderer = SceneRenderer("cornell-box", [name], resolution=(16, 16), spp=4)
    scenes = Scenes(renderer, metrics.MeanLuminance(), None, seed=0, spp=4, replicates=2)
    found = _hessian._StencilRenderer(scenes, direction, offsets).guides_of({})
    for number, offset in enumerate(offsets):
        expected = renderer.guides_of({name: offset * direction[name]})
        assert torch.equal(found.normal[number], expected.normal)
        assert torch.equal(found.albedo[number], expected.albedo)
    assert not torch.equal(found.normal[0], found.normal[1])


@pytest.mark.parametrize(
    ("value", "error", "written"),
    [
        (0.0123, 0.0004, "0.0123(4)"),
        (-0.0123, 0.0004, "−0.0123(4)"),
        (0.0, 0.05, "0.00(5)"),
        (-1e-9, 0.05, "0.00(5)"),
        (0.0, 9e-8, "0(9)e−8"),
        (1e-12, 9e-8, "0(9)e−8"),
        (0.0, 1.5e-8, "0.0(15)e−8"),
        (0.0, 50.0, "0(50)"),
        (1234.0, 50.0, "1230(50)"),
        (1.2e8, 5e7, "1.2(5)e8"),
        (2.0, 0.0, "2.000"),
        (0.0, 0.0, "0"),
    ],
)
def test_brackets_have_the_size_of_the_error(value, error, written):
    assert _concise(value, error) == written
    digits = written.rpartition("(")[2].partition(")")[0]
    if error:
        # Read as metrologists do: the digits in brackets stand in the last places of the mantissa.
        head, _, exponent = written.partition("e")
        mantissa = head.partition("(")[0].partition(".")[2]
        read = int(digits) * 10.0 ** (int(exponent.replace("−", "-") or 0) - len(mantissa))
        assert read == pytest.approx(error)
