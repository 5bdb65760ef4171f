"""The paper's claims, one function each, which renders, draws and reports the results."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from pathlib import Path

import torch
from _figures import Accuracy, ablation_grid, map_grid, stability_grid
from _rooms import HEADINGS, LEADERS, TURNED, Room, Size, clear_sign, load, map_row, quick_rooms
from _section import Section, table, verdict
from _specificity import specificity

from scenecaptum import VanillaSceneGradient, metrics, tradeoff
from scenecaptum.validation import ablation_test

STABLE = 0.9  # Kendall's τ of a stable ranking
MIRRORS = {  # mirrors, and a wall for comparison
    "office": ["mirror.*", "wall_left.*"],
    "living-room": ["Mirror.*", "Walls.*"],
}


def ablation(rooms: list[str], size: Size, folder: Path) -> Section:
    """Move each leading parameter separately, by an adaptive step and by the paper's fixed one."""
    section = Section(
        "Independent parameter ablation",
        "After a fixed step of 0.01 down the gradient of each leading parameter, the change of UGR decreases "
        "strictly along the computed ranking; that of mean luminance does so until it is below the noise, about "
        "1e-4. Step sizes adapted to each parameter are future work.",
    )
    rows, tests = [], {}
    agreeing = above = kept = neighbours = 0
    for name, metric in itertools.product(quick_rooms(rooms), ("UGR", "mean luminance")):
        room = load(name, "materials", size.small, size.reference // 4)
        test = ablation_test(room.renderer, room.metrics[metric], top=size.top, replicates=8)
        tests[name, metric] = test
        clear = [row for row in test.rows if row.above_noise]
        agree = sum(row.agrees for row in clear)
        steps = [abs(row.fixed) for row in test.rows if row.fixed is not None]
        in_order, pairs = sum(a >= b for a, b in itertools.pairwise(steps)), max(0, len(steps) - 1)
        agreeing, above = agreeing + agree, above + len(clear)
        kept, neighbours = kept + in_order, neighbours + pairs
        tau = "–" if test.kendall_tau is None else f"{test.kendall_tau:.2f}"
        below = f"{len(test.rows) - len(clear)}"
        rows.append([name, metric, f"{agree} of {len(clear)}", tau, below, f"{in_order} of {pairs}"])
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
    section.facts = {"agreeing": agreeing, "above": above, "predicted": verdict(agreeing, above)}
    section.claims = [
        (
            "Gradients predict the effects of separate steps",
            f"{agreeing} of {above} parameters above the noise change the metric as predicted, with adapted steps",
            verdict(agreeing, above),
        ),
        (
            "With a fixed step, the changes decrease along the ranking",
            f"{kept} of {neighbours} neighbouring pairs keep their order",
            verdict(kept, neighbours),
        ),
    ]
    section.difference = (
        "Steps are a tenth of each parameter's physical range, shortened where the metric is not linear, and "
        f"every change has an error. With the paper's fixed step {kept} of {neighbours} neighbouring pairs keep "
        "their order: the same step is large for one parameter and below the noise for another."
    )
    title = (
        f"{agreeing} of {above} changes are as predicted; with a fixed step, {kept} of {neighbours} neighbouring "
        "pairs are in order"
    )
    caption = (
        "Change of the metric per unit of a step along the gradient, predicted and measured, for the leading "
        "parameters of each room; crosses: with the paper's fixed step"
    )
    units = {"UGR": "", "mean luminance": "cd/m²"}
    section.show(ablation_grid(tests, units, title), folder / "grid-ablation.webp", caption)
    return section


def stability(rooms: list[str], size: Size, folder: Path) -> Section:
    """Compare rankings from few samples with those from many."""
    section = Section(
        "Stability of the ranking",
        "64 to 256 samples per pixel give the same ranking as 1024.",
    )
    rows, orders, accuracies = [], [], {}
    counts = [max(2, size.reference // share) for share in (64, 16, 4)]
    for name in quick_rooms(rooms):
        room = load(name, "materials", size.small, counts[0])
        for metric in ("UGR", "mean luminance"):
            trade = tradeoff.measure(
                room.renderer,
                room.metrics[metric],
                vary={"spp": counts[1:]},
                reference_spp=size.reference,
                runs=3,
            )
            found = accuracies[name, metric] = [
                Accuracy(row.setting.primal_spp, row.kendall_resolved.value, row.relative_error.value)
                for row in trade.rows
            ]
            orders += [row.order for row in found if row.samples > counts[0]]
            rows += [
                [
                    *(name, metric, f"{one.samples}", f"{one.error:.1%}", f"{row.spearman.value:.2f}"),
                    *(f"{one.order:.2f}", f"{row.top.value:.0%}", f"{trade.reference.relative_error:.1%}"),
                ]
                for one, row in zip(found, trade.rows, strict=True)
            ]
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
    stable, worst = sum(order >= STABLE for order in orders), min(orders)
    section.facts = {"spp": counts[1], "worst": worst}
    section.claims = [
        (
            f"{counts[1]} to {counts[2]} samples per pixel give the ranking of {size.reference}",
            f"Pairs that the reference resolves keep their order, with a Kendall's τ of {worst:.2f} or more; "
            f"{STABLE} or more in {stable} of {len(orders)} rankings",
            verdict(stable, len(orders)),
        )
    ]
    section.difference = (
        f"Images are {size.small} pixels wide. Pairs that the reference of {size.reference} samples resolves keep "
        f"their order from {counts[1]} samples on, with a Kendall's τ of {worst:.2f} or more; the other pairs "
        "have no order to keep. [Speed and accuracy](speed.md) also covers a network's logit and the path depth."
    )
    title = f"From {counts[1]} samples per pixel on, Kendall's τ of the resolved pairs is {worst:.2f} or more"
    caption = "Agreement of the rankings with the reference, and error of the gradient, over the samples"
    section.show(stability_grid(accuracies, title), folder / "grid-stability.webp", caption)
    return section


def unseen(rooms: list[str], size: Size, folder: Path) -> Section:
    """Find the parameters with the largest effects that are not visible."""
    section = Section(
        "Parameters outside the image",
        "Saliency is defined in parameter space: parameters that influence the metric need not be visible.",
    )
    rows, turned, places = [], {}, {}
    for name, metric in itertools.product([*rooms, TURNED], ("mean luminance", "UGR")):
        room = load(name, "all", size.small if name != TURNED else size.width, size.spp)
        found = VanillaSceneGradient(room.renderer, room.metrics[metric]).attribute(seed=0)
        ranking = found.ranking()
        hidden = [row for row in ranking if not room.renderer.surfaces.shown([row.name]).any()]
        if name == TURNED:
            turned[metric] = found
        if not (hidden and clear_sign(hidden[0])):
            rows.append([name, metric, ranking[0].label, "nothing", "–", "–"])
            continue
        strongest = hidden[0]
        share = strongest.saliency / ranking[0].saliency
        place = f"{strongest.rank} of {len(ranking)}"
        rows.append([name, metric, ranking[0].label, strongest.label, place, f"{share:.0%}"])
        if strongest.rank <= LEADERS:
            owner, _, kind = strongest.label.partition(": ")
            places.setdefault((name, owner, kind), []).append(f"{place} for {metric}")
    section.measured = table(
        [
            "room",
            "metric",
            "largest effect",
            "largest that no pixel shows",
            "rank",
            "relative to the largest",
        ],
        rows,
    )
    found = [
        f"{room}: the {owner}'s {kind}, outside the image, is number {' and '.join(ranks)}"
        for (room, owner, kind), ranks in places.items()
    ]
    section.claims = [
        (
            "Parameters that influence the metric need not be visible",
            "; ".join(found) or f"No parameter outside the image is among the first {LEADERS}",
            verdict(bool(places), 1),
        )
    ]
    section.difference = (
        "All parameters that have a derivative are compared, lamps and skies included, by their effects: the "
        "change of the metric over the range of the parameter, for a radiance from off to its value. In the view "
        f"{TURNED} the sky is behind the camera, and among the largest effects nevertheless. A map leaves out "
        "parameters that no pixel shows; the ranking and the report include them."
    )
    row = map_row(room, list(turned.values()), size)
    headings = [HEADINGS[metric] for metric in turned]
    titles = [text.removeprefix(f"{TURNED}: ") for text in found if text.startswith(TURNED)]
    title = " ".join(text[0].upper() + text[1:] for text in titles)
    figure = map_grid([row], headings, title, leaders=LEADERS)
    caption = f"{TURNED}: effects on mean luminance and UGR, with the leading parameters below the maps"
    section.show(figure, folder / "grid-unseen.webp", caption)
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
    section.facts = {"lost": lost, "mirrors": count}
    section.claims = [
        (
            "Mitsuba's `prb` gives the derivatives that the maps need",
            f"It has no derivative of {lost} of {count} parameters of smooth mirrors that change mean luminance",
            verdict(count - lost, count),
        )
    ]
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
