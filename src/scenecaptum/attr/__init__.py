"""The attribution methods, named after Captum's, and the result that they return."""

# What users see; the other names are for the rooms above.
__all__ = [
    "AttributionInterrupted",
    "Change",
    "Definition",
    "Explanation",
    "FeatureAblationScene",
    "GradientShapScene",
    "InputXGradientScene",
    "IntegratedGradientsScene",
    "MeanEffect",
    "MeanEffects",
    "OcclusionScene",
    "Ranked",
    "Row",
    "SceneAttribution",
    "ShapleyValueScene",
    "SmoothGradScene",
    "Source",
    "VanillaSceneGradient",
    "mean_effects",
]

from ._attribution import SceneAttribution as SceneAttribution
from ._attribution import versions as versions
from ._baseline_words import describe_baselines as describe_baselines
from ._baseline_words import have_same_baselines as have_same_baselines
from ._baselines import Baselines as Baselines
from ._baselines import own_texels as own_texels
from ._baselines import resolve_baselines as resolve_baselines
from ._baselines import table_of as table_of
from ._data import Ranked as Ranked
from ._data import summarize as summarize
from ._difference import lights_switched as lights_switched
from ._difference import with_different_ranges as with_different_ranges
from ._explanation import Explanation as Explanation
from ._feature_ablation import FeatureAblationScene as FeatureAblationScene
from ._findings import Change as Change
from ._findings import Definition as Definition
from ._findings import Row as Row
from ._findings import Source as Source
from ._findings import are_far_apart as are_far_apart
from ._findings import lacks_much as lacks_much
from ._gradient_shap import GradientShapScene as GradientShapScene
from ._groups import GROUPS as GROUPS
from ._groups import sum_groups as sum_groups
from ._input_x_gradient import InputXGradientScene as InputXGradientScene
from ._integrated_gradients import IntegratedGradientsScene as IntegratedGradientsScene
from ._mean_effects import MeanEffect as MeanEffect
from ._mean_effects import MeanEffects as MeanEffects
from ._mean_effects import mean_effects as mean_effects
from ._method import AttributionInterrupted as AttributionInterrupted
from ._method import GradientMethod as GradientMethod
from ._method import NamedMethod as NamedMethod
from ._method import Result as Result
from ._method import Settings as Settings
from ._method import Targets as Targets
from ._method import target_list as target_list
from ._occlusion import OcclusionScene as OcclusionScene
from ._perturbation import Arm as Arm
from ._perturbation import Effect as Effect
from ._perturbation import Perturbation as Perturbation
from ._range_check import checked_over_ranges as checked_over_ranges
from ._ranges import Noise as Noise
from ._ranges import range_lengths as range_lengths
from ._shapley_value import ShapleyValueScene as ShapleyValueScene
from ._smooth_grad import SmoothGradScene as SmoothGradScene
from ._vanilla import VanillaSceneGradient as VanillaSceneGradient
from ._wording import rating_in_words as rating_in_words

# By their names on the command line.
METHODS = {
    "gradient": NamedMethod(VanillaSceneGradient, "change per unit of each parameter"),
    "input-x-gradient": NamedMethod(InputXGradientScene, "value times gradient"),
    "integrated-gradients": NamedMethod(
        IntegratedGradientsScene, "contributions along the path from the dark scene"
    ),
    "smooth-grad": NamedMethod(SmoothGradScene, "mean gradient over noisy scenes"),
    "gradient-shap": NamedMethod(GradientShapScene, "expected contributions over random points"),
    "ablation": NamedMethod(FeatureAblationScene, "effect of setting each input to its baseline"),
    "shapley": NamedMethod(ShapleyValueScene, "contributions that include interactions"),
    "occlusion": NamedMethod(OcclusionScene, "effect of covering patches of each texture"),
}
