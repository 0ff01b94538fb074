"""The card of a session in a notebook: escaped, and with a picture."""

from __future__ import annotations

import base64
import re
from pathlib import Path

import cv2
import numpy as np

import flowrec
from flowrec.store.session_card import card

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


def picture_in(shown: str) -> np.ndarray:
    (data,) = re.findall(r"data:image/png;base64,([A-Za-z0-9+/=]+)", shown)
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_UNCHANGED)


def test_the_card_of_a_session_tells_how_it_ended_and_shows_the_image_in_its_middle() -> None:
    session = flowrec.open(GOLDEN)
    shown = session._repr_html_()
    assert shown.index("<b>Reached") < shown.index("Flow error: assumed 12.7 %") < shown.index("golden.mcap")
    assert "µm" in shown and " um" not in shown and "bifurcation" in shown and len(shown) < 100_000
    image = session.frames[len(session.frames) // 2].image
    assert picture_in(shown).shape == image.shape
    assert np.corrcoef(picture_in(shown).ravel(), image.ravel())[0, 1] > 0.99


def test_text_of_a_file_is_escaped_cut_and_without_control_characters() -> None:
    notes = "<script>alert(1)</script>\x1b[31m\u202etxt" + "x" * 1_000_000
    shown = card("<b>a</b>.mcap", [("notes", notes)], np.full((20, 4000), 40_000, np.uint16))
    assert "<script>" not in shown and "<b>a</b>" not in shown and "&lt;script&gt;" in shown
    assert "\x1b" not in shown and "\u202e" not in shown and len(shown) < 5_000
    assert picture_in(shown).shape[1] == 480
    assert "<img" not in card("a", [], None)
