"""What the commands say of a glare rating whose main source is near the threshold."""

from __future__ import annotations

import json

from scenecaptum import cli


def test_a_rating_near_its_threshold_is_stated_by_the_definition(tmp_path, capsys):
    """A dimmed sky just above 2000 cd/m² counts in full by the definition, and in part in the relaxed rating."""
    small = "office --metric ugr --inputs emitters --resolution 32x18 --spp 16 --max-depth 3 --no-progress"
    dimmed = "--set sky.emitter.radiance.value*=0.7"
    assert cli.main(["compare", *small.split(), *dimmed.split(), "--json", "--out", str(tmp_path / "a")]) == 0
    found = json.loads(capsys.readouterr().out)
    assert all(result["definition"] for result in found["results"])
    change = found["change"]
    assert change["value"] < change["definition"]["value"] < 0
    assert cli.main(["attribute", *small.split(), *dimmed.split(), "--out", str(tmp_path / "b")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "the value by the definition, with its error, is that of an explanation" in printed
