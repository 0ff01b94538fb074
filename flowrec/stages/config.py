"""Config: the settings of a run. TOML in and out, `--set key=value`, errors that name the nearest valid value.

Every section is the frozen dataclass of the stage it sets, so a setting is declared once, where it is used. resolve.py
makes a ResolvedConfig of it, on a chip; a session carries that one, so a replay needs nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

import tomli_w
from pydantic import TypeAdapter, ValidationError

from flowrec.core import (
    FACT,
    IMAGE_SIZE,
    REGISTRATION,
    Fault,
    Origin,
    Range,
    UsageError,
    apply_sets,
    faults,
    hints,
    parse_toml,
    place_paths,
    read_toml,
    refuse_unknown,
    settings_of,
    take_registration,
    type_error,
    without_none,
)
from flowrec.physics import CHIP_KEYS, Calibration, Chip, ChipSettings, FlowSolver, Robot, RobotSettings
from flowrec.stages.control import Coils, Controller
from flowrec.stages.control.mission import MissionStateMachine, PlacedMission
from flowrec.stages.estimation import HealthMonitor, Observer, Sampler
from flowrec.stages.estimation.pump import PumpFollower
from flowrec.stages.extra_topics import TOPIC_ROWS
from flowrec.stages.other_robots import OtherRobots
from flowrec.stages.outside_settings import extend_config, key_of_section, our_class, sections
from flowrec.stages.planning import PLANNERS, Planner, SurveyPlanner
from flowrec.stages.refine import Refiner
from flowrec.stages.rig_settings import RIGS, SIMULATED, CameraSettings, Lab, MovieSettings, ResolvedCamera, Safety
from flowrec.stages.simulated_settings import FIRST_WORLD, WORLDS, Simulated, SimulatedImage
from flowrec.stages.stream_settings import StreamSettings
from flowrec.stages.vision import Stabiliser, Tracker


@dataclass(frozen=True, slots=True)
class WorkerSettings:
    """Time at which results of slow stages reach the loop."""

    # A simulated run without --realtime adopts each result exactly this long after its order, so that the same seed
    # gives the same session. A live run adopts it on the first frame after it is done.
    adopt_after_s: Annotated[float, Range(0.0, 3600.0)] = 0.5


@dataclass(frozen=True, slots=True)
class Recording:
    """The session file: encoding, what may be lost, parts, snapshots, notes."""

    # encoding of the images; auto: by the camera's data rate
    frames: Literal["auto", "zstd", "raw", "png", "delta", "jpeg"] = "auto"
    # longest end of the session that is lost when the process is killed, in wall or session time
    flush_s: Annotated[float, Range(0.0, 3600.0)] = 0.5
    sync_s: Annotated[float, Range(0.0, 3600.0)] = 1.0  # longest end of the session that is lost when the power fails
    # robot: most images hold only what the tracker read, the rest is black; replays with the same tracker are exact
    region: Literal["whole", "robot"] = "whole"
    # interval of whole images with region = robot; images without the robot are always whole
    full_every_s: Annotated[float, Range(0.0, 1e6)] = 10.0
    region_pad_px: Annotated[int, Range(0, 10_000)] = 16  # margin around what the tracker read
    leave_out: tuple[str, ...] = ()  # topics that are not recorded, as in ["/view/*", "/truth/*"]
    # a process of its own records, and completes the file however the run ends; False: a thread of the run
    own_process: bool = True
    # Limit of the data that waits for the recorder; from half of it on, a live run records fewer frames. None: four
    # seconds of the camera's images, but 64 MB to 1.25 GB; in a live run all of it is taken before the run begins.
    queue_mb: Annotated[float, Range(1e-3, 1e6)] | None = None
    # Size after which a run continues in another file; None or 0: one file.
    split_mb: Annotated[float, Range(0.0, 1e9)] | None = None
    # duration after which a run continues in another file. None: one file
    split_s: Annotated[float, Range(0.0, 1e7)] | None = None
    # Only this time before and after events is written. None: everything.
    snapshot_before_s: Annotated[float, Range(0.0, 1e6)] | None = None
    snapshot_after_s: Annotated[float, Range(0.0, 1e6)] = 10.0  # time after a mark or an alarm that a snapshot holds
    # memory for the time before an event; if it is too small, less time is kept
    snapshot_mb: Annotated[float, Range(1e-3, 1e6)] = 1000.0
    # free space below which a run is ended as by Ctrl-C; 0: never
    disk_floor_gb: Annotated[float, Range(0.0, 1e6)] = 1.0
    # Duration of the trial before the file of a live run begins: the mission's methods are compiled, and for so long
    # the camera's images are processed and written. A machine that does not hold them is refused. 0: the run begins at
    # once.
    admission_s: Annotated[float, Range(0.0, 60.0)] = 2.0
    # record also where the trial says that images will be lost, and go on when the recorder fails
    accept_losses: bool = False
    recover_leftovers: bool = True  # recover what killed runs have left in the same folder
    operator: str = ""  # person who ran it, for the record
    notes: str = ""  # free text, for the record
    sample: str = ""  # sample or experiment, for the record
    anonymous: bool = False  # do not record host, user, platform and local changes


@dataclass(frozen=True, slots=True)
class Start:
    """Another session from which a run takes its flow field."""

    field: str = ""  # session whose flow field is used instead of solving: survey once, navigate often


@dataclass(frozen=True, slots=True)
class Config:
    """All settings of a run, one section per stage."""

    rig: Annotated[str, RIGS] = SIMULATED
    # longest duration of the run; None: until the mission is finished
    duration_s: Annotated[float, Range(1e-3, 1e7)] | None = None
    # topics of other packages that are recorded besides flowrec's own
    topics: tuple[Annotated[str, TOPIC_ROWS], ...] = ()
    streams: dict[str, StreamSettings] = field(default_factory=dict)  # of other programs, a section each
    chip: ChipSettings = field(default_factory=ChipSettings)
    robot: RobotSettings = field(default_factory=RobotSettings)
    camera: CameraSettings = field(default_factory=CameraSettings)
    simulated: Simulated = field(default_factory=Simulated)
    movie: MovieSettings = field(default_factory=MovieSettings)
    lab: Lab = field(default_factory=Lab)
    start: Start = field(default_factory=Start)
    stabilise: Stabiliser = field(default_factory=Stabiliser)
    tracker: Tracker = field(default_factory=Tracker)
    observer: Observer = field(default_factory=Observer)
    health: HealthMonitor = field(default_factory=HealthMonitor)
    sampler: Sampler = field(default_factory=Sampler)
    pump: PumpFollower = field(default_factory=PumpFollower)
    others: OtherRobots = field(default_factory=OtherRobots)
    flow: FlowSolver = field(default_factory=FlowSolver)
    refine: Refiner = field(default_factory=Refiner)
    survey: SurveyPlanner = field(default_factory=SurveyPlanner)
    plan: Planner = field(default_factory=Planner)
    mission: MissionStateMachine = field(default_factory=MissionStateMachine)
    control: Controller = field(default_factory=Controller)
    coils: Coils = field(default_factory=Coils)
    safety: Safety = field(default_factory=Safety)
    worker: WorkerSettings = field(default_factory=WorkerSettings)
    recording: Recording = field(default_factory=Recording)


@dataclass(frozen=True, slots=True, kw_only=True)
class ResolvedConfig(Config):
    """The settings of a run on its chip: no setting of robot, camera, start and goal is None."""

    robot: Robot
    camera: ResolvedCamera
    mission: PlacedMission


# Settings that a session from before them does not hold, with the values with which it replays unchanged.
_BEFORE: dict[str, Any] = {
    "simulated.world": FIRST_WORLD,
    "survey.method": "downstream",
    "survey.memory_stretches": 0,
    "mission.reassimilate_observations": 0,
    "mission.replan_slower": 0.0,
    "mission.stuck_s": 0.0,
    "mission.hold_start_s": 0.0,
    "plan.policy_course_share": 1.0,
    "plan.wall_error_um": 0.0,
    "health.slowest_hz": 0.3,
    "plan.policy_points_per_radius": 3.0,
    "plan.policy_points_per_px": 4,
    "health.step_out.learned": False,
    "health.step_out.least_gain": -0.5,
    "sampler.without_map": False,
    "camera.trace_walls": False,
    "others.observe_flow": False,
    "tracker.tracer.most_elongated": 0.0,
    "refine.place_robot": False,
    "refine.correct_robot": False,
    "refine.correct_heading": False,
    "refine.correct_lag": False,
    "refine.adopt": "always",
    "mission.wait_at_goal_s": 0.0,
    "recording.admission_s": 0.0,
    "mission.check_axes": False,
}
# Settings that have moved into the section of their device: a session is read by either key, a person told the new one.
_MOVED = {
    **{f"camera.{each.name}": f"simulated.image.{each.name}" for each in fields(SimulatedImage)},
    "lab.port": "lab.serial.port",
    "lab.baud": "lab.serial.baud",
    "lab.channels": "lab.ni.channels",
    "lab.ni_server": "lab.ni.server",
}
_AnyConfig = TypeVar("_AnyConfig", Config, ResolvedConfig)
_ADAPTERS: dict[type, TypeAdapter[Any]] = {}
_OF_PYDANTIC = re.compile(r"(tuple|str|function)\b")  # parts of the place of an error that are no keys


def load_config(
    path: Path | str | None = None, sets: Mapping[str, Any] | Iterable[str] = (), flags: Mapping[str, str] | None = None
) -> Config:
    """Defaults, then the TOML file, then `sets`: values by key; or texts `key=value`, as TOML or bare words.

    `flags` holds the flag of each setting that was not typed as `--set`, by key.

    Raises
    ------
    UsageError : one line that names the flag or the file, the key, its range and the nearest valid value.
    """
    tree, given = _read_config(Path(path)) if path is not None else {}, settings_of(sets)
    take_registration(tree, given)
    origin = Origin(str(path) if path is not None else "--set", apply_sets(tree, given) | dict(flags or {}))
    config = _config_from(Config, tree, origin)
    check_config(config, origin)
    return config


def config_from_tree(tree: dict[str, Any], where: str) -> Config:
    """The configuration of nested tables; UsageError, which begins with `where`, for a setting that is wrong."""
    origin = Origin(where)
    config = _config_from(Config, tree, origin)
    check_config(config, origin)
    return config


def config_from_toml(text: str, where: str, provenance: Mapping[str, str] = MappingProxyType({})) -> ResolvedConfig:
    """The configuration of a session, as `to_toml` wrote it; `where` names its origin in errors.

    `provenance`, of the session's head, tells which sections are of other packages: these may be missing.

    A session is readable even with settings outside of their ranges. Only the sections that determine sizes and scales
    are checked.
    """
    origin = Origin(where)
    try:
        tree = parse_toml(text)
        for key, value in _BEFORE.items():
            _set_default(tree, key, value)
        for old, new in _moved_in(tree):
            section, _, name = old.partition(".")
            _set_default(tree, new, tree[section].pop(name))
        config = _config_from(ResolvedConfig, tree, origin, lambda section: FACT + section in provenance)
    except (ValueError, RecursionError) as error:  # bad TOML, and absurd numbers and nesting
        raise UsageError(f"{where}: not valid TOML ({error}); mend that line") from error
    for fault in faults(config):
        if fault.key.startswith(("chip.", "camera.", "robot.", "coils.")):
            raise UsageError(f"{where}: {fault}")
    config.coils.check(where)
    return config


def _moved_in(tree: dict[str, Any]) -> list[tuple[str, str]]:
    """Former and present key of each setting that nested tables hold under its former key."""
    there = {f"{section}.{name}" for section, table in tree.items() if isinstance(table, dict) for name in table}
    return [(old, new) for old, new in _MOVED.items() if old in there]


def _set_default(tree: dict[str, Any], key: str, value: Any) -> None:
    """Set a setting that nested tables lack."""
    *sections, name = key.split(".")
    table: Any = tree
    for section in sections:
        table = table.setdefault(section, {}) if isinstance(table, dict) else None
    if isinstance(table, dict):
        table.setdefault(name, value)


def to_toml(config: Config) -> str:
    """The configuration as TOML, without the settings that are None, and without `topics` and `streams` if empty."""
    tree = without_none(asdict(config))
    return tomli_w.dumps({key: each for key, each in tree.items() if each or key not in ("topics", "streams")})


def with_sets(
    config: _AnyConfig, sets: Mapping[str, Any] | Iterable[str], flags: Mapping[str, str] | None = None
) -> _AnyConfig:
    """The configuration with some settings changed; `sets` and `flags` as in `load_config`.

    A recorded configuration may hold settings outside of their ranges; only the changed settings are checked.
    """
    tree, given = without_none(asdict(config)), settings_of(sets)
    if REGISTRATION in given:
        tree["camera"] = {k: v for k, v in tree["camera"].items() if k not in IMAGE_SIZE}  # that of the file
        take_registration(tree, given)
    if "simulated.world" in given:  # what the other world's preset has stated goes with it
        preset = WORLDS[config.simulated.world]
        tree["simulated"] = {key: value for key, value in tree["simulated"].items() if value != preset.get(key)}
    origin = Origin("configuration", apply_sets(tree, given) | dict(flags or {}))
    others = {key_of_section(setting, name) for setting, _, name, _ in sections(config)}
    changed: _AnyConfig = _config_from(our_class(config), tree, origin, others.__contains__)
    check_config(changed, origin, frozenset(faults(config)))
    return changed


def calibration_of(config: ResolvedConfig, chip: Chip) -> Calibration:
    """Transform from camera pixels to chip coordinates, as the settings state it."""
    return registration_of(config.camera, chip)


def registration_of(camera: ResolvedCamera, chip: Chip) -> Calibration:
    """Transform from the pixels of a camera to chip coordinates."""
    width_um, height_um = chip.size_um
    half = 0.5 * chip.um_per_px
    middle = (width_um / 2 - half, height_um / 2 - half) if camera.centre_um is None else camera.centre_um
    size_px = camera.size_px
    return Calibration.centre_on(camera.um_per_px, middle, size_px, camera.angle_deg, camera.mirror)


def _read_config(path: Path) -> dict[str, Any]:
    tree = read_toml(path)
    if tree.keys() & set(CHIP_KEYS) and not tree.keys() & hints(Config).keys():
        raise UsageError(f"{path}: describes a chip; a run on it is flowrec record --set chip.path={path}")
    place_paths(tree, path)
    return tree


def _config_from(
    kind: type[_AnyConfig], tree: dict[str, Any], origin: Origin, recorded: Callable[[str], bool] | None = None
) -> _AnyConfig:
    """The configuration of a tree; types are checked, ranges are not. `recorded`: as of `extended`."""
    phases = tree.get("mission", {}).get("phases") if isinstance(tree.get("mission", {}), dict) else None
    if isinstance(phases, str):
        tree["mission"]["phases"] = [phase.strip() for phase in phases.split(",") if phase.strip()]
    for old, new in _moved_in(tree):
        raise UsageError(f"{origin(old)}: {old} is now {new}; write that")
    kind = extend_config(kind, tree, recorded)
    refuse_unknown(tree, kind, origin)
    if kind not in _ADAPTERS:
        _ADAPTERS[kind] = TypeAdapter(kind)
    try:
        config: _AnyConfig = _ADAPTERS[kind].validate_python(tree)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(part for part in map(str, first["loc"]) if not _OF_PYDANTIC.match(part))
        if first["type"] == "missing" and not key.rpartition(".")[2].isdecimal():
            raise UsageError(f"{origin(key)}: {key} is missing; a session states it") from error
        raise UsageError(f"{origin(key)}: {type_error(kind, key, first['input'], first['msg'].lower())}") from error
    return config


def check_config(config: Config, origin: Origin | None = None, known: frozenset[Fault] = frozenset()) -> None:
    """Raise UsageError, in one line, for a setting outside of its range and for settings that exclude each other.

    `origin` gives the origin of a key; faults in `known` are accepted.
    """
    origin = origin or Origin("configuration")
    for fault in faults(config):
        if fault not in known:
            raise UsageError(f"{origin(fault.key)}: {fault}")
    config.coils.check(origin("coils"))
    config.robot.check(origin("robot"))
    recording = config.recording
    if recording.snapshot_before_s and (recording.split_mb or recording.split_s):
        raise UsageError(
            f"{origin('recording')}: recording.snapshot_before_s keeps single moments and recording.split_mb, split_s "
            "all of a run; set one of them to 0"
        )
    if config.stabilise.on and recording.region == "robot":
        raise UsageError(
            f"{origin('stabilise.on', 'recording.region')}: stabilise.on reads the walls in every image, which "
            "recording.region = 'robot' does not keep; set recording.region = 'whole', or stabilise.on = false"
        )
    if config.mission.observes and len(config.mission.phases) > 1:
        raise UsageError(
            f"{origin('mission.phases')}: mission.phases = {', '.join(config.mission.phases)}: observe drives no robot "
            "and ends with a refinement of its own; set mission.phases = 'observe', or leave it out"
        )
    if recording.frames == "jpeg" and config.camera.bits > 8:
        raise UsageError(
            f"{origin('recording.frames')}: recording.frames = 'jpeg' holds 8 bit, camera.bits = {config.camera.bits}; "
            "set recording.frames = 'auto'"
        )
    if config.control.needs and not set(config.control.needs) <= set(PLANNERS[config.plan.method].provides):
        able = [row.name for row in PLANNERS.values() if set(config.control.needs) <= set(row.provides)]
        raise UsageError(
            f"{origin('control.method', 'plan.method')}: control.method = {config.control.method!r} needs the time to "
            f"go, which plan.method = {config.plan.method!r} does not know; set plan.method = {able[0]!r}, or "
            "control.method = 'vector'"
        )
    if config.control.needs and config.plan.cost != "time":
        raise UsageError(
            f"{origin('control.method', 'plan.cost')}: control.method = {config.control.method!r} needs the time to "
            f"go, which a plan of least {config.plan.cost} does not hold; set plan.cost = 'time', or "
            "control.method = 'vector'"
        )
