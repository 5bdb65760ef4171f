"""Sky patches: order and size, against Radiance's own definition of them."""

from __future__ import annotations

import math
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from refusals import message
from seeds import shifted

from scenecaptum.daylight import SkyPatches

SUBDIVISIONS = (1, 2, 3, 4)


def evaluate(radiance: Path, source: str, m: int, directions: np.ndarray) -> np.ndarray:
    """Return Radiance's rbin of each direction."""
    cal = ["-f", str(radiance / "lib" / source)]
    if source == "reinhart.cal":  # wants the subdivision as a constant, before it is loaded
        options = ["-e", f"MF:{m}", *cal, "-e", "$1=rbin"]
    else:  # has the ground as −1
        options = [*cal, "-e", f"MF={m}", "-e", "$1=rbin+1"]
    found = subprocess.run(
        [str(radiance / "bin" / "rcalc"), *options, "-e", "Dx=$1;Dy=$2;Dz=$3"],
        input="\n".join(" ".join(f"{value:.17g}" for value in one) for one in directions),
        capture_output=True,
        text=True,
        check=True,
    )
    return np.array(found.stdout.split(), dtype=float)


def away_from_edges(patches: SkyPatches, directions: np.ndarray) -> np.ndarray:
    """Whether the patch does not change within 1e-5 rad: reinhart.cal cuts the last 1e-4 degrees of a circle."""
    tangents = np.linalg.svd(np.broadcast_to(directions[:, None], (len(directions), 3, 3)))[2][:, 1:]
    same = np.ones(len(directions), bool)
    middle = patches.index(torch.from_numpy(directions))
    for step in np.array([[1, 0], [-1, 0], [0, 1], [0, -1]]) * 1e-5:
        moved = directions + np.einsum("k,nkd->nd", step, tangents)
        moved /= np.linalg.norm(moved, axis=-1, keepdims=True)
        same &= (patches.index(torch.from_numpy(moved)) == middle).numpy()
    return same


@pytest.mark.parametrize("source", ["reinhart.cal", "reinhartb.cal"])
@pytest.mark.parametrize("m", SUBDIVISIONS)
def test_the_order_is_that_of_radiance(radiance, m, source):
    directions = np.random.default_rng(shifted(m)).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    patches = SkyPatches(m)
    clear = away_from_edges(patches, directions)
    assert clear.mean() > 0.99
    theirs = evaluate(radiance, source, m, directions)
    np.testing.assert_array_equal(patches.index(torch.from_numpy(directions)).numpy()[clear], theirs[clear])


@pytest.mark.parametrize("m", SUBDIVISIONS)
def test_each_center_is_in_its_patch(m):
    patches = SkyPatches(m)
    assert torch.equal(patches.index(patches.directions), torch.arange(patches.count))
    assert torch.equal(patches.index(patches.directions.float()), torch.arange(patches.count))


@pytest.mark.parametrize("m", SUBDIVISIONS)
def test_solid_angles_cover_both_half_spaces(m):
    patches = SkyPatches(m)
    assert patches.solid_angles[0].item() == pytest.approx(2 * math.pi)
    assert patches.solid_angles[1:].sum().item() == pytest.approx(2 * math.pi)
    assert patches.projected_solid_angles.sum().item() == pytest.approx(math.pi)


def test_sizes_are_the_shares_of_random_directions():
    generator = np.random.default_rng(shifted(9))
    directions = generator.normal(size=(400_000, 3))
    directions = torch.from_numpy(directions / np.linalg.norm(directions, axis=-1, keepdims=True))
    patches = SkyPatches(1)
    index = patches.index(directions)
    share = torch.bincount(index, minlength=patches.count) / len(directions)
    expected = patches.solid_angles / (4 * math.pi)
    z = (share - expected) / (expected / len(directions)).sqrt()
    assert z.abs().max() < 5
    cosine = torch.zeros(patches.count, dtype=torch.float64)
    cosine.index_add_(0, index, directions[:, 2].clamp(min=0))
    projected = 4 * math.pi * cosine / len(directions)
    assert projected.numpy() == pytest.approx(patches.projected_solid_angles.numpy(), rel=0.1, abs=1e-9)


def test_the_rows_are_a_closed_formula_of_the_index():
    patches = SkyPatches.reinhart()
    rows = patches.rows
    assert len(rows.altitudes) == len(rows.counts) + 1 == len(rows.first) + 1
    assert rows.first[-1] + rows.counts[-1] == patches.count == 578
    for x, y, z in np.random.default_rng(shifted(3)).normal(size=(200, 3)):
        length = math.hypot(x, y, z)
        altitude, azimuth = math.asin(abs(z) / length), math.atan2(x, y)
        row = max(r for r in range(len(rows.counts)) if rows.altitudes[r] <= altitude)
        turn = math.floor(azimuth / (2 * math.pi) * rows.counts[row] + 0.5)
        by_hand = rows.first[row] + turn % rows.counts[row]
        direction = torch.tensor([[x, y, abs(z)]], dtype=torch.float64) / length
        assert patches.index(direction).item() == by_hand


@pytest.mark.parametrize(("m", "percent"), [(1, 0.55), (2, 0.14)])
def test_centers_overestimate_the_projected_solid_angle(m, percent):
    patches = SkyPatches(m)
    by_center = patches.solid_angles * patches.directions[:, 2]
    excess = 100 * (by_center / patches.projected_solid_angles - 1)[1:]
    assert 0 < excess.min() <= excess.max() < percent + 0.01
    assert excess.max() > percent - 0.02


def test_east_follows_north():
    patches = SkyPatches.tregenza()
    assert patches.directions[1].tolist() == pytest.approx(
        [0, math.cos(math.radians(6)), math.sin(math.radians(6))]
    )
    assert patches.directions[2, 0] > 0
    assert patches.directions[0].tolist() == [0, 0, -1]


@pytest.mark.parametrize("count", [146, 578, 1298, 2306])
def test_the_count_tells_the_subdivision(count):
    assert SkyPatches.with_count(count).count == count


def test_refusals():
    assert "145" in message(lambda: SkyPatches.with_count(145))
    assert "subdivision must be" in message(lambda: SkyPatches(0))
    assert "(N, 3)" in message(lambda: SkyPatches(1).index(torch.zeros(3)))
    assert "unit vectors" in message(lambda: SkyPatches(1).index(torch.tensor([[0.0, 0.0, 2.0]])))
