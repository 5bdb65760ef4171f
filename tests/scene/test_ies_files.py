"""Reading IES LM-63 files, their symmetries, and the exact integral of their candelas."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from luminaires import HORIZONTAL, VERTICAL, ies_text, write_asymmetric, write_ies
from refusals import message
from seeds import shifted

from scenecaptum.errors import SceneCaptumError
from scenecaptum.scene import Photometry, read_ies

DEGREES = [*range(0, 181, 5)]


def spread(count: int) -> torch.Tensor:
    """Return directions of equal weight over the sphere, ``(count, 3)`` (Fibonacci's spiral)."""
    z = (torch.arange(count, dtype=torch.float64) + 0.5) * 2 / count - 1
    turn = torch.arange(count, dtype=torch.float64) * math.pi * (3 - math.sqrt(5))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * turn.cos(), radius * turn.sin(), z], -1)


def direction(gamma: float, c: float) -> torch.Tensor:
    """Return the direction of two angles in degrees."""
    g, c = math.radians(gamma), math.radians(c)
    return torch.tensor(
        [math.sin(g) * math.cos(c), math.sin(g) * math.sin(c), -math.cos(g)], dtype=torch.float64
    )


# The folded angle of each symmetry, and the horizontal angles that a file with it gives.
SYMMETRIES = {
    "full": ([*range(0, 361, 15)], lambda c: c),
    "two halves": ([*range(0, 181, 15)], lambda c: min(c, 360 - c)),
    "two halves across": ([*range(90, 271, 15)], lambda c: c if 90 <= c <= 270 else (180 - c) % 360),
    "two halves across, uneven": (
        [90, 105, 165, 200, 270],
        lambda c: c if 90 <= c <= 270 else (180 - c) % 360,
    ),
    "quadrants": ([*range(0, 91, 15)], lambda c: min(c % 180, 180 - c % 180)),
    "rotation": ([0], lambda c: 0),
}


@pytest.mark.parametrize("symmetry", SYMMETRIES)
def test_planes_that_a_file_leaves_out_repeat_by_its_symmetry(symmetry, tmp_path):
    given, fold = SYMMETRIES[symmetry]
    rng = np.random.default_rng(shifted())
    planes = {fold(c): rng.uniform(0, 100, len(VERTICAL)) for c in given}
    photometry = read_ies(write_ies(tmp_path / "a.ies", VERTICAL, given, [planes[fold(c)] for c in given]))
    turn = photometry.horizontal
    assert turn[-1] - turn[0] == 360
    assert (turn.diff() > 0).all()
    for c in {a % 360 for a in given} | {(360 - a) % 360 for a in given} | {(180 - a) % 360 for a in given}:
        if fold(c) in planes:
            for index, gamma in enumerate(VERTICAL[1:-1], start=1):
                value = photometry.candela(direction(gamma, c)).item()
                assert value == pytest.approx(planes[fold(c)][index], rel=1e-9), (c, gamma)


def test_angles_are_measured_from_the_nadir_and_from_x_towards_y(tmp_path):
    candela = [[9, 1], [9, 2], [9, 3], [9, 4], [9, 1]]
    photometry = read_ies(write_ies(tmp_path / "a.ies", [0, 90], [0, 90, 180, 270, 360], candela))
    axes = torch.tensor([[0, 0, -3.0], [1, 0, 0], [0, 2, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1]])
    assert photometry.candela(axes).tolist() == pytest.approx([9, 1, 2, 3, 4, 0], abs=1e-9)
    assert photometry.candela(direction(45, 135)).item() == pytest.approx((9 + 2.5) / 2)


@pytest.mark.parametrize("horizontal", [given for given, _ in SYMMETRIES.values()], ids=list(SYMMETRIES))
def test_the_flux_of_equal_light_in_all_directions(horizontal, tmp_path):
    assert read_ies(write_ies(tmp_path / "a.ies", DEGREES, horizontal, 70)).lumens == pytest.approx(
        4 * math.pi * 70, rel=1e-12
    )
    below = read_ies(write_ies(tmp_path / "b.ies", [0, 7, 90], horizontal, 70))
    above = read_ies(write_ies(tmp_path / "c.ies", [90, 100, 180], horizontal, 70))
    assert [below.lumens, above.lumens] == pytest.approx([2 * math.pi * 70] * 2, rel=1e-12)


def test_the_flux_of_a_cosine_up_to_its_interpolation(tmp_path):
    errors = []
    for step in (2, 1):
        gamma = np.arange(0, 91, step)
        file = write_ies(tmp_path / "a.ies", gamma, [0], 300 * np.cos(np.radians(gamma)))
        errors.append(1 - read_ies(file).lumens / (math.pi * 300))
    # The chords of a cosine lie below it, by a twelfth of the squared step on average.
    assert errors == pytest.approx([math.radians(2) ** 2 / 12, math.radians(1) ** 2 / 12], rel=0.01)


@pytest.mark.parametrize("width", [0.1, 2, 90])
def test_the_flux_of_a_beam_is_exact(width, tmp_path):
    photometry = read_ies(write_ies(tmp_path / "a.ies", [0, width, 180], [0], [5000, 0, 0]))
    a = math.radians(width)
    # 2π ∫ (1 − γ/a) sin γ dγ; 1 − sin a / a would lose digits for a narrow beam
    series = sum((-1) ** k * a ** (2 * k + 2) / math.factorial(2 * k + 3) for k in range(12))
    assert photometry.lumens == pytest.approx(2 * math.pi * 5000 * series, rel=1e-8)


def test_the_flux_is_that_of_the_interpolated_candelas(tmp_path):
    photometry = read_ies(write_asymmetric(tmp_path / "a.ies", shifted()))
    mean = photometry.candela(spread(400_000)).mean().item()
    assert photometry.lumens == pytest.approx(4 * math.pi * mean, rel=1e-5)


def test_rated_lumens_and_the_ratio_to_them(tmp_path):
    file = write_ies(tmp_path / "a.ies", DEGREES, [0], 1000 / (4 * math.pi), lamps=2, lumens=625)
    photometry = read_ies(file)
    assert photometry.rated_lumens == 1250
    assert photometry.light_output_ratio == pytest.approx(0.8)
    absolute = read_ies(write_ies(tmp_path / "b.ies", DEGREES, [0], 1))
    assert absolute.rated_lumens is None
    assert absolute.light_output_ratio is None


def test_multiplier_ballast_factor_and_units(tmp_path):
    values = {
        "multiplier": 2.5,
        "ballast": 0.9,
        "unit": 1,
        "width": 1,
        "length": -2,
        "height": 0.5,
        "watts": 36,
    }
    photometry = read_ies(write_ies(tmp_path / "a.ies", [0, 180], [0], 10, **values))
    assert photometry.candela(direction(33, 44)).item() == pytest.approx(22.5)
    assert photometry.size == pytest.approx((0.3048, -0.6096, 0.1524))
    assert photometry.watts == 36


@pytest.mark.parametrize(
    ("version", "factor"),
    [
        (None, 0.5),
        ("IESNA91", 0.5),
        ("IESNA:LM-63-1995", 1),
        ("IESNA:LM-63-2002", 1),
        ("IES:LM-63-2019", 1),
        ("\ufeffIES:LM-63-2019", 1),
    ],
)
def test_only_the_old_editions_have_a_photometric_factor(version, factor, tmp_path):
    file = write_ies(tmp_path / "a.ies", [0, 180], [0], 10, version=version, future=0.5)
    assert read_ies(file).candela(direction(33, 44)).item() == pytest.approx(10 * factor)


def test_numbers_may_break_over_lines_and_be_separated_by_commas(tmp_path):
    text = ies_text([0, 90, 180], [0], [1, 2, 3])
    head, numbers = text.split("TILT=NONE\n")
    path = tmp_path / "a.ies"
    path.write_bytes((head + "tilt = none \r\n" + ",\r\n".join(numbers.split()) + "\r\n\x1a").encode())
    assert read_ies(path).table[0].tolist() == [1, 2, 3]


def test_a_tilt_table_without_effect_is_read(tmp_path):
    file = write_ies(tmp_path / "a.ies", [0, 90], [0], 5, tilt="TILT=INCLUDE\n1\n3\n0 45 90\n1 1 1")
    assert read_ies(file).candela(direction(10, 0)).item() == pytest.approx(5)


def test_an_eulumdat_file_is_named_as_such(tmp_path):
    path = tmp_path / "lamp.LDT"
    path.write_text("Maker\n1\n1\n24\n15\n")
    with pytest.raises(
        SceneCaptumError, match="is an EULUMDAT file, which is not read: export the lamp as IES"
    ):
        read_ies(path)


GOOD = ies_text([0, 90, 180], [0, 180], [[1, 2, 3], [4, 5, 6]])
BAD = {
    "not IES": ("solid cube\nfacet normal 0 0 0\n", "no TILT= line"),
    "empty": ("", "no TILT= line"),
    "header only": (GOOD[: GOOD.index("1 -1")], "ends after 0 of 13 header values"),
    "truncated": (GOOD[: GOOD.rindex("5")], "ends after 4 of 6 candela values"),
    "more numbers": (GOOD + "7", "'7' follows its last candela"),
    "words": (GOOD.replace("4 5 6", "4 five 6"), "candela values contain 'five'"),
    "not finite": (GOOD.replace("4 5 6", "4 nan 6"), "candela values contain 'nan'"),
    "negative": (GOOD.replace("4 5 6", "4 -5 6"), "must not be negative"),
    "dark": (ies_text([0, 180], [0], 0), "not all 0"),
    "type A": (ies_text([0, 90], [0], 1, type=3), "must be of type C (number 1), not type A"),
    "type B": (ies_text([0, 90], [0], 1, type=2), "must be of type C (number 1), not type B"),
    "type 7": (ies_text([0, 90], [0], 1, type=7), "not number 7"),
    "unit": (ies_text([0, 90], [0], 1, unit=3), "unit must be 1 (feet) or 2 (metres), not 3"),
    "no lamps": (ies_text([0, 90], [0], 1, lamps=0), "number of lamps must be a whole number"),
    "half a lamp": (ies_text([0, 90], [0], 1, lamps=1.5), "not 1.5"),
    "lumens": (ies_text([0, 90], [0], 1, lumens=0), "lumens per lamp must be positive, or -1"),
    "multiplier": (ies_text([0, 90], [0], 1, multiplier=0), "multiplier must be positive, not 0"),
    "ballast": (ies_text([0, 90], [0], 1, ballast=-1), "ballast factor must be positive, not -1"),
    "old factor": (ies_text([0, 90], [0], 1, version="IESNA91", future=0), "photometric factor must be"),
    "one angle": (ies_text([0], [0], 1), "at least 2 vertical angles"),
    "count": (ies_text([0, 90], [0], 1, H=0), "number of horizontal angles must be"),
    "huge count": (ies_text([0, 90], [0], 1, V=10**12), "ends after"),
    "vertical order": (ies_text([0, 60, 45, 90], [0], 1), "must ascend, but 45 follows 60"),
    "horizontal order": (ies_text([0, 90], [0, 0, 90], 1), "must ascend, but 0 follows 0"),
    "vertical span": (ies_text([0, 80], [0], 1), "must span 0–90, 90–180 or 0–180°, not 0–80°"),
    "horizontal span": (ies_text([0, 90], [0, 270], 1), "span 0–90, 0–180, 90–270 or 0–360°, not 0–270°"),
    "tilt file": (ies_text([0, 90], [0], 1, tilt="TILT=a.tlt"), "TILT=a.tlt makes its light depend"),
    "tilt table": (
        ies_text([0, 90], [0], 1, tilt="TILT=INCLUDE\n1\n2\n0 90\n1 0.8"),
        "TILT=INCLUDE makes its light depend",
    ),
}


@pytest.mark.parametrize("fault", BAD)
def test_a_bad_file_says_what_is_wrong(fault, tmp_path):
    text, expected = BAD[fault]
    path = tmp_path / "bad.ies"
    path.write_text(text, encoding="utf-8")
    said = message(lambda: read_ies(path))
    assert expected in said
    assert said.startswith(f"{path} cannot be read as an IES file: ")
    assert "\n" not in said


def test_a_path_that_is_no_file_says_so(tmp_path):
    assert "There is no IES file" in message(lambda: read_ies(tmp_path / "none.ies"))
    assert "folder" in message(lambda: read_ies(tmp_path))


@pytest.mark.parametrize(
    ("directions", "expected"),
    [
        (torch.zeros(4, 2), "shape (…, 3), not (4, 2)"),
        (torch.zeros(3), "not 0"),
        (torch.tensor([0, math.nan, 1.0]), "finite"),
    ],
    ids=["shape", "zero", "nan"],
)
def test_directions_are_checked(directions, expected):
    photometry = Photometry(torch.tensor([0.0, 180]), torch.tensor([0.0, 360]), torch.ones(2, 2))
    assert expected in message(lambda: photometry.candela(directions))


def test_the_asymmetric_file_of_other_tests_is_read_as_written(tmp_path):
    photometry = read_ies(write_asymmetric(tmp_path / "a.ies", 0))
    assert photometry.vertical.tolist() == VERTICAL
    assert photometry.horizontal.tolist() == HORIZONTAL
