from . import (
    calibrate_chip as calibrate_chip, calibrate_coils as calibrate_coils, calibrate_image as calibrate_image,
    calibrate_motion as calibrate_motion,
)
from .calibrate_image import (
    WallsState as WallsState, registration_state as registration_state, walls_state as walls_state,
)
from .calibrate_motion import (
    ANYWHERE as ANYWHERE, figures_of as figures_of, fit_log as fit_log, fit_samples as fit_samples,
    heading_settings as heading_settings, remarks as remarks, rows_of as rows_of, sampled_s as sampled_s,
)
from .motion_fit import MotionFit as MotionFit, UNEXPLAINED as UNEXPLAINED
from .picture_registration import ImageVerdict as ImageVerdict, orientation_by_image as orientation_by_image
from .tuning import tune as tune
