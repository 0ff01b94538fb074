"""Figure: how the recording went: time per tick, data that waits for the disk, lost images, delay of the images."""

from __future__ import annotations

from typing import TYPE_CHECKING

from flowrec.exports.report import style
from flowrec.exports.report.report_data import ReportData
from flowrec.exports.report.time_axis import line, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PANEL_MM = 20.0


class RecordingFigure:
    """Timing of the run: periods of the loop, the write queue, and lost frames."""

    name = "recording"
    title = "Losses and clocks"

    def why_not(self, data: ReportData) -> str:
        return "" if self._panels(data) else "the session holds neither the times of its ticks nor its clocks"

    def caption(self, data: ReportData) -> str:
        texts = {
            "tick_ms": "Time per tick: computing time of one image (logarithmic); dashed: the time between images.",
            "late_ms": "Delay of images: arrival at the computer after the moment that the fit of the camera's clock "
            "predicts; mean and largest of each second.",
            "lost": "Lost images: images so far that the camera counted and that did not reach the loop.",
            "dropped": "Dropped images: images so far that reached the loop and were not written.",
            "queue_mb": "Queue: data that waits for the disk.",
        }
        shown = [texts[name] for name in self._panels(data)]
        absent = []
        if not data.history.curve("late_ms"):
            absent.append("The session holds no clock of a camera.")
        if not data.history.curve("lost"):
            absent.append("The camera did not count its images, or the session is not from a camera that does.")
        return " ".join([*shown, *absent])

    def alt(self, data: ReportData) -> str:
        largest = {name: data.history.curve(name).largest for name in self._panels(data)}
        words = {
            "tick_ms": "time per tick up to {:.1f} ms",
            "late_ms": "mean delay of images up to {:.1f} ms",
            "lost": "{:.0f} images lost",
            "dropped": "{:.0f} images dropped",
            "queue_mb": "up to {:.1f} MB waiting for the disk",
        }
        return f"Curves over time: {', '.join(words[name].format(value) for name, value in largest.items())}."

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        history, names = data.history, self._panels(data)
        figure, axes = panels(history, width_mm, [_PANEL_MM] * len(names))
        labels = {
            "tick_ms": "time per\ntick (ms)",
            "late_ms": "delay of\nimages (ms)",
            "lost": "lost\nimages",
            "dropped": "dropped\nimages",
            "queue_mb": "queue\n(MB)",
        }
        rate_hz = data.session.config.camera.rate_hz
        for ax, name in zip(axes, names, strict=True):
            line(ax, history.curve(name), style.BLUE, "mean")
            if name == "late_ms":
                line(ax, history.curve("latest_ms"), style.VERMILLION, "largest", lw=0.8)
                style.legend_above(ax, 2)
            if name == "tick_ms" and rate_hz:
                ax.axhline(1e3 / rate_hz, color=style.INK, lw=0.6, ls=(0, (3, 2)))
            if name == "tick_ms":
                ax.set_yscale("log")
                ax.yaxis.set_major_formatter("{x:g}")
            else:
                ax.set_ylim(bottom=0.0)
            if ax.get_ylim()[1] < 1.0 and name in ("lost", "dropped"):
                ax.set_ylim(0.0, 1.0)
            ax.set_ylabel(labels[name])
        return figure

    def _panels(self, data: ReportData) -> list[str]:
        """The curves to draw; of the queue and of dropped images only where there were any."""
        history = data.history
        always = [name for name in ("tick_ms", "late_ms", "lost") if history.curve(name)]
        if not history.curve("tick_ms"):
            return always
        return always + [name for name in ("dropped", "queue_mb") if history.curve(name).largest > 0.0]
