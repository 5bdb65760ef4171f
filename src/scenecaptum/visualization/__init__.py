"""Tables and figures of results.

Importing this package loads neither matplotlib nor kornia; they are loaded when a figure is drawn. Figures do not
use pyplot, so no backend is selected and ``rcParams`` are not modified. Save a figure with
``figure.savefig(path)``; notebooks display it automatically.
"""

from ._ablation import ablation_text as ablation_text
from ._ablation import plot_ablation as plot_ablation
from ._bars import plot_bars as plot_bars
from ._faithfulness import deletion_text as deletion_text
from ._faithfulness import infidelity_text as infidelity_text
from ._faithfulness import plot_deletion as plot_deletion
from ._faithfulness import plot_infidelity as plot_infidelity
from ._faithfulness import plot_sensitivity_n as plot_sensitivity_n
from ._faithfulness import sensitivity_n_text as sensitivity_n_text
from ._interactions import interactions_text as interactions_text
from ._interactions import plot_interactions as plot_interactions
from ._luminance_map import plot_luminance as plot_luminance
from ._maps import plot_heatmap as plot_heatmap
from ._maps import plot_overlay as plot_overlay
from ._optimization import optimization_text as optimization_text
from ._optimization import plot_optimization as plot_optimization
from ._randomization import plot_randomization as plot_randomization
from ._randomization import randomization_text as randomization_text
from ._ranks import plot_rank_comparison as plot_rank_comparison
from ._scene_tables import parameters_html as parameters_html
from ._scene_tables import parameters_text as parameters_text
from ._scene_tables import plan_html as plan_html
from ._scene_tables import plan_text as plan_text
from ._sensitivity import dgsm_text as dgsm_text
from ._sensitivity import plot_sensitivity as plot_sensitivity
from ._sensitivity import sensitivity_text as sensitivity_text
from ._specificity import plot_specificity as plot_specificity
from ._table import table_html as table_html
from ._table import table_text as table_text
from ._tonemap import display_image as display_image
from ._tonemap import save_render as save_render
from ._tradeoff import plot_tradeoff as plot_tradeoff
from ._tradeoff import recommendation_text as recommendation_text
from ._tradeoff import tradeoff_text as tradeoff_text
from .report import write_report as write_report
