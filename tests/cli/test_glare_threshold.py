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
    attributed = ["attribute", *small.split(), *dimmed.split(), "--report", "--out", str(tmp_path / "b")]
    assert cli.main(attributed) == 0
    printed = " ".join(capsys.readouterr().out.split())
    relaxed = "this rating is relaxed near the threshold; the value by the definition has no error bar here"
    assert relaxed in printed
    assert "the limit for" not in printed.partition("relaxed; by the definition")[0]  # no class is stated
    written = (tmp_path / "b" / "attribution.csv").read_text()
    assert ",relaxed unified glare rating," in written
    assert "`scenecaptum explain` states the value by the definition with its error bar" in printed
    # What to run is for who runs it, and not for the readers of the page.
    page = (tmp_path / "b" / "report.html").read_text()
    premises = json.loads(page.partition('id="data">')[2].partition("</script>")[0])["results"][0]["premises"]
    assert relaxed in premises
    assert "scenecaptum" not in " ".join(premises)
