"""What a slider says of an effect that may not hold over its range."""

from __future__ import annotations

import torch

from scenecaptum import SceneAttribution
from scenecaptum.explore._session import doubts_about

TURN = "desk.pose.rotation"


def result(**info: object) -> SceneAttribution:
    values = {TURN: torch.tensor([1.0, 0.0, 0.0]), "lamp": torch.tensor(2.0)}
    return SceneAttribution(
        attributions=values,
        standard_error={name: torch.full_like(value, 0.1) for name, value in values.items()},
        metric_value=1.0,
        covariance={name: 0.01 * torch.eye(value.numel()) for name, value in values.items()},
        extents={name: torch.ones(value.numel()) for name, value in values.items()},
        parameter_values={TURN: torch.zeros(3), "lamp": torch.tensor(2.0)},
        labels={TURN: "desk: rotation"},
        info={"metric": "UGR", "method": "VanillaSceneGradient", "replicates": 8, **info},
    )


def test_a_slider_gives_the_rendered_change_and_says_nothing_of_rankings() -> None:
    of_turn = result(nonlinear=[TURN], range_changes={TURN: (-0.5, 0.1)})
    assert TURN in of_turn.ranked_last()
    text = doubts_about(of_turn, TURN)
    assert text.startswith("the gradient at this value does not hold over the range")
    assert text.endswith("UGR changes by −0.50 ± 0.10")
    assert doubts_about(of_turn, "lamp") == ""


def test_nor_of_a_lamp_that_is_off() -> None:
    text = doubts_about(result(lights_off=["lamp"]), "lamp")
    assert text.endswith("the effect of switching on may be far off, even in its sign")
