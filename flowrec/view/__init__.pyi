from . import viewer as viewer
from .bare_blueprint import bare_blueprint as bare_blueprint
from .bare_plots import plot_of as plot_of, stream_plots as stream_plots
from .colours import ColourScale as ColourScale, OF_PHASE as OF_PHASE, of_robot as of_robot, round_below as round_below
from .drawing import WindowCompleter as WindowCompleter, encode_jpeg as encode_jpeg
from .entities import PAIR as PAIR, REPLAY as REPLAY
from .feed import Batch as Batch, Feed as Feed, FeedSink as FeedSink, read_feed as read_feed
from .flow_values import (
    arrow_grid as arrow_grid, change as change, flow_arrows as flow_arrows, peak as peak, scale_of as scale_of,
    speed as speed, uncertainty as uncertainty,
)
from .foxglove_layout import foxglove_layout as foxglove_layout
from .live import LiveView as LiveView
from .overlay import Overlay as Overlay
from .rrd_file import APPLICATION as APPLICATION, is_made_from as is_made_from, write_rrd as write_rrd
from .scene import Box as Box, Scene as Scene, goal_of as goal_of, place_on_chip as place_on_chip, way_of as way_of
from .screenshot import screenshot as screenshot
from .status_bar import length_text as length_text, state_text as state_text
from .summary_text import (
    FIGURES as FIGURES, document_of_run as document_of_run, doubts_remark as doubts_remark, note_of as note_of,
    registration_remark as registration_remark, rows_of_run as rows_of_run, summary_document as summary_document,
)
from .viewer import (
    DATASET as DATASET, LOOPBACK as LOOPBACK, executable as executable, has_display as has_display,
    open_viewer as open_viewer, serve_recordings as serve_recordings,
)
