"""The paper's claims, one function each: it renders, draws, and says what came out."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from pathlib import Path

import torch
from _rooms import TURNED, Room, Size, load
from _section import Section, table

from scenecaptum import SceneAttribution, VanillaSceneGradient, metrics, tradeoff
from scenecaptum.tradeoff._statistics import spearman
from scenecaptum.validation import ablation_test
from scenecaptum.visualization import plot_specificity


def specificity(rooms: list[str], size: Size, folder: Path) -> Section:
    """Draw three metrics of one picture, bars above maps, and compare their rankings."""
    section = Section(
        "Metric specificity",
        "UGR isolates localised reflective surfaces and lights, mean luminance large areas; the maps of metrics "
        "differ, so that they are no generic map of the scene. A network's logit can be attributed alike.",
    )
    rows, shares = [], []
    for name in rooms:
        room = load(name, "materials", size.width, size.spp, resnet=size.resnet)
        found = attribute(room)
        section.add_figure(
            folder,
            f"specificity-{name}",
            plot_specificity(list(found.values()), top=size.top),
            f"{name}: three metrics, their rankings above their maps",
        )
        areas = {metric: area_of_leaders(room, one) for metric, one in found.items()}
        shares.append(areas["mean luminance"] - areas["UGR"])
        firsts = [", ".join(ranked.label for ranked in one.ranking(top=3)) for one in found.values()]
        pairs = itertools.combinations(found.values(), 2)
        rows.append(
            [name, *firsts, *(f"{area:.0%}" for area in areas.values()), *(f"{alike(*p):.2f}" for p in pairs)]
        )
    names = list(room.metrics)
    section.measured = [
        *table(["room", *(f"first three, {metric}" for metric in names)], [row[:4] for row in rows]),
        "",
        *table(
            [
                "room",
                *(f"area, {m}" for m in names),
                *(f"ρ {a}, {b}" for a, b in itertools.combinations(names, 2)),
            ],
            [[row[0], *row[4:]] for row in rows],
        ),
        "",
        "Area is the part of the picture that shows the five most salient materials, ρ Spearman's correlation of "
        "two rankings of all materials.",
    ]
    larger = sum(share > 0 for share in shares)
    section.difference = (
        f"In {larger} of {len(shares)} rooms the materials that matter most to mean luminance fill more of the "
        "picture than those that matter most to UGR. Rankings are correlated all the same, since every metric "
        "hangs on how much light there is; what differs is the head of the ranking."
    )
    return section


def attribute(room: Room) -> dict[str, SceneAttribution]:
    """Return the gradients of all metrics, from one set of renders each."""
    return {
        name: VanillaSceneGradient(room.renderer, metric).attribute(seed=0, show_progress=True)
        for name, metric in room.metrics.items()
    }


def area_of_leaders(room: Room, attribution: SceneAttribution) -> float:
    """Return the part of the picture that shows the first five parameters."""
    leaders = [ranked.name for ranked in attribution.ranking(top=5)]
    return float(room.renderer.surfaces.shown(leaders).mean())


def alike(one: SceneAttribution, other: SceneAttribution) -> float:
    """Return Spearman's correlation of two rankings."""
    first, second = one.saliency(), other.saliency()
    return spearman(torch.tensor([first[n] for n in first]), torch.tensor([second[n] for n in first]))


def ablation(rooms: list[str], size: Size, folder: Path) -> Section:
    """Move each leading parameter on its own, by a step of its own and by the paper's fixed one."""
    section = Section(
        "Independent parameter ablation",
        "After a fixed step of 0.01 down the gradient of each leading parameter, the change of UGR falls strictly "
        "along the computed ranking; that of mean luminance does so until it sinks below the noise, some 1e-4. "
        "Steps that suit each parameter are left for later.",
    )
    rows, fixed = [], []
    for name, metric in itertools.product(rooms, ("UGR", "mean luminance")):
        room = load(name, "materials", size.judged, size.reference // 4)
        test = ablation_test(room.renderer, room.metrics[metric], top=size.top, replicates=8)
        section.add_figure(
            folder,
            f"ablation-{name}-{metric.replace(' ', '-')}",
            test.plot(),
            f"{name}: predicted and measured change of {metric}; crosses: the fixed step",
        )
        clear = [row for row in test.rows if row.above_noise]
        steps = [abs(row.fixed) for row in test.rows if row.fixed is not None]
        fixed.append((sum(a >= b for a, b in itertools.pairwise(steps)), max(0, len(steps) - 1)))
        agree = f"{sum(row.agrees for row in clear)} of {len(clear)}"
        tau = "–" if test.kendall_tau is None else f"{test.kendall_tau:.2f}"
        in_order = "{} of {}".format(*fixed[-1])
        rows.append([name, metric, agree, tau, f"{len(test.rows) - len(clear)}", in_order])
    section.measured = table(
        ["room", "metric", "as predicted", "Kendall's τ", "in the noise", "in order by the fixed step"], rows
    )
    kept, all_pairs = (sum(pair[k] for pair in fixed) for k in (0, 1))
    section.difference = (
        "Steps are a tenth of each parameter's physical range, shortened where the metric bends, and every bar "
        f"has an error. With the paper's fixed step {kept} of {all_pairs} neighbours keep their order: a step of "
        "the same length is large for one parameter and lost in the noise for another."
    )
    return section


def stability(rooms: list[str], size: Size, folder: Path) -> Section:
    """Compare rankings of few samples with those of many."""
    section = Section(
        "Stability of the ranking",
        "64 to 256 samples per pixel give the ranking that 1024 give.",
    )
    rows, worst = [], math.inf
    counts = [max(2, size.reference // share) for share in (64, 16, 4)]
    for name in rooms:
        room = load(name, "materials", size.judged, counts[0])
        for metric in ("UGR", "mean luminance"):
            trade = tradeoff.measure(
                room.renderer,
                room.metrics[metric],
                vary={"spp": counts[1:]},
                reference_spp=size.reference,
                runs=3,
            )
            for row in trade.rows:
                spp, order = row.setting.primal_spp, row.kendall_resolved.value
                worst = worst if spp == counts[0] else min(worst, order)
                cells = [f"{row.relative_error.value:.1%}", f"{row.spearman.value:.2f}", f"{order:.2f}"]
                rows.append([name, metric, f"{spp}", *cells, f"{row.top.value:.0%}"])
            section.add_figure(
                folder,
                f"stability-{name}-{metric.replace(' ', '-')}",
                trade.plot(),
                f"{name}, {metric}: error and seconds",
            )
    section.measured = table(
        ["room", "metric", "spp", "error of the gradient", "Spearman", "Kendall, resolved pairs", "top 5"],
        rows,
    )
    section.difference = (
        f"Pictures are {size.judged} pixels wide. Of the pairs that the reference of {size.reference} samples "
        f"tells apart, the order holds from {counts[1]} samples on, to a Kendall's τ of {worst:.2f} or better; "
        "pairs that no setting tells apart have no order to keep. [Speed and accuracy](speed.md) has a network's "
        "logit and depth as well."
    )
    return section


def unseen(rooms: list[str], size: Size, folder: Path) -> Section:
    """Find what matters most without being in the picture."""
    section = Section(
        "What the picture does not show",
        "Saliency lives in parameter space: what influences the metric need not be visible.",
    )
    rows = []
    for name, metric in itertools.product([*rooms, TURNED], ("mean luminance", "UGR")):
        room = load(name, "all", size.judged, size.spp)
        found = VanillaSceneGradient(room.renderer, room.metrics[metric]).attribute(seed=0, scale="value")
        ranking = found.ranking()
        hidden = [one for one in ranking if not room.renderer.surfaces.shown([one.name]).any()]
        section.add_figure(
            folder,
            f"unseen-{name.replace(' ', '-')}-{metric.replace(' ', '-')}",
            found.plot_bars(),
            f"{name}, {metric}: the ranking, with what no pixel shows",
        )
        if hidden and hidden[0].saliency:
            place = 1 + [one.name for one in ranking].index(hidden[0].name)
            share = hidden[0].saliency / ranking[0].saliency
            rows.append([name, metric, hidden[0].label, f"{place} of {len(ranking)}", f"{share:.0%}"])
        else:
            rows.append([name, metric, "nothing", "–", "–"])
    section.measured = table(
        ["room", "metric", "the strongest that no pixel shows", "its rank", "of the strongest"], rows
    )
    section.difference = (
        f"Saliency is per relative change here. The {TURNED} looks away from the sky, which rules all the same. "
        "A map leaves out what no pixel shows, and says how much of the saliency that is; the ranking and the "
        "report hold it."
    )
    return section


def mirror(rooms: list[str], size: Size, folder: Path) -> Section:
    """Compare derivatives of a mirror: Mitsuba's integrator, ours, and finite differences."""
    del rooms, folder
    section = Section(
        "Where stock derivatives mislead",
        "Gradients are Mitsuba's `prb`; smooth mirrors show up among what drives UGR.",
    )
    room = load("office", ["mirror.*", "wall_left.*"], size.judged, size.reference)
    metric = metrics.MeanLuminance()
    gradients = {
        "scenecaptum": VanillaSceneGradient(room.renderer, metric).attribute(seed=0),
        "`prb`": VanillaSceneGradient(room.renderer.replace(integrator="prb"), metric).attribute(seed=0),
    }
    rows = []
    for name in room.renderer.inputs:
        measured, error = difference(room, metric, name)
        cells = [
            f"{one[name].sum():.3g} ± {one.standard_error[name].norm():.1g}" for one in gradients.values()
        ]
        rows.append([f"`{name}`", f"{measured:.3g} ± {error:.1g}", *cells])
    section.measured = table(["parameter of the office", "finite difference", *gradients], rows)
    section.difference = (
        "Stock `prb` gives smooth mirrors, and glass, no derivative at all: their saliency is 0 in any map made "
        "with it, and the table on [derivatives](derivatives.md) lists what else is wrong."
    )
    return section


def difference(room: Room, metric: metrics.MeanLuminance, name: str, seeds: int = 4) -> tuple[float, float]:
    """Return the difference quotient by all channels of a parameter, with its standard error.

    It is one-sided, away from the bounds, and of second order.
    """
    value, (low, high) = room.renderer.inputs[name], room.renderer.bounds[name]
    step = 0.01 * (high - low if math.isfinite(high - low) else value.abs().mean().item())
    step = -step if value.max() + 2 * step > high else step

    @torch.no_grad()
    def at(steps: int, seed: int) -> float:
        return metric(room.renderer({name: value + steps * step}, seed=seed)).double().item()

    slopes = torch.tensor(
        [(4 * at(1, seed) - at(2, seed) - 3 * at(0, seed)) / (2 * step) for seed in range(seeds)]
    )
    return slopes.mean().item(), (slopes.std() / math.sqrt(seeds)).item()


CLAIMS = {one.__name__: one for one in (specificity, ablation, stability, unseen, mirror)}


def chosen(names: Iterable[str]) -> list[str]:
    """Return the claims that were asked for, all by default."""
    return [name for name in CLAIMS if name in set(names)] or list(CLAIMS)
