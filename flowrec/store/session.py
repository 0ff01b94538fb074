"""A recorded session, open for reading. Nothing heavy is imported until a message is read."""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flowrec.core import (
    Closing,
    Figures,
    FlowrecError,
    NotFiniteError,
    SessionError,
    UsageError,
    goal_text,
    nanoseconds,
    of_text,
    parse_toml,
    rows_for_people,
    seconds,
    shell_word,
    verdict_lines,
)
from flowrec.store.notes import Note, append_note, read_notes
from flowrec.store.run_files import Run
from flowrec.store.session_metadata import SessionHeader, SessionMetadata
from flowrec.store.session_path import session_path

if TYPE_CHECKING:
    import pyarrow as pa
    import xarray

    from flowrec.core import Event, FlowField, Tick
    from flowrec.physics import Calibration, Chip
    from flowrec.stages import ResolvedConfig
    from flowrec.store.reader import Channel, Frames, SessionReader
    from flowrec.store.tables import Tables

_CARD_FIGURES = ("tracking_error_um", "contacts", "frames_dropped", "covered")  # that no sentence states
_LARGEST_NUMBER = 1e15  # larger numbers are damage: it is a million kilometres in um


class FlowFields(dict[str, "FlowField"]):
    """Flow fields by name, which print as a table."""

    def __missing__(self, name: str) -> FlowField:
        raise KeyError(f"there is no flow field {name!r}; there are {', '.join(map(repr, self)) or 'none'}")

    def __repr__(self) -> str:
        return "\n".join(f"{name:8s}  {field!r}" for name, field in self.items()) or "no flow field"

    def to_xarray(self) -> xarray.Dataset:
        """All of them as one Dataset along the dimension `field`: FlowField.to_xarray, with time and method of each.

        A standard deviation that a method does not state is NaN.

        Raises
        ------
        UsageError : there is no field, or xarray is not installed.
        """
        if not self:
            raise UsageError("there is no flow field to make a Dataset of")
        data = [field.to_xarray() for field in self.values()]
        import xarray as xr  # is installed: it made `data`

        every = xr.concat(data, xr.Variable("field", list(self)), combine_attrs="drop_conflicts", join="exact")
        return every.assign_coords(method=("field", [field.method for field in self.values()]))


class Session(Closing):
    """A finished session, or one finished part of a run, open for reading; it never writes.

    X.mcap is that file or, if there is none, the run with the parts X.part001.mcap and so on. Times are session
    time in s, the stamps of the ticks. Every attribute is read when it is first used. A session may be used as a
    context manager; it is closed when it is collected, too.

    Parameters
    ----------
    path : the session (.mcap), or the URL of one: s3://, gs://, az://, http:// or https://.

    Attributes
    ----------
    path : as given.

    Raises
    ------
    SessionError : there is no such file, it is being recorded, was not finished, or is no session; reading damaged
        messages raises it as well.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = session_path(path)
        self.run = Run.at(self.path)

    @classmethod
    def of(cls, session: Session | Path | str) -> Session:
        """The session itself, or that of a path."""
        return session if isinstance(session, Session) else cls(session)

    @cached_property
    def header(self) -> SessionHeader:
        """Configuration, chip, provenance and parent as they were written before the first message."""
        with SessionMetadata(self.run.files[0].path, self.run.first_index) as head:
            return head.header

    @property
    def provenance(self) -> Mapping[str, str]:
        """Origin of the session: version, commit, packages, host, time, operator, seed; all text."""
        return self.header.provenance

    @property
    def numerics(self) -> str:
        """Version of the numerics that the session was computed with; the first release, "1", did not state it."""
        return self.provenance.get("numerics_version", "1")

    @cached_property
    def outcome(self) -> Figures:
        """Outcome of the run, and its figures; keys carry the unit, as in `duration_s`."""
        return of_text(self.run.outcome)

    @property
    def duration_s(self) -> float:
        """From the first tick to the last, in s; of a movie to that of its last image, which its outcome states."""
        ticks_s = seconds(self.run.last_ns - self.run.first_ns)
        stated_s = self.outcome.get("duration_s") if self.setting("rig") == "movie" else None
        return min(ticks_s, stated_s) if isinstance(stated_s, float) else ticks_s

    @cached_property
    def topics(self) -> dict[str, int]:
        """Number of messages by topic."""
        return self.run.counts()

    @cached_property
    def _settings(self) -> dict[str, Any]:
        return toml_table(self.header.config_toml, f"{self.path}: config.toml inside")

    def setting(self, *keys: str) -> Any:
        """A setting as the file holds it, not validated, such as `setting("camera", "rate_hz")`; None if absent."""
        tree: Any = self._settings
        for key in keys:
            tree = tree.get(key) if isinstance(tree, dict) else None
        return tree

    @cached_property
    def config(self) -> ResolvedConfig:
        """The resolved configuration of the run; UsageError where it is not valid."""
        return self.header.config(f"{self.path}: config.toml inside")

    @cached_property
    def chip(self) -> Chip:
        """The chip with its mask (h, w) and openings; ChipError where it is not valid."""
        return self.header.chip()

    @cached_property
    def calibration(self) -> Calibration:
        """Camera pixels to chip coordinates in um."""
        from flowrec.stages import calibration_of

        return calibration_of(self.config, self.chip)

    @cached_property
    def reader(self) -> SessionReader:
        """The reader of the messages, by stamps in ns."""
        from flowrec.store.reader import SessionReader

        return SessionReader(self.path, self.run)

    def ticks(
        self, start_s: float | None = None, end_s: float | None = None, *, with_frames: bool = True
    ) -> Iterator[Tick]:
        """All ticks, or those at and after `start_s` and before `end_s`, each with every message known by then.

        A message is new in a tick if it is another object than in the tick before. Without `with_frames` no image is
        read, and ticks with nothing but a new image are left out.
        """
        start_ns = None if start_s is None else self.stamp_ns(start_s)
        whole = end_s is None or end_s > seconds(self.run.last_ns)
        end_ns = None if whole or end_s is None else self.stamp_ns(end_s)
        return self.reader.ticks(start_ns, end_ns, with_frames=with_frames)

    def at(self, time_s: float, *, with_frames: bool = True) -> Tick:
        """The tick at or before a time, with every message known by then.

        Raises
        ------
        UsageError : the session does not cover that time.
        """
        return self.reader.tick_before(self.stamp_ns(time_s), with_frames=with_frames)

    @property
    def last(self) -> Tick:
        """The last tick, with every message known by then."""
        return self.reader.tick_before(self.run.last_ns)

    def messages(self, field: str) -> Iterator[Any]:
        """All messages of one topic, named by its field of `Tick` or its path; SessionError if there is none."""
        return self.reader.messages(field)

    def stream(self, channel: str) -> Channel:
        """Samples of a channel of a stream, such as "pump/flow": `time_s`, `value`, `unit`; SessionError if none."""
        return self.reader.channel(channel)

    def table(self, topic: str) -> pa.Table:
        """All messages of one topic as an Arrow table, one row a message; `.to_pandas()` makes a DataFrame of it.

        Columns carry the unit in their names, and unit and meaning in the metadata of their fields; each table begins
        with `stamp_ns`, `time_s` and `wall_time` (see table_columns.py). It is as large as its content; `batches`
        reads the same in pieces. The table of "frame" has no images: `frames` has them.

        Parameters
        ----------
        topic : named by its field of `Tick`, such as "track", or by its path, such as "/robot/track".

        Raises
        ------
        SessionError : there is no such topic, or the file is damaged. UsageError if pyarrow is not installed.
        """
        field = self.reader.field_of(topic)
        return self._tables([field]).table(field, self.reader.rows([field]))

    def batches(self, topics: Sequence[str]) -> Iterator[tuple[str, pa.RecordBatch]]:
        """Field and next record batch of the tables of some topics, in one pass over the file; errors as of `table`."""
        fields = [self.reader.field_of(topic) for topic in topics]
        return self._tables(fields).batches(self.reader.rows(fields))

    def schema(self, topic: str) -> pa.Schema:
        """The Arrow schema of the table of one topic; errors as of `table`."""
        field = self.reader.field_of(topic)
        return self._tables([field]).schema(field)

    def _tables(self, fields: Sequence[str]) -> Tables:
        from flowrec.store.tables import Tables

        return Tables(self.header.taken_unix_ns, self.reader.topics, self.reader.coils_of(fields))

    @cached_property
    def frames(self) -> Frames:
        """The recorded camera images, in order: a sequence, of which `frames[i]` reads one image only."""
        from flowrec.store.reader import Frames

        return Frames(self.reader)

    @property
    def events(self) -> list[Event]:
        """Events that the run reported, in order."""
        return list(self.messages("event"))

    @property
    def fields(self) -> FlowFields:
        """The last flow field of each kind that was recorded: "assumed", "refined" and, of a simulation, "true"."""
        last = self.reader.tick_before(self.run.last_ns, with_frames=False)
        found = {"assumed": last.assumed, "refined": last.refined, "true": last.true_field}
        return FlowFields({name: field for name, field in found.items() if field is not None})

    def stamp_ns(self, time_s: float, flag: str = "") -> int:
        """A time of the session in s as a stamp in ns; UsageError, which begins with `flag`, outside of the session."""
        first_ns, last_ns = self.run.first_ns, self.run.last_ns
        if not math.isfinite(time_s) or not first_ns <= nanoseconds(time_s) <= last_ns:
            what = f"{flag} {time_s:g}".strip()
            raise UsageError(f"{what}: {self.path} runs from {seconds(first_ns):g} s to {seconds(last_ns):g} s")
        return nanoseconds(time_s)

    @property
    def key(self) -> str:
        """Hash of header and times, 32 hexadecimal digits, that tells this session from every other."""
        header = self.header
        content = (header.config_toml, sorted(header.provenance.items()), sorted(header.parent.items()))
        return hashlib.sha256(repr((content, self.run.first_ns, self.run.last_ns)).encode()).hexdigest()[:32]

    @property
    def notes(self) -> list[Note]:
        """Notes and tags that were added after the run, in order; those of the recording are in `provenance`."""
        return read_notes(self.path, self.key)

    def add_note(self, text: str, tags: Sequence[str] = ()) -> Note:
        """Add a note, tags or both to a file beside the session, X.mcap.notes.jsonl; the recording is not changed.

        Raises
        ------
        UsageError : there is neither text nor tag, or one is too long.
        SessionError : the note can not be written.
        """
        from flowrec.core import user_name

        return append_note(self.path, self.key, text, tags, user_name())

    def close(self) -> None:
        """Close the files; nothing more can be read."""
        if "reader" in vars(self):
            self.reader.close()

    def __repr__(self) -> str:
        return f"Session({str(self.path)!r})"

    def _repr_html_(self) -> str:
        """A card for notebooks: how the run ended, with what, and the image in its middle, or the chip without one."""
        from flowrec.store.session_card import card

        frames, outcome, last = self.frames, self.outcome, self.last
        image = frames[len(frames) // 2].image if len(frames) else self.chip.mask.astype("uint8")
        recorded = {name: self.provenance.get(name, "") for name in ("wall_time", "operator", "sample", "notes")}
        goal = goal_text(last.mission.goal_um if last.mission is not None else None)
        rows = [("goal", goal), ("chip", self.chip.name)]
        rows += rows_for_people({key: outcome[key] for key in _CARD_FIGURES if key in outcome})
        rows += [(name.replace("_", " "), value) for name, value in recorded.items() if value]
        rows += [("topics", f"{len(self.topics)}, {sum(self.topics.values())} messages, {len(frames)} images")]
        return card(self.path.name, rows, image, verdict_lines(outcome, last.refined))


def open(path: Path | str) -> Session:  # noqa: A001 - flowrec.open
    """Open a session (.mcap) for reading.

    Raises
    ------
    SessionError : one line that says what the file is, and what to do.
    """
    return Session(path)


def toml_table(text: str, where: str) -> dict[str, Any]:
    """The tables of a TOML text in a session; SessionError, which begins with `where`, if it is damaged."""
    try:
        return parse_toml(text)
    except (ValueError, RecursionError) as error:  # also numbers and nesting that no flowrec has written
        raise SessionError(f"{where}: is not valid TOML ({error}); the file is damaged or was edited") from error


@contextlib.contextmanager
def input_blamed(session: Session, config: ResolvedConfig | None, done: str) -> Iterator[None]:
    """Turn an exception that absurd numbers or settings in a session cause into a SessionError.

    A replay does not check the recorded settings. Any other exception is raised unchanged.

    Parameters
    ----------
    config : the settings in use; None: those of the session, which are only read to explain an exception.
    done : the participle for the error, such as "replayed".
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, FlowrecError) and not isinstance(error, NotFiniteError):
            raise
        from flowrec.core import faults

        used = session.config if config is None else config
        number, fault = next(_absurd_numbers(session), None), next(faults(used), None)
        if number is not None:
            reason, advice = number, f"`flowrec check {shell_word(session.path)}` says more"
        elif fault is not None:
            reason, advice = f"it was recorded with {fault}", f"replay it with --set {fault.key}=..."
        else:
            raise
        failure = f"{type(error).__name__}: {error}"
        raise SessionError(f"{session.path}: {reason}, so it can not be {done} ({failure}); {advice}") from error


def _absurd_numbers(session: Session) -> Iterator[str]:
    from flowrec.core import invalid_numbers

    for topic in session.reader.topics.topics:
        for message in session.messages(topic.field) if topic.field != "frame" else ():
            for name in invalid_numbers(message, _LARGEST_NUMBER):
                at_s = seconds(message.stamp_ns - session.run.first_ns)
                yield f"{topic.path} {name} at {at_s:.3f} s holds NaN, infinity or an impossibly large number"
