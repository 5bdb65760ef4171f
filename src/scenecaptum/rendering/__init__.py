"""θ → image as a torch function: the renderer, the plan it follows, and what each pixel shows."""

from ._plan import RenderPlan as RenderPlan
from ._renderer import SceneRenderer as SceneRenderer
