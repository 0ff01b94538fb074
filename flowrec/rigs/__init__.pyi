from .emulated.camera import EmulatedCamera as EmulatedCamera
from .emulated.coils import compiled_firmware as compiled_firmware, emulated_board as emulated_board
from .emulated.instruments import EmulatedInstruments as EmulatedInstruments
from .emulated.world import emulated_world as emulated_world
from .lab.amplifiers.limits import CommandLimits as CommandLimits
from .lab.cameras.camera import CameraInfo as CameraInfo, Grabbed as Grabbed, Wanted as Wanted, bits_of as bits_of
from .lab.cameras.probe import first_camera as first_camera, probe_camera as probe_camera
from .lab.drive import probe_amplifier as probe_amplifier
from .lab.guardian import Guardian as Guardian, ONLY_HARDWARE as ONLY_HARDWARE
from .movie.exported import session_of_log as session_of_log, with_exported as with_exported
from .movie.rig import MovieRig as MovieRig, fitted_to_movie as fitted_to_movie
from .movie.source import MovieSource as MovieSource, open_source as open_source, sha256_of as sha256_of
from .rig import (
    Clocked as Clocked, Connecting as Connecting, Measuring as Measuring, Picturing as Picturing, Resting as Resting, Rig as Rig, Tried as Tried, checked_images as checked_images,
    increasing_stamps as increasing_stamps,
)
from .streams.log import LogStream as LogStream, RunLog as RunLog
from .streams.stream import (
    Chunk as Chunk, NoStreamError as NoStreamError, SampleStream as SampleStream, SettableStream as SettableStream, StreamHead as StreamHead,
    settings_of_device as settings_of_device,
)
from .simulated.rig import SimulatedRig as SimulatedRig, true_view as true_view
from .simulated.world import true_depth_um as true_depth_um, true_robot as true_robot
