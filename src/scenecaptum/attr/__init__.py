"""The attribution methods, named after Captum's, and the result that they return."""

from ._attribution import Ranked as Ranked
from ._attribution import SceneAttribution as SceneAttribution
from ._feature_ablation import FeatureAblationScene as FeatureAblationScene
from ._gradient_shap import GradientShapScene as GradientShapScene
from ._input_x_gradient import InputXGradientScene as InputXGradientScene
from ._integrated_gradients import IntegratedGradientsScene as IntegratedGradientsScene
from ._interruption import AttributionInterrupted as AttributionInterrupted
from ._occlusion import OcclusionScene as OcclusionScene
from ._shapley_value import ShapleyValueScene as ShapleyValueScene
from ._smooth_grad import SmoothGradScene as SmoothGradScene
from ._vanilla import VanillaSceneGradient as VanillaSceneGradient
