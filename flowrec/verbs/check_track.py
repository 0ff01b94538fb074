"""The part of `flowrec check` that judges the track: it takes the messages one by one, as they are in the file."""

from __future__ import annotations

from flowrec.core import Appearance, FlowrecError, Message, Shift, Track
from flowrec.physics import chip_from_files
from flowrec.stages import TrackQuality, calibration_of, config_from_toml
from flowrec.store import Audit


class TrackTally:
    """Takes the messages of one file in order; those of a time belong to one tick."""

    def __init__(self) -> None:
        self._quality: TrackQuality | None = None
        self._at_ns = 0
        self._track: Track | None = None
        self._appearance: Appearance | None = None
        self._shift: Shift | None = None

    def begin(self, found: Audit) -> None:
        """Take the header; without a readable one nothing is judged, and `check` tells of it elsewhere."""
        if found.header is None:
            return
        try:
            head = found.header
            config = config_from_toml(head.config_toml, "its configuration", head.provenance)
            chip = chip_from_files(head.chip_png, head.chip_toml, "its chip")
        except FlowrecError:
            return
        shape = config.camera.height_px, config.camera.width_px
        self._quality = TrackQuality(calibration_of(config, chip), shape, config.robot)

    def add(self, log_ns: int, message: Message) -> None:
        """Take one message: the time of its tick in ns, itself."""
        if log_ns != self._at_ns:
            self.close()
            self._at_ns = log_ns
        if isinstance(message, Track):
            self._track = message
        elif isinstance(message, Appearance):
            self._appearance = message
        elif isinstance(message, Shift):
            self._shift = message

    def close(self) -> None:
        """Take the tick whose messages are complete."""
        if self._quality is not None:
            self._quality.take(self._track, self._appearance, self._shift)

    def doubts(self) -> list[str]:
        """Reasons to doubt the track; none if there is no reason."""
        return [] if self._quality is None else self._quality.doubts()
