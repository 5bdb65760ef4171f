"""The paper's claims, one function each: it renders, draws, and says what came out."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from _rooms import TURNED, Room, Size, load
from _section import Section, table

from scenecaptum import SceneAttribution, VanillaSceneGradient, metrics, tradeoff
from scenecaptum.tradeoff._statistics import spearman
from scenecaptum.validation import ablation_test
from scenecaptum.visualization import plot_specificity

LEADERS = 5  # materials that matter most
MIRRORS = {
    "office": ["mirror.*", "wall_left.*"],
    "living-room": ["Mirror.*", "Walls.*"],
}  # and a wall, to compare


def specificity(rooms: list[str], size: Size, folder: Path) -> Section:
    """Draw three metrics of one picture, bars above maps, and compare their rankings."""
    section = Section(
        "Metric specificity",
        "UGR isolates localised reflective surfaces and lights, mean luminance large areas; the maps of metrics "
        "differ, so that they are no generic map of the scene. A network's logit can be attributed alike.",
    )
    firsts, compared = [], []
    for name in rooms:
        room = load(name, "materials", size.width, size.spp, resnet=size.resnet)
        found = attribute(room)
        section.add_figure(
            folder,
            f"specificity-{name}",
            plot_specificity(list(found.values()), top=size.top),
            f"{name}: three metrics, their rankings above their maps",
        )
        firsts.append(
            [name, *(", ".join(ranked.label for ranked in one.ranking(top=3)) for one in found.values())]
        )
        compared += [
            Pair(room, names, (found[names[0]], found[names[1]]))
            for names in itertools.combinations(found, 2)
        ]
    section.measured = [
        *table(["room", *(f"first three, {metric}" for metric in room.metrics)], firsts),
        "",
        *table(
            ["room", "metrics", "area", "leaders in common", "opposite in sign", "ρ"],
            [one.cells for one in compared],
        ),
        "",
        f"Leaders are the {LEADERS} most salient materials of a metric, area the part of the picture that shows "
        "them. Opposite in sign are those leaders of either that raise one metric and lower the other. ρ is "
        "Spearman's correlation of the two rankings of all materials, by size.",
    ]
    ours = [one for one in compared if one.names == ("mean luminance", "UGR")]
    larger = sum(one.areas[0] > one.areas[1] for one in ours)
    section.difference = (
        f"In {larger} of {len(ours)} rooms the leaders of mean luminance fill more of the picture than those of "
        f"UGR. The two share {sum(one.common for one in ours)} of {LEADERS * len(ours)} leaders, since both hang "
        "on how much light there is: by their sizes alone, maps of these two metrics are not far from a generic "
        "map of the scene. What tells them apart is the sign, which the paper's magnitudes leave out: "
        f"{sum(one.opposite for one in ours)} of {sum(one.either for one in ours)} leaders raise one and lower "
        "the other, because what brightens the surroundings of a light makes it glare less."
    )
    return section


def attribute(room: Room) -> dict[str, SceneAttribution]:
    """Return the gradients of all metrics, from one set of renders each."""
    return {
        name: VanillaSceneGradient(room.renderer, metric).attribute(seed=0, show_progress=True)
        for name, metric in room.metrics.items()
    }


@dataclass
class Pair:
    """Two metrics of a room, compared."""

    room: Room
    names: tuple[str, str]
    found: tuple[SceneAttribution, SceneAttribution]

    def __post_init__(self) -> None:
        first, second = ({ranked.name: ranked for ranked in one.ranking()} for one in self.found)
        leaders = [list(one)[:LEADERS] for one in (first, second)]
        shown = self.room.renderer.surfaces.shown
        self.areas = [float(shown(names).mean()) for names in leaders]
        either = set(leaders[0]) | set(leaders[1])
        self.either, self.common = len(either), len(set(leaders[0]) & set(leaders[1]))
        self.opposite = sum(sum(first[name].total) * sum(second[name].total) < 0 for name in either)
        sizes = [torch.tensor([one[name].saliency for name in first]) for one in (first, second)]
        self.correlation = spearman(*sizes)

    @property
    def cells(self) -> list[str]:
        """Return a row of the table."""
        return [
            self.room.name,
            " and ".join(self.names),
            " and ".join(f"{area:.0%}" for area in self.areas),
            f"{self.common} of {LEADERS}",
            f"{self.opposite} of {self.either}",
            f"{self.correlation:.2f}",
        ]


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
                reference = f"{trade.reference.relative_error:.1%}"
                rows.append([name, metric, f"{spp}", *cells, f"{row.top.value:.0%}", reference])
            section.add_figure(
                folder,
                f"stability-{name}-{metric.replace(' ', '-')}",
                trade.plot(),
                f"{name}, {metric}: error and seconds",
            )
    section.measured = table(
        [
            "room",
            "metric",
            "spp",
            "error of the gradient",
            "Spearman",
            "Kendall, resolved pairs",
            "top 5",
            "the reference's own error",
        ],
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
        if not (hidden and hidden[0].saliency):
            rows.append([name, metric, "nothing", "–", "–"])
            continue
        strongest = hidden[0]
        share = strongest.saliency / ranking[0].saliency
        rows.append([name, metric, strongest.label, f"{strongest.rank} of {len(ranking)}", f"{share:.0%}"])
        if strongest.rank <= LEADERS:
            section.add_figure(
                folder,
                f"unseen-{name.replace(' ', '-')}-{metric.replace(' ', '-')}",
                found.plot_heatmap(),
                f"{name}: what moves {metric}; below the picture, what it does not show",
            )
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
    """Compare derivatives of mirrors: Mitsuba's integrator, ours, and finite differences."""
    del folder
    section = Section(
        "Where stock derivatives mislead",
        "Gradients are Mitsuba's `prb`. The map of UGR isolates reflective surfaces, such as the mirror in the "
        "living room.",
    )
    metric = metrics.MeanLuminance()
    rows, lost, count = [], 0, 0
    for room_name in filter(MIRRORS.__contains__, rooms):
        room = load(room_name, MIRRORS[room_name], size.judged, size.reference)
        ours, stock = (
            VanillaSceneGradient(renderer, metric).attribute(seed=0)
            for renderer in (room.renderer, room.renderer.replace(integrator="prb"))
        )
        for name in room.renderer.inputs:
            measured, error = difference(room, metric, name)
            cells = [
                f"{one[name].sum():.3g} ± {one.standard_error[name].norm():.1g}" for one in (ours, stock)
            ]
            rows.append([room_name, f"`{name}`", f"{measured:.3g} ± {error:.1g}", *cells])
            if "mirror" in name.lower() and abs(measured) > 3 * error:
                count, lost = count + 1, lost + (not stock[name].any())
    section.measured = table(["room", "parameter", "finite difference", "scenecaptum", "`prb`"], rows)
    section.difference = (
        f"Of {count} parameters of smooth mirrors whose finite difference is told from 0, stock `prb` gives "
        f"{lost} no derivative at all: their saliency is 0 in any map made with it, whatever the metric. The "
        "table on [derivatives](derivatives.md) lists what else is wrong."
    )
    return section


def difference(room: Room, metric: metrics.MeanLuminance, name: str, seeds: int = 4) -> tuple[float, float]:
    """Return the difference quotient by all channels of a parameter, with its standard error.

    It is one-sided, away from the bounds, and of second order.
    """
    value, (low, high) = room.renderer.inputs[name], room.renderer.bounds[name]
    step = 0.01 * (high - low if math.isfinite(high - low) else value.abs().mean().item() or 1.0)
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
