"""Global sensitivity: gradients, Morris's and Sobol's methods against closed forms."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest
import torch
from chance import allowed
from seeds import seeds, shifted

from scenecaptum import SceneRenderer, metrics
from scenecaptum.errors import SceneCaptumError
from scenecaptum.estimation import TargetedMetric
from scenecaptum.validation import compare_sensitivity, dgsm
from scenecaptum.validation._dgsm import Derivatives, summarise_derivatives
from scenecaptum.validation._scalars import INTERVAL_NOTE, find_scalars
from scenecaptum.validation._sensitivity import _samples_until_stable


class Function:
    """A noise-free "renderer" whose image is a function of numbers."""

    spp = 16

    def __init__(self, count, low, high):
        self.inputs = {f"x{k}": torch.tensor(0.3 + 0.1 * k) for k in range(1, count + 1)}
        self.bounds = dict.fromkeys(self.inputs, (low, high))
        self.calls = 0

    def __call__(self, inputs, *, seed, spp):
        self.calls += 1
        x = torch.stack([inputs[name].double() for name in self.inputs])
        return self.value(x).expand(2, 2, 3)


class Ishigami(Function):
    """``sin x₁ + 7 sin² x₂ + 0.1 x₃⁴ sin x₁`` on [−π, π]³; Sobol and Levitan, 1999, give its indices."""

    def __init__(self):
        super().__init__(3, -math.pi, math.pi)
        fourth, eighth = 0.1 * math.pi**4, 0.01 * math.pi**8
        self.variance = 49 / 8 + fourth / 5 + eighth / 18 + 1 / 2
        slope_1 = 0.5 * (1 + 2 * fourth / 5 + eighth / 9)  # E[(cos x₁ (1 + 0.1 x₃⁴))²]
        slope_3 = 0.08 * math.pi**6 / 7  # E[(0.4 x₃³ sin x₁)²]
        self.nu = (slope_1, 49 / 2, slope_3)  # 49/2 = E[(7 sin 2x₂)²]
        both = 8 * eighth / 225
        parts = (0.5 * (1 + fourth / 5) ** 2 + both, 49 / 8, both)
        self.total = tuple(part / self.variance for part in parts)

    def value(self, x):
        return x[0].sin() + 7 * x[1].sin() ** 2 + 0.1 * x[2] ** 4 * x[0].sin()


class Product(Function):
    """Sobol's g-function ``Π (|4x − 2| + a) / (1 + a)`` on the unit cube."""

    a = (0.0, 1.0, 4.5, 9.0, 99.0, 20.0)

    def __init__(self):
        super().__init__(len(self.a), 0.0, 1.0)
        parts = [1 / (3 * (1 + a) ** 2) for a in self.a]
        square = math.prod(1 + part for part in parts)
        self.variance = square - 1
        # The derivative of a factor is ±4 / (1 + a); it is multiplied by the mean square of the others.
        self.nu = tuple(48 * part * square / (1 + part) for part in parts)
        self.total = tuple(part * square / (1 + part) / self.variance for part in parts)

    def value(self, x):
        a = torch.tensor(self.a, dtype=x.dtype)
        return (((4 * x - 2).abs() + a) / (1 + a)).prod()


@pytest.mark.parametrize("function", [Ishigami, Product])
def test_the_integrals_are_those_in_closed_form(function):
    function = function()
    found = dgsm(function, torch.mean, points=512)
    rows = {row.name: row for row in found.rows}
    assert abs(found.variance - function.variance) < allowed(40) * found.variance_error
    for k, (nu, total) in enumerate(zip(function.nu, function.total, strict=True), start=1):
        row = rows[f"x{k}"]
        bound = (row.high - row.low) ** 2 * nu / (math.pi**2 * function.variance)
        assert abs(row.nu - nu) < allowed(40, 6) * row.nu_error, (
            f"{row.name}: {row.nu} ± {row.nu_error}, not {nu}"
        )
        assert abs(row.bound - bound) < allowed(40, 6) * row.bound_error, (
            f"{row.name}: {row.bound}, not {bound}"
        )
        assert row.bound > total
        assert row.nu_error < 0.3 * row.nu
    assert [row.nu for row in found.rows] == sorted((row.nu for row in found.rows), reverse=True)


def test_scattered_points_repeat_and_follow_the_seed():
    one, same, other = (
        dgsm(Ishigami(), torch.mean, points=16, seed=seed).rows for seed in map(shifted, (1, 1, 2))
    )
    assert one == same
    assert one != other


@pytest.mark.parametrize("function", [Ishigami, Product])
def test_morris_and_sobol_use_the_same_function(function):
    """The input and output of SALib are checked by the closed form as well."""
    function = function()
    found = compare_sensitivity(function, torch.mean, points=256, base_samples=1024, trajectories=8, top=2)
    for k, total in enumerate(function.total, start=1):
        name = f"x{k}"
        error = max(found.sobol.errors[name], 1e-4)
        assert abs(found.sobol.values[name] - total) < allowed(40, 6) * error
        bound = (2 * math.pi) ** 2 if isinstance(function, Ishigami) else 1.0
        bound *= function.nu[k - 1] / (math.pi**2 * function.variance)
        assert abs(found.dgsm.values[name] - bound) < allowed(40, 6) * found.dgsm.errors[name]
    best = sorted(range(len(function.total)), key=lambda k: -function.total[k])[:2]
    assert found.sobol.top == tuple(f"x{k + 1}" for k in best)
    assert found.sobol.resolved
    assert [one.name for one in found.parameters] == sorted(
        found.sobol.values, key=lambda name: -found.sobol.values[name]
    )


def test_the_g_function_ranks_alike_by_every_global_method():
    found = compare_sensitivity(Product(), torch.mean, points=128, base_samples=256, trajectories=60, top=3)
    assert found.dgsm.top == found.sobol.top == ("x1", "x2", "x3")
    # One step of Morris's grid, 2/3 of the interval, crosses the kink: from |4x − 2| = 2 to 2/3.
    assert found.morris.top == found.sobol.top
    assert found.agreement["DGSM bound", "Sobol total"] == pytest.approx(1.0)


def test_the_local_index_is_the_gradient_times_the_interval():
    found = compare_sensitivity(Ishigami(), torch.mean, points=8, base_samples=4, trajectories=2)
    slope = math.cos(0.4) * (1 + 0.1 * 0.6**4)
    assert found.local.values["x1"] == pytest.approx(2 * math.pi * slope, rel=1e-5)


class Noisy:
    """``image = (1 + noise) · (3a + b₁ + b₂)``, noise as 1/√spp; ``c`` has a derivative that is noise alone."""

    spp = 16

    def __init__(self, noise=1.0):
        self.noise = noise
        self.inputs = {"a": torch.tensor(0.5), "b": torch.tensor([0.4, 0.8]), "c": torch.tensor(0.5)}
        self.bounds = dict.fromkeys(self.inputs, (0.0, 1.0))

    def __call__(self, inputs, *, seed, spp):
        draw = torch.randn(4, 4, 3, 2, generator=torch.Generator().manual_seed(seed)) * self.noise / spp**0.5
        signal = 3 * inputs["a"] + inputs["b"].sum()
        return (1 + draw[..., 0]) * signal + 20 * draw[..., 1] * inputs["c"]


def test_render_noise_is_not_counted_as_sensitivity():
    found = dgsm(Noisy(), torch.mean, points=256)
    rows = {row.name: row for row in found.rows}
    # b keeps the ratio of its channels, (u/2, u); means of a uniform interval have the variance 1/12.
    true = {"a": 9.0, "b": 2.25, "c": 0.0}
    for name, nu in true.items():
        assert abs(rows[name].nu - nu) < 4 * rows[name].nu_error, str(found)
    assert abs(found.variance - 11.25 / 12) < 4 * found.variance_error
    assert rows["c"].nu_error > 0
    loud = dgsm(Noisy(4.0), torch.mean, points=256)
    assert abs(loud.variance - 11.25 / 12) < 4 * loud.variance_error < 2.5, str(loud)


@pytest.mark.parametrize(
    ("values", "noise", "reason"),
    [
        (
            (1.0, 2.0, 3.0, 2.0),
            4.0,
            "nan: too noisy to tell, since the variance of the metric is within the noise of rendering;\n"
            "use more samples (spp=) or points (points=)\n",
        ),
        ((1.0, 1.0, 1.0, 1.0), 0.0, "nan: the metric is the same at all points\n"),
        ((1.0, 2.0, 3.0, 2.0), 0.1, ""),
    ],
)
def test_a_bound_that_is_nan_has_its_reason(values, noise, reason):
    function = Product()
    scalars = find_scalars(function, function.inputs, ["x1"], None)
    metric_values = torch.tensor(values, dtype=torch.float64)
    sampled = Derivatives(
        torch.ones_like(metric_values)[:, None], metric_values, 0 * metric_values + noise, 2, 0
    )
    text = str(summarise_derivatives(sampled, scalars, TargetedMetric(torch.mean, None)))
    assert reason in text
    assert ("nan" in text) == bool(reason)


def test_a_non_linear_metric_agrees_with_its_closed_form():
    """E[(2f ∂f)²] of the square of the mean, ``f = 3a + 1.5u`` over the unit square."""
    found = dgsm(Noisy(0.3), lambda image: image.mean() ** 2, parameters=["a", "b"], points=256)
    mean_square = (9 + 2.25) / 12 + 2.25**2
    true = {"a": 36 * mean_square, "b": 9 * mean_square}
    for row in found.rows:
        assert abs(row.nu - true[row.name]) < 4 * row.nu_error, str(found)


def test_every_render_is_counted():
    renderer = Product()
    found = compare_sensitivity(renderer, torch.mean, points=8, base_samples=16, trajectories=4)
    assert found.morris.renders == 4 * 7
    assert found.sobol.renders == 16 * 8
    assert (found.local.renders, found.dgsm.renders) == (2, 16)
    # It has no seed_grad, so both images of a replicate are forward passes.
    assert renderer.calls == 28 + 128 + 8 * 2 + 8 * 2 * 2
    # For a non-linear metric, the biases of few samples and of the denoiser take a backward pass each.
    bent = compare_sensitivity(Noisy(), lambda i: i.mean().exp(), points=8, base_samples=4, trajectories=4)
    assert (bent.local.renders, bent.dgsm.renders) == (2 + 2 / 8, 8 * (2 + 2 / 2))


def test_a_ranking_is_stable_once_it_no_longer_changes():
    running = np.array([[3, 2, 1.0], [1, 2, 3], [3, 1, 2], [1, 3, 2], [2, 3, 1]])
    assert _samples_until_stable(running, 2) == 5
    assert _samples_until_stable(running[:4], 2) == 4
    assert _samples_until_stable(np.repeat(running[:1], 6, axis=0), 2) == 2
    assert _samples_until_stable(running[[0, 1, 2, 2, 2]], 2) == 3
    assert _samples_until_stable(running[[1, 1, 1, 0, 1]], 2) == 5


class Sum(Function):
    """Every number has the same weight, but the last has none."""

    def value(self, x):
        return x[:-1].sum()


def test_a_tie_at_the_border_of_the_set_is_reported():
    settings = {"points": 8, "base_samples": 4, "trajectories": 4}
    tied = compare_sensitivity(Sum(4, 0.0, 1.0), torch.mean, top=2, **settings)
    assert not any(one.resolved for one in (tied.local, tied.dgsm, tied.morris))
    assert "tied" in str(tied)
    compared = compare_sensitivity(Sum(4, 0.0, 1.0), torch.mean, top=3, **settings)
    assert all(one.resolved for one in (compared.local, compared.dgsm, compared.morris))


def test_targets_share_their_renders():
    renderer = Product()

    def two(image):
        return torch.stack([image.mean(), image.mean() ** 2])

    both = compare_sensitivity(renderer, two, [0, 1], points=8, base_samples=8, trajectories=4)
    calls = renderer.calls
    alone = compare_sensitivity(renderer, two, 1, points=8, base_samples=8, trajectories=4)
    assert calls < 1.5 * (renderer.calls - calls)
    assert both[1].sobol.values == alone.sobol.values
    assert both[1].morris.values == alone.morris.values
    assert both[0].sobol.values != both[1].sobol.values
    lists = dgsm(renderer, two, [0, 1], points=8)
    assert lists[1].rows == dgsm(renderer, two, 1, points=8).rows


class Table:
    """A parameter table with only what intervals depend on."""

    inputs = {  # noqa: RUF012
        "colour": torch.tensor([0.8, 0.2, 0.0]),
        "black": torch.zeros(3),
        "lamp": torch.tensor([4.0, 2.0, 1.0]),
        "off": torch.zeros(()),
        "signed": torch.tensor([0.5, -1.0]),
        "texture": torch.tensor([0.1, 0.4]).reshape(1, 2, 1),
    }
    bounds = {  # noqa: RUF012
        "colour": (0.0, 1.0),
        "black": (0.0, 1.0),
        "lamp": (0.0, math.inf),
        "off": (0.0, math.inf),
        "signed": (-1.0, 2.0),
        "texture": (0.0, 1.0),
    }


def test_one_number_moves_a_parameter_within_its_bounds():
    found = {one.name: one for one in find_scalars(Table(), Table.inputs, None, None)}
    intervals = {name: (one.low, one.high) for name, one in found.items()}
    assert intervals == {
        "colour": (0.0, 1.0),
        "black": (0.0, 1.0),
        "lamp": (2.0, 6.0),
        "off": (0.0, 1.0),
        "signed": (-2.0, 1.0),
        "texture": (0.0, 1.0),
    }
    assert torch.equal(found["colour"].at(1.0), torch.tensor([1.0, 0.25, 0.0]))
    assert torch.equal(found["black"].at(0.5), torch.full((3,), 0.5))
    assert torch.equal(found["texture"].at(1.0).flatten(), torch.tensor([0.25, 1.0]))
    assert torch.equal(found["signed"].at(0.0), torch.tensor([-1.0, 2.0]))
    given = {
        one.name: one for one in find_scalars(Table(), Table.inputs, ["l*"], {"*": (1, 3), "lamp": (0, 8)})
    }
    assert {name: (one.low, one.high) for name, one in given.items()} == {"lamp": (0.0, 8.0)}


def test_intervals_leave_out_the_bounds_of_roughness(mi):
    renderer = SceneRenderer("office", inputs="roughness", resolution=(16, 9), spp=1)
    for one in find_scalars(renderer, renderer.inputs, None, None):
        assert 0 < one.low < 0.01
        assert one.high == 1.0
        assert one.label == renderer.labels[one.name]


def test_bad_input_is_refused():
    renderer = Product()
    for wrong, words in [
        ({"parameters": ["y*"]}, "'y\\*' matches none"),
        ({"bounds": {"x1": (0.5, 0.2)}}, "0.5, 0.2.*a low and a higher number"),
        ({"bounds": {"x1": (0.0, 1.2)}}, "0, 1.2.*from 0 to 1"),
        ({"bounds": {"x1": 3}}, r"must be \(low, high\)"),
        ({"points": 2}, "points must be a whole number of at least 3"),
        ({"seed": -1}, "seed"),
    ]:
        with pytest.raises(SceneCaptumError, match=words):
            dgsm(renderer, torch.mean, **wrong)
    with pytest.raises(SceneCaptumError, match="power of 2, such as 32 or 64, not 48"):
        compare_sensitivity(renderer, torch.mean, base_samples=48)
    with pytest.raises(SceneCaptumError, match="at least 2 parameters"):
        compare_sensitivity(renderer, torch.mean, parameters=["x1"])
    with pytest.raises(SceneCaptumError, match="nothing to rank"):
        compare_sensitivity(renderer, lambda image: 0 * image.mean(), points=4)


def test_without_salib_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "SALib", None)
    with pytest.raises(SceneCaptumError, match=r"pip install 'scenecaptum\[compare\]'"):
        compare_sensitivity(Product(), torch.mean)
    assert dgsm(Product(), torch.mean, points=4).points == 4


def test_on_the_cornell_box_finite_differences_agree(mi):
    """The mean squared slope over a wall's interval, by differences at Gauss–Legendre's nodes."""
    renderer = SceneRenderer(
        "cornell-box", ["reflectance", "emitters"], resolution=(12, 12), spp=64, max_depth=4
    )
    name = "left_wall.reflectance.value"
    found = dgsm(renderer, metrics.MeanLuminance(), parameters=[name], points=48, spp=32)
    (row,), (scalar,) = found.rows, find_scalars(renderer, renderer.inputs, [name], None)
    nodes, weights = np.polynomial.legendre.leggauss(4)

    def slope(place, seed):
        ends = [renderer({name: scalar.at(place + step)}, seed=seed) for step in (0.01, -0.01)]
        return [metrics.MeanLuminance()(image).item() for image in ends]

    slopes = np.array([[np.subtract(*slope((n + 1) / 2, s)) / 0.02 for n in nodes] for s in seeds(4)])
    pairs = [slopes[i] * slopes[j] @ weights / 2 for i in range(4) for j in range(i)]
    error = math.hypot(row.nu_error, np.std(pairs, ddof=1) / 2)
    assert abs(row.nu - np.mean(pairs)) < allowed(8) * error, (
        f"{row.nu} ± {row.nu_error}, not {np.mean(pairs)}"
    )
    assert error < 0.2 * row.nu


def test_tables_and_figure(mi):
    renderer = SceneRenderer("cornell-box", "reflectance", resolution=(12, 12), spp=16, max_depth=4)
    found = compare_sensitivity(
        renderer, metrics.MeanLuminance(), points=12, base_samples=4, trajectories=4, top=3
    )
    text = str(found)
    assert "back_wall: reflectance" in text
    assert "renders until the top 3 is stable" in text
    assert text.splitlines()[-4] == (  # the metric's name, not that of its class
        "mean luminance; * the top 3 of each method; gradient × range and Morris μ* in cd/m²"
    )
    assert "a render has spp samples per pixel" in text
    assert text.endswith(INTERVAL_NOTE)
    assert len({line.index("Sobol total") for line in text.splitlines() if line.startswith("parameter")}) == 1
    figure = found.plot()
    assert [ax.get_title(loc="left") for ax in figure.axes] == [one.method for one in found.methods]
    labels = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert labels == [one.label for one in found.parameters]
    in_unit = [ax.get_xlabel().splitlines()[1] for ax in figure.axes]
    assert in_unit == ["in cd/m²", "", "in cd/m²", ""]
    bars = figure.axes[3].patches
    assert [bar.get_width() for bar in bars] == [found.sobol.values[one.name] for one in found.parameters]
    assert sum(bar.get_facecolor() == bars[0].get_facecolor() for bar in bars) == 3
    lines = str(dgsm(renderer, metrics.MeanLuminance(), points=4)).splitlines()
    assert lines[0].split()[:3] == ["parameter", "from", "to"]
    assert "ν, (cd/m²)² per unit squared" in lines[0]
    assert any(" (cd/m²)² over the intervals" in line for line in lines)
    assert "\n".join(lines[-2:]) == INTERVAL_NOTE
