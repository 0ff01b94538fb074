"""The page of a report: one HTML file that needs no network and no script; every text of a session is escaped."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from flowrec.core import __version__, printable
from flowrec.exports.report import style
from flowrec.exports.report.explanations import LONGEST
from flowrec.exports.report.report_data import ReportData

_TEMPLATES = {"Page": "page.html", "SweepPage": "sweep.html"}  # by the class of the page


class ReportFigure(Protocol):
    """A figure of a report."""

    name: str  # of its files, without a suffix
    title: str  # its heading

    def why_not(self, data: ReportData) -> str:
        """Reason why it can not be drawn of this session, as words after a colon; '' if it can."""

    def caption(self, data: ReportData) -> str:
        """Caption: the content of the figure, and what this session lacks for it."""

    def alt(self, data: ReportData) -> str:
        """Text alternative of the figure, for a reader who does not see it."""

    def draw(self, data: ReportData, width_mm: float) -> Any:
        """A matplotlib figure of this width."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """A figure on the page: data URIs at both widths, or the reason why there is none."""

    name: str
    title: str
    caption: str = ""
    alt: str = ""
    narrow: str = ""
    wide: str = ""
    why_not: str = ""


@dataclass(frozen=True, slots=True)
class ReportTable:
    """Rows of text under a heading; no heading of columns where `columns` is empty."""

    title: str
    rows: Sequence[Sequence[str]]
    columns: Sequence[str] = ()
    note: str = ""
    narrow_columns: int = 0  # that a narrow screen has room for; 0: all


@dataclass(frozen=True, slots=True)
class ReplayPart:
    """One replay on the page."""

    name: str
    tables: Sequence[ReportTable]
    remarks: Sequence[str]
    figure: Drawn


@dataclass(frozen=True, slots=True)
class Folded:
    """Lines of text that are folded away until the reader opens them, and not printed."""

    title: str
    lines: Sequence[str]


@dataclass(slots=True)
class Page:
    """Content of the page, in the order of reading; all texts may come from a session and are not trusted."""

    name: str
    outcome: str
    ended: str  # the outcome, and when
    good: bool
    sentence: str
    note: str
    won: Sequence[str]  # the way, the flow, what the refinement learned
    doubts: Sequence[str]  # why it is doubtful
    about: str  # when, where, with what, in one line
    notes: Sequence[str]  # of people
    key_figures: ReportTable
    figures: dict[str, Drawn] = field(default_factory=dict)
    refined: bool = False
    refinement: str = ""  # how both maps predict what was held back
    boundary: ReportTable | None = None
    events: Sequence[ReportTable] = ()
    recording: ReportTable | None = None
    findings: Sequence[str] = ()
    replays: Sequence[ReplayPart] = ()
    provenance: Sequence[ReportTable] = ()
    folded: Sequence[Folded] = ()
    glossary: Sequence[tuple[str, str]] = ()


@dataclass(slots=True)
class SweepPage:
    """Content of the page about a sweep, in the order of reading; the texts are not trusted."""

    name: str
    outcome: str
    good: bool
    note: str
    about: str
    figure: Drawn
    ranking: ReportTable
    tables: Sequence[ReportTable] = ()


def draw_figure(figure: ReportFigure, data: ReportData) -> Drawn:
    """Draw a figure for the page; call it within `style.drawing()`."""
    why = figure.why_not(data)
    if why:
        return Drawn(figure.name, figure.title, why_not=why)
    narrow, wide = (as_uri(style.as_svg(figure.draw(data, width_mm), figure.title)) for width_mm in style.WIDTHS_MM)
    return Drawn(figure.name, figure.title, figure.caption(data), figure.alt(data), narrow, wide)


def as_uri(svg: bytes) -> str:
    """An image that is part of the page."""
    return "data:image/svg+xml;base64," + base64.b64encode(svg).decode("ascii")


def plain(value: Any) -> Any:
    """A text of a session for the page: control and bidi characters as escape sequences, a very long one cut."""
    from markupsafe import Markup

    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    if len(value) > LONGEST:
        value = f"{value[:LONGEST]} ... (cut here; {len(value)} characters in all)"
    return printable(value)


def render(page: Page | SweepPage) -> str:
    """The page as HTML."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        finalize=plain,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["uri"] = Markup  # of images that were made here
    environment.globals["flowrec_version"] = __version__
    return environment.get_template(_TEMPLATES[type(page).__name__]).render(page=page)
