"""Messages of the library in the words of the command line."""

from __future__ import annotations

import argparse
import sys
import warnings

import pytest

from scenecaptum import cli
from scenecaptum.cli._messages import in_options, warnings_in_options

OFFICE = ["office", "--resolution", "16x9", "--spp", "4", "--max-depth", "2", "--no-progress"]


def test_a_word_in_quotes_is_the_value_of_an_option():
    options = argparse.Namespace(sensor=None)
    assert in_options('Use SceneRenderer(…, sensor="fisheye").', options) == "Use --sensor fisheye."
    given = "SensorGrid(floor='flor'): the scene has no such shape."
    assert in_options(given, argparse.Namespace(floor=None)) == "--floor 'flor': the scene has no such shape."


def test_advice_to_call_a_function_is_no_message_of_a_command():
    said = "'a' is 2, outside the range [0, 1] of its kind. Clamp it before, with renderer.clamp_(inputs)."
    shown = "'a' is 2, outside the range [0, 1] of its kind."
    assert in_options(said, argparse.Namespace()) == shown


def test_warnings_name_options(monkeypatch, capsys):
    def show(message, category, filename, lineno, file=None, line=None):
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno))

    monkeypatch.setattr(warnings, "showwarning", show)
    before = warnings.formatwarning
    with warnings_in_options(argparse.Namespace(sensor=None)):
        warnings.warn('Too low. Use SceneRenderer(…, sensor="fisheye").', stacklevel=1)
    assert capsys.readouterr().err == "scenecaptum: warning: Too low. Use --sensor fisheye.\n"
    assert warnings.formatwarning is before


def test_a_value_outside_its_range_is_refused_with_the_range(tmp_path, capsys):
    arguments = ["--metric", "luminance", "--set", "wall_left.reflectance.value=62", "--out", str(tmp_path)]
    assert cli.main(["compare", *OFFICE, *arguments]) == 2
    message = capsys.readouterr().err
    assert "outside the physical range" in message
    assert "renderer" not in message


@pytest.mark.parametrize(
    ("formats", "place"), [([], "attribution.csv"), (["json"], "attribution.json"), (["npz"], "--format csv")]
)
def test_a_table_says_which_file_has_all_parameters(formats, place, tmp_path, capsys):
    chosen = [word for name in formats for word in ("--format", name)]
    assert cli.main(["attribute", *OFFICE, "--metric", "luminance", *chosen, "--out", str(tmp_path)]) == 0
    assert f"{place} lists all" in " ".join(capsys.readouterr().out.split())
