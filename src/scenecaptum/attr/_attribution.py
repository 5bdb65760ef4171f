"""``SceneAttribution``: what an attribution method returns."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from ..errors import SceneCaptumError, UnknownNameError, near_misses
from ..scene import SurfaceMap
from ._jackknife import Adjoints
from ._passes import channel_totals, covariance_of_mean
from ._student import student_t
from ._values import summarise

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ._gradients import GradientSum

Tensors = Mapping[str, torch.Tensor]


class Ranked(NamedTuple):
    """One row of a ranking.

    Attributes
    ----------
    rank
        From 1, the most salient.
    name, label
        The parameter's name in the scene, and a readable one.
    saliency, saliency_error
        Its magnitude and the standard error of that; errors are None where there were fewer than two passes.
    total, total_error
        The attribution, summed over texels, with one element per channel, and its standard errors.
    """

    rank: int
    name: str
    label: str
    saliency: float
    saliency_error: float | None
    total: tuple[float, ...]
    total_error: tuple[float, ...] | None


@dataclass(frozen=True, repr=False)
class SceneAttribution(Mapping[str, torch.Tensor]):
    """Signed attributions by parameter name, each with the shape of its parameter; prints as a ranked table.

    Attributes
    ----------
    attributions
        The tensors by name; ``attribution[name]`` is the same.
    standard_error
        Standard errors of the same shapes, or None where there were fewer than two passes: the spread of the
        passes and, as errors of their own size, the ``bias`` and the ``quadrature_error``.
    bias
        By how much each gradient may be off for want of samples in the picture that a non-linear metric saw, and
        by what a denoiser changed there: an error of its own size, to first order. None where there were fewer
        than two passes.
    quadrature_error
        For integrals over a way, a ``(C,)`` tensor for each parameter: the error of the quadrature of its channel
        totals, estimated from its own points. None for other methods.
    replicates
        For each parameter a ``(passes, C)`` tensor: its channel totals in every pass.
    covariance
        For each parameter a ``(C, C)`` tensor: the covariance of its channel totals, or None like the errors.
    metric_value, metric_standard_error
        The metric at the rendered image, or at what a denoiser makes of it corrected for what that changed, and
        its standard error where there is one.
    convergence_delta, convergence_delta_error
        For methods that have one: by how much the sum of the attributions exceeds the difference that they
        explain (``info["explained"]``), and its standard error, which holds that of the quadrature.
        ``info["convergence"]`` is ``"adds up"`` where |delta| and two errors are within 5 % of that difference,
        ``"does not add up"`` where |delta| less two errors is beyond, else ``"cannot be told"``.
    parameter_values
        What the parameters were: whole where they are small, a texture's mean over its texels; members of groups
        by their own names.
    labels
        A readable name for each parameter.
    image
        The rendered image, ``(H, W, 3)`` linear radiance.
    surfaces
        Which objects each pixel shows, and which texels of textures, where the renderer knows.
    info
        How it was computed: method, metric, seed, samples, integrator, seconds, versions.
    """

    attributions: Tensors
    standard_error: Tensors | None
    metric_value: float
    metric_standard_error: float | None = None
    convergence_delta: float | None = None
    convergence_delta_error: float | None = None
    bias: Tensors | None = None
    quadrature_error: Tensors | None = None
    replicates: Tensors = field(default_factory=dict)
    covariance: Tensors | None = None
    parameter_values: Tensors = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    image: torch.Tensor | None = None
    surfaces: SurfaceMap | None = None
    info: Mapping[str, Any] = field(default_factory=dict)

    def __getitem__(self, name: str) -> torch.Tensor:
        try:
            return self.attributions[name]
        except KeyError:
            raise UnknownNameError(
                f"There is no attribution to {name!r}.{near_misses(name, self.attributions)}"
            ) from None

    def __contains__(self, name: object) -> bool:
        return name in self.attributions

    def __iter__(self) -> Iterator[str]:
        return iter(self.attributions)

    def __len__(self) -> int:
        return len(self.attributions)

    def saliency(self) -> dict[str, float]:
        """Return each parameter's magnitude: the ℓ2 norm over its channels.

        A texture is first summed over its texels: its saliency is that of raising all of them alike, so that a
        texture of one colour ranks like that colour.
        """
        return {name: channel_totals(value).double().norm().item() for name, value in self.items()}

    def saliency_error(self) -> dict[str, float] | None:
        """Return the standard error of each saliency, from the covariance of the channels over the passes.

        It is None where there were fewer than two passes.
        """
        if self.covariance is None:
            return None
        return {name: _norm_error(channel_totals(self[name]), self.covariance[name]) for name in self}

    def ranking(self, top: int | None = None) -> list[Ranked]:
        """Return the parameters by falling saliency, all of them or the ``top`` first."""
        saliency, errors = self.saliency(), self.saliency_error()
        order = sorted(self, key=lambda name: -saliency[name])
        return [
            Ranked(
                rank=rank,
                name=name,
                label=self.labels.get(name, name),
                saliency=saliency[name],
                saliency_error=None if errors is None else errors[name],
                total=tuple(channel_totals(self[name]).tolist()),
                total_error=self._total_error(name),
            )
            for rank, name in enumerate(order[:top], start=1)
        ]

    def _total_error(self, name: str) -> tuple[float, ...] | None:
        if self.covariance is None:
            return None
        return tuple(self.covariance[name].diagonal().sqrt().tolist())

    def interval(self, level: float = 0.95) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Return for each parameter the lower and upper ends of a confidence interval, of its shape (Student's t).

        Raises
        ------
        SceneCaptumError
            Where there is no standard error, or ``level`` is not between 0 and 1.
        """
        if self.standard_error is None:
            raise SceneCaptumError(
                "There are no error bars: they take at least two passes. Call attribute(replicates=8)."
            )
        if not 0 < level < 1:
            raise SceneCaptumError(f"level must lie between 0 and 1, not {level!r}.")
        width = student_t(level, self.info.get("degrees_of_freedom", self.info["passes"] - 1))
        return {
            name: (value - width * self.standard_error[name], value + width * self.standard_error[name])
            for name, value in self.items()
        }

    def metric_interval(self, level: float = 0.95) -> tuple[float, float] | None:
        """Return the ends of a confidence interval of the metric (Student's t), or None without an error bar."""
        return metric_interval(self.metric_value, self.metric_standard_error, self.info["passes"], level)

    def untrusted_errors(self) -> dict[str, str]:
        """Return the parameters whose standard error cannot be trusted, each with the reason; ``?`` in tables.

        There are too few passes, or one of them dominates the spread, as where a rare path is very bright: more
        samples help, or ``median_of_means``.

        References
        ----------
        Grubbs, "Sample criteria for testing outlying observations", Annals of Mathematical Statistics 21(1), 1950.
        """
        from ._heavy_tails import untrusted_errors

        return untrusted_errors(self)

    def median_of_means(self) -> SceneAttribution:
        """Return the same result with the median over the passes in place of their mean.

        Each pass is a mean over its samples, and a rare bright path moves only the passes that hold it. The price
        is a bias where passes are skewed: light that arrives by rare paths is left out, and the more so the fewer
        samples a pass has (see the page on extremes). The errors hold the spread of the passes, outliers clipped,
        and what the median leaves out of the mean. Of a texture only the channel totals are medians; its texels
        keep their pattern.

        Raises
        ------
        SceneCaptumError
            Where there are no error bars, or the result is of several scenes or rounds.

        References
        ----------
        Nemirovsky and Yudin, "Problem Complexity and Method Efficiency in Optimization", 1983.
        """
        from ._heavy_tails import median_of_means

        return median_of_means(self)

    def __sub__(self, other: SceneAttribution) -> SceneAttribution:
        """Compare two metrics or two designs: this attribution minus ``other``, parameter by parameter.

        Two results of the same seed and samples share their noise, so the errors of their totals come from the
        pass-by-pass differences; otherwise, and for the texels of a texture, they are taken as independent.

        Raises
        ------
        SceneCaptumError
            Where the parameters, or their shapes, differ.
        """
        if not isinstance(other, SceneAttribution):
            return NotImplemented
        if set(self) != set(other) or any(self[name].shape != other[name].shape for name in self):
            odd = sorted(set(self) ^ set(other))
            raise SceneCaptumError(
                "Only attributions to the same parameters can be subtracted; these differ in "
                f"{', '.join(odd[:3]) or 'the shape of a parameter'}{' …' if len(odd) > 3 else ''}."
            )
        from ._difference import subtract

        return subtract(self, other)

    def to_dataframe(self) -> pandas.DataFrame:
        """Return the ranking as a pandas DataFrame with the columns of `Ranked`, indexed by rank.

        Raises
        ------
        SceneCaptumError
            Where pandas is missing: ``pip install 'scenecaptum[frames]'``.
        """
        try:
            import pandas
        except ImportError as error:
            raise SceneCaptumError(
                "to_dataframe() needs pandas: pip install 'scenecaptum[frames]'"
            ) from error
        return pandas.DataFrame([row._asdict() for row in self.ranking()]).set_index("rank")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one file (numpy's ``.npz``, no pickle), from which ``load`` restores it.

        Raises
        ------
        SceneCaptumError
            Where the file cannot be written; what was there before is as it was.
        """
        from ._storage import save

        save(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SceneAttribution:
        """Read what ``save`` wrote.

        Raises
        ------
        SceneCaptumError
            Where the file is missing, damaged, or something else.
        """
        from ._storage import load

        return load(path)

    def heatmap(self, **options: Any) -> torch.Tensor:
        """Return an ``(H, W)`` tensor in [0, 1]: each pixel has the saliency of what it shows.

        The ``options`` are those of ``projection.heatmap``: ``parameter``, ``signed``, ``scale``, ``decades``,
        ``maximum``, ``texels``, ``surfaces``.
        """
        from ..projection import heatmap

        return heatmap(self, **options)

    def plot_heatmap(self, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the heatmap and the render, with the ``ax`` and ``options`` of ``visualization.plot_heatmap``."""
        from ..visualization import plot_heatmap

        return plot_heatmap(self, ax, **options)

    def plot_overlay(self, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the heatmap over the render, with the ``ax`` and ``options`` of ``visualization.plot_overlay``."""
        from ..visualization import plot_overlay

        return plot_overlay(self, ax, **options)

    def plot_bars(self, top: int | None = 15, ax: Axes | None = None) -> Figure:
        """Draw the ranking as bars with their standard errors: the ``top`` first, or all, into ``ax`` if given."""
        from ..visualization import plot_bars

        return plot_bars(self, top=top, ax=ax)

    def report(self, path: str | os.PathLike[str], *others: SceneAttribution) -> None:
        """Write this result, and ``others`` beside it, to ``path`` as one HTML file to explore in a browser.

        Raises
        ------
        SceneCaptumError
            As ``visualization.write_report``.
        """
        from ..visualization import write_report

        write_report([self, *others], path)

    def __str__(self) -> str:
        from ..visualization import table_text

        return table_text(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        from ..visualization import table_html

        return table_html(self)


def make_attribution(
    renderer: Any,
    gradients: GradientSum,
    adjoints: Adjoints,
    *,
    values: Tensors,
    image: torch.Tensor,
    info: dict[str, Any],
) -> SceneAttribution:
    """Put a result together from the passes, and ask the renderer for what it knows of itself.

    What Ctrl-C has left of a sum stands for the whole.
    """
    whole = 1 / gradients.share
    names = list(gradients.mean)
    replicates = {name: whole * gradients.rows(name) for name in names}
    barred = gradients.degrees_of_freedom > 0
    bias = None if gradients.bias is None else {name: whole * one for name, one in gradients.bias.items()}
    return SceneAttribution(
        attributions={name: whole * value for name, value in gradients.mean.items()},
        standard_error={n: _error(gradients, n) for n in names} if barred else None,
        metric_value=adjoints.value,
        metric_standard_error=adjoints.standard_error,
        bias=bias,
        replicates=replicates,
        covariance=covariances(replicates, bias) if barred else None,
        parameter_values=summarise(values),
        labels=dict(getattr(renderer, "labels", {})),
        image=image,
        surfaces=surfaces_of(renderer, names),
        info={
            **info,
            "passes": gradients.replicates,
            "degrees_of_freedom": gradients.degrees_of_freedom,
            "metric_bias": adjoints.bias,
            "effective_samples": _effective_samples(renderer, gradients, adjoints, values, info.get("spp")),
            **getattr(renderer, "info", {}),
            "versions": _versions(),
        },
    )


def metric_interval(
    value: float, error: float | None, replicates: int, level: float = 0.95
) -> tuple[float, float] | None:
    """Return a confidence interval of a metric whose error so many replicates tell, or None without one."""
    if error is None:
        return None
    width = student_t(level, max(1, replicates - 1)) * error
    return value - width, value + width


def _effective_samples(
    renderer: Any, gradients: GradientSum, adjoints: Adjoints, values: Tensors, spp: int | None
) -> dict[str, float]:
    """Return how many samples tell the spread of each gradient, where the renderer knows."""
    ask = getattr(renderer, "effective_samples", None)
    if ask is None or spp is None or not gradients.degrees_of_freedom:
        return {}
    adjoint = torch.stack(adjoints.passes).mean(0)
    each = max(1, spp // gradients.replicates)
    found: dict[str, float] = ask(values, adjoint, spp=each, replicates=gradients.replicates)
    return found


def surfaces_of(renderer: Any, names: Iterable[str]) -> SurfaceMap | None:
    """Return what the renderer knows of what its pixels show, with the texels of the named parameters."""
    with_texels = getattr(renderer, "surfaces_with_texels", None)
    found: SurfaceMap | None = with_texels(names) if with_texels else getattr(renderer, "surfaces", None)
    return found


def _error(gradients: GradientSum, name: str) -> torch.Tensor:
    """Return a standard error, elementwise: the spread, and the bias that was taken out."""
    error = gradients.error(name)
    if gradients.bias is not None:
        error = error.hypot(gradients.bias[name])
    return error / gradients.share


def covariances(replicates: Tensors, bias: Tensors | None) -> dict[str, torch.Tensor]:
    """Return the covariance of each parameter's channel totals."""
    totals = {} if bias is None else {name: channel_totals(one) for name, one in bias.items()}
    return {name: covariance_of_mean(one, totals.get(name)) for name, one in replicates.items()}


def _norm_error(total: torch.Tensor, covariance: torch.Tensor) -> float:
    """Return the standard error of a norm, to first order: the spread along the vector's direction."""
    total, covariance = total.double(), covariance.double()
    norm = total.norm()
    if norm == 0:
        return float(covariance.diagonal().sum().sqrt())
    direction = total / norm
    return float((direction @ covariance @ direction).clamp_min(0).sqrt())


def _versions() -> dict[str, str]:
    packages = ("scenecaptum", "torch", "mitsuba", "drjit")
    return {"python": platform.python_version(), **{p: importlib.metadata.version(p) for p in packages}}
