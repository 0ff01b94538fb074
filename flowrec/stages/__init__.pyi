from .config import (
    Config as Config, ResolvedConfig as ResolvedConfig, calibration_of as calibration_of,
    config_from_toml as config_from_toml, config_from_tree as config_from_tree, load_config as load_config,
    registration_of as registration_of, to_toml as to_toml, with_sets as with_sets,
)
from .control.amplifier import (
    AmplifierSettings as AmplifierSettings, WORST_CONDITION as WORST_CONDITION, direction_name as direction_name,
)
from .control.coil_log import columns_by_unit as columns_by_unit, current_columns as current_columns, is_of_session as is_of_session, read_coil_log as read_coil_log
from .control.coils import Coils as Coils, field_limits as field_limits
from .control.controller import CONTROLLERS as CONTROLLERS, Controller as Controller
from .control.field_log import FieldLog as FieldLog
from .control.field_rotation import (
    FieldCommand as FieldCommand, FieldState as FieldState, MotionSegment as MotionSegment,
    field_motion as field_motion,
)
from .control.mission import PHASES as PHASES
from .control.motion_axes import (
    MotionOfRun as MotionOfRun, MotionVerdict as MotionVerdict, contradiction as contradiction,
    orientation_by_motion as orientation_by_motion, own_gain as own_gain,
)
from .estimation.consistency_monitor import EXPECTED_NIS as EXPECTED_NIS, HealthMonitor as HealthMonitor
from .estimation.kalman import Kalman as Kalman, memory_s as memory_s
from .estimation.luenberger import Luenberger as Luenberger
from .estimation.observer import OBSERVERS as OBSERVERS, Observer as Observer
from .estimation.pump import as_planned as as_planned
from .estimation.sampler import SAMPLERS as SAMPLERS, Trimmed as Trimmed
from .estimation.smoother import observe as observe, smooth as smooth
from .estimation.whitening import (
    FREEDOM as FREEDOM, Flags as Flags, NoiseModel as NoiseModel, RESTART as RESTART,
    SKIPPED as SKIPPED, USED as USED, fit_noise as fit_noise, whiten as whiten, without_jumps as without_jumps,
)
from .extra_topics import ExtraRow as ExtraRow, extra_rows as extra_rows, topics_of as topics_of
from .outside_settings import (
    all_tables as all_tables, facts_of as facts_of, needed_packages as needed_packages, of_stages as of_stages,
    other_packages as other_packages, with_row as with_row,
)
from .inputs import (
    ARRIVING as ARRIVING, FROM_IMAGE as FROM_IMAGE, Inputs as Inputs, recorded_extra as recorded_extra,
    with_inputs as with_inputs,
)
from .pipeline import (
    Pipeline as Pipeline, assemble as assemble, step as step,
)
from .planning.eikonal import descend as descend, time_field as time_field
from .planning.feasibility import no_room as no_room, swept_out as swept_out, too_swift as too_swift
from .planning.free_space import open_space as open_space
from .planning.path_refinement import SPACING_PX as SPACING_PX, refine_path as refine_path
from .planning.planner import PLANNERS as PLANNERS, Planner as Planner, warm_up as warm_up
from .planning.problem import Problem as Problem
from .planning.replanning import better_route as better_route, route_elsewhere as route_elsewhere
from .planning.route import no_route as no_route, travel_time as travel_time
from .planning.survey import SurveyPlanner as SurveyPlanner
from .planning.survey_design import (
    Need as Need, Sampling as Sampling, SurveyOrder as SurveyOrder, covariance_after as covariance_after,
)
from .robot_topics import (
    estimates_of_others as estimates_of_others, observations_of_others as observations_of_others,
    observations_topic as observations_topic,
    robot_number as robot_number, robot_topic as robot_topic,
)
from .refine.case import Case as Case
from .refine.findings import map_doubts as map_doubts
from .refine.misstated_inflow import ratios_along as ratios_along
from .refine.network import UNet as UNet, trained_network as trained_network
from .refine.network_fit import Device as Device, torch_run as torch_run
from .refine.network_inputs import LEAST_SPEED as LEAST_SPEED, LOG_STD as LOG_STD, NetworkInputs as NetworkInputs
from .refine.observation_operator import (
    ObservationOperator as ObservationOperator, observation_operator as observation_operator,
)
from .refine.pi_unet import PiUnet as PiUnet
from .refine.refiner import REFINERS as REFINERS, Refiner as Refiner, keep_flow as keep_flow
from .refine.residuals import Physics as Physics
from .refine.weights import write_weights as write_weights
from .resolve import derived_values as derived_values, resolve as resolve, not_measured as not_measured, refuse_unseen as refuse_unseen
from .rig_settings import (
    AMPLIFIERS as AMPLIFIERS, CAMERAS as CAMERAS, CameraSettings as CameraSettings, LAB as LAB, Lab as Lab,
    MOVIE as MOVIE, MovieSettings as MovieSettings, OutputLimits as OutputLimits, RIGS as RIGS,
    ResolvedCamera as ResolvedCamera, SIMULATED as SIMULATED,
)
from .run_figures import (
    RunStatistics as RunStatistics, figures_of as figures_of, flow_error as flow_error, length_um as length_um,
    robot_at as robot_at, shortest_way as shortest_way, tells_flow as tells_flow,
)
from .setting_rows import (
    SettingRow as SettingRow, commented_toml as commented_toml, section_summary as section_summary,
    setting_rows as setting_rows,
)
from .sight import Sight as Sight, look as look
from .simulated_settings import (
    Optics as Optics, Simulated as Simulated, SimulatedImage as SimulatedImage,
)
from .stream_settings import LOG as LOG, STREAM_KINDS as STREAM_KINDS, StreamSettings as StreamSettings
from .vision.learned import View as View
from .vision.learning import (
    MOST as MOST, bodies_like as bodies_like, bodies_that_stand_out as bodies_that_stand_out,
)
from .vision.track_quality import TrackQuality as TrackQuality
from .vision.tracker import Tracker as Tracker
from .vision.walls import seen_walls as seen_walls
