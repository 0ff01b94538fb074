"""`flowrec calibrate NAME`: verbs that measure settings."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flowrec.verbs.command import add_verb, verb
from flowrec.verbs.options import Overwrite, Sets, WholeDescriptions, known_session

TomlOut = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="TOML", help="Write the settings as a section of a configuration.")
]
Picture = Annotated[Path, typer.Argument(help="Image file; or a movie or a session, of which the median is taken.")]


class _Calibrations(WholeDescriptions):
    """The group; a table where the name of a command is expected goes to `coils`, as before there was a group."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        if args and args[0] not in self.commands and args[0].lower().endswith(".csv"):
            typer.echo(f"{ctx.command_path} TABLE is now {ctx.command_path} coils TABLE", err=True)
            args = ["coils", *args]
        return super().resolve_command(ctx, args)


@verb()
def coils(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="FILE.csv", help="Rows of i_x_a,i_y_a,i_z_a,b_x_mt,b_y_mt,b_z_mt; of more coils i_1_a,i_2_a,..."
        ),
    ] = None,
    out: TomlOut = None,
    winding: Annotated[
        list[str] | None,
        typer.Option(
            "--winding",
            metavar="AXIS:KIND:RADIUS_MM:TURNS",
            help="Instead of a file, a coil or pair by formula: x:helmholtz:50:120, y:maxwell:50:80, "
            "z:pair:40:100:45 or -z:coil:40:100:30 with a distance in mm; one for each output.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> object:
    """Fit the field per ampere of the coils and the bias to measured fields, with standard errors (section coils)."""
    from flowrec.core import UsageError
    from flowrec.measure import calibrate_coils, windings_matrix

    if (file is None) == (not winding):
        raise UsageError("calibrate coils: give a table of measured fields, or --winding for each coil, not both")
    if winding:
        return windings_matrix(winding, out, overwrite)
    assert file is not None
    return calibrate_coils(file, out, overwrite)


@verb()
def motion(
    session: Annotated[
        Path, typer.Argument(metavar="SESSION", callback=known_session, help="Session (.mcap), recorded or imported.")
    ],
    coils: Annotated[
        Path | None, typer.Option("--coils", metavar="LOG", help="Another log of the coils (CSV, Excel), on any clock.")
    ] = None,
    out: TomlOut = None,
    overwrite: Overwrite = False,
) -> object:
    """Fit um per revolution, latency and heading offset to the motion of the robot, with standard errors."""
    from flowrec.measure import calibrate_motion

    return calibrate_motion(session, coils, out, overwrite)


@verb()
def image(
    picture: Picture,
    config: Annotated[
        Path | None, typer.Argument(help="Configuration (TOML) with the chip and, roughly, camera.um_per_px.")
    ] = None,
    out: TomlOut = None,
    mirror: Annotated[
        bool | None,
        typer.Option("--mirror/--no-mirror", help="Whether the image is mirrored; by default both are tried."),
    ] = None,
    pick: Annotated[
        int | None, typer.Option(metavar="N", help="Which of several equally good poses is meant, from 1.")
    ] = None,
    sets: Sets = None,
    overwrite: Overwrite = False,
) -> object:
    """Find the chip in a picture: um per pixel, angle, mirror and origin (section camera); an overlay shows it."""
    from flowrec.measure import calibrate_image
    from flowrec.stages import load_config

    inputs = [config] if config is not None else []
    return calibrate_image(picture, load_config(config, sets or ()), out, mirror, pick, overwrite, inputs)


@verb("flowrec calibrate chip movie.avi --um-per-px 5 --inlet left:0 --inlet-speed 200 -o chip.toml")
def chip(
    picture: Picture,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", metavar="TOML", help="Write the chip; mask and overlay (PNG) go beside it."),
    ] = None,
    um_per_px: Annotated[
        float | None, typer.Option("--um-per-px", metavar="UM", help="Micrometres per pixel of the picture.")
    ] = None,
    inlet: Annotated[
        list[str] | None,
        typer.Option("--inlet", metavar="SIDE:N", help="An opening that is an inlet, as in left:0; may be repeated."),
    ] = None,
    inlet_speed: Annotated[
        float | None, typer.Option("--inlet-speed", metavar="UM_S", help="Mean speed at the inlets, in um/s.")
    ] = None,
    walls: Annotated[
        str, typer.Option(metavar="auto|dark|bright|step|relief", help="How walls show: as lines, or as a step.")
    ] = "auto",
    seed_point: Annotated[
        list[str] | None,
        typer.Option("--seed-point", metavar="X,Y", help="A point in the channel, in pixels; may be repeated."),
    ] = None,
    channel: Annotated[
        str, typer.Option(metavar="red|green|blue|grey", help="What is used of a picture in colour.")
    ] = "grey",
    wall_shift: Annotated[
        float,
        typer.Option(metavar="UM", help="Move walls outwards by so much (negative: inwards), if widths are known."),
    ] = 0.0,
    overwrite: Overwrite = False,
) -> object:
    """Make a chip of a picture: mask, openings and an overlay; the mask can be corrected in any paint program."""
    from flowrec.measure import calibrate_chip

    return calibrate_chip(
        picture, out, um_per_px, walls, seed_point or (), inlet or (), inlet_speed, channel, wall_shift, overwrite
    )


calibrate = typer.Typer(
    cls=_Calibrations, help="Measure settings and write them as a section of a configuration.", no_args_is_help=True
)
for _verb in (coils, motion, image, chip):
    add_verb(calibrate, _verb)
