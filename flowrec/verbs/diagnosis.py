"""Checks of `flowrec doctor`: every device and all else that a run needs, without energising anything."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import replace
from itertools import starmap
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from flowrec.core import (
    CameraLosses,
    FlowrecError,
    Image,
    RigError,
    UsageError,
    apply_sets,
    kernels_cached,
    read_toml,
    temporary_name,
    write_all,
)
from flowrec.measure import orientation_by_image, registration_state, walls_state
from flowrec.physics import Chip, ChipSettings, load_chip
from flowrec.rigs import ONLY_HARDWARE, Guardian
from flowrec.stages import (
    AMPLIFIERS,
    LAB,
    SIMULATED,
    Coils,
    Config,
    ResolvedConfig,
    config_from_tree,
    length_um,
    registration_of,
    resolve,
)
from flowrec.store import frames_of, image_bytes_s
from flowrec.verbs.admission import rehearse, route_on_assumed_flow
from flowrec.verbs.preparation import refuse_adrift
from flowrec.verbs.verdict import RATE_TOLERANCE
from flowrec.view import executable, has_display

T = TypeVar("T")
OK, WARNING, FAILURE = "ok", "warning", "failure"
_SIGNS = {OK: " ", WARNING: "!", FAILURE: "x"}
_OF_DEVICES = ("camera", "coils", "lab")  # sections
_CLOCK_TOLERANCE = 0.01  # relative: 20 times what a crystal is off (CRYSTAL_PPM)
_LOSS_WARNING, _LOSS_FAILURE = 0.001, 0.05  # fraction of the blocks
_DARK = 0.1  # of the full scale
_TRIAL_BYTES = 128 << 20
_HEADROOM = 2.0  # of the disk's speed over the rate of a run
_LEAST_MINUTES = 10.0  # of a run, for which the disk has to have room
_SILENT_S = 0.3  # longer than lab.guardian_s
_OLD_DAYS = 90.0  # since the file of the configuration was changed, after which it may not fit any more
_SEES_ALL = 1.02  # of a side of the view: a chip that is larger is not seen whole
# By how much the encodings compress the images of a camera at least; frame_encodings.py has the measurements.
_PACKED = {"raw": 1.0, "zstd": 1.3, "delta": 1.8, "png": 1.8, "jpeg": 6.0}
_CAUSES = {
    "link": "lost in the camera or on its link: see to cable, network card, jumbo frames",
    "incomplete": "arrived with parts missing: see to cable and bandwidth",
    "driver": "thrown away by the driver: the computer is too slow or too busy",
    "backlog": "thrown away before the loop: the computer is too slow or too busy",
    "triggers": "triggers without an image: the exposure is too long for the rate of the triggers",
}


class Finding(NamedTuple):
    """One line."""

    what: str  # what was looked at
    level: str  # ok, warning or failure
    text: str  # what was found, with what to do unless it is ok

    @property
    def line(self) -> str:
        """For people."""
        return f"{_SIGNS[self.level]} {self.what:12s} {self.text}"


_Row = tuple[str, str, str]  # the fields of a finding
_Rows = Generator[_Row, None, None]


def diagnose(
    asked: Config, config_file: Path | None = None, folder: Path | None = None, wrong: str = ""
) -> Iterator[Finding]:
    """Look at everything that a run of a configuration needs, and yield what is found, as it is found.

    Parameters
    ----------
    config_file : from which the configuration was read, for the age of its calibrations.
    folder : where sessions are written; None: the present one.
    wrong : why the configuration was refused, and `asked` is only what is right of it; "" if it was not.
    """
    return starmap(Finding, _rows(asked, config_file, folder, wrong))


def _rows(asked: Config, config_file: Path | None, folder: Path | None, wrong: str) -> Iterator[_Row]:
    settled: tuple[ResolvedConfig, Chip | None] | None = None
    if wrong:
        yield "settings", FAILURE, wrong
    else:
        settled = yield from _look("settings", _settings, asked)
    if settled is None and asked.rig == LAB:
        settled = yield from _look("devices", _without_settings, asked)
    if settled is not None:
        config, chip = settled
        if chip is not None:
            yield from _view(config, chip)
            yield from _look("mission", _mission, config, chip)
            if config.recording.admission_s:
                yield from _look("kernels", _kernels, config)
        if asked.rig == LAB:
            yield from _look("camera", _camera, config, chip)
            yield from _look("coils", _coils, config)
        else:
            text = f"rig = {asked.rig!r}: neither camera nor coils are looked at"
            yield "devices", WARNING, f"{text}; give the configuration of a lab, which flowrec init lab writes"
        yield from _look("disk", _disk, config, folder or Path())
    yield from _calibrations(asked, config_file)
    yield _viewer()


def _look(what: str, check: Callable[..., Generator[_Row, None, T]], *given: Any) -> Generator[_Row, None, T | None]:
    """The findings of a check; an error, which says in its line what to do, is a failure."""
    try:
        return (yield from check(*given))
    except FlowrecError as error:
        yield what, FAILURE, str(error)
    except OSError as error:
        named = f"{error.filename}: " if error.filename is not None else ""
        yield what, FAILURE, f"{named}{error.strerror or error}; see to it, then try again"
    return None


def _without_settings(asked: Config) -> Generator[_Row, None, tuple[ResolvedConfig, None]]:
    config = stand_in(asked)
    text = "what is wrong or missing in the settings is made up to look at them; mission and walls are left out"
    yield "devices", WARNING, text
    return config, None


def _settings(asked: Config) -> Generator[_Row, None, tuple[ResolvedConfig, Chip]]:
    chip = load_chip(asked.chip)
    config = resolve(asked, chip)
    camera = config.camera
    yield (
        "settings",
        OK,
        f"chip {chip.name}; {camera.width_px} x {camera.height_px} pixels of {camera.bits} bit at {camera.rate_hz:g} "
        f"Hz, {camera.um_per_px:.4g} um per pixel; robot of radius {config.robot.radius_um:g} um",
    )
    return config, chip


def _view(config: ResolvedConfig, chip: Chip) -> Iterator[_Row]:
    """Compare what the camera sees with the chip, of which a mission that observes may see a part."""
    seen_um = config.camera.um_per_px * np.array(config.camera.size_px)
    if (np.sort(chip.size_um) > _SEES_ALL * np.sort(seen_um)).any():
        view, whole = (" x ".join(f"{1e-3 * side:.3g}" for side in each) for each in (seen_um, chip.size_um))
        text, observes = f"the image shows {view} mm of a chip of {whole} mm", config.mission.observes
        beyond = "; beyond it the robot is lost: magnify less"
        yield "view", OK if observes else WARNING, text + ("" if observes else beyond)


def _mission(config: ResolvedConfig, chip: Chip) -> _Rows:
    mission = config.mission
    if mission.observes:
        yield "mission", OK, "observes: the coils are not used"
        return
    refuse_adrift(config, chip)
    route = route_on_assumed_flow(config, chip)
    if not route.reachable:
        yield "mission", FAILURE, f"no route on the assumed flow: {route.reason}; choose another goal"
        return
    length_mm = 1e-3 * length_um(route)
    way = f"a route of {length_mm:.2f} mm in {route.lasts_s:.1f} s" if length_mm else "back to the start"
    yield "mission", OK, f"{', '.join(mission.phases)}; {way}"


def _kernels(config: ResolvedConfig) -> _Rows:
    """Compile what a live run would compile before it begins."""
    known = kernels_cached()
    begin_s = time.perf_counter()
    rehearse(config)
    if not kernels_cached():
        text = "can not be kept, no folder for a cache can be written: each run compiles them, half a minute before it"
        yield "kernels", WARNING, f"{text}; set XDG_CACHE_HOME to a folder of your own"
        return
    once = f"compiled in {time.perf_counter() - begin_s:.0f} s, once after an installation"
    text = "compiled before" if known else once
    yield "kernels", OK, f"{text}; a short simulated mission with this configuration's methods went through"


def _camera(config: ResolvedConfig, chip: Chip | None) -> _Rows:
    from flowrec.rigs import probe_camera

    camera = config.camera
    seen = probe_camera(camera, config.lab)
    info = seen.info
    yield "camera", OK, f"{info.name}: {info.width_px} x {info.height_px} pixels, {info.pixel_format or info.bits}"
    if (info.width_px, info.height_px, info.bits) != (*camera.size_px, camera.bits):
        yield (
            "camera",
            FAILURE,
            f"its images are {info.width_px} x {info.height_px} pixels of {info.bits} bit; set camera.width_px, "
            "camera.height_px and camera.bits to that",
        )
    yield from (("camera", WARNING, note) for note in seen.notes)
    wrong = abs(seen.rate_hz / camera.rate_hz - 1.0) > RATE_TOLERANCE
    text = f"{seen.rate_hz:.1f} frames per second, longest interval {seen.arrival_ms:.0f} ms"
    advice = f", where camera.rate_hz = {camera.rate_hz:g}: set it, a shorter exposure or a smaller image"
    yield "rate", WARNING if wrong else OK, text + (advice if wrong else "")
    yield from _losses(seen.losses)
    if not seen.clock_slope:
        yield "clock", WARNING, "the camera has no clock that can be used: frames are stamped by their arrival"
    elif abs(seen.clock_slope - 1.0) > _CLOCK_TOLERANCE:
        text = (
            f"the camera's clock runs at {seen.clock_slope:.4g} of what it states; its true rate is measured in a run"
        )
        yield "clock", WARNING, text
    else:
        yield "clock", OK, f"{1e6 * (seen.clock_slope - 1.0):+.0f} ppm from the host's, within what 2.5 s can tell"
    full = 2**info.bits - 1
    if seen.brightest >= full:
        yield "image", WARNING, "overexposed: some pixels are at the highest grey level; shorten the exposure"
    elif seen.brightest < _DARK * full:
        text = f"dark: the brightest pixel has level {seen.brightest} of {full}; more light, exposure or lab.gain"
        yield "image", WARNING, text
    else:
        yield "image", OK, f"brightest pixel {seen.brightest} of {full}"
    if chip is not None and seen.image is not None and seen.image.shape == camera.shape:
        yield from _walls(config, chip, seen.image)


def _walls(config: ResolvedConfig, chip: Chip, image: Image) -> Iterator[_Row]:
    """The orientation of the chip in the image; and whether it still lies as registered, if the image shows enough."""
    stated = registration_of(config.camera, chip)
    seen = orientation_by_image(image, chip, stated)
    if seen.contradiction:
        yield "axes", FAILURE, seen.text
        return
    observes = config.mission.observes
    later = "" if seen.decided or observes else "; the motion tells at the beginning of a run"
    yield "axes", WARNING if observes and not seen.alike else OK, seen.text + later
    found = walls_state(image, chip, stated)
    if found is not None:
        yield "walls", OK if found.good else WARNING, found.text


def _losses(losses: CameraLosses | None) -> Iterator[_Row]:
    if losses is None:
        return
    total = max(losses.ids, 1)
    found = {cause: getattr(losses, cause) for cause in _CAUSES if getattr(losses, cause)}
    if not found:
        yield "losses", OK, f"none of {losses.ids} images"
    for cause, count in found.items():
        share = count / total
        level = FAILURE if share > _LOSS_FAILURE else WARNING if share > _LOSS_WARNING else OK
        yield "losses", level, f"{count} of {losses.ids} images {_CAUSES[cause]}"


def _coils(config: ResolvedConfig) -> _Rows:
    if config.mission.observes:
        yield "coils", OK, "not used by a mission that observes"
        return
    from flowrec.rigs import probe_amplifier

    seen = probe_amplifier(config)
    info = seen.info
    timer = f"goes to zero by itself after {info.timer_s:g} s" if info.timer_s else "holds its last output by itself"
    yield "amplifier", OK, f"{' '.join(filter(None, (info.model, info.serial)))}; {timer}"
    yield (
        "limits",
        OK,
        f"{config.coils.max_current_a:g} A and {config.coils.amplifier.max_voltage_v:g} V a coil: "
        f"{seen.amplitude_mt:.3g} mT up to {seen.rotation_hz:.3g} Hz, {config.lab.output.longest_on_s:g} s at a time",
    )
    yield (
        "guardian",
        OK,
        f"its process starts, and takes the output to zero {1e3 * seen.trip_s:.1f} ms after it is asked to",
    )
    yield _silence(config)
    yield from (("coils", WARNING, text) for text in seen.warnings)
    yield "interlock", WARNING, f"can not be seen from here: {ONLY_HARDWARE}"


def _silence(config: ResolvedConfig) -> _Row:
    """Tell the guardian that a field is on, which is not, and fall silent."""
    amplifier = AMPLIFIERS[config.lab.amplifier].load().of(config)
    amplifier.open()
    try:
        action, descriptors = amplifier.guard()
        with Guardian(action, descriptors, config.lab.guardian_s) as guardian:
            guardian.beat(energised=True)
            time.sleep(config.lab.guardian_s + _SILENT_S)
            try:
                guardian.beat(energised=False)
            except RigError as error:
                return "guardian", OK, f"when a loop falls silent: {error}"
    finally:
        amplifier.close()
    return "guardian", FAILURE, "it does not notice that a loop falls silent; do not record with these coils"


def _disk(config: ResolvedConfig, folder: Path) -> _Rows:
    speed = _write_speed(folder)
    need = image_bytes_s(config) / _PACKED[frames_of(config)]
    left = max(shutil.disk_usage(folder).free - 1e9 * config.recording.disk_floor_gb, 0.0)
    minutes = left / max(need, 1.0) / 60.0
    text = f"writes {speed / 1e6:.0f} MB/s, a run needs {need / 1e6:.0f}; room for {minutes:.0f} min"
    if speed < need:
        yield "disk", FAILURE, f"{text}: images would be dropped; use a faster disk or a smaller image"
    elif speed < _HEADROOM * need or minutes < _LEAST_MINUTES:
        yield "disk", WARNING, f"{text}: use another disk (--out), or recording.region = 'robot'"
    else:
        yield "disk", OK, text


def _write_speed(folder: Path) -> float:
    """Bytes per second that reach the disk of a folder."""
    trial = folder / temporary_name()
    block = np.random.default_rng(0).integers(0, 256, 1 << 22, dtype=np.uint8).tobytes()
    begin_s = time.perf_counter()
    try:
        with trial.open("xb", buffering=0) as file:
            for _ in range(_TRIAL_BYTES // len(block)):
                write_all(file.fileno(), block)
            os.fsync(file.fileno())
        return _TRIAL_BYTES / (time.perf_counter() - begin_s)
    finally:
        trial.unlink(missing_ok=True)


def _calibrations(config: Config, file: Path | None) -> Iterator[_Row]:
    """Calibrations, which only a measurement gives, and the last change of the configuration that holds them."""
    if config.rig != LAB:
        return
    driven = not config.mission.observes
    if driven and config.coils.mt_per_a == Coils().mt_per_a:
        yield "coils", WARNING, "coils.mt_per_a is the default; measure it: flowrec calibrate coils TABLE.csv"
    fresh, text = registration_state(config.camera)
    yield "registration", OK if fresh else WARNING, text
    if file is None:
        return
    days = (time.time() - file.stat().st_mtime) / 86_400.0
    old = days > _OLD_DAYS
    text = f"{file} was last changed {days:.0f} days ago"
    yield ("calibrations", WARNING if old else OK, text + ("; measure again what has moved since" if old else ""))


def _viewer() -> _Row:
    if executable() is None:
        return "viewer", WARNING, "Rerun's viewer is not installed: pip install rerun-sdk"
    if not has_display():
        return "viewer", WARNING, "there is no screen here: record with --view serve and watch from another one"
    return "viewer", OK, "Rerun's viewer is there"


def of_devices(file: Path | None, sets: Mapping[str, Any], wrong: UsageError) -> Config:
    """The settings of camera and coils that are right in themselves, where the whole configuration is refused.

    Raises UsageError: `wrong`, if the configuration does not describe a lab; or the file can not be read.
    """
    tree: dict[str, Any] = read_toml(file) if file is not None else {}
    apply_sets(tree, sets)
    kept: dict[str, Any] = {"rig": tree.get("rig")}
    if kept["rig"] != LAB:
        raise wrong
    for section in _OF_DEVICES:
        table = tree.get(section)
        for key, value in table.items() if isinstance(table, dict) else ():
            more = kept | {section: kept.get(section, {}) | {key: value}}
            try:
                config_from_tree(more, str(file))
            except UsageError:
                continue  # told already, or after it is mended
            kept = more
    return config_from_tree(kept, str(file))


def stand_in(asked: Config) -> ResolvedConfig:
    """The settings of camera, coils and lab that are given, with those of a made-up run for all the rest.

    Raises UsageError: these are wrong, too.
    """
    devices = {section: getattr(asked, section) for section in _OF_DEVICES}
    made_up = resolve(replace(Config(), rig=SIMULATED, recording=asked.recording, **devices), load_chip(ChipSettings()))
    return replace(made_up, rig=LAB)
