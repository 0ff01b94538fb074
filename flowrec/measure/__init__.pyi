from .calibrate_chip import (
    PictureChip as PictureChip, calibrate_chip as calibrate_chip, draw_outline as draw_outline, open_field as open_field,
)
from .calibrate_coils import calibrate_coils as calibrate_coils
from .calibrate_image import (
    WallsState as WallsState, calibrate_image as calibrate_image, registration_state as registration_state,
    walls_state as walls_state,
)
from .calibrate_motion import (
    ANYWHERE as ANYWHERE, calibrate_motion as calibrate_motion, figures_of as figures_of, fit_log as fit_log, fit_samples as fit_samples,
    heading_settings as heading_settings, remarks as remarks, rows_of as rows_of, sampled_s as sampled_s,
)
from .coil_windings import windings_matrix as windings_matrix
from .images import write_picture as write_picture
from .motion_fit import MotionFit as MotionFit, UNEXPLAINED as UNEXPLAINED
from .picture_registration import ImageVerdict as ImageVerdict, orientation_by_image as orientation_by_image
from .proposal import as_toml as as_toml
from .tuning import tune as tune
from .wall_trace import as_pictured as as_pictured
