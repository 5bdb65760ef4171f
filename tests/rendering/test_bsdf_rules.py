"""A rule of a BSDF, as docs/extending.md adds it."""

from __future__ import annotations

import re
from typing import Any

import pytest
from extending import code, section

from scenecaptum import SceneRenderer
from scenecaptum.rendering import _derivative_routes


def test_a_bsdf_rule(mi: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    title = "A BSDF rule"
    (line,) = re.findall(r"^    (\(_\w+, .*\)),$", section(title), re.MULTILINE)
    rule = eval(line, vars(code(title)))
    scene = {"type": "scene", "sensor": {"type": "perspective"}, "sky": {"type": "constant"}}
    scene["ball"] = {"type": "sphere", "bsdf": {"type": "principledthin", "roughness": 0.05}}
    name = "ball.bsdf.roughness.value"
    assert name not in dict(SceneRenderer(scene, name).plan.differences)
    monkeypatch.setattr(_derivative_routes, "_RULES", (*_derivative_routes._RULES, rule))
    assert SceneRenderer(scene, name).plan.differences == ((name, rule[1]),)
