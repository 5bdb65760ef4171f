"""``SceneAttribution``: what an attribution method returns."""

from __future__ import annotations

import importlib.metadata
import math
import os
import platform
from collections.abc import Iterable
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, Any, BinaryIO

import torch

from ..checkpoint import digest, without_checkpoint
from ..errors import SceneCaptumError
from ..estimation import Adjoints, GradientSum, TargetedMetric, scaled
from ..projection import SurfaceMap
from ..protocols import Capabilities, Renderer, ResultKind, Scale
from ..visualization import DEFAULT_TOP
from ._baselines import own_texels
from ._data import AttributionData, Ranked, Tensors, covariances, summarize
from ._difference import add, multiply, subtract
from ._explanation import DEFAULT_EFFECTS, Explanation
from ._nonlinear_poses import nonlinear_poses
from ._ranges import extents, lights, unit_ranges
from ._steps import RangeErrors, StepErrors, local_poses, step_errors
from ._storage import read_file, write_file
from ._trust import median_of_means, untrusted_errors

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class SceneAttribution(AttributionData):
    """Signed attributions by parameter name, each with the shape of its parameter; prints as a ranked table.

    All tensors are on the CPU, whichever device has rendered.

    Attributes
    ----------
    attributions
        The tensors by name; ``attribution[name]`` is the same.
    standard_error
        Standard errors of the same shapes, or None with fewer than two replicates. They combine the standard error
        over the replicates with ``bias`` and ``quadrature_error``.
    bias
        Estimated first-order bias of each gradient, due to the noise of the metric image (for non-linear metrics),
        to its denoising, to the steps of the finite differences of poses, and to what the metric does beyond first
        order over their ranges. That of an ablation, an occlusion or a Shapley value is due to the noise alone.
        None with fewer than two replicates.
    quadrature_error
        For path integrals, a ``(C,)`` tensor for each parameter: the quadrature error of its channel totals,
        estimated from the same points. None for other methods.
    replicates
        For each parameter a ``(replicates, C)`` tensor: its channel totals in every replicate.
    covariance
        For each parameter a ``(C, C)`` tensor: the covariance of its channel totals. None if there are no errors.
    extents
        For each parameter a ``(C,)`` tensor: the change of its channels over its range, by which effects are
        compared. Empty if the renderer has no ranges.
    metric_value, metric_standard_error
        The metric at the rendered image, or at the denoised image with a first-order correction of the denoiser's
        bias, and its standard error or None.
    metric_error_parts
        A tensor whose norm is ``metric_standard_error``: its independent parts, with signs. Those of results with
        the same seed and samples add and subtract. None if it does not consist of such.
    convergence_delta, convergence_delta_error
        For methods that have one: the sum of the attributions minus the difference that they explain
        (``info["explained"]``), and its standard error, including that of the quadrature.
        ``info["convergence"]`` is ``"adds up"`` if ``|delta|`` plus two errors is within 5 % of that difference,
        ``"does not add up"`` if ``|delta|`` is beyond 5 % by more than noise is in one case of 1000, by Student's
        t, else ``"inconclusive"``.
    parameter_values
        The values of the parameters; for textures the mean over the texels, and nothing for other large tensors.
        Members of groups have their own entries.
    labels
        A readable name for each parameter.
    image
        The rendered image, ``(H, W, 3)`` linear radiance.
    surfaces
        The objects and texels visible in each pixel, if the renderer provides them.
    info
        How it was computed: method, metric, seed, samples, integrator, seconds, versions.
    """

    def untrusted_errors(self) -> dict[str, str]:
        """Return the parameters whose standard error is unreliable, each with the reason; ``?`` in tables.

        Reasons are too few replicates, or a single replicate that dominates the variance, typically because of a
        rare bright path. Use more samples or ``median_of_means``.

        References
        ----------
        Grubbs, "Sample criteria for testing outlying observations", Annals of Mathematical Statistics 21(1), 1950.
        """
        return untrusted_errors(self)

    def median_of_means(self) -> SceneAttribution:
        """Return this result with the median over the replicates instead of their mean.

        Each replicate is a mean over its samples, and a rare bright path affects only the replicates that contain
        it. For skewed replicates the median is biased: it omits part of the light that arrives by rare paths, the
        more the fewer samples a replicate has (see the page on extremes). The errors combine the standard error
        over the replicates, with outliers clipped, and the difference between median and mean. For a texture, only
        the channel totals are medians; the texels keep their pattern.

        Raises
        ------
        SceneCaptumError
            If there are no error bars, or the result combines several scenes or rounds.

        References
        ----------
        Nemirovsky and Yudin, "Problem Complexity and Method Efficiency in Optimization", 1983.
        """
        return median_of_means(self)

    def __sub__(self, other: SceneAttribution) -> SceneAttribution:
        """Return this attribution minus ``other``, to compare two metrics or two designs.

        Results with the same seed and samples use common random numbers, so the errors of their totals are
        computed from the differences of their replicates, and so is that of the metric's value. Otherwise, and for
        single texels, they are treated as independent. Errors are smallest where one renderer gave both, at two
        sets of ``inputs``: two renderers spread the samples of gradients differently. A parameter whose range
        differs, as that of a lamp that was dimmed, has the difference of its effects, each over its own range, in
        place of that of its gradients.

        Raises
        ------
        SceneCaptumError
            If the parameters or their shapes differ, or the quantities, such as gradients and contributions.
        """
        if not isinstance(other, SceneAttribution):
            return NotImplemented
        self._check_matches(other)
        return subtract(self, other)

    def __add__(self, other: SceneAttribution) -> SceneAttribution:
        """Return the attribution of the sum of two metrics; errors as for a difference."""
        if not isinstance(other, SceneAttribution):
            return NotImplemented
        self._check_matches(other)
        return add(self, other)

    def __radd__(self, other: float) -> SceneAttribution:
        """Return this attribution for ``0 + attribution``, with which ``sum`` begins."""
        if not isinstance(other, Real) or other != 0:
            return NotImplemented
        return self

    def __neg__(self) -> SceneAttribution:
        """Return the attribution of the metric with the other sign."""
        return multiply(self, -1.0)

    def __mul__(self, factor: float) -> SceneAttribution:
        """Return the attribution of a multiple of the metric."""
        if not isinstance(factor, Real):
            return NotImplemented
        return multiply(self, float(factor))

    __rmul__ = __mul__

    def __truediv__(self, divisor: float) -> SceneAttribution:
        """Return the attribution of the metric divided by a number."""
        if not isinstance(divisor, Real):
            return NotImplemented
        return multiply(self, 1 / float(divisor))

    def _check_matches(self, other: SceneAttribution) -> None:
        if set(self) != set(other) or any(self[name].shape != other[name].shape for name in self):
            unmatched = sorted(set(self) ^ set(other))
            raise SceneCaptumError(
                "Only attributions to the same parameters can be added or subtracted; these differ in "
                f"{', '.join(unmatched[:3]) or 'the shape of a parameter'}{' …' if len(unmatched) > 3 else ''}."
            )
        both_per_unit = self.kind.is_gradient_per_unit and other.kind.is_gradient_per_unit
        if self.kind != other.kind and not both_per_unit:
            quantities = [
                f"{one.kind.value} ({one.info.get('method', 'unknown method')})" for one in (self, other)
            ]
            raise SceneCaptumError(
                f"Results of different quantities cannot be added or subtracted: {' and '.join(quantities)}. "
                "Compare results of the same method, or the effects() of each side by side."
            )

    def to_dataframe(self, *, scale: Scale | None = None) -> pandas.DataFrame:
        """Return the ranking as a pandas DataFrame with the columns of `Ranked`, indexed by rank.

        Further columns are ``value`` and ``range``, the parameter's value in the scene and the length of its range
        for each channel (of a texture the mean), and ``caution``, which says what a table marks a row for: an
        inaccurate derivative (``!``), an unreliable standard error (``?``), or a range over which an effect may
        not hold (``~``). It is empty for others. ``attrs`` has the metric: name, value, standard error and unit.

        Parameters
        ----------
        scale
            As for ``ranking``.

        Raises
        ------
        SceneCaptumError
            If pandas is not installed: ``pip install 'scenecaptum[frames]'``.
        """
        try:
            import pandas
        except ImportError as error:
            raise SceneCaptumError(
                "to_dataframe() needs pandas: pip install 'scenecaptum[frames]'"
            ) from error
        from ..visualization import attributed_name, metric_unit, row_cautions

        frame = pandas.DataFrame(self.ranking(scale=scale), columns=Ranked._fields)
        cautions = row_cautions(self, scale)

        def numbers(tensors: Tensors, name: str) -> tuple[float, ...]:
            return tuple(tensors[name].reshape(-1).tolist()) if name in tensors else ()

        frame = frame.assign(
            value=[numbers(self.parameter_values, name) for name in frame["name"]],
            range=[numbers(self.extents, name) for name in frame["name"]],
            caution=[cautions.get(name, "") for name in frame["name"]],
        )
        frame.attrs = {
            "metric": attributed_name(self),
            "metric_value": self.metric_value,
            "metric_error": self.metric_standard_error,
            "metric_unit": metric_unit(self),
        }
        return frame.set_index("rank")

    def save(self, path: str | os.PathLike[str] | BinaryIO, *, exact_texels: bool = False) -> None:
        """Write everything to one file (NumPy ``.npz``, no pickle), to be read by ``load``.

        All values are stored exactly, except for large textures: those beyond the first 16 384 texels, counted
        from the smallest texture. Of these, the gradients of the texels that the picture shows are exact. The
        others are replaced by their means over square blocks, at most 32 768 blocks in a file. Channel totals keep
        their value up to the rounding of single precision, and their errors exactly, so a loaded result has the
        same ranking, figures and report. The standard errors of single texels are rounded to 0.4 %; in a block,
        they include the distances of the values from their mean.

        Parameters
        ----------
        path
            The file to write, atomically; or a binary file that is open for writing.
        exact_texels
            Whether to store every texel exactly, for further computations with the gradients of single texels or a
            ``heatmap`` with another surface map. This takes 5 to 9 times the space in rooms with large textures.

        Raises
        ------
        SceneCaptumError
            If the file cannot be written; an existing file stays unchanged.
        """
        write_file(self, path, exact_texels=exact_texels)

    @classmethod
    def load(cls, path: str | os.PathLike[str] | BinaryIO) -> SceneAttribution:
        """Read a file written by ``save``, from its path or open for reading.

        Raises
        ------
        SceneCaptumError
            If the file is missing, damaged or not a saved attribution, or was written by another version.
        """
        return cls(**read_file(path))

    def heatmap(self, **options: Any) -> torch.Tensor:
        """Return an ``(H, W)`` tensor in [0, 1]: the saliency of the parameters visible in each pixel.

        The ``options`` are those of ``projection.heatmap``: ``parameter``, ``signed``, ``scale``, ``norm`` (by
        default ``"sqrt"``), ``decades``, ``maximum``, ``texels``, ``surfaces``.
        """
        from ..projection import heatmap

        return heatmap(self, **options)

    def plot_heatmap(self, *, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the heatmap and the render, with the ``ax`` and ``options`` of ``visualization.plot_heatmap``."""
        from ..visualization import plot_heatmap

        return plot_heatmap(self, ax=ax, **options)

    def plot_overlay(self, *, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the heatmap over the render, with the ``ax`` and ``options`` of ``visualization.plot_overlay``."""
        from ..visualization import plot_overlay

        return plot_overlay(self, ax=ax, **options)

    def plot_bars(
        self,
        top: int | None = DEFAULT_TOP,
        *,
        ax: Axes | None = None,
        scale: Scale | None = None,
        figsize: tuple[float, float] | None = None,
        captions: bool = True,
    ) -> Figure:
        """Draw the effects of the first ``top`` parameters, or all, as bars with errors, into ``ax`` if given.

        ``scale`` is as for ``ranking``, ``figsize`` the width and height of the figure in inches.
        ``captions`` is whether the title and the notes are written.
        """
        from ..visualization import plot_bars

        return plot_bars(self, top=top, scale=scale, ax=ax, figsize=figsize, captions=captions)

    def explain(self, count: int = DEFAULT_EFFECTS) -> Explanation:
        """Return what the result says in sentences: the verdict, and the first ``count`` effects.

        ``explanation.explain`` also proposes changes and renders them.
        """
        return Explanation(self, count=count)

    def __str__(self) -> str:
        from ..visualization import table_text

        return table_text(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        from ..visualization import table_html

        return table_html(self)


def make_attribution(
    renderer: Renderer,
    gradients: GradientSum,
    adjoints: Adjoints,
    *,
    metric: TargetedMetric,
    values: Tensors,
    image: torch.Tensor,
    info: dict[str, Any],
) -> SceneAttribution:
    """Build a result from a sum of gradients, with labels, surfaces and info from the renderer.

    A sum that was interrupted is normalized to a total weight of 1.
    """
    scale = 1 / gradients.weight
    names = list(gradients.mean)
    surfaces = surfaces_of(renderer, names, values)
    shown_moves = Capabilities(renderer).shown_moves
    replicates = {name: scale * gradients.rows(name) for name in names}
    has_errors = gradients.degrees_of_freedom > 0
    bias = (
        None if gradients.bias is None else {n: scaled(value, scale) for n, value in gradients.bias.items()}
    )
    steps, local, nonlinear = StepErrors(), RangeErrors(), RangeErrors()
    changes: dict[str, tuple[float, float]] = {}
    are_gradients = info.get("quantity") in (ResultKind.GRADIENT, ResultKind.MEAN_GRADIENT)
    if has_errors and bias is not None and info.get("spp") and are_gradients:
        adjoint = torch.stack(adjoints.per_replicate).mean(0)
        # Those of textures are large, and no texture is a pose.
        mean = {name: scaled(value, scale) for name, value in gradients.mean.items() if value.ndim < 2}
        samples = {name: info["spp"] * gradients.share_of_samples(name) for name in mean}
        steps = step_errors(renderer, mean, values, adjoint, samples, info["seed"])
        bias |= {n: bias[n].hypot(error) for n, error in steps.truncation.items()}
        errors = {name: _error(gradients, name, bias[name]) for name in mean}
        local = local_poses(renderer, mean, errors, values, adjoint, samples, info["seed"])
        is_at_values = info["quantity"] == ResultKind.GRADIENT  # not a mean over other scenes
        # Of a smoothed metric, with hundreds of draws for each value, this would take longer than the rest.
        if is_at_values and not (adjoints.is_linear or metric.is_smoothed):
            nonlinear = nonlinear_poses(
                renderer,
                metric,
                values,
                image=image,
                adjoints=adjoints.per_replicate,
                gradients=mean,
                errors=errors,
                kept={
                    name: steps.kept_directions.get(name, 1.0)
                    for name in (*steps.truncation, *local.errors, *local.marked)
                    if name not in steps.jumps
                },
                marked=local.marked,
                samples=samples,
                seed=info["seed"],
            )
        for over_range in (local, nonlinear) if is_at_values else ():
            # Of the sign of the gradient: an error along its direction, of which no part cancels another.
            bias |= {n: bias[n].hypot(error).copysign(error) for n, error in over_range.errors.items()}
        if is_at_values:
            # Those of a camera are to first order in the picture.
            changes = local.changes if adjoints.is_linear else nonlinear.changes
    lights_off, lights_on = lights(renderer, values)
    return SceneAttribution(
        attributions={name: scaled(value, scale) for name, value in gradients.mean.items()},
        standard_error={n: _error(gradients, n, None if bias is None else bias[n]) for n in names}
        if has_errors
        else None,
        metric_value=adjoints.value,
        metric_standard_error=adjoints.standard_error,
        metric_error_parts=adjoints.error_parts,
        bias=bias,
        replicates=replicates,
        covariance=covariances(replicates, bias) if has_errors else None,
        extents=extents(renderer, values),
        parameter_values=summarize(own_texels(renderer, values)),
        labels=dict(Capabilities(renderer).labels or {}),
        image=image,
        surfaces=surfaces,
        info={
            **info,
            "replicates": gradients.replicates,
            "degrees_of_freedom": gradients.degrees_of_freedom,
            "metric_bias": adjoints.bias,
            "seen_through": seen_through(renderer, surfaces, names, values),
            "jumps": steps.jumps,
            "local": [] if metric.is_smoothed else local.marked,
            "nonlinear": nonlinear.marked,
            "range_changes": changes,
            # To first order in the picture alone, a deviation does not say what the metric does.
            "untested": [*local.marked, *local.errors] if metric.is_smoothed else [],
            "unit_ranges": unit_ranges(renderer, values),
            "lights_off": lights_off,
            "lights_on": lights_on,
            "linear_in_light": not adjoints.bias_adjoints,
            "kept_directions": steps.kept_directions,
            "left_out_directions": steps.left_out_directions,
            "shown_moves": dict(shown_moves(names, values)) if shown_moves else {},
            "up": Capabilities(renderer).up,
            "vectors": [name for name in Capabilities(renderer).vectors or () if name in names],
            "proportional_errors": _proportional_errors(gradients, values, bias)
            if info.get("quantity") == ResultKind.GRADIENT
            else {},
            "effective_samples": _effective_samples(renderer, gradients, adjoints, values, info.get("spp")),
            **info_of(renderer, values),
            "versions": versions(),
        },
    )


def _proportional_errors(gradients: GradientSum, values: Tensors, bias: Tensors | None) -> dict[str, float]:
    """Return the standard errors of the effects of textures per relative change of all their texels."""
    noise = {name: gradients.product_error(name) for name in values}
    return {
        name: math.hypot(
            error / gradients.weight,
            0.0 if bias is None else (bias[name] * values[name]).sum(dtype=torch.float64).item(),
        )
        for name, error in noise.items()
        if error is not None
    }


def _effective_samples(
    renderer: Renderer, gradients: GradientSum, adjoints: Adjoints, values: Tensors, spp: int | None
) -> dict[str, float]:
    """Return the effective number of samples behind each standard error, if the renderer provides it."""
    estimate = Capabilities(renderer).effective_samples
    if estimate is None or spp is None or not gradients.degrees_of_freedom:
        return {}
    adjoint = torch.stack(adjoints.per_replicate).mean(0)
    if not adjoint.any():  # the metric does not depend on the picture, wherever the samples arrive
        return {}
    count = gradients.replicates
    return estimate(values, adjoint, spp=max(1, spp // count), replicates=count)


def surfaces_of(renderer: Renderer, names: Iterable[str], values: Tensors) -> SurfaceMap | None:
    """Return the renderer's map from pixels to objects, with the texels of the named parameters, if it has one.

    Objects are where the ``values`` move them.
    """
    with_texels = Capabilities(renderer).surfaces_with_texels
    surfaces: SurfaceMap | None = (
        with_texels(names, values) if with_texels else Capabilities(renderer).surfaces
    )
    return surfaces


def info_of(renderer: Renderer, values: Tensors) -> dict[str, Any]:
    """Return how the renderer renders, the camera where the ``values`` move it, and a hash of each texture."""
    of = Capabilities(renderer).info_of
    info = dict(of(values) if of else Capabilities(renderer).info or {})
    # A renderer of one's own may have no scene by which its results could be told apart.
    own = without_checkpoint(renderer)
    name = getattr(own, "__name__", type(own).__name__)
    textures = {name: digest(value) for name, value in values.items() if value.ndim > 1}
    return {**({} if "scene" in info else {"renderer": name}), **info, "texture_digests": textures}


def seen_through(
    renderer: Renderer, surfaces: SurfaceMap | None, names: Iterable[str], values: Tensors
) -> list[str]:
    """Return the parameters whose objects are seen only in mirrors or behind glass."""
    hidden = set(names) - (set(names) if surfaces is None else surfaces.visible_parameters())
    trace = Capabilities(renderer).see_through
    behind = trace((), values) if trace is not None and hidden else None
    return [] if behind is None else sorted(hidden & behind.visible_parameters())


def _error(gradients: GradientSum, name: str, bias: torch.Tensor | None) -> torch.Tensor:
    """Return the elementwise standard error of a gradient, including its bias."""
    error = scaled(gradients.error(name), 1 / gradients.weight)
    return error if bias is None or not bias.any() else error.hypot(bias)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that determine a result."""
    packages = ("scenecaptum", "torch", "mitsuba", "drjit")
    return {"python": platform.python_version(), **{p: importlib.metadata.version(p) for p in packages}}
