"""`flowrec calibrate chip`: the channel in a picture as a chip of one's own: mask, openings and an overlay.

What a picture does not tell is left open in the TOML: the chip loads when a person has filled it in.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import cv2
import numpy as np

from flowrec.core import ChipError, OutputError, UsageError, __version__, say, table
from flowrec.measure.images import Colours, Mask, SourcePicture, png_of, read_picture, with_curves
from flowrec.measure.proposal import check_outputs, write_outputs
from flowrec.measure.segmentation import Segmentation, Shown, chip_mask, segment
from flowrec.physics import (
    WATER_KG_M3,
    WATER_MPA_S,
    Chip,
    Opening,
    check_chip,
    chip_files,
    find_openings,
    guess_inlets,
    name_inlets,
    opening_names,
    set_inlet_speed,
)

_INLET, _OTHER = (0, 200, 0), (0, 0, 255)  # blue, green, red
_OVERLAY = "_overlay.png"  # end of its name, beside the mask's
_SHOWN = {
    "dark": "dark lines",
    "bright": "bright lines",
    "relief": "lines, dark or bright",
    "step": "the border of the fluid's grey level",
}


class PictureChip(NamedTuple):
    """A chip of a picture."""

    picture: SourcePicture
    found: Segmentation
    mask: Mask  # (h, w) True in fluid
    pixel: float  # size of a pixel of the mask, in pixels of the picture
    um_per_px: float | None  # of the picture; None: not known
    openings: tuple[Opening, ...]  # of the mask; which are inlets means nothing unless `inlets_known`
    inlets_known: bool
    speed_um_s: float | None  # mean speed at the inlets; None: not known
    wall_shift_um: float
    out: Path | None  # the TOML file, if it was written

    @property
    def unit(self) -> str:
        """The unit of lengths: um, or pixels of the picture."""
        return "px" if self.um_per_px is None else "um"

    @property
    def pixel_size(self) -> float:
        """Size of a pixel of the mask, in `unit`."""
        return self.pixel * (self.um_per_px or 1.0)

    @property
    def named_openings(self) -> list[tuple[str, Opening, str | None]]:
        """The openings with their names, and their kinds where those are known."""
        names = opening_names(self.openings)
        return [(name, o, o.kind if self.inlets_known else None) for name, o in zip(names, self.openings, strict=True)]

    def chip(self, name: str) -> Chip:
        """The chip with assumptions in place of what is not known."""
        return Chip(name, self.mask, self.pixel_size, self.openings, WATER_MPA_S, WATER_KG_M3)

    def as_json(self) -> dict[str, Any]:
        openings = [
            {"name": name, "side": o.side, "first": o.first, "last": o.last, "kind": kind}
            for name, o, kind in self.named_openings
        ]
        return {
            "walls": self.found.shown,
            **{key: round(value, 4) for key, value in self.found.figures.items()},
            "um_per_px": None if self.um_per_px is None else self.pixel_size,
            "mask_px": [self.mask.shape[1], self.mask.shape[0]],
            "fluid_share": round(float(self.mask.mean()), 4),
            "openings": openings,
            "remarks": remarks(self),
            "covered": self.picture.covered.as_json(),
        }

    def show(self) -> None:
        """Print the openings as a table, the verdict, the files, and what a person must do."""
        rows = [
            (name, f"{o.first}-{o.last}", f"{o.width_px * self.pixel_size:.4g}", kind or "?")
            for name, o, kind in self.named_openings
        ]
        height, width = self.mask.shape
        size = ""
        if self.um_per_px is not None:
            size = f" ({width * self.pixel_size:.4g} um x {height * self.pixel_size:.4g} um in all)"
        fluid = f"{100 * float(self.mask.mean()):.1f} % fluid"
        title = f"Channel in {self.picture.source}: mask of {width} x {height} px{size}, {fluid}"
        table(title, ("opening", "pixels", f"width ({self.unit})", "kind"), rows)
        say(verdict(self))
        if (out := self.out) is not None:
            say(f"{out}, {out.stem}.png (mask) and {out.stem}{_OVERLAY} written: look at the overlay, correct the mask")
        for line in remarks(self):
            say(line)


def calibrate_chip(
    path: Path,
    out: Path | None = None,
    um_per_px: float | None = None,
    walls: str = "auto",
    seed_points: Sequence[str] = (),
    inlets: Sequence[str] = (),
    inlet_speed_um_s: float | None = None,
    channel: str = "grey",
    wall_shift_um: float = 0.0,
    overwrite: bool = False,
    seen: PictureChip | None = None,
) -> PictureChip:
    """Find the channel in a picture; write `out` (TOML), the mask of the same stem (PNG) and an overlay.

    Raises FlowrecError: one line: the picture can not be read, shows no channel for sure, or the outputs may not be
    written.

    Parameters
    ----------
    path : an image file, a movie or a session, of which the median is taken.
    um_per_px : of the picture; None: it is left open.
    walls : how walls show: auto, dark, bright, step or relief.
    seed_points : points "x,y" in the channel, in pixels.
    inlets : names of openings, as in chip.inlets; none: they are left open.
    inlet_speed_um_s : mean; None: it is left open.
    channel : red, green, blue or grey of colours.
    wall_shift_um : all walls are moved outwards by so much; a known width shows by how much.
    seen : of an earlier call with the same picture, so that the channel need not be looked for again.
    """
    if walls not in get_args(Shown):
        raise UsageError(f"--walls {walls}: choose one of {', '.join(get_args(Shown))}")
    for name, value in (("--um-per-px", um_per_px), ("--inlet-speed", inlet_speed_um_s)):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise UsageError(f"{name} {value:g}: it must be more than zero")
    if wall_shift_um and (um_per_px is None or not math.isfinite(wall_shift_um)):
        raise UsageError(f"--wall-shift {wall_shift_um:g}: it is in um, so give --um-per-px, too")
    seeds = [_point(text) for text in seed_points]
    if out is not None and out.with_suffix(".png").absolute() == path.absolute():
        raise OutputError(
            f"{path}: is read by this command, and the mask of {out} would be written to it; choose another name, as "
            f"in -o {out.with_name(f'{out.stem}_chip{out.suffix}')}"
        )
    outputs = check_outputs(out, (path,), overwrite, (".png", _OVERLAY))
    picture = read_picture(path, channel) if seen is None else seen.picture
    try:
        found = segment(picture.image, cast(Shown, walls), seeds) if seen is None else seen.found
    except ChipError as error:
        raise ChipError(f"{path}: {error}") from error
    if wall_shift_um and um_per_px is not None:
        shift_px = wall_shift_um / um_per_px
        if not abs(shift_px) < 0.4 * found.outline.width_px:
            width_um = found.outline.width_px * um_per_px
            raise UsageError(f"--wall-shift {wall_shift_um:g}: too much for channels of {width_um:.3g} um")
        found = replace(found, outline=found.outline.move_walls(shift_px))
    mask, pixel = chip_mask(found, 1.0)
    openings = guess_inlets(find_openings(mask))
    if len(openings) < 2:
        raise ChipError(
            f"{path}: the channel meets the border of the picture {len(openings)} times; crop the picture so that "
            "inlet and outlet reach its border"
        )
    openings = name_inlets(openings, inlets, str(path)) if inlets else openings
    if inlet_speed_um_s is not None:
        openings = set_inlet_speed(openings, inlet_speed_um_s)
    done = PictureChip(
        picture, found, mask, pixel, um_per_px, openings, bool(inlets), inlet_speed_um_s, wall_shift_um, out
    )
    check_chip(done.chip(path.stem), str(path))
    if out is not None:
        mask_png, _ = chip_files(done.chip(out.stem))
        write_outputs(outputs, (chip_toml(done, out.stem).encode(), mask_png, png_of(draw_outline(done))))
    return done


def open_field(width_px: int, height_px: int) -> bytes:
    """PNG of a mask without a channel: fluid, but for the first and the last row, since a chip must have a wall."""
    mask = np.full((height_px, width_px), 255, np.uint8)
    mask[[0, -1]] = 0
    return png_of(mask)


def chip_toml(done: PictureChip, name: str) -> str:
    """The chip as TOML; what must be filled in is marked with a question mark."""
    lines = [
        f"# By flowrec {__version__} calibrate chip from {done.picture.source} (sha256 {done.picture.sha256}).",
        f"# {verdict(done)}",
        f"# {name}{_OVERLAY} shows the outline. {name}.png is the mask: white is fluid, black is chip. Correct it",
        "# in any paint program, at its size. Where that moves an opening, correct its first and last pixel below.",
    ]
    what = "a pixel of the mask" if done.pixel == 1.0 else f"a pixel of the mask, {done.pixel:g} pixels of the picture"
    if done.um_per_px is None:
        lines.append(f"# um_per_px =   # FILL IN: um, {what}")
    else:
        lines.append(f"um_per_px = {float(f'{done.pixel_size:.7g}')!r}  # {what}")
    lines += [
        f"viscosity_mpa_s = {WATER_MPA_S!r}  # of water",
        f"density_kg_m3 = {WATER_KG_M3!r}  # of water",
        "# depth_um = 100.0  # of the channel; without it the flow is two-dimensional",
        'walls = "smooth"',
        'fluid = "bright"',
    ]
    for opening, o, kind in done.named_openings:
        lines += ["", f"[[opening]]  # {opening}", f'side = "{o.side}"', f"first = {o.first}", f"last = {o.last}"]
        lines.append(f'kind = "{kind}"' if kind else 'kind = "?"  # FILL IN: inlet or outlet')
        if kind == "outlet":
            lines.append("pressure_pa = 0.0")
        elif done.speed_um_s is None:
            lines.append("# speed_um_s =   # FILL IN for an inlet: mean inward speed, um/s")
        elif kind:
            lines.append(f"speed_um_s = {o.value!r}  # mean")
        else:
            lines.append(f"# speed_um_s = {done.speed_um_s!r}  # mean; only of an inlet")
    return "\n".join(lines) + "\n"


def verdict(done: PictureChip) -> str:
    """Confidence in the channel, in one line."""
    found = done.found
    o = found.outline
    text = (
        f"Walls show as {_SHOWN[found.shown]}: {100 * o.support:.0f} % of the outline looks so, "
        f"{100 * max(o.explained, 0.0):.0f} % of the edges in the picture lie on it"
    )
    if found.shown != "step":
        wide = f"{o.line_px * (done.um_per_px or 1.0):.2g} {done.unit}"
        text += f"; lines are {wide} wide, and the wall is taken to be in their middle"
    if done.wall_shift_um:
        text += f"; walls were moved outwards by {done.wall_shift_um:g} um"
    return text


def remarks(done: PictureChip) -> list[str]:
    """Remarks on the result: assumptions to check, and steps left to a person."""
    found, lines = done.found.outline, []
    if found.between_px > 0.1 * found.width_px:
        lines.append(
            f"Beside each {done.found.shown} line is another one of the other brightness, {found.between_px:.2g} px "
            "away; if that is the wall, choose it with --walls"
        )
    if done.found.shown != "step" and not done.wall_shift_um:
        lines.append(
            "If you know the width of an opening and the table has another: --wall-shift UM moves walls outwards"
        )
    if done.um_per_px is None:
        lines.append("um_per_px is not known: fill it in, or give --um-per-px")
    if not done.inlets_known:
        lines.append("A picture does not tell which openings are inlets: fill in kind, or give --inlet SIDE:N")
    if done.speed_um_s is None:
        lines.append("Nor how fast the flow is: fill in speed_um_s, or give --inlet-speed UM_S")
    return lines


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(f"--seed-point {text}: give x,y in pixels of the picture, as in 120,80") from error
    return x, y


def draw_outline(done: PictureChip) -> Colours:
    """The picture (h, w, 3), blue first, with the outline in orange and the openings with their names."""
    image, wide = with_curves(done.picture.image, done.found.outline.curves)
    height, width = image.shape[:2]
    for name, o, kind in done.named_openings:
        across = o.side in ("left", "right")
        side_px, of_mask = (height, done.mask.shape[0]) if across else (width, done.mask.shape[1])
        off = 0.5 * (side_px - of_mask * done.pixel)
        first, last = (round(off + end * done.pixel) for end in (o.first, o.last + 1))
        far = {"left": 0, "top": 0, "right": width - 1, "bottom": height - 1}[o.side]
        ends = [(far, end) if across else (end, far) for end in (first, last)]
        colour = _INLET if kind == "inlet" else _OTHER
        cv2.line(image, ends[0], ends[1], colour, 4 * wide)
        size = 0.5 * wide
        (text_px, tall), _ = cv2.getTextSize(name, cv2.FONT_HERSHEY_SIMPLEX, size, wide)
        x = min(max((ends[0][0] + ends[1][0] - text_px) // 2, 6), width - text_px - 6)
        y = min(max((ends[0][1] + ends[1][1] + tall) // 2, tall + 6), height - 6)
        cv2.putText(image, name, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, colour, wide, cv2.LINE_AA)
    return image
