"""`flowrec init`: a configuration for a movie or a lab, with the chip in its images; asks for what is missing."""

import sys
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from flowrec.core import shell_word
from flowrec.verbs.command import verb
from flowrec.verbs.options import OF_FOLDER, Overwrite, Sets

if TYPE_CHECKING:
    from flowrec.measure import PictureChip
    from flowrec.stages import Config

LAB = Path("lab")  # said instead of a movie
_INLET, _INLET_SPEED = "--inlet", "--inlet-speed"
_OF_CHIP = {
    _INLET: "openings that are inlets, with commas between; there are: {openings}",
    _INLET_SPEED: "mean speed of the fluid at the inlets in um/s, as the pump says",
}
_ANSWERED = {"inlets": _INLET, "inlet_speed_um_s": _INLET_SPEED}  # by parameter of calibrate_chip
_OPTIONS = {  # by setting: the option that sets it, and the question
    "camera.um_per_px": ("--um-per-px", "micrometres per pixel of the image"),
    "robot.radius_um": ("--radius", "radius of the robot in um"),
}
_FLAGS = {key: option for key, (option, _) in _OPTIONS.items()} | {"robot.um_per_rev": "--um-per-rev"}
_ASKED_OF_COILS = {"serial": ("lab.serial.port",), "ni": ("lab.ni.channels",)}  # by amplifier


class StartedConfig(NamedTuple):
    """A configuration that was written, and its files."""

    source: Path  # the movie, or `lab`
    path: Path
    chip: Path | None  # its file; None: it is one that was there already
    coils: Path | None  # log of a movie
    timed: bool  # the movie states the times of its images
    picture: Path  # the movie, or the image of the camera
    still: bool  # it is one image alone

    def as_json(self) -> dict[str, Any]:
        return {name: str(value) if isinstance(value, Path) else value for name, value in self._asdict().items()}

    def lines(self) -> list[str]:
        """The files that were made, and the next command."""
        chip, file = self.chip, "" if self.path == OF_FOLDER else f" {shell_word(self.path)}"
        told = f"{self.path} written"
        if chip is not None and chip.suffix == ".png":
            told += f", without a chip: {chip} says that all of the image is fluid"
        elif chip is not None:
            mask = chip.with_suffix(".png")
            told += f", with the chip {chip}: look at {chip.stem}_overlay.png, correct {mask}"
        if self.picture != self.source:
            return [
                f"{told}; {self.picture} is what the camera sees",
                f"next: flowrec doctor{file}    flowrec record{file}",
            ]
        if self.still and chip is not None and chip.suffix != ".png":
            return [told, f"next: flowrec record{file}  (a simulated mission on this chip)"]
        coils = f" --coils {shell_word(self.coils or 'LOG.csv')}"
        log = coils if self.coils or chip is None or chip.suffix != ".png" else ""
        log += "" if self.timed else " --fps F"
        return [
            told,
            f"next: flowrec import {shell_word(self.source)}{file}{log} -o {shell_word(self.source.stem + '.mcap')}",
        ]


class _Subject(NamedTuple):
    """Settings that were given or read, and the picture that may show a channel."""

    sets: dict[str, Any]
    picture: Path
    size_px: tuple[int, int]
    choices: Mapping[str, str] = MappingProxyType({})  # by setting: what there is to choose from
    timed: bool = True
    still: bool = False


@verb(
    "flowrec init movie.avi",
    "flowrec init movie.avi --um-per-px 5 --radius 40 --inlet left:0 --inlet-speed 200",
    "flowrec init movie.avi --no-chip",
    "flowrec init lab --set lab.camera=genicam",
)
def init(
    source: Annotated[
        Path, typer.Argument(metavar="MOVIE|lab", help="Movie: a file, or a folder of images; or lab: its devices.")
    ],
    um_per_px: Annotated[float | None, typer.Option("--um-per-px", metavar="UM", help="Scale of the image.")] = None,
    radius_um: Annotated[float | None, typer.Option("--radius", metavar="UM", help="Radius of the robot.")] = None,
    inlet: Annotated[
        list[str] | None,
        typer.Option(_INLET, metavar="SIDE:N", help="Openings that are inlets, with commas between; may be repeated."),
    ] = None,
    inlet_speed_um_s: Annotated[
        float | None, typer.Option(_INLET_SPEED, metavar="UM_S", help="Mean speed at the inlets, in um/s.")
    ] = None,
    no_chip: Annotated[bool, typer.Option("--no-chip", help="There is no channel: track only.")] = False,
    coils: Annotated[
        Path | None, typer.Option(metavar="LOG", help="What the coils did; its columns are named by their units.")
    ] = None,
    um_per_rev: Annotated[
        float | None, typer.Option("--um-per-rev", metavar="UM", help="Way per revolution of the field, if known.")
    ] = None,
    sets: Sets = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="TOML", help="Configuration to write; its chip goes beside it.")
    ] = OF_FOLDER,
    overwrite: Overwrite = False,
) -> StartedConfig:
    """Write a configuration for a movie or a lab, with the chip that the images show; asks for what is missing.

    Without a terminal to ask at, what is missing is listed, and a picture shows the openings with their names.

    Notes
    -----
    Long because it asks all questions before it writes the first file.

    Of a lab the camera is opened for some seconds, then the amplifier, which is left at zero. With mission.phases =
    observe no coils are needed. A chip.path that is given is used as it is.

    Raises
    ------
    UsageError : facts are missing, and nobody can be asked.
    FlowrecError : the movie can not be read, a device not be used, no channel is seen for sure, or a file not written.
    """
    from flowrec.core import PICTURE, TOML, Output, UsageError, settings_of
    from flowrec.measure import calibrate_chip, open_field
    from flowrec.stages import commented_toml, load_config, refuse_unseen

    output = Output(out, TOML, (source,), overwrite)
    output.check()
    options = {"camera.um_per_px": um_per_px, "robot.radius_um": radius_um, "robot.um_per_rev": um_per_rev}
    given = settings_of(sets or ()) | {key: value for key, value in options.items() if value is not None}
    own_chip = "chip.path" in given
    if own_chip and no_chip:
        raise UsageError("--no-chip: chip.path names a chip; leave one of them out")
    of_mask = PICTURE if no_chip else TOML
    stem = source.stem if out.name == OF_FOLDER.name else out.stem
    chip = Output(out.with_name(f"{stem}_chip{of_mask[0]}"), of_mask, (), overwrite)
    if not own_chip:
        chip.check()
    lab = source == LAB and not source.exists()
    subject = _lab_subject(given, out.parent, no_chip) if lab else _movie_subject(source, coils, given)
    with ExitStack() as on_failure:
        if lab:  # the configuration that would name the picture of the camera is not written
            on_failure.callback(subject.picture.unlink, missing_ok=True)
        inlet = [name for text in inlet or () for name in text.split(",")]
        of_chip = {} if no_chip or own_chip else {_INLET: inlet, _INLET_SPEED: inlet_speed_um_s}
        missing = _questions(subject) | {option: _OF_CHIP[option] for option, value in of_chip.items() if not value}
        seen = _channel_of(subject.picture) if of_chip else None
        answers = {} if not missing else _answers(missing, seen, subject, out.with_name(f"{source.stem}_openings.png"))
        settled = subject.sets | {key: value for key, value in answers.items() if key not in _OF_CHIP}
        if not own_chip:
            settled["chip.path"] = chip.path.name
        if no_chip:
            settled |= {
                "chip.um_per_px": settled["camera.um_per_px"],
                "chip.inlet_speed_um_s": 0.0,
            }  # nothing else knows
        config = load_config(None, settled, _FLAGS)
        width_px, height_px = subject.size_px
        refuse_unseen(
            replace(config, rig=str(LAB), camera=replace(config.camera, width_px=width_px, height_px=height_px))
        )
        if lab and not config.mission.observes:
            _try_amplifier(config)
        if no_chip:
            with chip.new_file() as part:
                part.write_bytes(open_field(*subject.size_px))
        elif not own_chip:
            told: dict[str, Any] = {"inlets": inlet, "inlet_speed_um_s": inlet_speed_um_s}
            told |= {name: answers[option] for name, option in _ANSWERED.items() if option in answers}
            calibrate_chip(
                subject.picture, chip.path, settled["camera.um_per_px"], **told, overwrite=overwrite, seen=seen
            )
        head = f"# By flowrec init, for {source.name}. flowrec settings explains what else can be set.\n\n"
        with output.new_file() as part:
            part.write_text(head + commented_toml(config, changed_only=True), encoding="utf-8")
        on_failure.pop_all()
    return StartedConfig(
        source, out, None if own_chip else chip.path, coils, subject.timed, subject.picture, still=subject.still
    )


def _channel_of(picture: Path) -> "PictureChip":
    from flowrec.core import ChipError
    from flowrec.measure import calibrate_chip

    try:
        return calibrate_chip(picture)
    except ChipError as error:
        raise ChipError(f"{error}; where there is no channel, say --no-chip: track only") from error


def _movie_subject(movie: Path, coils: Path | None, given: Mapping[str, Any]) -> _Subject:
    """Size and scale of a movie, and the columns of its log."""
    from flowrec.core import read_table, say
    from flowrec.movies import open_movie
    from flowrec.stages import columns_by_unit, load_config, read_coil_log

    columns = columns_by_unit(read_table(coils).header) if coils is not None else {}
    with open_movie(movie) as opened:
        facts = opened.facts
    say(f"{movie}: {facts.describe()}")
    told = {} if facts.um_per_px is None else {"camera.um_per_px": facts.um_per_px}
    sets = {f"movie.columns.{key}": name for key, name in columns.items()} | told | dict(given)
    if coils is not None:  # a log that an import would refuse is refused before anybody is asked
        config = load_config(None, sets, _FLAGS)
        read_coil_log(coils, config.movie.columns, config.coils)
    return _Subject(
        sets, movie, (facts.width_px, facts.height_px), timed=facts.times_ns is not None, still=facts.frames == 1
    )


def _lab_subject(given: Mapping[str, Any], folder: Path, no_chip: bool) -> _Subject:
    """The camera that is found, and a picture of it; and the ports at which the amplifier may be."""
    from flowrec.core import RigError, say
    from flowrec.measure import write_picture
    from flowrec.rigs import first_camera
    from flowrec.stages import AMPLIFIERS, CAMERAS, load_config

    asked = load_config(None, {"rig": "lab", **given})
    camera = replace(asked.camera, rate_hz=asked.camera.rate_hz or 30.0)
    drivers = [asked.lab.camera] if "lab.camera" in given else list(CAMERAS.names())
    driver, seen = first_camera(camera, asked.lab, drivers)
    info = seen.info
    rate_hz = round(info.rate_hz or seen.rate_hz, 3)
    say(f"camera {info.name} by {driver}: {info.width_px} x {info.height_px} px, {info.bits} bit, {rate_hz:g} Hz")
    if seen.image is None:
        raise RigError(f"camera {info.name}: no image has come; see its trigger, or set lab.trigger = ''")
    picture = write_picture(seen.image, folder / "lab.png")
    read = {"rig": "lab", "lab.camera": driver, "lab.device": info.serial, "camera.bits": info.bits}
    read |= {"camera.width_px": info.width_px, "camera.height_px": info.height_px, "camera.rate_hz": rate_hz}
    read |= {"camera.exposure_s": info.exposure_s} if info.exposure_s else {}
    watch = {"mission.phases": "observe"} if no_chip else {}
    settings, choices = watch | read | dict(given), {}
    if asked.lab.amplifier == "serial" and not load_config(None, settings).mission.observes:
        there = ", ".join(AMPLIFIERS["serial"].load().ports())
        choices["lab.serial.port"] = f"there are: {there}" if there else "this computer has none"
    return _Subject(settings, picture, (info.width_px, info.height_px), choices)


def _questions(subject: _Subject) -> dict[str, str]:
    """Questions about the settings that are not known, by setting."""
    from flowrec.stages import load_config, not_measured, setting_rows

    config = load_config(None, subject.sets, _FLAGS)
    keys = [key for key in _OPTIONS if key not in subject.sets]
    if config.rig == "lab":
        keys += [key for key in not_measured(config) if key not in _OPTIONS]
        if not config.mission.observes:
            # A default must not be a current that the coils do not bear.
            of_coils = (*_ASKED_OF_COILS.get(config.lab.amplifier, ()), "coils.max_current_a")
            keys += [key for key in of_coils if key not in subject.sets]
    rows = {row.key: row for row in setting_rows()}

    def question(key: str) -> str:
        facts = rows[key].facts
        return ", ".join([rows[key].meaning, *([facts] if facts != "text" else [])])

    return {key: _OPTIONS[key][1] if key in _OPTIONS else question(key) for key in keys}


def _answers(
    missing: Mapping[str, str], seen: "PictureChip | None", subject: _Subject, picture: Path
) -> dict[str, Any]:
    """Answers of the person at the terminal, by setting or option; before that the openings are drawn."""
    from flowrec.core import UsageError, say
    from flowrec.measure import draw_outline, write_picture

    openings = ""
    if seen is not None:
        picture = write_picture(draw_outline(seen), picture)
        openings = ", ".join(name for name, _, _ in seen.named_openings)
        say(f"{picture}: the channel, and the names of its openings: {openings}")
    texts = {
        key: "; ".join(filter(None, (text.format(openings=openings), subject.choices.get(key))))
        for key, text in missing.items()
    }
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        options = {key: _OPTIONS[key][0] if key in _OPTIONS else f"--set {key}=..." for key in texts if "." in key}
        for key, text in texts.items():
            say(f"  {options.get(key, key)}   {text}")
        raise UsageError(f"missing, and nobody to ask: {', '.join(options.get(key, key) for key in texts)}")
    return {key: typer.prompt(text, err=True, value_proc=_reader(key)) for key, text in texts.items()}


def _reader(key: str) -> Callable[[str], Any]:
    """A parser of answers, which asks again after one that it can not read."""

    def read(text: str) -> Any:
        from flowrec.core import FlowrecError, settings_of
        from flowrec.stages import load_config

        try:
            if key == _INLET:
                return text.split(",")
            if key == _INLET_SPEED:
                return float(text)
            answer = settings_of([f"{key}={text}"])
            load_config(None, answer, {key: "the answer"})
            return answer[key]
        except (ValueError, FlowrecError) as error:
            raise typer.BadParameter(str(error)) from error

    return read


def _try_amplifier(config: "Config") -> None:
    """Open the amplifier, which stays at zero, and say what it is and what field the limits permit.

    One that is not there is told of: the settings of the lab are complete without it.
    """
    from flowrec.core import RigError, say, warn
    from flowrec.rigs import probe_amplifier
    from flowrec.verbs.diagnosis import stand_in

    try:
        seen = probe_amplifier(stand_in(config))
    except RigError as error:
        warn(f"the amplifier was not tried: {error}; flowrec doctor tries it again")
        return
    name = " ".join(filter(None, (seen.info.model, seen.info.serial)))
    say(f"amplifier {name}: {seen.amplitude_mt:.3g} mT up to {seen.rotation_hz:.3g} Hz within the limits")
    for warning in seen.warnings:
        say(warning)
