"""`flowrec init`: a configuration for a movie, with the chip that its images show; asks for what they do not tell."""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from flowrec.verbs.command import verb
from flowrec.verbs.options import OF_FOLDER, Overwrite

if TYPE_CHECKING:
    from flowrec.measure import PictureChip

_QUESTIONS: dict[str, tuple[str, Callable[[str], Any]]] = {  # by option: the fact, and how an answer is read
    "--um-per-px": ("micrometres per pixel of the image", float),
    "--radius": ("radius of the robot in um", float),
    "--inlet": ("openings that are inlets, with commas between: {openings}", lambda text: text.split(",")),
    "--inlet-speed": ("mean speed of the fluid at the inlets in um/s, as the pump says", float),
}


class StartedConfig(NamedTuple):
    """A configuration that was written for a movie, and the files of its chip."""

    movie: Path
    path: Path
    chip: Path
    coils: Path | None

    def as_json(self) -> dict[str, Any]:
        """For JSON."""
        return {name: None if value is None else str(value) for name, value in self._asdict().items()}

    def lines(self) -> list[str]:
        """The files that were made, and the next command."""
        mask = self.chip.with_suffix(".png")
        named = "" if self.path == OF_FOLDER else f" {self.path}"
        return [
            f"{self.path} written, with the chip {self.chip}: look at {self.chip.stem}_overlay.png, correct {mask}",
            f"next: flowrec import {self.movie}{named} --coils {self.coils or 'LOG.csv'} -o {self.movie.stem}.mcap",
        ]


@verb(
    "flowrec init movie.avi",
    "flowrec init movie.avi --um-per-px 5 --radius 40 --inlet left:0 --inlet-speed 200",
)
def init(
    movie: Annotated[Path, typer.Argument(help="Movie: a file, or a folder of images.")],
    um_per_px: Annotated[float | None, typer.Option("--um-per-px", metavar="UM", help="Scale of the image.")] = None,
    radius_um: Annotated[float | None, typer.Option("--radius", metavar="UM", help="Radius of the robot.")] = None,
    inlet: Annotated[
        list[str] | None, typer.Option("--inlet", metavar="SIDE:N", help="Opening that is an inlet; may be repeated.")
    ] = None,
    inlet_speed_um_s: Annotated[
        float | None, typer.Option("--inlet-speed", metavar="UM_S", help="Mean speed at the inlets, in um/s.")
    ] = None,
    coils: Annotated[
        Path | None, typer.Option(metavar="LOG", help="What the coils did; its columns are named by their units.")
    ] = None,
    um_per_rev: Annotated[
        float | None, typer.Option("--um-per-rev", metavar="UM", help="Way per revolution of the field, if known.")
    ] = None,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="TOML", help="Configuration to write; its chip goes beside it.")
    ] = OF_FOLDER,
    overwrite: Overwrite = False,
) -> StartedConfig:
    """Write a configuration for a movie, with the chip that its images show; asks for what they do not tell.

    Without a terminal to ask at, what is missing is listed, and a picture shows the openings with their names.

    Raises
    ------
    UsageError : facts are missing, and nobody can be asked.
    FlowrecError : the movie can not be read, shows no channel for sure, or a file may not be written.
    """
    from flowrec.core import TOML, Output, read_table, say
    from flowrec.measure import calibrate_chip
    from flowrec.movies import open_movie
    from flowrec.stages import columns_by_unit, commented_toml, load_config

    output = Output(out, TOML, (movie,), overwrite)
    output.check()
    columns = columns_by_unit(read_table(coils).header) if coils is not None else {}
    with open_movie(movie) as opened:
        facts = opened.facts
    say(f"{movie}: {facts.describe()}")
    given: dict[str, Any] = dict(
        zip(_QUESTIONS, (um_per_px or facts.um_per_px, radius_um, inlet, inlet_speed_um_s), strict=True)
    )
    if missing := [option for option, value in given.items() if not value]:
        given |= _ask(missing, calibrate_chip(movie), out.with_name(f"{movie.stem}_openings.png"), overwrite)
    scale, radius, inlets, speed = given.values()
    chip = out.with_name(f"{movie.stem}_chip.toml")
    calibrate_chip(movie, chip, scale, inlets=inlets, inlet_speed_um_s=speed, overwrite=overwrite)
    sets: dict[str, Any] = {f"movie.columns.{key}": name for key, name in columns.items()}
    sets |= {"chip.path": chip.name, "robot.radius_um": radius, "camera.um_per_px": scale}
    if um_per_rev is not None:
        sets["robot.um_per_rev"] = um_per_rev
    head = f"# By flowrec init, for {movie.name}. flowrec settings explains what else can be set.\n\n"
    with output.new_file() as part:
        part.write_text(head + commented_toml(load_config(None, sets), changed_only=True), encoding="utf-8")
    return StartedConfig(movie, out, chip, coils)


def _ask(missing: list[str], found: "PictureChip", picture: Path, overwrite: bool) -> dict[str, Any]:
    """Answers of the person at the terminal, by option; before that the openings are drawn."""
    from flowrec.core import PICTURE, Output, UsageError, say
    from flowrec.measure import draw_outline, png_of

    drawn = png_of(draw_outline(found))
    if not (picture.is_file() and picture.read_bytes() == drawn):
        output = Output(picture, PICTURE, (), overwrite)
        output.check()
        with output.new_file() as part:
            part.write_bytes(drawn)
    openings = ", ".join(name for name, _, _ in found.named_openings)
    say(f"{picture}: the channel, and the names of its openings: {openings}")
    texts = {option: _QUESTIONS[option][0].format(openings=openings) for option in missing}
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        raise UsageError(f"missing: {'; '.join(f'{option} ({text})' for option, text in texts.items())}")
    answers = {}
    for option, text in texts.items():
        answers[option] = typer.prompt(text, err=True, value_proc=_reader(_QUESTIONS[option][1]))
    return answers


def _reader(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """A parser of answers, which asks again after one that it can not read."""

    def read(text: str) -> Any:
        try:
            return parse(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from error

    return read
