"""Whether attributions are right: the scene is changed and rendered again, and nothing is taken on trust."""

from ._ablation import Ablated as Ablated
from ._ablation import AblationTest as AblationTest
from ._ablation import ablation_test as ablation_test
