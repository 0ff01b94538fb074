"""One file of a session, validated: whether it is whole, what it lacks, and whether it can be replayed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from flowrec.core import (
    CRYSTAL_PPM,
    NS_PER_S,
    NUMERICS_VERSION,
    SILENT,
    Coverage,
    FlowrecError,
    Outcome,
    __version__,
    camera_summary,
    doubts_of,
    finite,
    irregular_frames,
    is_growing,
    seconds,
    shell_word,
    skew_ppm,
)
from flowrec.physics import chip_from_files
from flowrec.stages import ResolvedConfig, TrackQuality, calibration_of, config_from_toml, needed_packages
from flowrec.store import FRAME_PATH, Audit, audit, is_left_out
from flowrec.verbs.verdict import (
    CONSISTENT,
    DAMAGED,
    GAP_PERIODS,
    NO_DIGEST,
    RATE_TOLERANCE,
    UNFINISHED,
    Tally,
    Verdict,
)

_LISTED = 4  # gaps, kinds of numbers and settings of a clock that are named one by one
_CLOCK_JUMP_S = 1.0  # of the wall clock against the monotonic one: more than any drift in a run
HEAD = ("configuration", "chip", "provenance", "outcome")
_CLOCKS = ("wall_ns", "monotonic_ns")
EXACT = "yes: configuration, chip, and the inputs of every tick"
NOT_EXACT = "yes, but not exact after the first missing message"


class FileCheck:
    """Reads one file and fills its verdict, one method for each subject.

    `read_bytes`: how far it is.
    """

    def __init__(self, path: Path, progress: Callable[[], None]) -> None:
        self.tally, self.found = Tally(), Audit(path, 0)
        self.read_bytes = 0
        self._progress = progress
        self.verdict = Verdict(path, Coverage(0, 0, "bytes"))
        self._config: ResolvedConfig | None = None
        self._head_fault = ""

    def _begin(self, found: Audit) -> None:
        """Take the head, before the first message."""
        self.found, header = found, found.header
        quality: TrackQuality | None = None
        try:
            if header is not None:
                config = self._config = config_from_toml(header.config_toml, "its configuration", header.provenance)
                chip = chip_from_files(header.chip_png, header.chip_toml, "its chip")
                shape = config.camera.shape
                quality = TrackQuality(calibration_of(config, chip), shape, config.robot)
        except FlowrecError as error:
            self._head_fault = str(error)
        self.tally.begin(found, quality)

    def _at(self, read_bytes: int) -> None:
        self.read_bytes = read_bytes
        self._progress()

    @property
    def topics(self) -> dict[str, int]:
        """Messages by topic that were read."""
        return {self._path(name): count for name, count in self.found.counts.items()}

    def _path(self, name: str) -> str:
        return self.found.topics.by_field[name].path

    def undecodable(self, verdict: Verdict) -> None:
        """Tell of messages, among those that were read so far, that can not be decoded."""
        if count := self.found.undecodable.total():
            verdict.bad("content", f"{count} messages can not be decoded, the first is {self.found.first_undecodable}")

    def not_finite(self, verdict: Verdict) -> None:
        """Tell of NaN and infinity in the messages that were read so far."""
        for what, count in self.tally.not_finite.most_common(_LISTED):
            verdict.odd("numbers", f"NaN or infinity in {what}, {count} times")

    def read(self) -> None:
        """Read the file and judge it."""
        self.found = audit(self.found.path, self.tally.add, self._at, self._begin)
        self._at(self.found.size_bytes)
        self.tally.close()
        self.verdict.topics = self.topics
        self.verdict.covered = Coverage(self.read_bytes, self.found.size_bytes, "bytes")
        self._header()
        self._end()
        self._content()
        self._digest()
        self._times()
        self._images()
        self._numbers()
        self._clocks()
        self._replay()

    def _header(self) -> None:
        verdict, found = self.verdict, self.found
        written = f"by flowrec {found.flowrec_version}"
        if found.flowrec_version != __version__:
            written += f" (this is {__version__}: flowrec replay --verify shows whether it computes the same)"
        numerics = found.header.provenance.get("numerics_version", "1") if found.header is not None else None
        if numerics not in (None, str(NUMERICS_VERSION)):
            written += f", made by other numerics (version {numerics}; this is {NUMERICS_VERSION})"
        verdict.fact("written", written)
        if found.header is None:
            verdict.bad("head", f"its header is incomplete: {found.header_fault}")
        elif self._head_fault:
            verdict.bad("head", self._head_fault)

    def _end(self) -> None:
        verdict, found = self.verdict, self.found
        how = found.outcome.get("outcome", "")
        note = found.outcome.get("note") or found.outcome.get("reason", "")
        why = f" ({note})" if note and how != Outcome.CUT else ""  # findings report a cut
        verdict.figures |= {"outcome": how, "note": note}
        verdict.fact("outcome", (how or "not recorded") + why)
        if not found.finished:
            if is_growing(found.path):
                verdict.bad("end", "it is being recorded just now; stop that run with Ctrl-C, then check again")
            else:
                fault = found.why_not if found.why_not.startswith(("was ", "has ")) else f"is damaged: {found.why_not}"
                verdict.bad("end", f"it {fault}; `flowrec recover {shell_word(found.path)}` recovers what is intact")
        elif not how:
            verdict.odd("end", "how the run ended was not recorded")
        elif how == Outcome.FAILED:
            verdict.odd("end", f"the run failed: {note or 'for a reason that was not recorded'}")
        source = found.outcome.get("recovered_from")
        if source is not None and how == Outcome.CUT:
            verdict.odd("end", f"it was recovered from {source}; {note}")
        elif source is not None:
            verdict.fact("recovered", f"from {source}, without a loss")
        quality = self.tally.quality
        doubts = [*doubts_of(found.outcome), *(quality.doubts() if quality is not None else [])]
        for doubt in dict.fromkeys(doubts):
            verdict.odd("doubts", f"doubtful: {doubt}")

    def _content(self) -> None:
        verdict, found = self.verdict, self.found
        if found.lost:
            text = f"{found.lost} bytes are damaged, the first at {found.first_lost}"
            if found.finished:
                verdict.bad("content", f"{text}; `flowrec recover {shell_word(found.path)}` recovers what is intact")
            else:
                verdict.odd("content", text)
        for text in found.contradictions:
            verdict.bad("index", f"{text}; `flowrec recover {shell_word(found.path)}` makes a new index")
        for text in found.disagreements:
            verdict.odd("index", text)
        self.undecodable(verdict)
        for name, count in (+found.missing).items():
            verdict.odd("content", f"{count} messages of {self._path(name)} are missing in the middle")
        agrees = found.finished and not (found.contradictions or found.disagreements or found.lost)
        count = found.counts.total()
        verdict.figures |= {"messages": count, "size_bytes": found.size_bytes}
        text = f"{count} messages on {len(found.counts)} topics in {found.size_bytes / 1e6:.1f} MB"
        verdict.fact("content", text + ("; index and statistics agree with what was read" if agrees else ""))

    def _digest(self) -> None:
        verdict, found = self.verdict, self.found
        if found.edits is None:
            verdict.fact("digest", "none: recorded by an older flowrec" if found.finished else "none: not finished")
            verdict.integrity = NO_DIGEST if found.finished else UNFINISHED
        else:
            for place in found.edits:
                verdict.bad("digest", f"{DAMAGED} at {place}")
            if found.edits:
                verdict.integrity = f"{DAMAGED} at {found.edits[0]}"
            else:
                verdict.fact("digest", f"{CONSISTENT}: whoever can edit the file can edit its digest")
        if found.finished and found.lost:
            verdict.integrity = f"{DAMAGED} at byte {found.first_lost}"
        elif found.contradictions:
            verdict.integrity = f"{DAMAGED} at its index"

    def _times(self) -> None:
        verdict, found, tally = self.verdict, self.found, self.tally
        rate_hz = NS_PER_S / tally.period_ns if tally.period_ns else math.nan
        verdict.figures |= {"duration_s": found.duration_s, "ticks": tally.ticks, "rate_hz": finite(rate_hz)}
        rate = f", {rate_hz:.1f} Hz" if tally.period_ns else ""
        verdict.fact("length", f"{found.duration_s:.2f} s, {tally.ticks} ticks{rate}")
        if not (found.backwards.total() or found.stamps_backwards.total() or tally.index_backwards):
            verdict.fact("time", "in order on every topic")
        for name, count in (+found.backwards).items():
            verdict.odd("time", f"time goes backwards {count} times in {self._path(name)}")
        for name, count in (+found.stamps_backwards).items():
            if not found.backwards[name]:
                verdict.odd("time", f"the source of {self._path(name)} stamped {count} messages back in time")
        if tally.index_backwards:
            verdict.odd("time", f"the numbers of the images go backwards {tally.index_backwards} times")
        verdict.gaps, verdict.gap_count = tally.gaps(found.first_ns)
        if verdict.gap_count:
            longest = sorted(verdict.gaps, key=lambda gap: -gap.length_s)[:_LISTED]
            listed = [f"{gap.length_s:.3f} s at {gap.at_s:.2f} s" for gap in longest]
            listed += ["..."] * (verdict.gap_count > len(longest))
            text = f"{verdict.gap_count} times more than {GAP_PERIODS} periods without a frame: {', '.join(listed)}"
            verdict.odd("gaps", text)
        wanted_hz = self._config.camera.rate_hz if self._config is not None else None
        if wanted_hz and tally.period_ns and abs(rate_hz / wanted_hz - 1.0) > RATE_TOLERANCE:
            verdict.odd("rate", f"{rate_hz:.1f} frames per second instead of camera.rate_hz = {wanted_hz:g}")

    def _images(self) -> None:
        verdict, found, tally = self.verdict, self.found, self.tally
        images = found.counts["frame"] - tally.repeated["frame"]
        if not images and found.header is not None and found.header.parent:
            verdict.fact("images", "none: a replay, the recorded tracks stand in")
            return
        leave_out = self._config.recording.leave_out if self._config is not None else ()
        if not images and is_left_out(FRAME_PATH, leave_out):
            verdict.fact("images", "none: recording.leave_out, the recorded tracks stand in")
            return
        dropped = max(tally.dropped, _count(found.outcome, "dropped_frames"))
        verdict.figures |= {"frames": images, "frames_dropped": dropped}
        verdict.fact("images", f"{images} for {tally.ticks} ticks; {dropped} dropped by the writer")
        if found.region is not None:
            windows = found.outcome.get("frames_windows", "most of them are black outside of what the tracker read")
            verdict.fact("windows", f"{windows}; exact for the recorded tracker and robot only")
        lost_images = {
            "were dropped because the disk was too slow (counted by the writer)": dropped,
            "are missing without having been counted": tally.images_missing - dropped,
            "of the camera never arrived, as their numbers show": tally.index_steps - tally.images_missing,
        }
        for how, count in lost_images.items():
            if count > 0:
                verdict.odd("drops", f"{count} images {how}")
        losses = tally.losses
        if losses is not None:
            lost = {
                "on the link": losses.link,
                "incomplete": losses.incomplete,
                "by the driver": losses.driver,
                "by the queue before the loop": losses.backlog,
            }
            causes = ", ".join(f"{count} {cause}" for cause, count in lost.items() if count) or "none lost"
            by_s = seconds(losses.stamp_ns - found.first_ns)
            counts = f"of {losses.ids} images that the camera has numbered by {by_s:.1f} s, {losses.frames} came"
            verdict.fact("losses", f"{counts}; {causes}")
            if losses.triggers:
                verdict.odd("drops", f"{losses.triggers} triggers that the camera has not answered")
            if losses.reconnections:
                verdict.odd("drops", f"the camera was absent {losses.reconnections} times, and came back")

        if tally.streams is not None:
            self._streams(tally.streams)

    def _streams(self, states: Any) -> None:
        """Samples of the streams of other programs: a fact, and what was lost or stepped."""
        names = states.streams.split("\n")
        counts = zip(names, states.samples.tolist(), strict=False)
        self.verdict.fact("streams", ", ".join(f"{name}: {count} samples" for name, count in counts))
        told = {
            "samples thrown away by the queue before the loop": states.lost,
            "samples missing, as gaps in the stamps show": states.missing,
            "steps of the sender's clock, taken out": states.steps,
            "interruptions, after which it came back": states.restarts,
        }
        for number, (name, state) in enumerate(zip(names, states.state.tolist(), strict=False)):
            odd = [f"{count} {what}" for what, counts in told.items() for count in counts[number : number + 1] if count]
            odd += ["silent at the end"] if state == SILENT else []
            if odd:
                self.verdict.odd("streams", f"{name}: {', '.join(odd)}")

    def _numbers(self) -> None:
        self.not_finite(self.verdict)
        if not self.tally.not_finite:
            self.verdict.fact("numbers", "finite wherever they must be")

    def _clocks(self) -> None:
        """Stamps come from one monotonic clock; what the wall clock and the camera's clock do is only reported."""
        verdict, found, clocks = self.verdict, self.found, self.tally.clocks
        last = clocks.last
        if last is not None and last.rate:
            verdict.fact("camera", camera_summary(last, clocks.late_s, clocks.latest_s))
            if last.unit or (last.known and abs(skew_ppm(last)) > CRYSTAL_PPM):
                verdict.odd(
                    "clocks",
                    f"a count of the camera's clock is {last.rate:.6g} ns, more than the error of a quartz; stamps are "
                    "corrected by the fit",
                )
        for what, count in irregular_frames(last) if last is not None else ():
            verdict.odd("clocks", f"{count} frames {what}")
        for stamp_ns, set_s in clocks.wall_set[:_LISTED]:
            at_s = seconds(stamp_ns - found.first_ns)
            verdict.odd("clocks", f"the wall clock was set by {set_s:+.3f} s at {at_s:.2f} s; stamps are not affected")
        if len(clocks.wall_set) > _LISTED:
            verdict.odd("clocks", f"and {len(clocks.wall_set) - _LISTED} times more")
        provenance: Mapping[str, str] = found.header.provenance if found.header is not None else {}
        began = [_count(provenance, name) for name in _CLOCKS]
        ended = [_count(found.outcome, name) for name in _CLOCKS]
        if not all(began):
            verdict.fact("clocks", "the wall clock was not read together with the monotonic clock")
            return
        text = f"wall clock and monotonic clock read at {provenance.get('wall_time', '')[:19].replace('T', ' ')} UTC"
        if all(ended):
            jump_s = seconds((ended[0] - began[0]) - (ended[1] - began[1]))
            text += f" and at the end, {round(1e3 * jump_s):+d} ms apart by then"
            if abs(jump_s) > _CLOCK_JUMP_S and not clocks.wall_set:
                set_by = f"the wall clock was set by {jump_s:+.1f} s during the run"
                verdict.odd("clocks", f"{set_by}; stamps are not affected")
        verdict.fact("clocks", text)

    def _replay(self) -> None:
        verdict, tally = self.verdict, self.tally
        if not tally.ticks and tally.repeated:
            verdict.odd("replay", "it holds only the tick that it repeats from the part before")
        elif not tally.ticks:
            verdict.bad("replay", "there is no tick in it, so nothing to replay")
        lacking = {
            f"of {tally.ticks} ticks lack inputs; a replay leaves them out": tally.inputs_missing,
            "ticks have only their image": tally.images_alone,
            "ticks have inputs, but no results of the stages": tally.unfinished_ticks,
        }
        for what, count in lacking.items():
            if count:
                verdict.odd("replay", f"{count} {what}")
        lacks = tally.inputs_missing or tally.images_alone or self.found.missing.total()
        exact = NOT_EXACT if lacks else EXACT
        header = self.found.header
        packages = [] if self._config is None or header is None else needed_packages(self._config, header.provenance)
        with_these = f"; its stages need the packages {', '.join(packages)}" if packages else ""
        verdict.fact("replay", "no" if verdict.word == "bad" else exact + with_these)


def _count(text: Mapping[str, str], key: str) -> int:
    """A number in a header or an outcome, 0 if there is none."""
    number = text.get(key, "")
    return int(number) if number.isdecimal() and len(number) < 20 else 0
