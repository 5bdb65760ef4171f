"""Tables and figures of results.

Importing this package loads neither matplotlib nor kornia; they are loaded when a figure is drawn. Figures do not
use pyplot, so no backend is selected and ``rcParams`` are not modified. Save a figure with
``figure.savefig(path)``; notebooks display it automatically.
"""

# What users see; the other names are for the rooms above.
__all__ = [
    "display_image",
    "plot_bars",
    "plot_heatmap",
    "plot_overlay",
    "plot_plan",
    "plot_rank_comparison",
    "plot_specificity",
    "save_render",
    "table_html",
    "table_text",
]

from ._arrows import Arrow as Arrow
from ._arrows import arrows as arrows
from ._bars import plot_bars as plot_bars
from ._effect_notes import RANKED_LAST as RANKED_LAST
from ._effect_notes import light_notes as light_notes
from ._effect_notes import range_marked as range_marked
from ._effect_notes import range_notes as range_notes
from ._figures import DEFAULT_TOP as DEFAULT_TOP
from ._figures import LOWERS as LOWERS
from ._figures import RAISES as RAISES
from ._figures import SMALL as SMALL
from ._figures import TEXT as TEXT
from ._figures import TITLE as TITLE
from ._figures import UNCLEAR as UNCLEAR
from ._figures import WIDTH as WIDTH
from ._figures import Label as Label
from ._figures import add_footnotes as add_footnotes
from ._figures import axes_or_new as axes_or_new
from ._figures import characters_per_line as characters_per_line
from ._figures import color_of as color_of
from ._figures import figure_of as figure_of
from ._figures import first as first
from ._figures import log_axis as log_axis
from ._figures import log_steps as log_steps
from ._figures import name_rows as name_rows
from ._figures import new_figure as new_figure
from ._figures import style_axes as style_axes
from ._figures import write_at as write_at
from ._figures import write_clear as write_clear
from ._figures import write_header as write_header
from ._layout import first_few as first_few
from ._layout import grid as grid
from ._layout import group_by_text as group_by_text
from ._layout import html_cells as html_cells
from ._layout import terminal_width as terminal_width
from ._layout import wrap as wrap
from ._layout import wrapped_lines as wrapped_lines
from ._maps import diverging as diverging
from ._maps import draw_colorbar as draw_colorbar
from ._maps import draw_overlay as draw_overlay
from ._maps import is_denoised as is_denoised
from ._maps import plot_heatmap as plot_heatmap
from ._maps import plot_overlay as plot_overlay
from ._maps import shown_render as shown_render
from ._moves import MOVES as MOVES
from ._moves import move as move
from ._notes import baseline_notes as baseline_notes
from ._notes import caution_groups as caution_groups
from ._notes import caution_marks as caution_marks
from ._notes import convergence_notes as convergence_notes
from ._notes import gradient_advice as gradient_advice
from ._notes import group_notes as group_notes
from ._notes import jump_notes as jump_notes
from ._notes import kept_channels as kept_channels
from ._notes import marked_doubts as marked_doubts
from ._notes import noise_notes as noise_notes
from ._notes import pose_notes as pose_notes
from ._notes import sampling_notes as sampling_notes
from ._notes import scene_cautions as scene_cautions
from ._notes import unit_notes as unit_notes
from ._notes import untrusted_groups as untrusted_groups
from ._numbers import Format as Format
from ._numbers import align_decimals as align_decimals
from ._numbers import align_with_errors as align_with_errors
from ._numbers import columns as columns
from ._numbers import cut as cut
from ._numbers import format_with_error as format_with_error
from ._numbers import minus as minus
from ._numbers import plain_number as plain_number
from ._numbers import rounded as rounded
from ._numbers import rounded_up as rounded_up
from ._numbers import shorten as shorten
from ._numbers import signed_roughly as signed_roughly
from ._numbers import signed_with_error as signed_with_error
from ._numbers import with_error as with_error
from ._plan import LEVELS as LEVELS
from ._plan import plot_plan as plot_plan
from ._plan import share_scale as share_scale
from ._ranks import plot_rank_comparison as plot_rank_comparison
from ._row_cautions import row_cautions as row_cautions
from ._specificity import plot_specificity as plot_specificity
from ._table import STYLE as STYLE
from ._table import table_html as table_html
from ._table import table_text as table_text
from ._text import CAUTION as CAUTION
from ._text import TEXEL_MEANING as TEXEL_MEANING
from ._text import advised as advised
from ._text import attributed_name as attributed_name
from ._text import axis_label as axis_label
from ._text import cautions_among as cautions_among
from ._text import class_doubt as class_doubt
from ._text import findings as findings
from ._text import is_of_camera as is_of_camera
from ._text import method_name as method_name
from ._text import metric_line as metric_line
from ._text import metric_name as metric_name
from ._text import metric_symbol as metric_symbol
from ._text import metric_unit as metric_unit
from ._text import pack as pack
from ._text import pluralize as pluralize
from ._text import prefixed as prefixed
from ._text import rating as rating
from ._text import sign_labels as sign_labels
from ._text import unit_of_change as unit_of_change
from ._text import verdict as verdict
from ._tonemap import automatic_exposure as automatic_exposure
from ._tonemap import display_image as display_image
from ._tonemap import save_render as save_render
