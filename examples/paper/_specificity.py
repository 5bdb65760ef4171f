"""The paper's main claim: a map is specific to its metric."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import torch
from _figures import MAPS, map_grid
from _rooms import HEADINGS, LEADERS, Room, Size, clear_sign, load, map_row
from _section import Section, table, verdict

from scenecaptum import SceneAttribution, VanillaSceneGradient
from scenecaptum.ranks import spearman


def specificity(rooms: list[str], size: Size, folder: Path) -> Section:
    """Map three metrics of one image, and compare their rankings."""
    section = Section(
        "Metric specificity",
        "UGR isolates localised reflective surfaces and lights, mean luminance large areas; the maps differ "
        "between metrics, so they are not a generic map of the scene. A network's logit can be attributed in the "
        "same way.",
    )
    firsts, compared, maps = [], [], []
    for name in rooms:
        room = load(name, "materials", size.width, size.spp, resnet=size.resnet)
        found = attribute(room)
        maps.append(map_row(room, list(found.values()), size))
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
        "Compared are the parameters of the materials, as in the paper, by their effects: the change of the "
        "metric over the range of the parameter, to first order. Gradients per unit cannot be compared "
        "between a reflectance and an index of refraction. "
        "[Parameters outside the image](#parameters-outside-the-image) compares them with lamps and skies. "
        f"Leaders are the {LEADERS} parameters with the largest effects on a metric, area is the fraction of the "
        "image that shows them. Opposite signs counts the leaders of either metric that raise one and lower the "
        "other, both by more than two standard errors. ρ is Spearman's correlation of the two rankings of all "
        "parameters, by magnitude.",
    ]
    _summarize_specificity(section, compared)
    facts = section.facts
    title = (
        f"Of the leading parameters of mean luminance and UGR, {facts['common']} of {facts['leaders']} are the "
        f"same, and {facts['opposite']} of {facts['either']} have opposite signs"
    )
    figure = map_grid(maps, [HEADINGS[metric] for metric in room.metrics], title, leaders=3)
    section.save(figure, folder / MAPS)
    return section


def _summarize_specificity(section: Section, compared: list[Pair]) -> None:
    """Write what the pairs of metrics show."""
    pairs = [pair for pair in compared if pair.names == ("mean luminance", "UGR")]
    networks = [pair for pair in compared if pair.names == ("mean luminance", "logit")]
    facts = {
        "common": sum(pair.common for pair in pairs),
        "leaders": LEADERS * len(pairs),
        "opposite": sum(pair.opposite for pair in pairs),
        "either": sum(pair.either for pair in pairs),
        "common_with_logit": sum(pair.common for pair in networks),
    }
    differing = sum(pair.common <= LEADERS // 2 for pair in compared)
    smaller = sum(pair.areas[1] < pair.areas[0] / 2 for pair in pairs)
    clear = sum(pair.clear_second for pair in networks)
    section.facts = {**facts, "specific": verdict(differing, len(compared))}
    areas = [[f"{area:.0%}" for area in sorted(pair.areas[k] for pair in pairs)] for k in (0, 1)]
    section.claims = [
        (
            "The rankings of different metrics differ substantially",
            f"In {differing} of {len(compared)} pairs of metrics, at most {LEADERS // 2} of {LEADERS} leading "
            f"parameters are the same; mean luminance and UGR share {facts['common']} of {facts['leaders']}",
            verdict(differing, len(compared)),
        ),
        (
            "UGR isolates small surfaces, mean luminance large areas",
            f"The leaders of UGR cover {areas[1][0]} to {areas[1][-1]} of the image, those of mean luminance "
            f"{areas[0][0]} to {areas[0][-1]}; less than half as much in {smaller} of {len(pairs)} rooms",
            verdict(smaller, len(pairs)),
        ),
        (
            "A network's logit can be attributed in the same way",
            f"{clear} of {LEADERS * len(networks)} leading effects on the logit exceed two standard errors",
            verdict(clear, LEADERS * len(networks)),
        ),
    ]
    larger = sum(pair.areas[0] > pair.areas[1] for pair in pairs)
    section.difference = (
        f"In {larger} of {len(pairs)} rooms the leaders of mean luminance cover more of the image than those of "
        f"UGR. The two share {facts['common']} of {facts['leaders']} leaders, because both depend on the amount "
        "of light: by magnitude alone, maps of these two metrics are close to a generic map of the scene. They "
        f"differ in the sign, which the paper's magnitudes leave out: {facts['opposite']} of {facts['either']} "
        "leaders raise one and lower the other, because brighter surroundings of a light reduce its glare."
    )


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
        self.opposite = sum(clear_sign(first[name]) * clear_sign(second[name]) < 0 for name in either)
        self.clear_second = sum(clear_sign(second[name]) != 0 for name in leaders[1])
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
