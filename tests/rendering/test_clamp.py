"""``renderer.clamp_`` keeps leaves within their physical bounds in an optimizer's loop."""

from __future__ import annotations

import torch
from seeds import shifted

from scenecaptum import SceneRenderer


def test_adam_stays_within_the_bounds():
    renderer = SceneRenderer("cornell-box", inputs="reflectance", resolution=(16, 16), spp=4, max_depth=3)
    leaves = renderer.leaves()
    adam = torch.optim.Adam(leaves.values(), lr=0.3)
    for step in range(6):
        adam.zero_grad()
        (-renderer(leaves, seed=shifted(step)).mean()).backward()
        adam.step()
        renderer.clamp_(leaves)
    for name, leaf in leaves.items():
        low, high = renderer.bounds[name]
        assert low <= leaf.min() <= leaf.max() <= high, name
        assert leaf.is_leaf, name
        assert leaf.requires_grad, name
    assert max(leaf.max().item() for leaf in leaves.values()) == 1.0  # they would have left their range


def test_an_open_bound_is_kept_at_a_distance():
    renderer = SceneRenderer("office", inputs="roughness", resolution=(8, 8), spp=1)
    leaves = renderer.leaves()
    with torch.no_grad():
        for leaf in leaves.values():
            leaf.sub_(10)
    renderer.clamp_(leaves)
    assert all(leaf.min() > 0 for leaf in leaves.values())
    renderer(leaves, seed=0)
