"""The rig of a replay: it returns the recorded inputs of a session and sends no command."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from flowrec.core import Currents, Role, Tick, TopicTable, Track
from flowrec.stages import ARRIVING, FROM_IMAGE, Inputs
from flowrec.store import SessionReader


class RecordedRig:
    """Yields a session's inputs. Results of the worker in fields of `recompute` are left out: the replay makes its own.

    `recorded` is the recorded tick of the inputs yielded last, for comparison. `topics` has the types in which the
    stages take the messages of extra topics.
    """

    def __init__(
        self,
        reader: SessionReader,
        start_ns: int | None = None,
        recompute: frozenset[str] = frozenset(),
        end_ns: int | None = None,
        topics: TopicTable | None = None,
    ) -> None:
        self._reader = reader
        self._start_ns = start_ns
        self._recompute = recompute
        self._end_ns = reader.last_ns if end_ns is None else end_ns
        self._topics = reader.topics if topics is None else topics
        extra = reader.topics.extra
        self._extra = frozenset(topic.path for topic in extra if topic.role in (Role.INPUT, Role.TRUTH))
        self._tracks = frozenset(topic.path for topic in extra if topic.type is Track)  # of an image that was dropped
        self.recorded = Tick()
        self.frames_missing = 0

    def __enter__(self) -> RecordedRig:
        return self

    def __exit__(self, *error: object) -> None:
        """Nothing to switch off."""

    def inputs(self) -> Iterator[Inputs]:
        """One Inputs per recorded tick, from the start to the end, both included."""
        before = self._reader.tick_before(self._start_ns - 1) if self._start_ns is not None else Tick()
        for tick in self._reader.ticks(self._start_ns):
            if tick.stamp_ns > self._end_ns:
                return
            if tick.applied is None or tick.applied is before.applied:
                # An incomplete tick: the last one before a crash, or an operator event, which the next tick takes.
                before = replace(before, frame=tick.frame)
                continue
            self.recorded = tick
            names = [name for name in ARRIVING if name not in self._recompute]
            new: dict[str, Any] = {
                name: message for name in names if (message := getattr(tick, name)) is not getattr(before, name)
            }
            if new.get("frame") is None:
                if tick.track is None or tick.track is before.track:
                    before = tick
                    continue  # a crash left the inputs without an image: nothing to replay
                self.frames_missing += not tick.applied.without_image
                from_image = {name: getattr(tick, name) for name in FROM_IMAGE}
                new |= {name: known for name, known in from_image.items() if known is not getattr(before, name)}
            if tick.extra is not before.extra:
                taken = self._extra if new.get("frame") is not None else self._extra | self._tracks
                new["extra"] = {
                    path: self._topics.as_declared(message, path)
                    for path, message in tick.extra.items()
                    if path in taken and message is not before.extra.get(path)
                }
            yield Inputs(tick.stamp_ns, **({"frame": None} | new))
            before = tick

    def apply(self, currents: Currents) -> None:
        """Do nothing: there are no coils."""

    def zero(self) -> None:
        """Do nothing: there are no coils."""
