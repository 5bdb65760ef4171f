"""Checks of attributions: change the scene, render it again, and compare the metric with the prediction."""

# What users see; the other names are for the rooms above and for extensions.
__all__ = [
    "DGSM",
    "Ablated",
    "AblationTest",
    "DeletionInsertion",
    "GlobalDerivative",
    "Infidelity",
    "Interactions",
    "OrderCurves",
    "RandomizationCheck",
    "SensitivityComparison",
    "SensitivityIndex",
    "SensitivityN",
    "ablation_test",
    "compare_sensitivity",
    "deletion_insertion",
    "dgsm",
    "hessian_vector_product",
    "infidelity",
    "interactions",
    "randomization_check",
    "sensitivity_n",
]

from ._ablation import Ablated as Ablated
from ._ablation import AblationTest as AblationTest
from ._ablation import ablation_test as ablation_test
from ._deletion import DeletionInsertion as DeletionInsertion
from ._deletion import deletion_insertion as deletion_insertion
from ._dgsm import DGSM as DGSM
from ._dgsm import GlobalDerivative as GlobalDerivative
from ._dgsm import dgsm as dgsm
from ._faithfulness import infidelity as infidelity
from ._faithfulness import sensitivity_n as sensitivity_n
from ._faithfulness_result import Infidelity as Infidelity
from ._faithfulness_result import SensitivityN as SensitivityN
from ._hessian import hessian_vector_product as hessian_vector_product
from ._interactions import Interactions as Interactions
from ._interactions import interactions as interactions
from ._orders import OrderCurves as OrderCurves
from ._randomization import RandomizationCheck as RandomizationCheck
from ._randomization import randomization_check as randomization_check
from ._scalars import Scalar as Scalar
from ._scenes import Scenes as Scenes
from ._scenes import denoise_of as denoise_of
from ._sensitivity import compare_sensitivity as compare_sensitivity
from ._sensitivity_result import SensitivityComparison as SensitivityComparison
from ._sensitivity_result import SensitivityIndex as SensitivityIndex
