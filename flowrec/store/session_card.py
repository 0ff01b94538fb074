"""The card of a session in notebooks: sentences, rows of names and values, and a picture, as HTML."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import text_for_picture

_WIDTH_PX = 240  # of the picture
_TEXT, _SENTENCE = 200, 600  # characters of a value, of a sentence


def card(
    title: str,
    rows: Iterable[tuple[str, str]],
    image: NDArray[np.uint8 | np.uint16] | None,
    verdict: Iterable[str] = (),
) -> str:
    """HTML without scripts and links.

    Parameters
    ----------
    rows : names and values, from a file, so not to be trusted.
    image : (h, w) grey levels, which are stretched to the full range; None: no picture.
    verdict : sentences above the rows, likewise; the first one is bold.
    """
    cells = "".join(
        f'<tr><td style="text-align:left">{_escape(name)}</td><td style="text-align:left">{_escape(value)}</td></tr>'
        for name, value in rows
    )
    data = base64.b64encode(_thumbnail(image)).decode() if image is not None and image.size else ""
    picture = f'<img alt="camera image" width="{_WIDTH_PX}" src="data:image/png;base64,{data}"/>' if data else ""
    sentences = "".join(
        f"<div>{_escape(text, _SENTENCE) if number else f'<b>{_escape(text)}</b>'}</div>"
        for number, text in enumerate(verdict)
    )
    return (
        '<div style="display:flex;gap:1em;align-items:flex-start;border:1px solid #8888;border-radius:6px;padding:8px;'
        f'max-width:52em">{picture}<div>{sentences}<div style="margin-top:4px">{_escape(title)}</div>'
        f"<table>{cells}</table></div></div>"
    )


def _escape(text: str, longest: int = _TEXT) -> str:
    return html.escape(text_for_picture(text, longest))


def _thumbnail(image: NDArray[np.uint8 | np.uint16]) -> bytes:
    """A PNG as wide as the card shows it."""
    scale = min(1.0, 2 * _WIDTH_PX / image.shape[1])  # sharp on screens with two pixels a point
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float64)
    low, high = np.quantile(small, (0.001, 0.999))
    grey = np.clip((small - low) / max(high - low, 1.0) * 255.0, 0, 255).astype(np.uint8)
    return bytes(cv2.imencode(".png", grey)[1])
