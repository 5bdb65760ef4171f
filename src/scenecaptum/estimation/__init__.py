"""Everything statistical: sample budgets, replicates, the jackknife, intervals and rounds of sampling.

Renderers and metrics are known only by what they do (``protocols``). Nothing here is for users.
"""

__all__: list[str] = []

from ..student import student_t as student_t
from ._adjoints import Adjoints as Adjoints
from ._adjoints import error_parts as error_parts
from ._autograd import gradients_enabled as gradients_enabled
from ._by_definition import difference_by_definition as difference_by_definition
from ._by_definition import value_by_definition as value_by_definition
from ._comparison import differences as differences
from ._goal import DEFAULT_SHARE as DEFAULT_SHARE
from ._goal import Compared as Compared
from ._goal import Goal as Goal
from ._gradients import MIN_METRIC_SPP as MIN_METRIC_SPP
from ._gradients import GradientEstimator as GradientEstimator
from ._gradients import GradientSum as GradientSum
from ._gradients import Point as Point
from ._gradients import PointGradient as PointGradient
from ._gradients import input_values as input_values
from ._gradients import interpolated_point as interpolated_point
from ._gradients import require_memory as require_memory
from ._gradients import scaled as scaled
from ._gradients import sum_gradients as sum_gradients
from ._heavy_tails import FALSE_ALARM_RATE as FALSE_ALARM_RATE
from ._heavy_tails import MIN_EFFECTIVE_SAMPLES as MIN_EFFECTIVE_SAMPLES
from ._heavy_tails import MIN_REPLICATES as MIN_REPLICATES
from ._heavy_tails import has_dominating_replicate as has_dominating_replicate
from ._heavy_tails import rows_of_median as rows_of_median
from ._image_info import THIS_METRIC as THIS_METRIC
from ._image_info import TOO_NOISY as TOO_NOISY
from ._image_info import describe_picture as describe_picture
from ._image_info import pixel_error as pixel_error
from ._image_info import relative_noise as relative_noise
from ._jackknife import at_values as at_values
from ._jackknife import jackknife as jackknife
from ._jackknife import with_image_transform as with_image_transform
from ._metric import Metric as Metric
from ._metric import Target as Target
from ._metric import TargetedMetric as TargetedMetric
from ._metric import check_renderer_and_metric as check_renderer_and_metric
from ._metric_image import Denoise as Denoise
from ._metric_image import ImageTransform as ImageTransform
from ._metric_image import TransformSelector as TransformSelector
from ._metric_image import choose_transform as choose_transform
from ._planner import Planner as Planner
from ._progress import Progress as Progress
from ._progress import ProgressBar as ProgressBar
from ._quadrature import Method as Method
from ._quadrature import Quadrature as Quadrature
from ._quadrature import quadrature as quadrature
from ._replicates import DEFAULT_REPLICATES as DEFAULT_REPLICATES
from ._replicates import NOISY_PICTURE_RATIO as NOISY_PICTURE_RATIO
from ._replicates import Budget as Budget
from ._replicates import ReplicateStatistics as ReplicateStatistics
from ._replicates import Sampling as Sampling
from ._replicates import channel_totals as channel_totals
from ._replicates import covariance_of_mean as covariance_of_mean
from ._replicates import render_images as render_images
from ._resampling import corrected_and_error as corrected_and_error
from ._resampling import delete_one_jackknife as delete_one_jackknife
from ._resampling import half_sample_error as half_sample_error
from ._resampling import half_samples as half_samples
from ._resampling import mean_and_error as mean_and_error
from ._resampling import pseudo_values as pseudo_values
from ._rounds import Rounds as Rounds
from ._rounds import RoundSum as RoundSum
from ._rounds import TimeLimit as TimeLimit
from ._seeds import Stream as Stream
from ._seeds import derived_seeds as derived_seeds
from ._seeds import random_generator as random_generator
from ._simultaneous import Quantity as Quantity
from ._simultaneous import simultaneous_quantile as simultaneous_quantile
from ._value import metric_value as metric_value
from ._weighted_means import deviations_of_mean as deviations_of_mean
