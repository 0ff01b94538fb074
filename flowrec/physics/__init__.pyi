from .chip.chip import (
    Chip as Chip, ChipSettings as ChipSettings, Opening as Opening, WATER_KG_M3 as WATER_KG_M3,
    WATER_MPA_S as WATER_MPA_S, Walls as Walls,
)
from .chip.clearance import (
    check_point as check_point, clearance_um as clearance_um, median_width_um as median_width_um,
    opening_point_um as opening_point_um,
)
from .chip.fluid import (
    CarreauYasuda as CarreauYasuda, PowerLaw as PowerLaw, ViscosityLaw as ViscosityLaw,
    ViscositySettings as ViscositySettings, blood as blood, law_text as law_text, with_settings as with_settings,
)
from .chip.io import (
    CHIP_KEYS as CHIP_KEYS, chip_files as chip_files, chip_from_files as chip_from_files,
    load_chip as load_chip, read_case as read_case, read_vessel_case as read_vessel_case,
    without_pockets as without_pockets,
)
from .chip.mask_image import MAX_PIXELS as MAX_PIXELS
from .chip.openings import (
    SIDES as SIDES, border as border, check_chip as check_chip, distance_px as distance_px, distance_um as distance_um,
    find_openings as find_openings, fluid_runs as fluid_runs, guess_inlets as guess_inlets, name_inlets as name_inlets,
    named_opening as named_opening, opening_names as opening_names, run_around as run_around,
    set_inlet_speed as set_inlet_speed,
)
from .chip.registration import (
    AS_STATED as AS_STATED, Calibration as Calibration, ORIENTATIONS as ORIENTATIONS, Orientation as Orientation,
    camera_settings as camera_settings, likeness as likeness, nearest as nearest, on_chip as on_chip,
)
from .chip.synthetic import (
    bifurcation as bifurcation, draw_channel as draw_channel, smooth_curve as smooth_curve, straight as straight,
    vessels as vessels,
)
from .flow.contour_smoothing import smooth_contours as smooth_contours
from .flow.generalised import generalised_equations as generalised_equations
from .flow.level_set import from_distance as from_distance
from .flow.linear_solver import chip_key as chip_key, clear_cache as clear_cache, compute_cached as compute_cached
from .flow.map_error import (
    CONTROL as CONTROL, COURSE as COURSE, OBSERVER as OBSERVER, RESERVE as RESERVE, STEP_OUT as STEP_OUT,
)
from .flow.newton_solver import (
    NotConvergedError as NotConvergedError, Scales as Scales, System as System, local_friction as local_friction,
    newton_equations as newton_equations, system as system, with_friction as with_friction,
)
from .flow.sampling import (
    MapRaster as MapRaster, fluid_image as fluid_image, raster_velocity as raster_velocity, relative_rmse as relative_rmse, sample as sample, sample_as_seen as sample_as_seen,
    walls_of as walls_of,
)
from .flow.sensitivities import Remainder as Remainder, Sensitivities as Sensitivities, sensitivities as sensitivities
from .flow.solver import FlowSolver as FlowSolver
from .flow.uncertainty import Doubts as Doubts, FlowUncertainty as FlowUncertainty, Registration as Registration
from .flow.velocity_stencil import pixel_weights as pixel_weights, velocity_at as velocity_at
from .flow.wall_offset import with_levels as with_levels, with_wall_offset as with_wall_offset
from .robot import (
    ROLLING_BY_DRAG as ROLLING_BY_DRAG, Robot as Robot, RobotSettings as RobotSettings, USUAL_DELAY_S as USUAL_DELAY_S,
)
from .sphere_between_walls import ChannelWidths as ChannelWidths, SphereBetweenWalls as SphereBetweenWalls
