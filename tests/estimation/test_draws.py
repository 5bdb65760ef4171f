"""The jackknife of a mean over draws of noise, each image with its share of them."""

from __future__ import annotations

import torch
from seeds import seeds, shifted

from scenecaptum import metrics
from scenecaptum.estimation import TargetedMetric
from scenecaptum.estimation._jackknife import jackknife

SIGMA = 0.8


def test_a_linear_metric_keeps_the_draws_of_each_replicate():
    images = [torch.rand(4, 4, 3, generator=torch.Generator().manual_seed(seed)) for seed in seeds(4)]
    metric = TargetedMetric(metrics.Smoothed(torch.mean, SIGMA, n=16))
    seen = jackknife(metric, images, draws=metric.split_draws(seeds(4)))
    assert seen.is_linear
    first, second = seen.per_replicate[:2]
    assert not torch.equal(first, second)
    share = metric.with_draws({shifted(1): 4})
    torch.testing.assert_close(second, share.value_and_adjoint(torch.stack(images).mean(0))[1])
