"""What never changes during a session: colours, names and sizes of what moves, and of the lines in the plots."""

from __future__ import annotations

import rerun as rr

from flowrec.view import colours
from flowrec.view import entities as e
from flowrec.view.entity_logger import Pen


def log_styles(pen: Pen) -> None:
    """What never changes of the things that move; in each tick only their places are logged."""
    style, points, above = pen.style, rr.Radius.ui_points, float(pen.prefix == "replayed")
    pen.log(
        e.TRAIL,
        rr.LineStrips2D.from_fields(colors=(*style.robot, 150), radii=points(1.0), draw_order=24.0),
        static=True,
    )
    pen.log(e.ROBOT, rr.LineStrips2D.from_fields(radii=points(style.width), draw_order=30.0 + above), static=True)
    pen.log(e.ROBOT_LABEL, rr.Points2D.from_fields(radii=points(0.0), show_labels=True), static=True)
    pen.log(
        e.REFERENCE,
        rr.Points2D.from_fields(
            colors=colours.YELLOW,
            radii=points(3.5),
            labels=[f"{style.word}reference"],
            show_labels=False,
            draw_order=28.0,
        ),
        static=True,
    )
    colour = style.robot if pen.prefix else colours.WHITE
    pen.log(e.COMMAND, rr.Arrows2D.from_fields(colors=colour, radii=points(1.6), draw_order=29.0), static=True)


def log_series(pen: Pen) -> None:
    """Names and colours of all lines. One line of each session in a plot: the session's name says which."""

    def lines(entity: str, *named: tuple[str, colours.Rgb]) -> None:
        names = [pen.style.word + name for name, _ in named]
        if pen.prefix and len(named) == 1:
            names = [pen.prefix]
        colours = [colour for _, colour in named]
        pen.log(entity, rr.SeriesLines(names=names, colors=colours, widths=[1.5] * len(named)), static=True)

    own = pen.style.path if pen.prefix else colours.YELLOW
    paler = colours.BLUE if pen.prefix == "replayed" else colours.YELLOW
    lines(e.CURRENT, ("x (A)", colours.RED), ("y (A)", colours.GREEN), ("z (A)", colours.BLUE))
    lines(e.FREQUENCY, ("frequency (Hz)", own))
    lines(e.HEADING, ("heading (°)", own))
    lines(e.TRACKING_ERROR, ("tracking error (µm)", own))
    lines(e.ESTIMATE_ERROR, ("estimate error (µm)", own))
    lines(e.NIS, ("NIS", own))
    lines(e.NIS_MEAN, ("mean NIS (2: all noise is stated right)", colours.WHITE))
    lines(e.PULSATION, ("pulsation (% of the flow)", own))
    lines(e.VOLTAGE, ("x (V)", colours.RED), ("y (V)", colours.GREEN), ("z (V)", colours.BLUE))
    truth = () if pen.prefix == "replayed" else (("truth", colours.GREEN),)  # the same in both
    lines(e.FLOW_SPEED, ("observer", pen.style.path), ("map", paler), *truth)
    lines(
        e.FLOW_COMPONENTS,
        ("vx observer", colours.CYAN),
        ("vx map", colours.BLUE),
        ("vy observer", colours.YELLOW),
        ("vy map", colours.ORANGE),
    )
    lines(
        e.TIMING,
        ("track (ms)", colours.CYAN),
        ("observe (ms)", colours.PURPLE),
        ("control (ms)", colours.YELLOW),
        ("sinks (ms)", colours.BLUE),
        ("total (ms)", colours.WHITE),
    )
