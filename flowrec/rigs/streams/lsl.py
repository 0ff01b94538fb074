"""Outlets of the Lab Streaming Layer, https://labstreaminglayer.readthedocs.io, by pylsl.

Stamps are those of the sender's clock plus the time correction that the layer measures with packets to and fro (as by
NTP); `local_clock` is then that of this machine. A stream that is lost is not recovered by the layer, which would do so
silently: the reader looks for it again, and refuses two.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from pathlib import Path

import numpy as np

from flowrec.core import NS_PER_S, RigError
from flowrec.rigs.streams.stream import Chunk, NoStreamError, StreamHead, named_channels
from flowrec.stages import StreamSettings

try:
    import pylsl
    from pylsl.util import LostError
except (ImportError, RuntimeError, OSError) as error:  # without the package, or without the library that it brings
    raise ModuleNotFoundError(str(error), name="pylsl") from error

_CONFIGURED = (Path("lsl_api.cfg"), Path("~/lsl_api/lsl_api.cfg"), Path("/etc/lsl_api/lsl_api.cfg"))
_FIND_S = 1.0  # all outlets of a name answer within this time, so that two are seen
_OPEN_S = 1.0  # for the connection, and for the first time correction
_BUFFER_S = 60  # of the layer's own buffer, while the reader does not read
_MOST = 4096  # samples a call
_CORRECTED_S = 1.0  # between two looks at the time correction; the layer measures it every few seconds


def _keep_quiet() -> None:
    """Let the layer print errors only, unless a person has configured it; before its first call."""
    if "LSLAPICFG" not in os.environ and not any(path.expanduser().exists() for path in _CONFIGURED):
        pylsl.set_config_content("[log]\nlevel = -2\n")


_keep_quiet()


class LslStream:
    """An outlet by name, or by a query. See rigs.streams.stream.SampleStream."""

    polled = False

    def __init__(self, outlet: str, settings: StreamSettings) -> None:
        self._outlet, self._settings = outlet, settings
        self._inlet: pylsl.StreamInlet | None = None
        self._correction_s = math.nan
        self._offset_ns = 0  # of the host's monotonic clock from the layer's; the same clock on Linux
        self._looked_s = -math.inf

    @classmethod
    def of(cls, name: str, settings: StreamSettings) -> LslStream:
        """The outlet of a section; without outlet and query that of the section's name."""
        return cls(settings.outlet or ("" if settings.query else name), settings)

    def open(self) -> StreamHead:
        found = self._find()
        info = found[0]
        if info.channel_format() == pylsl.cf_string:
            raise RigError(f"{_outlet_text(info)} sends texts, where numbers are wanted; name another outlet")
        self._inlet = inlet = pylsl.StreamInlet(info, max_buflen=_BUFFER_S, recover=False)
        try:
            full = inlet.info(_OPEN_S)
            inlet.open_stream(_OPEN_S)
            self._correction_s = inlet.time_correction(_OPEN_S)
        except (LostError, TimeoutError) as error:
            self.close()
            raise NoStreamError(f"{_outlet_text(info)} does not answer") from error
        self._note_clock()
        count = full.channel_count()
        units = [unit or "" for unit in full.get_channel_units() or [""] * count]
        stated = [label or "" for label in full.get_channel_labels() or []]
        unit = self._settings.unit
        return StreamHead(
            named_channels(self._settings, stated, count),
            (unit,) * count if unit else tuple(units if len(units) == count else [""] * count),
            full.nominal_srate(),
            _outlet_text(full),
        )

    def _find(self) -> list[pylsl.StreamInfo]:
        """The one outlet that fits.

        Raises
        ------
        NoStreamError : there is none.
        RigError : there are two; both are named.
        """
        name, query = self._outlet, self._settings.query
        if query:
            quote = '"' if "'" in name else "'"
            wanted = f"name={quote}{name}{quote} and ({query})" if name else query
            found = pylsl.resolve_bypred(wanted, 2, _FIND_S)
        else:
            wanted = f"name {name!r}"
            found = pylsl.resolve_byprop("name", name, 2, _FIND_S)
        if not found:
            raise NoStreamError(f"no outlet of the Lab Streaming Layer with {wanted}; start its program")
        if len(found) > 1:
            listed = "; ".join(sorted(map(_outlet_text, found)))
            raise RigError(f"{len(found)} outlets with {wanted}: {listed}; end one, or set `query` to tell them apart")
        return found

    def read(self, timeout_s: float) -> Chunk | None:
        assert self._inlet is not None, "the stream is open"
        try:
            values, stamps = self._inlet.pull_chunk(timeout_s, _MOST, min_samples=1, as_numpy=True)
            arrival_ns = time.monotonic_ns()
            if time.monotonic() - self._looked_s > _CORRECTED_S:
                self._note_clock()
                with contextlib.suppress(TimeoutError):  # no answer in time: the correction before it holds
                    self._correction_s = self._inlet.time_correction(0.1)
        except LostError as error:
            raise NoStreamError("its outlet has ended") from error
        if not len(stamps):
            return None
        times_ns = np.rint((stamps + self._correction_s) * NS_PER_S).astype(np.int64) + self._offset_ns
        return Chunk(times_ns, values.astype(np.float64), arrival_ns)

    def _note_clock(self) -> None:
        self._looked_s = time.monotonic()
        self._offset_ns = time.monotonic_ns() - round(pylsl.local_clock() * NS_PER_S)

    def correction_s(self) -> float:
        return self._correction_s

    def close(self) -> None:
        if self._inlet is not None:
            self._inlet.close_stream()
            self._inlet = None


def _outlet_text(info: pylsl.StreamInfo) -> str:
    """An outlet in words, enough to tell two apart."""
    source = info.source_id() or f"uid {info.uid()[:8]}"
    return f"{info.name()!r} of {info.hostname()} ({source}, {info.channel_count()} channels)"
