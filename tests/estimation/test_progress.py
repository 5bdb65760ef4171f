"""The progress bar counts time: a backward pass takes as long as several renders."""

from __future__ import annotations

import re

from scenecaptum.estimation import Progress


def shares(text: str) -> list[int]:
    return [int(share) for share in re.findall(r"(\d+)%", text)]


def test_a_backward_pass_counts_as_several_renders(capsys):
    with Progress("glare", show=True) as bar:
        bar.expect(2)
        for count in (bar.rendered, bar.rendered, bar.differentiated, bar.differentiated):
            count()
            bar._bar.refresh()
    seen = shares(capsys.readouterr().err)
    assert {25, 62, 100} <= set(seen)  # 2 of 8, 5 of 8, and all parts
    assert seen == sorted(seen)


def test_it_says_that_kernels_are_compiled_until_the_first_backward_pass(capsys):
    with Progress("glare", show=True) as bar:
        bar.expect(2)
        bar.rendered()
        bar._bar.refresh()
        assert "compiling" in capsys.readouterr().err
        bar.differentiated()
        bar._bar.refresh()
    after = capsys.readouterr().err.rpartition("\r")[2]
    assert "glare" in after
    assert "compiling" not in after


def test_nothing_is_shown_unless_asked_for(capsys):
    with Progress("glare", show=False) as bar:
        bar.expect(1)
        bar.rendered()
        bar.differentiated()
    assert capsys.readouterr().err == ""
