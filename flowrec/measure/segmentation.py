"""The channel of a chip in a picture: hypotheses, the outline of each, and a verdict.

Walls may show as dark lines, as bright ones, as lines that are dark here and bright there (relief), or as the border of
something brighter or darker than the chip. Each of these is tried, at several widths of the lines and thresholds
(wall_lines). The outline of each is fitted to the picture (outline), and judged by it: walls that look alike all along
(support), that divide what they should (agreed), and that are the edges in the picture (explained). If two hypotheses
that differ are equally good, the picture is refused: a person must say more. Of the two sides of the walls the channel
is the one that does not hold the corners of the picture, unless a point in the channel is given.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import scipy  # its ndimage loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import STD_PER_MAD, ChipError, Floats, Image, Ints
from flowrec.measure.images import Levels, Mask, blur_image, draw_curves, shrink
from flowrec.measure.outline import Outline, Walls, outline_of
from flowrec.measure.wall_lines import divisions, otsu
from flowrec.physics import MAX_PIXELS, border, find_openings

Seeds = Sequence[tuple[int, int]]  # column and row of points in the channel
Shown = Literal["auto", "dark", "bright", "step", "relief"]
_WORK_PX = 640  # longest side of the picture in which the channel is searched
_ROUNDS = 12  # of light and levels
_LEAST_CONTRAST = 2.6  # of two levels, in standard deviations of what is left
_LEAST_AGREED = 0.9  # of lines, before an outline is fitted
# What a channel that is accepted has at least; see Segmentation and Outline.
_SUPPORT, _EXPLAINED, _AGREED, _THROUGH = 0.88, 0.4, 0.96, 0.8
_EXPLAINED_BY_STEP = 0.6  # of steps, which any object has
_CLEAR: dict[Shown, float] = {"dark": 0.25, "bright": 0.25, "relief": 0.5, "step": 0.5}
_LINES_FIRST, _RELIEF_LAST = 0.85, 0.9  # what others must reach of the evidence for step and for relief
_RIVAL, _SAME = 0.9, 0.9  # quality of another hypothesis, relative to the best; IoU from which on both are one
_GAP, _GAP_COST = 0.25, 0.4  # from which on other hypotheses must have the same islands and openings; of the quality
_ALONG = 0.8  # of a channel that lies along lines: then it is their walls
_LARGE = 2.0  # area of an island without which the flow is another, relative to the channel's width squared
_MOST_PIXELS, _LEAST_WIDTH_PX, _NARROW_PX = 600_000, 10.0, 8.0  # of a mask; of its channels, if it is made coarser
_SPECK = 0.0015  # largest area that is debris, relative to the picture's
_LEAST_AREA, _MOST_AREA = 0.005, 0.75  # of the channel, relative to the picture's


@dataclass(frozen=True, slots=True, eq=False)
class Segmentation:
    """A channel."""

    outline: Outline  # its walls, in pixels of the picture
    shown: Shown  # how the walls show
    agreed: float  # share of what looks like a wall that is a wall of this channel; 1 where fluid shows, not walls

    @property
    def quality(self) -> float:
        """Evidence for this channel, 0 to 1."""
        whole, clear = 1.0 - _GAP_COST * min(self.gap, 1.0), 0.5 + min(self.outline.clear, 0.5)
        return self.evidence * whole * clear

    @property
    def evidence(self) -> float:
        """Evidence by support, explained part and agreement alone, without the factors for clarity and gaps."""
        return self.outline.support * self.outline.explained * self.agreed

    @property
    def gap(self) -> float:
        """Longest piece of the outline without a wall, in widths of the channel: so long is what closes a channel."""
        return self.outline.gap_px / max(self.outline.width_px, 1.0)

    @property
    def through(self) -> float:
        """Part of the channel that fluid can flow through: pieces that meet the border of the picture twice."""
        mask = self.outline.mask()
        labels, ends = _pieces(mask)
        return float(np.mean((ends >= 2)[labels[mask]])) if mask.any() else 0.0

    @property
    def figures(self) -> dict[str, float]:
        """Figures by which the hypothesis is judged."""
        o = self.outline
        return {
            "support": o.support,
            "gap_px": o.gap_px,
            "explained": o.explained,
            "agreed": self.agreed,
            "clear": o.clear,
            "through": self.through,
            "width_px": o.width_px,
            "line_px": o.line_px,
            "rough_px": o.rough_px,
            "rival_px": o.between_px,
        }


def segment(picture: Image, shown: Shown = "auto", seeds_px: Sequence[tuple[float, float]] = ()) -> Segmentation:
    """The channel in a picture (h, w).

    Raises ChipError: one line: nothing in the picture is surely a channel, several things may be one, or the points
    contradict what is seen.

    Parameters
    ----------
    shown : how the walls show; auto: all of these are tried.
    seeds_px : points x, y in the channel. Without any the channel is the side of the walls that does not hold the
        corners of the picture; with them it is what is connected with one of them.
    """
    full = np.asarray(picture, np.float32)
    height, width = full.shape
    if min(full.shape) < 64 or float(full.max() - full.min()) < 4.0:
        raise ChipError("the picture is blank or smaller than 64 x 64 pixels; is the chip in view?")
    for x, y in seeds_px:
        if not (0 <= x <= width - 1 and 0 <= y <= height - 1):
            raise ChipError(f"the point {x:g},{y:g} is outside of the picture, which is {width} x {height} pixels")
    step = max(1.0, max(full.shape) / _WORK_PX)
    size = max(round(width / step), 1), max(round(height / step), 1)
    grey = full if step == 1.0 else shrink(full, size)
    scale = np.array((width, height)) / size
    seeds = [(min(int((x + 0.5) / scale[0]), size[0] - 1), min(int((y + 0.5) / scale[1]), size[1] - 1))
             for x, y in seeds_px]  # fmt: skip
    found = list(hypotheses(np.log(grey + 0.02 * float(grey.max()) + 1.0), shown, seeds))
    whole = [each for each in found if _holds_seeds(each, seeds)]
    if found and not whole:
        raise ChipError(
            "the points lie on both sides of a wall, so they can not all be in the channel; give fewer points, or say "
            "how walls show (--walls)"
        )
    chosen = _choose(whole)
    return replace(chosen, outline=chosen.outline.enlarge((width, height)))


def _holds_seeds(found: Segmentation, seeds: Seeds) -> bool:
    mask = found.outline.mask()
    return all(mask[y, x] for x, y in seeds)


def _pieces(mask: Mask) -> tuple[NDArray[np.int32], Ints]:
    """Numbers (h, w) of the pieces of a channel, from 1, and how often each meets the border of the picture."""
    labels, count = scipy.ndimage.label(mask)
    ends = np.zeros(count + 1, np.int64)
    for opening in find_openings(mask):
        ends[border(labels, opening.side)[opening.first]] += 1
    return labels, ends


def chip_mask(found: Segmentation, um_per_px: float) -> tuple[Mask, float]:
    """The channel as a mask (h, w) over the picture's centre, and the size of its pixels.

    The mask has the pixels of the picture; where that would be too many for the solver, whole squares of them, and
    where channels are narrow, whole parts of them.
    """
    width, height = found.outline.size_px
    part = 1
    while width * height > _MOST_PIXELS * part**2 and found.outline.width_px / (part + 1) >= _LEAST_WIDTH_PX:
        part += 1
    part = max(part, math.ceil(math.sqrt(width * height / MAX_PIXELS)))
    finer = 1.0 / part
    if found.outline.width_px < _NARROW_PX and 4 * width * height <= 2 * _MOST_PIXELS:
        finer = 2.0
    return found.outline.mask(finer), um_per_px / finer


def _choose(found: list[Segmentation]) -> Segmentation:
    """The one hypothesis that explains the picture.

    Raises ChipError if there is none, or if there are two.
    """
    good = [each for each in found if not _faults(each)]
    if not good:
        best = max(found, key=lambda each: each.quality, default=None)
        if best is None or best.quality < 0.3:
            raise ChipError(
                "no channel is seen: nothing divides the picture along walls that look alike; is the chip in focus, "
                "and does the channel reach across the picture? A median over a movie has less noise. A field without "
                "walls, such as a dish, needs a mask (chip.path): white, its first and last row of pixels black"
            )
        raise ChipError(
            f"the channel is not sure enough: {_faults(best)}; take a sharper or more evenly lit picture, or show "
            "more of the chip"
        )

    def best_of(*kinds: Shown) -> Segmentation | None:
        return max((each for each in good if each.shown in kinds), key=lambda each: each.quality, default=None)

    lines, relief, step = best_of("dark", "bright"), best_of("relief"), best_of("step")
    chosen = lines
    if relief is not None and (chosen is None or chosen.evidence < _RELIEF_LAST * relief.evidence):
        chosen = relief
    if step is not None and (chosen is None or chosen.evidence < _LINES_FIRST * step.evidence):
        # Is what is darker or brighter nothing but the walls of a channel that other hypotheses see?
        doubts = [each for each in found if each.shown != "step" and _walls_of(each, step)]
        if not doubts:
            chosen = step
        elif chosen not in doubts:
            raise ChipError(
                "it is not sure whether what is dark or bright is the channel or its walls; say how walls show"
            )
    assert chosen is not None
    mask, ways = chosen.outline.mask(), _ways(chosen.outline)
    for other in found:
        near = other.shown == chosen.shown and other.outline.support >= _SUPPORT and chosen.gap > _GAP
        if near and other.evidence > _RIVAL * chosen.evidence and _ways(other.outline) != ways:
            raise ChipError(
                "it is not sure which channels are open: at one threshold a wall closes what is open at another; take "
                "a picture with less noise, as a median over a movie, or without dirt on the walls"
            )
        if (
            other in good
            and other.quality > _RIVAL * chosen.quality
            and _alike(other, chosen)
            and iou(mask, other.outline.mask()) < _SAME
        ):
            raise ChipError(
                f"two different channels are seen equally well, by {chosen.shown} and by {other.shown} walls, "
                f"{100 * mask.mean():.0f} and {100 * other.outline.mask().mean():.0f} % of the picture; say how walls "
                "show (--walls) or give a point in the channel (--seed-point X,Y)"
            )
    return chosen


def _alike(one: Segmentation, other: Segmentation) -> bool:
    return one.shown == other.shown or {one.shown, other.shown} == {"dark", "bright"}


def _walls_of(lines: Segmentation, step: Segmentation) -> bool:
    """True if a step's channel lies along the outline of a wider channel that lines show."""
    o, width_px = lines.outline, step.outline.width_px
    if o.support < _SUPPORT or o.clear < _CLEAR[lines.shown] or o.width_px < 1.2 * width_px:
        return False
    mask = step.outline.mask()
    near = draw_curves(np.zeros(mask.shape, np.uint8), o.curves, 2 * round(0.5 * width_px) + 3)
    return bool(near[mask].mean() > _ALONG)


def _ways(outline: Outline) -> tuple[tuple[str, ...], int]:
    """Topology of the channel: the sides of the openings, and the number of islands above a least size."""
    mask = outline.mask()
    solid, _ = scipy.ndimage.label(~mask, np.ones((3, 3)))
    areas = np.bincount(solid.ravel())[1:]
    return tuple(opening.side for opening in find_openings(mask)), int(np.sum(areas > _LARGE * outline.width_px**2))


def _faults(found: Segmentation) -> str:
    """Reasons against a hypothesis, for people; empty if there are none."""
    o, needed = found.outline, "{:.0f} % ({:.0f} % are needed)"
    if o.support < _SUPPORT:
        return f"of its outline only {needed.format(100 * o.support, 100 * _SUPPORT)} look like a wall"
    least = _EXPLAINED_BY_STEP if found.shown == "step" else _EXPLAINED
    if o.explained < least:
        return f"of the edges in the picture only {needed.format(100 * max(o.explained, 0), 100 * least)} lie on it"
    if found.agreed < _AGREED:
        return f"of the lines only {needed.format(100 * found.agreed, 100 * _AGREED)} divide channel and chip"
    if o.clear < _CLEAR[found.shown]:
        return "its walls are neither lines nor steps of brightness"
    if (through := found.through) < _THROUGH:
        return f"only {100 * through:.0f} % of it reach the border of the picture twice, as flow needs"
    return ""


def hypotheses(light: Levels, shown: Shown, seeds: Seeds) -> Iterator[Segmentation]:
    """Channels in the logarithm of a picture (h, w), good and bad ones."""
    uneven = blur_image(np.abs(blur_image(light, 1.0) - blur_image(light, 10.0)), 1.0)
    images: list[tuple[Shown, Walls, Levels]] = [
        ("dark", "dark", -light), ("bright", "bright", light), ("relief", "bright", uneven)
    ]  # fmt: skip
    enough = False
    for kind, walls, image in images:
        if shown not in ("auto", kind) or (kind == "relief" and enough):
            continue
        before: list[Mask] = []
        for parts, agreed in divisions(image):
            if agreed < _LEAST_AGREED and shown == "auto":
                continue
            mask = _channel(_remove_debris(parts), seeds)
            if any(iou(mask, other) > 0.995 for other in before) or not _possible(mask, seeds):
                continue
            before.append(mask)
            outline = outline_of(light if kind != "relief" else image, mask, walls)
            if outline is not None:
                found = Segmentation(outline, kind, agreed)
                enough |= found.evidence >= _RELIEF_LAST and not _faults(found)
                yield found
    if shown in ("auto", "step"):
        parts, contrast = _levels(light)
        if contrast > _LEAST_CONTRAST and _possible(mask := _channel(_remove_debris(parts), seeds), seeds):
            outline = outline_of(light, mask, "step")
            if outline is not None:
                yield Segmentation(outline, "step", 1.0)


def _possible(mask: Mask, seeds: Seeds) -> bool:
    return _LEAST_AREA < float(mask.mean()) < (0.99 if seeds else _MOST_AREA)


def iou(one: Mask, other: Mask) -> float:
    """Intersection over union of two masks."""
    return float(np.count_nonzero(one & other)) / max(float(np.count_nonzero(one | other)), 1.0)


def _channel(parts: Mask, seeds: Seeds) -> Mask:
    """The channel of two kinds of parts."""
    channel = bool(parts[seeds[0][::-1]]) if seeds else _solid(parts) <= _solid(~parts)
    mask = _remove_debris(parts if channel else ~parts)
    labels, ends = _pieces(mask)
    if seeds:
        return np.isin(labels, [labels[y, x] for x, y in seeds if labels[y, x]])
    # What lies apart from the channel, and does not reach the border twice, is no channel.
    areas = np.bincount(labels.ravel(), minlength=len(ends))
    areas[0] = 0
    kept: Mask = (areas >= 0.3 * areas.max()) | (ends >= 2)
    return kept[labels] & mask


def _solid(parts: Mask) -> tuple[int, float]:
    """Sort key that is higher for the solid than for the channel: number of the picture's corners, then width."""
    if parts.all() or not parts.any():
        return 4 * int(parts.all()), 0.0
    corners = parts[[0, 0, -1, -1], [0, -1, 0, -1]]
    distance = cv2.distanceTransform(np.pad(parts, 8, mode="edge").astype(np.uint8), cv2.DIST_L2, 5)
    return int(np.count_nonzero(corners)), float(np.mean(distance[8:-8, 8:-8][parts]))


def _levels(light: Levels) -> tuple[Mask, float]:
    """The brighter of two levels (h, w), and their distance in standard deviations of what is left."""
    height, width = light.shape
    step = max(1, min(height, width) // 100)
    smooth = blur_image(light, 2.5)
    x, y = np.meshgrid(np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32))
    terms = np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), -1)
    few, values = terms[::step, ::step].reshape(-1, 6), smooth[::step, ::step].reshape(-1)
    best: tuple[float, Floats, float] = 0.0, np.zeros(6), math.inf
    middle = float(np.median(values))
    for start in (np.ones(len(values), np.bool_), values < middle, values > middle):
        fit = np.asarray(np.linalg.lstsq(few[start], values[start], rcond=None)[0], np.float64)
        for _ in range(_ROUNDS):
            rest = values - few @ fit
            above = rest > otsu(rest)
            if above.all() or not above.any():
                break
            fit = np.linalg.lstsq(np.column_stack((few, above)), values, rcond=None)[0][:6]
        if above.all() or not above.any():
            continue
        rest = values - few @ fit
        levels = float(np.median(rest[~above])), float(np.median(rest[above]))
        off = np.where(above, rest - levels[1], rest - levels[0])
        contrast = (levels[1] - levels[0]) / max(STD_PER_MAD * float(np.median(np.abs(off))), 1e-6)
        if contrast > best[0]:  # half-way in light, not in its logarithm
            best = contrast, fit, float(np.log(0.5 * (np.exp(levels[0]) + np.exp(levels[1]))))
    contrast, fit, threshold = best
    return smooth - terms @ fit > threshold, contrast


def _remove_debris(mask: Mask) -> Mask:
    """Without debris: small pieces and small holes."""
    most = _SPECK * mask.size
    for _ in range(2):
        labels, _ = scipy.ndimage.label(mask)
        areas = np.bincount(labels.ravel())
        areas[0] = mask.size
        mask = ~(mask & (areas[labels] >= most))
    return mask
