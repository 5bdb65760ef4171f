"""The paper's claims, one function each, which renders, draws and reports the results."""

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
from scenecaptum.ranks import spearman
from scenecaptum.validation import ablation_test
from scenecaptum.visualization import plot_specificity

LEADERS = 5  # number of leading parameters
MIRRORS = {  # mirrors, and a wall for comparison
    "office": ["mirror.*", "wall_left.*"],
    "living-room": ["Mirror.*", "Walls.*"],
}


def specificity(rooms: list[str], size: Size, folder: Path) -> Section:
    """Draw three metrics of one image, bars above maps, and compare their rankings."""
    section = Section(
        "Metric specificity",
        "UGR isolates localised reflective surfaces and lights, mean luminance large areas; the maps differ "
        "between metrics, so they are not a generic map of the scene. A network's logit can be attributed in the "
        "same way.",
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
            [name, *(", ".join(row.label for row in result.ranking(top=3)) for result in found.values())]
        )
        compared += [
            Pair(room, names, (found[names[0]], found[names[1]]))
            for names in itertools.combinations(found, 2)
        ]
    section.measured = [
        *table(["room", *(f"first three, {metric}" for metric in room.metrics)], firsts),
        "",
        *table(
            ["room", "metrics", "area", "common leaders", "opposite signs", "ρ"],
            [pair.cells for pair in compared],
        ),
        "",
        f"Leaders are the {LEADERS} most salient parameters of a metric, area is the fraction of the image that "
        "shows them. Opposite signs counts the leaders of either metric that raise one and lower the other. ρ is "
        "Spearman's correlation of the two rankings of all parameters, by magnitude.",
    ]
    pairs = [pair for pair in compared if pair.names == ("mean luminance", "UGR")]
    larger = sum(pair.areas[0] > pair.areas[1] for pair in pairs)
    section.difference = (
        f"In {larger} of {len(pairs)} rooms the leaders of mean luminance cover more of the image than those of "
        f"UGR. The two share {sum(pair.common for pair in pairs)} of {LEADERS * len(pairs)} leaders, because both "
        "depend on the amount of light: by magnitude alone, maps of these two metrics are close to a generic map "
        "of the scene. They differ in the sign, which the paper's magnitudes leave out: "
        f"{sum(pair.opposite for pair in pairs)} of {sum(pair.either for pair in pairs)} leaders raise one and "
        "lower the other, because brighter surroundings of a light reduce its glare."
    )
    return section


def attribute(room: Room) -> dict[str, SceneAttribution]:
    """Return the gradients of all metrics."""
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
        first, second = ({row.name: row for row in result.ranking()} for result in self.found)
        leaders = [list(rows)[:LEADERS] for rows in (first, second)]
        shown = self.room.renderer.surfaces.shown
        self.areas = [float(shown(names).mean()) for names in leaders]
        either = set(leaders[0]) | set(leaders[1])
        self.either, self.common = len(either), len(set(leaders[0]) & set(leaders[1]))
        self.opposite = sum(sum(first[name].total) * sum(second[name].total) < 0 for name in either)
        saliencies = [torch.tensor([rows[name].saliency for name in first]) for rows in (first, second)]
        self.correlation = spearman(*saliencies)

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
    """Move each leading parameter separately, by an adaptive step and by the paper's fixed one."""
    section = Section(
        "Independent parameter ablation",
        "After a fixed step of 0.01 down the gradient of each leading parameter, the change of UGR decreases "
        "strictly along the computed ranking; that of mean luminance does so until it is below the noise, about "
        "1e-4. Step sizes adapted to each parameter are future work.",
    )
    rows, fixed = [], []
    for name, metric in itertools.product(rooms, ("UGR", "mean luminance")):
        room = load(name, "materials", size.small, size.reference // 4)
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
        [
            "room",
            "metric",
            "as predicted",
            "Kendall's τ",
            "below the noise",
            "ordered pairs with the fixed step",
        ],
        rows,
    )
    kept, all_pairs = (sum(pair[k] for pair in fixed) for k in (0, 1))
    section.difference = (
        "Steps are a tenth of each parameter's physical range, shortened where the metric is not linear, and "
        f"every bar has an error. With the paper's fixed step {kept} of {all_pairs} neighbouring pairs keep their "
        "order: the same step is large for one parameter and below the noise for another."
    )
    return section


def stability(rooms: list[str], size: Size, folder: Path) -> Section:
    """Compare rankings from few samples with those from many."""
    section = Section(
        "Stability of the ranking",
        "64 to 256 samples per pixel give the same ranking as 1024.",
    )
    rows, worst = [], math.inf
    counts = [max(2, size.reference // share) for share in (64, 16, 4)]
    for name in rooms:
        room = load(name, "materials", size.small, counts[0])
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
            "error of the reference",
        ],
        rows,
    )
    section.difference = (
        f"Images are {size.small} pixels wide. Pairs that the reference of {size.reference} samples resolves keep "
        f"their order from {counts[1]} samples on, with a Kendall's τ of {worst:.2f} or more; the other pairs "
        "have no order to keep. [Speed and accuracy](speed.md) also covers a network's logit and the path depth."
    )
    return section


def unseen(rooms: list[str], size: Size, folder: Path) -> Section:
    """Find the parameters with the largest effects that are not visible."""
    section = Section(
        "Parameters outside the image",
        "Saliency is defined in parameter space: parameters that influence the metric need not be visible.",
    )
    rows = []
    for name, metric in itertools.product([*rooms, TURNED], ("mean luminance", "UGR")):
        room = load(name, "all", size.small, size.spp)
        found = VanillaSceneGradient(room.renderer, room.metrics[metric]).attribute(seed=0)
        ranking = found.ranking()
        hidden = [row for row in ranking if not room.renderer.surfaces.shown([row.name]).any()]
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
                f"{name}: effects on {metric}; below the image, parameters that it does not show",
            )
    section.measured = table(
        [
            "room",
            "metric",
            "largest effect that no pixel shows",
            "rank",
            "relative to the largest",
        ],
        rows,
    )
    section.difference = (
        f"Effects are compared over the ranges of the parameters. In the view {TURNED} the sky is behind the "
        "camera, and among the largest effects nevertheless. A map leaves out parameters that no pixel shows, and "
        "states their effect; the ranking and the report include them."
    )
    return section


def mirror(rooms: list[str], size: Size, folder: Path) -> Section:
    """Compare derivatives of mirrors: Mitsuba's integrator, ours, and finite differences."""
    del folder
    section = Section(
        "Errors of stock derivatives",
        "Gradients are from Mitsuba's `prb`. The map of UGR isolates reflective surfaces, such as the mirror in "
        "the living room.",
    )
    metric = metrics.MeanLuminance()
    rows, lost, count = [], 0, 0
    for room_name in filter(MIRRORS.__contains__, rooms):
        room = load(room_name, MIRRORS[room_name], size.small, size.reference)
        ours, stock = (
            VanillaSceneGradient(renderer, metric).attribute(seed=0)
            for renderer in (room.renderer, room.renderer.replace(integrator="prb"))
        )
        for name in room.renderer.inputs:
            measured, error = difference(room, metric, name)
            cells = [
                f"{result[name].sum():.3g} ± {result.standard_error[name].norm():.1g}"
                for result in (ours, stock)
            ]
            rows.append([room_name, f"`{name}`", f"{measured:.3g} ± {error:.1g}", *cells])
            if "mirror" in name.lower() and abs(measured) > 3 * error:
                count, lost = count + 1, lost + (not stock[name].any())
    section.measured = table(["room", "parameter", "finite difference", "scenecaptum", "`prb`"], rows)
    section.difference = (
        f"Of {count} parameters of smooth mirrors with a significant finite difference, stock `prb` has no "
        f"derivative of {lost}: their saliency is 0 in any map computed with it, for any metric. The table of "
        "[derivatives](derivatives.md) lists its other errors."
    )
    return section


def difference(room: Room, metric: metrics.MeanLuminance, name: str, seeds: int = 4) -> tuple[float, float]:
    """Return the finite difference with respect to a parameter, all channels together, with its standard error.

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


CLAIMS = {claim.__name__: claim for claim in (specificity, ablation, stability, unseen, mirror)}


def chosen(names: Iterable[str]) -> list[str]:
    """Return the requested claims, or all of them."""
    return [name for name in CLAIMS if name in set(names)] or list(CLAIMS)
