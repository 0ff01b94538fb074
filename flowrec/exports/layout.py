"""`flowrec view --layout`: layouts with which Foxglove and Rerun show a session file as it is."""

from __future__ import annotations

import json
import shlex
from dataclasses import dataclass
from pathlib import Path

from flowrec.core import JSON, M_PER_UM, MM_PER_UM, RBL, SAMPLES, Output
from flowrec.store import LENGTHS, Session, SessionMetadata, files_behind
from flowrec.view import APPLICATION, bare_blueprint, foxglove_layout, peak, plot_of, stream_plots

_CAMERA = "/view/camera"
_LACKS = (
    "was recorded without the topics that place things on its image (by an older flowrec, or recording.leave_out);"
    " flowrec view shows all of it in Rerun"
)


@dataclass(frozen=True, slots=True)
class Layouts:
    """The files written for a session, and what it lacks for them ('' for nothing)."""

    session: Path
    foxglove: Path
    rerun: Path
    lacks: str

    @property
    def advice(self) -> list[str]:
        """Instructions to open the session with these files, a line each."""
        bare = self.rerun.with_name(f"{self.session.stem}_bare.rrd")
        mcap, rrd, rbl = (shlex.quote(str(path)) for path in (self.session, bare, self.rerun))
        convert = f"rerun mcap convert {mcap} --application-id {APPLICATION} -o {rrd}"
        return [
            f"{self.foxglove}: for Foxglove and Lichtblick; open {self.session} there, then Layouts > Import from file",
            f"{self.rerun}: for Rerun, which takes a layout with an .rrd only: {convert} && rerun {rrd} {rbl}",
            *([self.lacks] if self.lacks else []),
        ]


def write_layouts(session: Session | Path | str, folder: Path | str, overwrite: bool = False) -> Layouts:
    """Write a layout for Foxglove and Lichtblick (.json) and one for Rerun (.rbl) into a folder.

    Raises SessionError: the session can not be read; OutputError if a file may not be written.
    """
    session, folder = Session.of(session), Path(folder)
    files = tuple(files_behind(session.path))
    foxglove, rerun = (
        Output(folder / f"{session.path.stem}_{name}", suffixes, files, overwrite)
        for name, suffixes in (("foxglove.json", JSON), ("rerun.rbl", RBL))
    )
    foxglove.check()
    rerun.check()
    plots = [
        plot
        for topic in session.reader.topics.extra
        if topic.path != SAMPLES and (plot := plot_of(topic, next(session.messages(topic.path), None))) is not None
    ]
    plots += stream_plots(session.reader.stream_units)
    with SessionMetadata(session.run.files[0].path) as head:
        counts, began_ns = head.statistics.channel_message_counts, head.source.start_unix_ns
        present = {head.channels[number].topic for number, count in counts.items() if count}
        unit = next((each.metadata[LENGTHS] for each in head.channels.values() if LENGTHS in each.metadata), "m")
        schemas = {channel.topic: head.schemas[channel.schema_id].name for channel in head.channels.values()}
    scale, px_um = MM_PER_UM if unit == "mm" else M_PER_UM, session.chip.um_per_px
    (width, height), (x, y) = ([scale * (um - less) for um in session.chip.size_um] for less in (0.0, px_um))
    refined = session.fields.get("refined")
    top_um_s = peak(refined) if refined is not None else None
    layout = foxglove_layout((0.5 * x, 0.5 * y), max(width, height), plots, unit, top_um_s)
    extra = [(schemas[plot.topic], plot) for plot in plots if plot.topic in present]
    blueprint = bare_blueprint(present, began_ns + session.run.first_ns, began_ns + session.run.last_ns, extra)
    with foxglove.new_file() as part:
        part.write_text(json.dumps(layout, indent=1) + "\n", encoding="utf-8")
    with rerun.new_file() as part:
        blueprint.save(APPLICATION, str(part))
    lacks = "" if _CAMERA in present else f"{session.path}: {_LACKS}"
    return Layouts(session.path, foxglove.path, rerun.path, lacks)
