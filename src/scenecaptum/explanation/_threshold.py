"""What the threshold of a glare rating means for a picture."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, TypeGuard

import torch
from torch.nn import functional

from ..estimation import Metric
from ..metrics import GlareRating, GlareSource, luminance
from ..rendering import FILLED, Reflection, SceneRenderer, SmallLamp
from ..visualization import Format, advised, first_few, rounded
from ._sources import MIN_SHARE, PURITY, TINY

NEAR = 3.0  # times the threshold: below, a dimmed source may stop counting
LASTING = 2.0  # the luminance of a source is within this factor in another render
NOTABLE, MUCH = 0.01, 0.05  # of a rating
TOO_LOW = "the rating is too low"
AROUND = 2  # pixels within which the luminance of a lamp is that at its edge
REFLECTION = "the reflection of "
NAMED = 0.1  # of what the most important lamp loses
FACTOR = 5.0  # of the mean luminance: the other usual threshold
ASIDE = 0.03  # of that threshold: how far noise may take a source
JUMP = 0.02  # of a rating


def threshold_notes(
    metric: Metric, image: torch.Tensor, style: Format, *, explained: bool = False
) -> list[str]:
    """Return a note if a picture has no glare source, or its main source is close to an absolute threshold.

    ``style`` is that of the rating beside which the one by the other threshold stands. ``explained`` says that
    another note has the reason why nothing counts, such as lamps that are smaller than a pixel.
    """
    if not isinstance(metric, GlareRating):
        return []
    factor = metric.threshold_factor
    limit = f"{metric.threshold:g} cd/m²" if factor is None else f"{factor:g} times the mean luminance"
    if _main_source(metric, image) is None:
        brightest = rounded(metric.efficacy * luminance(image).max().item())
        lower = f"a threshold factor of {FACTOR:g}" if factor is None else "a smaller threshold factor"
        return [
            advised(
                f"no pixel is brighter than {limit} (the brightest: {brightest} cd/m²): nothing counts as a glare "
                "source",
                "" if explained else f"check the scene's units, or use {lower}",
            )
        ]
    if note := near_threshold_note(metric, image):
        return [f"{note}; {relative_sentence(metric, image, style)}"]
    return []


def near_threshold_note(metric: Metric, image: torch.Tensor) -> str:
    """Return what a threshold near the main source of a picture means; empty if it is far or not absolute."""
    if not has_absolute_threshold(metric) or not is_near_threshold(metric, image):
        return ""
    return (
        f"only pixels brighter than {metric.threshold:g} cd/m² count, and a source that is dimmed below it stops "
        "counting at once"
    )


def has_absolute_threshold(metric: Metric) -> TypeGuard[GlareRating]:
    """Whether the threshold of a glare rating is a luminance, and not a multiple of the mean luminance."""
    return isinstance(metric, GlareRating) and metric.threshold_factor is None


class Lamps(NamedTuple):
    """What pixels show of lamps and of the sky, by name, as ``SceneRenderer`` has it."""

    small: Mapping[str, SmallLamp]  # those that cover less than half of any pixel
    covered: Mapping[str, torch.Tensor]  # the fractions of the pixels that the others cover, (H, W)
    reflected: Mapping[str, Reflection]  # in panes

    @classmethod
    def of(cls, renderer: SceneRenderer, values: Mapping[str, torch.Tensor] | None = None) -> Lamps:
        """Return those of a scene with some values."""
        return cls(renderer.small_lamps(values), renderer.lamp_coverage(values), renderer.reflections(values))


class EdgeLoss(NamedTuple):
    """By how much pixels that lamps cover in part make a rating too low, and what each lamp loses.

    That is luminance² · solid angle, before the efficacy, and ``shown`` how much of it the picture has of sources.
    ``reflected`` are the pixels that show bright lamps by way of panes, ``(H, W)``; None where there are none.
    """

    missing: float
    lost: Mapping[str, float]
    shown: float
    reflected: torch.Tensor | None

    @classmethod
    def nothing(cls) -> EdgeLoss:
        """Return that of a picture without lamps."""
        return cls(0.0, {}, 0.0, None)

    @property
    def lamps(self) -> list[str]:
        """The lamps that lose most, the first most of all."""
        names = sorted(self.lost, key=self.lost.__getitem__, reverse=True)
        return [name for name in names if self.lost[name] >= NAMED * self.lost[names[0]]]

    @property
    def reflections(self) -> tuple[str, ...]:
        """The reflections in panes of which the picture lacks a notable part of the glare."""
        whole = self.shown + sum(self.lost.values())
        return _reflections([name for name in self.lost if self.lost[name] >= MIN_SHARE * whole])


def edge_loss(metric: GlareRating, image: torch.Tensor, lamps: Lamps) -> EdgeLoss:
    """Return by how much a picture is rated too low because of pixels that lamps cover in part.

    The luminance of such a pixel is averaged with what surrounds the lamp, and glare grows faster than luminance:
    with its square.
    """
    threshold, solid_angles = metric.held_at(image).threshold / metric.efficacy, metric.camera.solid_angles
    shown = luminance(image)
    direct = _bright(_directly_seen(metric, shown, lamps), threshold)
    reflected = _bright(_reflected(shown, solid_angles, lamps.reflected), threshold)
    bright = [*direct.values(), *reflected.values()]
    if not bright:
        return EdgeLoss.nothing()
    # As much luminance² · solid angle as the lamps have, and their luminance against the threshold.
    resolved = _root_mean_square(shown, reflected.values())
    for_lamps = sum((lamp.fraction * lamp.luminance**2 for lamp in direct.values()), torch.zeros_like(shown))
    resolved = torch.maximum(resolved, for_lamps.sqrt())[..., None]
    brightest = torch.stack([(lamp.fraction > 0) * lamp.luminance for lamp in bright]).amax(0)[..., None]
    changed = metric.hard(
        image.where(brightest == 0, resolved), compared=image.where(brightest == 0, brightest.to(image))
    )
    lost = {name: lamp.lost(solid_angles) for name, lamp in (direct | reflected).items()}
    of_sources = torch.where(shown > threshold, shown**2 * solid_angles.to(shown), 0).sum().item()
    masks = [one.fraction > 0 for one in reflected.values()]
    in_panes = torch.stack(masks).any(0) if masks else None
    return EdgeLoss(changed.item() - metric.hard(image).item(), lost, of_sources, in_panes)


def lamp_edge_notes(metric: GlareRating, image: torch.Tensor, lamps: Lamps) -> list[str]:
    """Return a note on what ``edge_loss`` says a rating lacks at the edges of lamps.

    It is a caution if that is much, or enough for another class.
    """
    loss = edge_loss(metric, image, lamps)
    missing, names, value = loss.missing, loss.lamps, metric.hard(image).item()
    if missing <= NOTABLE * abs(value):  # a rating may be negative
        return []
    shown, whole = metric.measure.verdict(value), metric.measure.verdict(value + missing)
    then = "" if whole == shown else f" (then {whole})"
    caution = "caution: " if then or missing > MUCH * abs(value) else ""
    their, them = ("its", "it") if len(names) == 1 else ("their", "them")
    few, more = "", ""
    if _reflections(names):
        # Where its pixels have light of few samples, the denoiser takes it for noise.
        few, more = ", and few samples meet a small reflection", " and more samples"
    return [
        advised(
            f"{caution}pixels at the edges of {first_few(names)} average {their} light with what is around "
            f"{them}{few}: {TOO_LOW}, by about {rounded(missing, 2)}{then}",
            f"use a higher resolution{more}",
        )
    ]


def _reflections(names: Sequence[str]) -> tuple[str, ...]:
    return tuple(name for name in names if name.startswith(REFLECTION))


class _Lamp(NamedTuple):
    """The luminance of a lamp or of its reflection, and the fraction that it covers of the pixels at its edge.

    Both are ``(H, W)``, the luminance before the efficacy. A lamp that covers less than half of any pixel has all
    its light in one. ``most`` is the most that it covers. Of a reflection, ``lacking`` is the part of its light
    that is not in the picture.
    """

    luminance: torch.Tensor
    fraction: torch.Tensor
    most: float = 1.0
    lacking: float = 0.0

    def lost(self, solid_angles: torch.Tensor) -> float:
        """Return how much of its luminance² · solid angle the lamp loses to averaging."""
        averaged = (1 - self.lacking) ** 2 * self.fraction.clamp(max=self.most)
        lost = self.fraction * (1 - averaged)
        return (self.luminance**2 * lost * solid_angles.to(lost)).sum().item()


def _bright(lamps: Mapping[str, _Lamp], threshold: float) -> dict[str, _Lamp]:
    return {name: lamp for name, lamp in lamps.items() if (lamp.luminance > threshold).any()}


def _directly_seen(metric: GlareRating, shown: torch.Tensor, lamps: Lamps) -> dict[str, _Lamp]:
    found = {}
    for name, mask in lamps.covered.items():
        fraction = mask.to(shown)
        is_edge = functional.max_pool2d(1 - fraction[None], 3, 1, 1)[0] > 0  # or beside one
        found[name] = _Lamp(_luminance_of_lamp(shown, fraction), fraction * is_edge)
    for name, lamp in lamps.small.items():
        fraction = torch.zeros_like(shown)
        fraction[lamp.pixel] = lamp.solid_angle / metric.camera.solid_angles[lamp.pixel].item()
        own = luminance(lamp.radiance[None, None]).to(shown)
        found[name] = _Lamp(own.expand_as(shown), fraction, FILLED)
    return found


def _reflected(
    shown: torch.Tensor, solid_angles: torch.Tensor, reflections: Mapping[str, Reflection]
) -> dict[str, _Lamp]:
    """Return reflections with what a picture lacks of them: a denoiser takes a few bright pixels for noise."""
    found = {}
    for name, one in reflections.items():
        own, fraction = luminance(one.radiance).to(shown), one.fraction.to(shown)
        light = own * fraction * solid_angles.to(shown)
        there = (shown * solid_angles.to(shown))[light > 0].sum() / light.sum().clamp_min(TINY)
        found[REFLECTION + name] = _Lamp(own, fraction, lacking=max(0.0, 1 - there.item()))
    return found


def _root_mean_square(shown: torch.Tensor, reflections: Iterable[_Lamp]) -> torch.Tensor:
    """Return the root of the mean of luminance² in each pixel, ``(H, W)``: of reflections and all else."""
    mean, variance = shown, torch.zeros_like(shown)
    for one in reflections:
        mean = mean + one.lacking * one.fraction * one.luminance
        variance = variance + one.fraction * (1 - one.fraction) * one.luminance**2
    return (mean**2 + variance).sqrt()


def _luminance_of_lamp(shown: torch.Tensor, fraction: torch.Tensor) -> torch.Tensor:
    """Return the luminance of a lamp, or of the sky, at each pixel, ``(H, W)``, from that of the pixels.

    It is that of the pixels around, mostly of those that show nothing else; where there are none, that of most of
    the lamp, which has the weight of one pixel. Of a pixel that shows it in part, it is the light relative to the
    fraction.
    """
    purity = fraction**PURITY
    apparent = shown / fraction.clamp_min(torch.finfo(fraction.dtype).tiny)
    common = _weighted_median(apparent, purity)
    light, weight = (
        functional.avg_pool2d(of_pixels[None], 2 * AROUND + 1, 1, AROUND, divisor_override=1)[0]
        for of_pixels in (torch.where(fraction > 0, purity * apparent, 0), purity)
    )
    return (light + common) / (weight + 1)


def _weighted_median(values: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    order = values.flatten().argsort()
    total = weights.flatten()[order].cumsum(0)
    return values.flatten()[order[torch.searchsorted(total, total[-1] / 2)]]


def single_sample_notes(metric: GlareRating, image: torch.Tensor, other: torch.Tensor) -> tuple[str, ...]:
    """Return a note if bright single samples make the main source of a picture: an independent one has it not."""
    if (main := _main_source(metric, image)) is None:
        return ()
    rows, columns = main.pixels.to(other.device).unbind(-1)
    there = metric.efficacy * luminance(other)[rows, columns].mean().item()
    if there > main.luminance / LASTING:
        return ()
    return (
        advised(
            f"caution: bright single samples make the main glare source, of {rounded(main.luminance)} cd/m²: in "
            f"another render its pixels have {rounded(there)} cd/m²",
            "use more samples",
        ),
    )


def is_near_threshold(metric: GlareRating, image: torch.Tensor) -> bool:
    """Whether the main source of a picture is so close to the threshold that a change may take it below."""
    main = _main_source(metric, image)
    return main is not None and main.luminance < NEAR * metric.held_at(image).threshold


def relative_sentence(metric: GlareRating, image: torch.Tensor, style: Format) -> str:
    """Return ``"with a threshold of 5 times the mean luminance, UGR is 21.6"``, in a style of numbers.

    If a source is as bright as that threshold, the rating jumps there, and the sentence says from what to what.
    """
    rating, name = relative_rating(metric, image), metric.measure.symbol or metric.measure.name
    text = f"with a threshold of {FACTOR:g} times the mean luminance, {name} is {style.write(rating)}"
    beside = [relative_rating(metric, image, FACTOR * (1 + aside)) for aside in (-ASIDE, ASIDE)]
    low, high = min(rating, *beside), max(rating, *beside)
    if high - low <= JUMP * abs(rating):
        return text
    between = f"{style.write(low)} to {style.write(high)} within {100 * ASIDE:g} % of that threshold"
    return f"{text} ({between}, which a source is close to)"


def relative_rating(metric: GlareRating, image: torch.Tensor, factor: float = FACTOR) -> float:
    """Return the rating of a picture with a threshold relative to its mean luminance: the other usual one."""
    return metric.relative_to_mean(factor).hard(image).item()


def _main_source(metric: GlareRating, image: torch.Tensor) -> GlareSource | None:
    return max(
        metric.sources(image),
        key=lambda one: one.luminance**2 * one.solid_angle / one.position_index**2,
        default=None,
    )
