"""Measure figures that the guides state in sentences, without a table of their own.

``files`` (seeing): the size of saved results of rooms with large textures, at 160×90, with means over blocks of
texels that no pixel shows, and relative to that with every texel exact.

``randomization`` (validation): the randomization check of the bundled classifier's smoothed logit in the office at
64×36, with four draws.

``units`` (validation): how many channels of the classifier's last three layers are active at every pixel of eight
random pictures, and how many at none, with random weights behind the learnt and behind the reset statistics of
batch normalization: the layers with the least and the most, as means of ten draws of the weights.

    python benchmarks/sentences.py files|randomization|units
"""

from __future__ import annotations

import argparse
import copy
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from _script import scene_of

from scenecaptum import SceneRenderer, VanillaSceneGradient, metrics, validation

SIZE, DEPTH = (160, 90), 6
TEXTURED = ("living-room", "dining-room", "kitchen")
DRAWS, PICTURES, LAYERS = 10, 8, 3


def main() -> None:
    """Run the section that is asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("section", choices=SECTIONS)
    SECTIONS[parser.parse_args().section]()


def files() -> None:
    """Print the sizes of saved results, and how much larger they are with exact texels."""
    for room in TEXTURED:
        renderer = SceneRenderer(scene_of(room), resolution=SIZE, spp=16, max_depth=DEPTH)
        result = VanillaSceneGradient(renderer, metrics.MeanLuminance()).attribute(seed=0)
        with tempfile.TemporaryDirectory() as folder:
            usual, exact = Path(folder) / "usual", Path(folder) / "exact"
            result.save(usual)
            result.save(exact, exact_texels=True)
            sizes = usual.stat().st_size, exact.stat().st_size
        print(f"{room}: {sizes[0] / 1e6:.2f} MB, exact {sizes[1] / sizes[0]:.1f} times", flush=True)


def randomization() -> None:
    """Print the randomization check of the bundled classifier."""
    renderer = SceneRenderer(
        "office", ["reflectance", "emitters"], resolution=(64, 36), spp=64, max_depth=DEPTH
    )
    logit = metrics.ClassLogit(metrics.ShapeClassifier.pretrained(), "cube", smoothing=0.3)
    print(validation.randomization_check(renderer, logit))


def units() -> None:
    """Print the shares of channels that are always or never active."""
    resets: dict[str, Callable[[torch.nn.BatchNorm2d], None]] = {
        "learnt statistics": reset_weights,
        "reset statistics": torch.nn.BatchNorm2d.reset_parameters,
    }
    for name, reset in resets.items():
        drawn = torch.stack([shares_of_channels(seed, reset) for seed in range(DRAWS)])
        by_layer = 100 * drawn.mean(0)
        for state, values in zip(("always", "never"), by_layer, strict=True):
            print(f"{name}: {state} active {values.min():.0f} to {values.max():.0f} % of a layer's channels")


def reset_weights(layer: torch.nn.BatchNorm2d) -> None:
    """Reset scale and shift of batch normalization, and keep its statistics."""
    torch.nn.init.ones_(layer.weight)
    torch.nn.init.zeros_(layer.bias)


def shares_of_channels(seed: int, reset: Callable[[torch.nn.BatchNorm2d], None]) -> torch.Tensor:
    """Return the shares of channels that are always and never active, ``(2, layers)``, with random weights."""
    torch.manual_seed(seed)
    model = copy.deepcopy(metrics.ShapeClassifier.pretrained())
    active: list[torch.Tensor] = []
    for layer in model.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            reset(layer)
        elif isinstance(layer, torch.nn.Conv2d | torch.nn.Linear):
            layer.reset_parameters()
        elif isinstance(layer, torch.nn.ReLU):
            layer.register_forward_hook(lambda _, __, output: active.append(output > 0))
    with torch.no_grad():
        model(model.preprocess(torch.rand(PICTURES, 3, 96, 96)))
    last = [where.flatten(2).transpose(0, 1).flatten(1) for where in active[-LAYERS:]]
    return torch.stack(
        [torch.stack([where.all(1).float().mean(), (~where).all(1).float().mean()]) for where in last],
        dim=1,
    )


SECTIONS: dict[str, Callable[[], None]] = {
    "files": files,
    "randomization": randomization,
    "units": units,
}

if __name__ == "__main__":
    main()
