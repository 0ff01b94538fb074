"""The bar below a picture: clock and state on the left; on the right a legend that ends with the scale bar.

Texts are masks of grey levels by Pillow's own font. OpenCV's fonts are outlines without a micro sign; Pillow's has none
either, so it is a u with a descender.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from flowrec.core import Estimate, Floats, Mission, Tick, printable, seconds
from flowrec.view import colours
from flowrec.view.colours import Rgb, round_below
from flowrec.view.drawing import CIRCLE, CROSS, Layer, Picture, arrows, bgr

ROBOT, ROUTE, GOAL, FLOW = colours.ORANGE, colours.CYAN, colours.GREEN, colours.PALE
TRACER = colours.PURPLE
_TEXT, _GROUND = colours.WHITE, (24, 24, 28)
GOAL_SIGN = (*(np.array([0.5 * arm, arm]) for line in CROSS for arm in line), 0.75 * CIRCLE)  # a crosshair, open inside
_LONGEST_BAR = 0.16  # of the width of the picture
_MOST_LETTERS = 40  # of words from a file
_DIGITS = "0123456789"
_LONGEST_TEXT = 200  # characters
_MICRO = "µ"
_STEM, _TAIL = 0.05, 0.15  # width and length of its descender, over the height of letters


class StatusBar:
    """Draws the bar of one picture after another.

    Parameters
    ----------
    size_px : width and height.
    letter_px : height of the letters.
    um_per_px : of the picture above it.
    """

    def __init__(self, size_px: tuple[int, int], letter_px: int, um_per_px: float) -> None:
        self._width, self._height = size_px
        self._letter, self._um_per_px = letter_px, um_per_px
        self._line = letter_px / 9.0  # width of lines
        self._top = (self._height - round(1.3 * letter_px)) // 2
        self._parts: list[Picture] = []

    def set_legend(self, *, goal: bool, route: bool, tracers: bool, flow: tuple[str, float, float] | None) -> None:
        """Set the entries of the legend besides the robot.

        `flow`: words before its arrow's speed, such as "refined flow", that speed in um/s, and px per um/s.
        """
        r, middle = 0.34 * self._letter, 0.5 * self._height
        centre = np.array([1.2 * r, middle])
        self._parts = [self._part(2.4 * r, "robot", ROBOT, [centre + r * CIRCLE])]
        if goal:
            sign = [centre + 1.2 * r * part for part in GOAL_SIGN]
            self._parts.append(self._part(2.4 * r, "goal", GOAL, sign, width=0.8))
        if route:
            px = 1.4 * self._letter
            self._parts.append(self._part(px, "route", ROUTE, [np.array([(0.0, middle), (px, middle)])]))
        if tracers:
            px = 0.8 * self._letter
            self._parts.append(self._part(px, "tracer", TRACER, [np.array([(0.0, middle), (px, middle)])], width=0.8))
        if flow is not None:
            words, speed, px_per_speed = flow
            tail, tip = np.array([[1.0, middle]]), np.array([[1.0 + speed * px_per_speed, middle]])
            arrow = arrows(tail, tip, 0.8 * self._line)
            self._parts.append(self._part(tip[0, 0], f"{words} {speed:g} µm/s", FLOW, *arrow, width=0.8))
        self._parts.append(self._scale_bar())

    def draw(self, bar: Picture, tick: Tick, ended: str = "", *, doubtful: bool = False) -> None:
        """Draw it into the lower part of a picture. What has no room on the right is left out, the robot first.

        `ended` and `doubtful` are outcome and verdict of a run that is over.
        """
        bar[:] = bgr(_GROUND)
        left = round(0.6 * self._letter)
        left += self._write(bar, _clock_mask(clock_text(seconds(tick.stamp_ns)), self._letter), left)
        left += round(0.9 * self._letter)
        left += self._write(
            bar, _text_mask(state_text(tick.mission, tick.estimate, ended, doubtful=doubtful), self._letter), left
        )
        right = bar.shape[1]
        for part in reversed(self._parts):
            begin = right - part.shape[1]
            if begin < left + self._letter:
                return
            bar[:, begin:right] = part
            right = begin

    def _scale_bar(self) -> Picture:
        length_um = round_below(_LONGEST_BAR * self._width * self._um_per_px)
        px, middle, tick = length_um / self._um_per_px, 0.5 * self._height, 0.3 * self._letter
        bar = np.array([(1.0, middle), (1.0 + px, middle)])
        ends = [np.array([(x, middle - tick), (x, middle + tick)]) for x in bar[:, 0]]
        return self._part(px + 2.0, length_text(length_um), _TEXT, [bar, *ends])

    def _part(
        self,
        sign_px: float,
        words: str,
        colour: Rgb,
        lines: Sequence[Floats],
        heads: Sequence[Floats] = (),
        width: float = 1.0,
    ) -> Picture:
        """A sign of some px in the given colour, by `Layer.lines`, with its words to the right of it."""
        gap, mask = round(0.45 * self._letter), _text_mask(words, self._letter)
        sign = math.ceil(sign_px)
        picture = np.empty((self._height, sign + gap + mask.shape[1] + round(1.2 * self._letter), 3), np.uint8)
        picture[:] = bgr(_GROUND)
        self._write(picture, mask, sign + gap)
        layer = Layer(picture.shape[:2])
        layer.lines(lines, heads, colour, width * self._line)
        layer.blend(picture[..., 0].copy(), picture)
        return picture

    def _write(self, picture: Picture, mask: Picture, left: int) -> int:
        """Put letters, a mask of grey levels (h, w), on a picture of one colour; returns their width in px."""
        part = picture[self._top :, left:][: mask.shape[0], : mask.shape[1]]
        mask = mask[: part.shape[0], : part.shape[1]]
        alpha = mask[..., None] * np.float32(1.0 / 255.0)
        part[:] = part * (1.0 - alpha) + alpha * np.array(bgr(_TEXT), np.float32) + 0.5
        return int(mask.shape[1])


def clock_text(time_s: float) -> str:
    """A time of the session: 12.34 s, 1:02.34 or 1:00:02.34."""
    hundredths = math.floor(100.0 * time_s + 1e-6)
    minutes, rest = divmod(hundredths, 6000)
    hours, minutes = divmod(minutes, 60)
    part = f"{rest // 100}.{rest % 100:02d}"
    if hours:
        return f"{hours}:{minutes:02d}:{part.zfill(5)}"
    return f"{minutes}:{part.zfill(5)}" if minutes else f"{part} s"


def length_text(length_um: float) -> str:
    """A length with its unit: 50 µm, 2 mm."""
    return f"{length_um / 1e3:g} mm" if length_um >= 1e3 else f"{length_um:g} µm"


def state_text(mission: Mission | None, estimate: Estimate | None, ended: str = "", *, doubtful: bool = False) -> str:
    """Current state of the mission, in a few words; of a run that has `ended`, its outcome, and if it is doubtful."""
    words = ended
    if mission is not None:
        if mission.finished:
            words = mission.outcome or "done"
        elif mission.held_since_ns is not None and not ended:
            words = "taken by hand" if mission.by_hand else "held by the operator"
        elif not ended:
            words = mission.phase
    if doubtful and (ended or (mission is not None and mission.finished)):
        words += ", doubtful"
    if estimate is not None and not estimate.seen:
        words += ", robot not seen" if words else "robot not seen"
    words = printable(words)
    return words if len(words) <= _MOST_LETTERS else words[: _MOST_LETTERS - 1] + "…"


@lru_cache(maxsize=8)
def _font(height_px: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(height_px)


@lru_cache(maxsize=512)
def _text_mask(text: str, height_px: int) -> Picture:
    """A text (h, w) on one line, 255 in letters; all texts of one height have one baseline and the same h."""
    font = _font(height_px)
    shown = text[:_LONGEST_TEXT].replace(_MICRO, "u")
    width = max(int(np.ceil(font.getlength(shown))), 1)
    picture = Pillow.new("L", (width, round(1.3 * height_px)), 0)
    draw = ImageDraw.Draw(picture)
    draw.text((0, 0), shown, fill=255, font=font)
    for place in (n for n, letter in enumerate(text[: len(shown)]) if letter == _MICRO):
        left, top, _, bottom = font.getbbox("u")
        stem = font.getlength(shown[:place]) + left + 0.5
        tail = (stem, 0.5 * (top + bottom), stem + _STEM * height_px, bottom + _TAIL * height_px)
        draw.rectangle(tuple(map(round, tail)), fill=255)
    return np.asarray(picture)


def _clock_mask(text: str, height_px: int) -> Picture:
    """Picture of a text that changes all the time: every digit is as wide as the widest, so nothing jumps."""
    widest = max(_text_mask(digit, height_px).shape[1] for digit in _DIGITS)
    parts = []
    for letter in text:
        mask = _text_mask(letter, height_px)
        missing = widest - mask.shape[1] if letter in _DIGITS else 0
        parts.append(np.pad(mask, ((0, 0), (missing // 2, missing - missing // 2))))
    return np.hstack(parts)
