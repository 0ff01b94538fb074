"""`flowrec report`: one page that is whole, safe and the same every time, and figures of exact width."""

from __future__ import annotations

import base64
import errno
import importlib.util
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import replace
from html.parser import HTMLParser
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

import flowrec
from flowrec.core import FlowrecError, OperatorEvent, Outcome, OutputError, Row, UsageError
from flowrec.exports import MEANINGS, PathFigure, RecordingFigure, ReportData, TimelineFigure, style
from flowrec.exports.report import page as pages
from flowrec.exports.report.curves import BUCKETS, CurveBuilder
from flowrec.exports.report.explanations import OUTCOMES
from flowrec.verbs import report_page as command
from flowrec.view import ColourScale
from flowrec.view.colours import Table
from tests.conftest import invoke, made_once
from tests.store.made_up import write_session

SESSIONS = Path(__file__).parents[2] / "sessions"
GOLDEN, MODERATE = SESSIONS / "golden.mcap", SESSIONS / "golden_moderate.mcap"
HOSTILE = "<script>alert(1)</script> \x1b[31mred \u202egnp.exe"


class Parsed(HTMLParser):
    """Elements with their attributes, and the text, of a page."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        self.text += " " if tag in ("td", "th", "tr", "p", "li") else ""

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def part_of(path: Path, out: Path, ticks: int, texts: Mapping[str, str] | None = None, **changed: object) -> Path:
    """The first ticks of a session, with other texts in its provenance and other messages in each tick."""
    session = flowrec.open(path)
    header = replace(session.header, provenance={**session.provenance, **(texts or {})})
    return write_session(
        out,
        (replace(tick, **changed) for tick in islice(session.ticks(), ticks)),
        header,
        outcome={"outcome": "stopped", "note": (texts or {}).get("notes", "")},
    )


@pytest.fixture(scope="session")
def html(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The page of a whole mission in a moderate world."""

    def make(folder: Path) -> str:
        return flowrec.report(MODERATE, out=folder / "page.html").read_text(encoding="utf-8")

    return made_once(tmp_path_factory, "report", make)


def test_the_page_needs_neither_network_nor_script_and_every_picture_says_what_it_shows(html: str) -> None:
    page = Parsed(html)
    assert not page.all("script")
    references = [
        value
        for _, attributes in page.elements
        for name, value in attributes.items()
        if name in ("src", "srcset", "href", "data", "action") or name.startswith("on")
    ]
    assert references
    assert all(value is not None and value.startswith("data:") for value in references)
    assert "@import" not in html and "url(" not in html
    images = page.all("img")
    assert [image["class"] for image in images] == ["wide", "narrow"] * 7  # narrow on a telephone, never on paper
    assert html.index(".narrow { display: none; }") < html.index("@media screen and (max-width: 600px)")
    assert all(len(image["alt"] or "") > 20 for image in images)
    assert len(html) < 5_000_000
    for image in images:
        svg = ElementTree.fromstring(base64.b64decode((image["src"] or "").partition(",")[2]))
        width_mm = {"wide": 180.0, "narrow": 88.0}[image["class"] or ""]
        assert float(svg.attrib["width"].removesuffix("pt")) * 25.4 / 72.0 == pytest.approx(width_mm, abs=0.01)
        assert svg.attrib["role"] == "img" and svg[0].tag.endswith("title") and svg[0].text


def test_the_page_states_outcome_numbers_with_units_refinement_and_provenance(html: str) -> None:
    text = " ".join(Parsed(html).text.split())
    for words in (
        "Reached after 12.2 s. The robot reached its goal.",
        "refined flow error 8.9 %",
        "tracking error 53.7 µm",
        "the robot moves 12 ± 2 % less per revolution than stated",
        "goal (5980, 2700) µm",
        "GOOD: consistent, unsigned; can be replayed",
        "by flowrec 0.1.0 (6421a40395)",
        "mean inward speed 220 µm/s",
    ):
        assert words in text
    above = text[text.index("Reached after") : text.index("Path of the robot")]
    assert all(words in above for words in ("to the goal in", "Flow error: assumed", "Learned from", "goal ("))
    shown = text[: text.index("All settings")]  # those are as the file states them
    assert "+-" not in shown and " um" not in shown


@pytest.mark.parametrize("table", ["speed", "uncertainty", "change"])
def test_a_map_has_the_colours_on_the_page_that_it_has_in_the_viewer(table: Table) -> None:
    scale = ColourScale.up_to(437.0, table)
    values = np.linspace(scale.low, scale.high, 256)
    shown = style.colour_map(scale)((values - scale.low) / (scale.high - scale.low))[:, :3]
    assert np.array_equal(np.rint(255.0 * shown), scale.paint(values))


def test_image_and_path_lie_where_the_registration_that_was_found_puts_them() -> None:
    data = ReportData.of(flowrec.open(MODERATE))
    last, corner, found = data.history.last, np.array([[0.0, 0.0], [1.0, 2.0]]), []
    assert last.refined is not None
    for shift_um in (0.0, 100.0):
        registration = np.array([[1.0, 0.0, shift_um], [0.0, 1.0, 0.0]])
        data.history.last = replace(last, refined=replace(last.refined, registration=registration))
        with style.drawing():
            ax = PathFigure().draw(data, style.WIDE_MM).axes[0]
        (path,) = (line for line in ax.lines if line.get_color() == style.VERMILLION)
        image, _flow = ax.images
        found.append((path.get_xydata(), (image.get_transform() - ax.transData).transform(corner)))
    moved = data.scene.directions(np.array([data.scene.length_px(100.0), 0.0]))
    for still, shifted in zip(*found, strict=True):
        difference = (shifted - still)[np.isfinite(still[:, 0])]
        assert len(difference) > 1 and difference == pytest.approx(np.tile(moved, (len(difference), 1)), abs=1e-6)


def test_an_older_session_without_clocks_says_so_in_words() -> None:
    caption = RecordingFigure().caption(ReportData.of(flowrec.open(GOLDEN)))
    assert "Time per tick" in caption and "The session holds no clock of a camera." in caption


@pytest.mark.slow("draws a report three times")
def test_the_same_session_gives_the_same_bytes_twice_and_outputs_are_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = part_of(MODERATE, tmp_path / "s.mcap", 30)
    monkeypatch.setattr(command, "_figures", lambda *_: [TimelineFigure()])
    monkeypatch.setattr(command, "_page", lambda data, *_: pages.draw_figure(TimelineFigure(), data))
    monkeypatch.setattr(command, "render", lambda drawn: drawn.wide)
    first = flowrec.report(session, figures=tmp_path / "figures")
    assert first == tmp_path / "s_report.html"
    before = {path: path.read_bytes() for path in [first, *(tmp_path / "figures").glob("*mm.*")]}
    assert len(before) == 5
    with pytest.raises(OutputError, match="exists already"):
        flowrec.report(session)
    flowrec.report(session, figures=tmp_path / "figures", overwrite=True)
    assert {path: path.read_bytes() for path in before} == before
    with pytest.raises(OutputError, match="is read by this command"):
        flowrec.report(session, out=session, overwrite=True)


def test_figures_have_the_width_of_a_column_and_their_fonts_with_them(tmp_path: Path) -> None:
    for width_mm in style.WIDTHS_MM:
        with style.drawing():
            figure = style.new_figure(width_mm, 40.0)
            figure.subplots().set_xlabel("flow (µm/s) & <more>")
            svg, pdf = style.as_svg(figure, "a < b", text="none"), style.as_pdf(figure, "a < b")
        root = ElementTree.fromstring(svg)
        assert float(root.attrib["width"].removesuffix("pt")) * 25.4 / 72.0 == pytest.approx(width_mm, abs=1e-3)
        assert "flow (µm/s) & <more>" in [element.text for element in root.iter() if element.tag.endswith("text")]
        (box,) = re.findall(rb"/MediaBox \[ ([\d. ]+) \]", pdf)
        assert float(box.split()[2]) * 25.4 / 72.0 == pytest.approx(width_mm, abs=1e-3)
        assert b"/FontFile2" in pdf and b"/Type3" not in pdf


def test_texts_of_a_session_are_escaped_and_shown_without_control_and_bidi_characters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(style, "as_svg", lambda *_: b"<svg/>")  # drawn, but not rendered
    mark = OperatorEvent(1_000_000, "mark", f"{HOSTILE} at $x^2$ ")
    texts = {
        "notes": HOSTILE + "x" * 1_000_000,
        "operator": HOSTILE,
        "git_diff": f"+{HOSTILE}\n-</pre>",
        "host": HOSTILE,
    }
    session = part_of(MODERATE, tmp_path / "s.mcap", 20, texts, operator=mark)
    html = flowrec.report(session, out=tmp_path / "page.html").read_text(encoding="utf-8")
    page = Parsed(html)
    assert not page.all("script")
    assert "<script>alert(1)</script> \\x1b[31mred \\u202egnp.exe" in page.text
    assert "(cut here; 1000" in page.text
    assert len(page.text) < 100_000
    assert not {"\x1b", "\u202e", "\u200f"} & set(html)
    assert "The operator" in page.text and "Stopped after" in page.text


def test_a_session_that_lacks_parts_shows_no_empty_figure_and_says_why(tmp_path: Path) -> None:
    nothing = dict.fromkeys(
        ("frame", "assumed", "refined", "route", "observations", "estimate", "demand", "mapless", "mission", "truth")
    ) | dict.fromkeys(("true_field", "event", "health", "timing", "clocks"))
    session = part_of(MODERATE, tmp_path / "s.mcap", 20, **nothing)
    page = Parsed(flowrec.report(session, out=tmp_path / "page.html").read_text(encoding="utf-8"))
    assert not page.all("img")
    assert page.text.count("Not shown: the session holds") == 7
    assert "only a simulation knows the true flow" in page.text


@pytest.fixture(scope="session")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Row]]:
    """A replay of the first golden session with another planner, and what the verb says of it."""

    def make(folder: Path) -> tuple[Path, list[Row]]:
        done = flowrec.replay(GOLDEN, flowrec.Change(plan="astar_length"), out=folder / "replay.mcap")
        return folder / "replay.mcap", flowrec.before_after(done)

    return made_once(tmp_path_factory, "report_replay", make)


@pytest.mark.slow("draws a report of a session and a replay")
def test_a_replay_is_compared_as_the_verb_compares_it_and_what_changed_is_listed(
    replayed: tuple[Path, list[Row]],
) -> None:
    path, rows = replayed
    pair = command.ReplayFiles.of(flowrec.open(GOLDEN), flowrec.open(path))
    assert flowrec.before_after(pair) == rows
    changed = {row[0]: row[1:] for row in command._changed_settings(pair)}
    assert changed["plan.method"] == ("time_field", "astar_length")
    assert not changed.keys() & {"sampler.capacity", "mission.replan_error_um"}
    assert "numerics_version" in changed


def test_what_is_no_replay_of_the_session_is_refused_in_one_line_before_any_work(tmp_path: Path) -> None:
    for other, words in ((GOLDEN, "is no replay"), (MODERATE, "is no replay")):
        with pytest.raises(UsageError, match=words):
            flowrec.report(GOLDEN, [other], tmp_path / "a.html")
    assert not list(tmp_path.iterdir())


def test_bad_files_are_refused_in_one_line_and_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    unfinished = tmp_path / "u.mcap"
    unfinished.write_bytes(GOLDEN.read_bytes()[:-5000])
    before = set(tmp_path.iterdir())
    for bad in (foreign, unfinished, tmp_path / "none.mcap"):
        done = invoke("report", bad, "-o", tmp_path / "a.html")
        assert isinstance(done.exception, FlowrecError) and "\n" not in str(done.exception)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "jinja2" else find(name))
    with pytest.raises(UsageError, match=r"^a report needs Jinja2, .*: pip install 'flowrec\[report\]'$"):
        flowrec.report(GOLDEN, out=tmp_path / "a.html")
    assert set(tmp_path.iterdir()) == before


def test_a_full_disk_halfway_leaves_neither_page_nor_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "_figures", lambda *_: [])
    monkeypatch.setattr(command, "_files", lambda *_: [("a.svg", b"1"), ("b.svg", b"2")])
    monkeypatch.setattr(command, "_page", lambda *_: None)
    monkeypatch.setattr(command, "render", lambda _: "<html>")
    write = Path.write_bytes

    def full(path: Path, content: bytes) -> int:
        if path.name == "b.svg":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        return write(path, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(FlowrecError, match="No space left on device"):
        flowrec.report(GOLDEN, out=tmp_path / "a.html", figures=tmp_path / "f")
    assert not list(tmp_path.iterdir())


def test_a_long_curve_is_thinned_to_its_range_and_gaps_and_nan_interrupt_it() -> None:
    builder = CurveBuilder(0, 1_000_000_000_000)
    for number in range(100_000):
        if not 50_000 <= number < 60_000:
            builder.add(number * 10_000_000, float(number % 100) if number != 7 else float("nan"))
    curve = builder.curve()
    assert len(curve.time_s) < BUCKETS
    assert curve.largest == 99.0 and np.nanmin(curve.low) == 0.0
    assert np.isnan(curve.mean).sum() == 1
    assert 500.0 < curve.time_s[np.isnan(curve.mean)][0] < 600.0


def test_a_point_of_a_thinned_curve_is_the_mean_of_its_values() -> None:
    builder = CurveBuilder(0, BUCKETS * 500_000_000)  # a bucket is half a second
    for place, value in ((0, 1.0), (100, 2.0), (200, 6.0), (700, -4.0)):
        builder.add(place * 1_000_000, value)
    curve = builder.curve()
    assert curve.known.tolist() == pytest.approx([3.0, -4.0])
    assert curve.time_s[np.isfinite(curve.mean)].tolist() == pytest.approx([0.1, 0.7])


def test_every_outcome_has_a_sentence_and_every_meaning_belongs_to_a_figure_of_a_run() -> None:
    assert set(OUTCOMES) == set(Outcome)
    assert set(flowrec.open(MODERATE).outcome) - {"outcome", "note"} - command._HIDDEN <= set(MEANINGS)
