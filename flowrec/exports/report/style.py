"""The look of all figures of a report, and their files: SVG and PDF of an exact width, the same bytes every time."""

from __future__ import annotations

import io
import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal
from xml.sax.saxutils import escape

import numpy as np

from flowrec.view import ColourScale

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import ListedColormap
    from matplotlib.figure import Figure

MM_PER_INCH = 25.4  # exactly, by its definition
NARROW_MM, WIDE_MM = 88.0, 180.0  # one and two columns of a journal
WIDTHS_MM = (NARROW_MM, WIDE_MM)
INK, QUIET, FAINT, SOLID = "#222222", "#767676", "#dddddd", "#c8c8c8"
# Distinguishable with colour blindness (Okabe and Ito 2008).
ORANGE, SKY, GREEN, BLUE, VERMILLION, PURPLE = "#e69f00", "#56b4e9", "#009e73", "#0072b2", "#d55e00", "#cc79a7"
PAGE_DPI, PAPER_DPI = 140, 300  # of images inside of a figure
_RC: dict[str, Any] = {
    "font.family": ["DejaVu Sans"],  # comes with matplotlib
    "font.size": 7.0,  # of all texts: the sizes of labels and legends are relative to it
    "axes.titlesize": "medium",
    "axes.titlelocation": "left",
    "axes.titlepad": 3.0,
    "axes.linewidth": 0.6,
    "axes.edgecolor": QUIET,
    "axes.labelcolor": INK,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.borderaxespad": 0.2,
    "legend.handlelength": 1.6,
    "lines.linewidth": 1.0,
    "hatch.linewidth": 0.5,
    "text.color": INK,
    "text.parse_math": False,  # a name may hold dollar signs
    "pdf.fonttype": 42,  # TrueType: text can be searched and edited
    "svg.hashsalt": "flowrec",
    "path.simplify_threshold": 0.2,
    "figure.constrained_layout.h_pad": 0.03,
    "figure.constrained_layout.w_pad": 0.03,
}
_PATH, _DECIMALS = re.compile(rb' d="[^"]+"'), re.compile(rb"(\.\d\d)\d+")  # coordinates in pt to 0.01 pt
_ID = re.compile(rb'(?<=id=")[A-Za-z]+[0-9a-f]{10}(?=")')  # made of coordinates, whose last bit is not always the same
_lock = threading.Lock()


@contextmanager
def drawing() -> Iterator[None]:
    """All figures are made and saved inside: the settings of matplotlib are ours, whatever the user's are.

    They belong to the process, so one thread draws at a time.
    """
    import matplotlib as mpl

    with _lock, mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_RC)  # type: ignore[arg-type]
        yield


def new_figure(width_mm: float, height_mm: float, dpi: int = PAGE_DPI) -> Figure:
    """An empty figure without a window and without pyplot's global state."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    size = (width_mm / MM_PER_INCH, height_mm / MM_PER_INCH)
    figure = Figure(figsize=size, layout="constrained", dpi=dpi)
    FigureCanvasAgg(figure)
    return figure


def colour_map(scale: ColourScale) -> ListedColormap:
    """The colours that a scale has in all pictures."""
    from matplotlib.colors import ListedColormap

    return ListedColormap(scale.paint(np.linspace(scale.low, scale.high, 256)) / 255.0)


def bare(ax: Axes) -> None:
    """An axis for an image: no ticks, no frame."""
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_visible(False)


def legend_above(ax: Axes, columns: int = 4) -> None:
    """A legend above an axis, where no curve is; of a narrow figure in two columns at most."""
    figure = ax.get_figure()
    assert figure is not None
    narrow = figure.bbox.width / PAGE_DPI * MM_PER_INCH <= NARROW_MM + 0.5
    if ax.get_legend_handles_labels()[0]:
        ax.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 1.0),
            ncols=min(columns, 2) if narrow else columns,
            columnspacing=1.2,
            handletextpad=0.5,
        )


def as_svg(figure: Figure, title: str, dpi: int = PAGE_DPI, text: Literal["none", "path"] = "path") -> bytes:
    """The figure as SVG with a title for screen readers; its text as outlines, or as text that can be edited."""
    import matplotlib as mpl

    file = io.BytesIO()
    if (layout := figure.get_layout_engine()) is not None:  # alone: matplotlib would go through a whole drawing for it
        layout.execute(figure)
        figure.set_layout_engine("none")
    with mpl.rc_context({"svg.fonttype": text}):
        figure.savefig(file, format="svg", dpi=dpi, metadata={"Title": title, "Date": None})
    svg = _PATH.sub(lambda path: _DECIMALS.sub(rb"\1", path[0]), file.getvalue())
    for number, name in enumerate(dict.fromkeys(_ID.findall(svg))):
        svg = svg.replace(name, b"i%d" % number)
    head, root, rest = svg.partition(b"<svg ")
    attributes, closing, content = rest.partition(b">")
    label = f"<title>{escape(title)}</title>".encode()
    return head + root + b'role="img" ' + attributes + closing + label + content


def as_pdf(figure: Figure, title: str) -> bytes:
    """The figure as PDF, its fonts embedded as TrueType."""
    file = io.BytesIO()
    figure.savefig(file, format="pdf", dpi=PAPER_DPI, metadata={"Title": title, "CreationDate": None})
    return file.getvalue()
