from .clocks.clock_monitor import (
    CRYSTAL_PPM as CRYSTAL_PPM, ClockMonitor as ClockMonitor, camera_summary as camera_summary,
    irregular_frames as irregular_frames, skew_ppm as skew_ppm,
)
from .clocks.device_clock import DeviceClock as DeviceClock, Fit as Fit, envelope as envelope
from .closing import Closing as Closing
from .config_tree import (
    IMAGE_SIZE as IMAGE_SIZE, NAME as NAME, Origin as Origin, REGISTRATION as REGISTRATION, apply_sets as apply_sets,
    nearest_settings as nearest_settings, place_paths as place_paths, refuse_unknown as refuse_unknown, settings_of as settings_of,
    take_registration as take_registration, type_error as type_error, without_none as without_none,
)
from .coverage import Coverage as Coverage
from .declarations import (
    COILS as COILS, Bools as Bools, Floats as Floats, Floats32 as Floats32, Image as Image, Ints as Ints, Matrix as Matrix, Message as Message, MessageField as MessageField, Role as Role,
    Source as Source, Topic as Topic, array_shapes as array_shapes,
    as_read as as_read, coil_names as coil_names, defaulted_fields as defaulted_fields, invalid_numbers as invalid_numbers,
    message_fields as message_fields, shape_error as shape_error, shape_fault as shape_fault,
    summary_of as summary_of,
)
from .declared_topics import (
    FIXED as FIXED, MadeType as MadeType, TopicTable as TopicTable, arguments_of as arguments_of,
    declaration as declaration, declared_topic as declared_topic, message_of as message_of,
    remember_call as remember_call,
)
from .diagnostics import CameraLosses as CameraLosses, Clocks as Clocks, Delays as Delays, Drops as Drops, Timing as Timing
from .enums import (
    ALARM_WORDS as ALARM_WORDS, Action as Action, Alarm as Alarm, AxesVerdict as AxesVerdict, Level as Level, Outcome as Outcome,
    Phase as Phase, View as View, WorkOrder as WorkOrder, completes_mission as completes_mission,
)
from .errors import (
    ChipError as ChipError, FlowError as FlowError, FlowrecError as FlowrecError, MovieError as MovieError,
    NotFiniteError as NotFiniteError, RigError as RigError, SessionError as SessionError,
    UnreachableError as UnreachableError, UsageError as UsageError, needs as needs, printable as printable,
)
from .interpolation import (
    bilinear as bilinear, bilinear_known as bilinear_known, cell_at as cell_at, cells_at as cells_at,
    corner_weights as corner_weights, nearest_pixel as nearest_pixel, nearest_pixels as nearest_pixels,
)
from .messages import (
    Appearance as Appearance, Applied as Applied, Measured as Measured, AxesCheck as AxesCheck, Background as Background,
    Currents as Currents, Demand as Demand, Estimate as Estimate, Event as Event, FlowField as FlowField,
    Frame as Frame, Hand as Hand, Health as Health, Mission as Mission, Observations as Observations,
    BY_STREAM as BY_STREAM, EXPECTED as EXPECTED, HEARD as HEARD, SAMPLES as SAMPLES, SILENT as SILENT, STREAMS as STREAMS,
    PUMP as PUMP, PumpShare as PumpShare, Samples as Samples, StreamStates as StreamStates,
    OperatorEvent as OperatorEvent, PIXEL_BITS as PIXEL_BITS, RobotWalls as RobotWalls, Route as Route, WALLS as WALLS, Shift as Shift, TracerTruth as TracerTruth,
    Tracers as Tracers, Track as Track,
    Truth as Truth, pixel_type as pixel_type, shift_px as shift_px,
)
from .messages.slow_stages import VALUES as VALUES, fluid_of as fluid_of, values_of as values_of
from .methods import (
    ListedMethod as ListedMethod, Method as Method, Methods as Methods, OWN as OWN, REPLAYED as REPLAYED,
    table_at as table_at,
)
from .outside import (
    FACT as FACT, Outside as Outside, VERBS as VERBS, entry_points_of as entry_points_of, outside_facts as outside_facts, the_one as the_one,
)
from .provenance import PACKAGE as PACKAGE, provenance as provenance, user_name as user_name
from .ranges import (
    Fault as Fault, OneOf as OneOf, PositiveShare as PositiveShare, Range as Range, Seed as Seed, Share as Share,
    Threads as Threads, Weight as Weight, check_ranges as check_ranges, faults as faults, hints as hints,
    named_section as named_section,
    range_of as range_of,
)
from .summary import (
    DOUBTS as DOUBTS, Figures as Figures, Row as Row, TRACERS as TRACERS, Value as Value,
    as_text as as_text, body_lines as body_lines,
    comparison_for_people as comparison_for_people, doubts_of as doubts_of, doubts_text as doubts_text,
    finite as finite, is_count as is_count, is_numeric as is_numeric, is_of_robot as is_of_robot,
    name_of as name_of, of_text as of_text, rows_for_people as rows_for_people, text_of_figure as text_of_figure,
    end_text as end_text, flow_text as flow_text, goal_text as goal_text, verdict_lines as verdict_lines,
    text_for_picture as text_for_picture, way_text as way_text, with_micro as with_micro,
)
from .system.blas_threads import one_blas_thread as one_blas_thread
from .system.bounded_process import BoundedProcess as BoundedProcess
from .system.shared_ring import SharedRing as SharedRing
from .system.child_process import ChildEndedError as ChildEndedError, ChildProcess as ChildProcess, Parent as Parent
from .system.durable import (
    append_line as append_line, put_in_place as put_in_place, replace_content as replace_content,
    replacing as replacing, sync_directory as sync_directory, write_all as write_all,
)
from .system.endings import (
    Ended as Ended, StoppedError as StoppedError, one_line_at_the_end as one_line_at_the_end,
    status_of as status_of, stopped_by as stopped_by, stopped_in_one_line as stopped_in_one_line,
)
from .system.large_blocks import separate_large_blocks as separate_large_blocks
from .system.leftovers import (
    PREFIX as PREFIX, remove_leftovers as remove_leftovers, remove_leftovers_once as remove_leftovers_once,
    temporary_name as temporary_name,
)
from .system.locks import (
    hold_file as hold_file, is_growing as is_growing, open_new as open_new, remove_idle as remove_idle, try_lock as try_lock,
)
from .system.numba_setup import compiled as compiled, keep_kernels as keep_kernels, kernels_cached as kernels_cached
from .system.output_folder import OutputFolder as OutputFolder, marker_of as marker_of
from .system.outputs import (
    FIGURE as FIGURE, JSON as JSON, MCAP as MCAP, MOVIE_FILES as MOVIE_FILES, Output as Output, OutputError as OutputError, PICTURE as PICTURE,
    RBL as RBL, RRD as RRD, TOML as TOML, WEIGHTS as WEIGHTS, is_as_written as is_as_written, name_taken as name_taken,
    named_otherwise as named_otherwise, note_written as note_written, written_sha256 as written_sha256,
)
from .system.processes import (
    Priority as Priority, forget_peak as forget_peak, peak_mb as peak_mb, pool as pool, prioritise_process as prioritise_process,
    prioritise_thread as prioritise_thread, realtime_priority as realtime_priority,
    interrupted_too as interrupted_too, start_child as start_child,
)
from .system.regular_file import (
    make_own_folder as make_own_folder, own_temporary_folder as own_temporary_folder,
    refuse_irregular as refuse_irregular,
)
from .system.stderr import said_within as said_within
from .system.table_file import DATES as DATES, TIME_UNITS as TIME_UNITS, Table as Table, read_table as read_table
from .system.toml_file import parse_toml as parse_toml, read_toml as read_toml
from .terminal import (
    Progress as Progress, console as console, looked_at as looked_at, outlet as outlet, progress as progress,
    say as say, table as table, shell_word as shell_word, warn as warn, width as width,
)
from .topics import (
    ANSWERED_BY as ANSWERED_BY, BY_FIELD as BY_FIELD, BY_PATH as BY_PATH, FLOW_FIELDS as FLOW_FIELDS,
    Extra as Extra, NO_EXTRA as NO_EXTRA, TOPICS as TOPICS, Tick as Tick, WORKER_FIELDS as WORKER_FIELDS, stale_results as stale_results,
)
from .units import (
    HALF_PX as HALF_PX, M_PER_UM as M_PER_UM, MM_PER_UM as MM_PER_UM, NS_PER_S as NS_PER_S, PA_S_PER_MPA_S as PA_S_PER_MPA_S,
    STD_PER_MAD as STD_PER_MAD, TUKEY as TUKEY, UM_PER_M as UM_PER_M, Z95 as Z95,
    amounts as amounts, nanoseconds as nanoseconds, seconds as seconds, unit_of as unit_of,
    unit_suffix as unit_suffix, wrap_rad as wrap_rad,
)
from .version import NUMERICS_VERSION as NUMERICS_VERSION, __version__ as __version__
