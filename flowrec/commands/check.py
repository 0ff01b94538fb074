"""`flowrec check`: whether a session is whole, what it lacks, and whether it can be replayed."""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from flowrec.chip import chip_from_files
from flowrec.clocks.clock_monitor import CRYSTAL_PPM, camera_told, faults_of, skew_ppm
from flowrec.config import Config, config_from_toml
from flowrec.errors import FlowrecError, printable
from flowrec.messages import Clocks, Frame, Message, Timing
from flowrec.session import Session
from flowrec.store import not_finite
from flowrec.store.audit import Audit, audit
from flowrec.store.part_continuity import fault_of, goes_on, without_part
from flowrec.store.paths import part_number, part_path, pieces
from flowrec.store.topic_filter import is_left_out
from flowrec.summary import Figures, finite
from flowrec.system.locks import is_growing
from flowrec.topics import BY_FIELD, TOPICS, Role
from flowrec.units import NS_PER_S, seconds
from flowrec.version import __version__

GAP_PERIODS = 1.5
_GAPS_KEPT = 100  # the longest ones
_GAPS_TOLD = 4
_PENDING = 100_000  # ticks whose image and state are not both read yet; in our own files half a second of them
_STEP_NS = 10_000  # intervals are told apart by so much
_INTERVALS = 100_000  # different ones that are counted
_RATE_TOLERANCE = 0.05
_CLOCK_JUMP_S = 1.0
_FRAME, _APPLIED, _TRACK = 1, 2, 4
_BITS = {"frame": _FRAME, "applied": _APPLIED, "track": _TRACK}

Level = Literal["odd", "bad"]


@dataclass(frozen=True, slots=True)
class Gap:
    """A time without a frame."""

    at_s: float  # of its beginning, since the first tick
    length_s: float


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that is not as it should be: `odd` does not keep one from using the session, `bad` does."""

    level: Level
    about: str
    text: str


@dataclass(slots=True)
class Verdict:
    """What `flowrec check` says.

    Attributes
    ----------
    path : the file.
    findings : what is not as it should be.
    facts : what was looked at, for people, by name.
    figures : the same in numbers, with the unit in the key.
    topics : messages read, by topic.
    gaps : the longest times without a frame, in order of time; `gap_count` has all of them.
    parts : the verdicts on its parts, where it is a run in parts.
    """

    path: Path
    findings: list[Finding] = field(default_factory=list)
    facts: dict[str, str] = field(default_factory=dict)
    figures: Figures = field(default_factory=dict)
    topics: dict[str, int] = field(default_factory=dict)
    gaps: list[Gap] = field(default_factory=list)
    gap_count: int = 0
    parts: list[Verdict] = field(default_factory=list)

    @property
    def word(self) -> Literal["good", "usable", "bad"]:
        """The verdict."""
        levels = {finding.level for finding in self.findings}
        return "bad" if "bad" in levels else "usable" if levels else "good"

    @property
    def exit_status(self) -> int:
        """0 good, 3 usable but something was lost or is odd, 1 not readable or not to be replayed."""
        return {"good": 0, "usable": 3, "bad": 1}[self.word]

    def odd(self, about: str, text: str) -> None:
        """Something was lost, or is odd."""
        self.findings.append(Finding("odd", about, printable(text)))

    def bad(self, about: str, text: str) -> None:
        """Something keeps one from replaying the session."""
        self.findings.append(Finding("bad", about, printable(text)))

    def fact(self, about: str, text: str) -> None:
        """Something was looked at."""
        self.facts[about] = printable(text)

    def lines(self) -> list[str]:
        """For people, the verdict first."""
        said = {
            "good": "GOOD: whole, and can be replayed",
            "usable": "USABLE: can be replayed, but something was lost or is odd",
            "bad": "NOT USABLE as it is",
        }[self.word]
        lines = [printable(f"{self.path.name}: {said}")]
        for level in ("bad", "odd"):
            lines += [f"  {'!!' if level == 'bad' else '! '} {f.text}" for f in self.findings if f.level == level]
        width = max((len(name) for name in self.facts), default=0)
        return [*lines, *(f"  {name:{width}s}  {text}" for name, text in self.facts.items())]

    def as_json(self) -> dict[str, Any]:
        """All of it."""
        return {
            "session": str(self.path),
            "verdict": self.word,
            "exit_status": self.exit_status,
            "findings": [{"level": f.level, "about": f.about, "text": f.text} for f in self.findings],
            "facts": self.facts,
            "figures": self.figures,
            "topics": self.topics,
            "gap_count": self.gap_count,
            "gaps": [{"at_s": gap.at_s, "length_s": gap.length_s} for gap in self.gaps],
            "parts": [part.as_json() for part in self.parts],
        }


def files_to_check(path: Path) -> list[Path]:
    """What `path` names: a file or, where there is none, what is there of the parts of that run, finished or not."""
    if path.exists():
        return [path]
    return sorted(filter(part_number, pieces(path)), key=part_number) or [path]


def check(session: Session | Path | str, progress: Callable[[int], None] | None = None) -> Verdict:
    """Read a whole session, finished or not, and judge it. Memory does not grow with the file.

    Of a run in parts each is judged, and whether they fit together.

    Parameters
    ----------
    session : the session, or the path of one; that of a file without an end as well.
    progress : told how many bytes have been read.

    Raises
    ------
    SessionError : it is no session that this flowrec can read; its text says what it is.
    """
    path = session.path if isinstance(session, Session) else Path(session)
    files = files_to_check(path)
    if files == [path]:
        return _check_file(path, progress)[0]
    judged, before = [], 0
    for file in files:
        done = (lambda at, before=before: progress(before + at)) if progress is not None else None
        judged.append(_check_file(file, done))
        before += file.stat().st_size
    return _check_run(path, judged)


def _check_file(path: Path, progress: Callable[[int], None] | None) -> tuple[Verdict, Audit, _Reading]:
    reading = _Reading()
    found = audit(path, reading.see, progress, reading.begin)
    reading.close()
    verdict = Verdict(path)
    verdict.topics = {BY_FIELD[name].path: count for name, count in found.counts.items()}
    config = _judge_head(verdict, found)
    _judge_end(verdict, found)
    _judge_content(verdict, found)
    _judge_digest(verdict, found)
    _judge_times(verdict, found, reading, config)
    _judge_images(verdict, found, reading, config)
    _judge_numbers(verdict, reading)
    _judge_clocks(verdict, found, reading.clocks)
    _judge_replay(verdict, found, reading)
    return verdict, found, reading


def _check_run(path: Path, judged: Sequence[tuple[Verdict, Audit, _Reading]]) -> Verdict:
    """The verdict on all parts together."""
    run = Verdict(path)
    run.parts = [verdict for verdict, _, _ in judged]
    said: dict[Finding, list[int]] = {}
    for (verdict, found, _), number in zip(judged, map(part_number, (v.path for v in run.parts)), strict=True):
        for finding in verdict.findings:
            said.setdefault(finding, []).append(number)
        run.gap_count += verdict.gap_count
        later_s = seconds(found.first_ns - judged[0][1].first_ns)
        run.gaps += [Gap(gap.at_s + later_s, gap.length_s) for gap in verdict.gaps]
    for finding, numbers in said.items():
        which = f"part {numbers[0]}" if len(numbers) == 1 else f"{len(numbers)} of {len(judged)} parts"
        run.findings.append(replace(finding, text=f"{which}: {finding.text}"))
    _judge_joints(run, judged)
    last = judged[-1][1]
    if last.finished and goes_on(last.outcome):
        following = part_path(path, part_number(last.path) + 1).name
        run.bad(
            "end", f"the run goes on in {following}, which is not here; `flowrec recover {path}` ends it before that"
        )
    counts = Counter[str]()
    for _, found, reading in judged:
        counts.update(found.counts)
        counts.subtract(reading.repeated)
    run.topics = {BY_FIELD[name].path: count for name, count in counts.items() if count}
    ticks, size_mb = sum(reading.ticks for _, _, reading in judged), sum(a.size_bytes for _, a, _ in judged) / 1e6
    run.figures = {key: run.parts[-1].figures.get(key) for key in ("outcome", "note")} | {
        "messages": counts.total(),
        "size_bytes": sum(found.size_bytes for _, found, _ in judged),
        "duration_s": seconds(last.last_ns - judged[0][1].first_ns),
        "ticks": ticks,
        "frames": counts["frame"],
    }
    run.fact("outcome", run.parts[-1].facts["outcome"])
    run.fact("content", f"{counts.total()} messages on {len(run.topics)} topics in {size_mb:.1f} MB")
    run.fact("length", f"{seconds(last.last_ns - judged[0][1].first_ns):.2f} s, {ticks} ticks")
    run.fact("images", f"{counts['frame']} for {ticks} ticks")
    exact = all(verdict.facts.get("replay", "").startswith("yes:") for verdict in run.parts)
    replay = "no" if run.word == "bad" else "yes" if exact else "yes, but not exact after what is missing"
    run.fact("replay", f"{replay}; each part alone, too" if replay == "yes" else replay)
    return run


def _judge_joints(run: Verdict, judged: Sequence[tuple[Verdict, Audit, _Reading]]) -> None:
    before: tuple[Audit, _Reading] | None = None
    number = 0
    for _, found, reading in judged:
        number += 1
        while number < part_number(found.path):
            run.bad("parts", f"part {number} is missing; the others can be read one by one")
            number, before = number + 1, None
        name = f"part {number}"
        if found.header is None:  # which has been told
            before = None
            continue
        fault = fault_of(found.piece, number, before[0].piece if before is not None else None)
        if fault is not None and (before is not None or number == 1):
            run.bad("parts", f"{name} {fault}")
        elif before is not None:
            _judge_joint(run, name, before, (found, reading))
        before = found, reading
    if not any(finding.about == "parts" for finding in run.findings):
        run.fact("parts", f"{len(judged)}, each begins where the one before ends")


def _judge_joint(run: Verdict, name: str, before: tuple[Audit, _Reading], after: tuple[Audit, _Reading]) -> None:
    (found, reading), (following, repeats) = before, after
    assert following.header is not None
    if found.header is not None and without_part(found.header) != without_part(following.header):
        run.bad("parts", f"{name} has another head (configuration, chip or origin) than the part before")
    if found.finished and not goes_on(found.outcome) and found.outcome.get("outcome") != "cut":
        run.odd("parts", f"{name} goes on although the part before says that the run ended with it")
    # An image that the disk had no time for may be in one of them only; no stage sees truths and timings.
    seen = {topic.field for topic in TOPICS if topic.role in (Role.INPUT, Role.OUTPUT)} - {"frame"}
    apart = [BY_FIELD[key].path for key in seen if reading.latest_ns.get(key) != repeats.repeated_ns.get(key)]
    if apart:
        run.odd("parts", f"{name} repeats something else than the part before ended with: {', '.join(sorted(apart))}")


class _Reading:
    """The tally of one pass over the messages, which come in file order: those of a tick not one after the other."""

    def __init__(self) -> None:
        self.not_finite: Counter[str] = Counter()
        self.dropped = 0  # images, as the writer counted them
        self.index_steps = 0  # numbers of images that were left out
        self.index_backwards = 0
        self.ticks = 0
        self.images_missing = 0  # ticks with state but without an image
        self.inputs_missing = 0  # ticks that can not be replayed: no report of the coils, or neither image nor track
        self.images_alone = 0
        self.unfinished_ticks = 0  # inputs that no stage has answered
        self.clocks = _Clocks()
        self._intervals: Counter[int] = Counter()
        self._longest: list[tuple[int, int]] = []  # a heap of length and beginning
        self._last_ns: int | None = None
        self._last_index: int | None = None
        self._pending: dict[int, int] = {}
        self._carried_ns: int | None = None
        self.repeated: Counter[str] = Counter()  # messages of the tick that a part repeats, by field
        self.repeated_ns: dict[str, int] = {}  # their own stamps
        self.latest_ns: dict[str, int] = {}  # stamps of the last messages

    def begin(self, found: Audit) -> None:
        """Take note of the head."""
        part = found.header.part if found.header is not None else None
        self._carried_ns = part.carried_ns if part is not None else None

    def see(self, name: str, log_ns: int, message: Message) -> None:
        """Take note of one message."""
        for wrong in not_finite(message):
            self.not_finite[f"{BY_FIELD[name].path} {wrong}"] += 1
        stamp_ns: int = message.stamp_ns  # type: ignore[attr-defined]
        self.latest_ns[name] = stamp_ns
        repeated = log_ns == self._carried_ns
        if repeated:
            self.repeated[name] += 1
            self.repeated_ns[name] = stamp_ns
        bit = _BITS.get(name)
        if bit is not None and not repeated:
            bits = self._pending.pop(log_ns, 0) | bit
            if bits == _FRAME | _APPLIED | _TRACK:
                self._count(bits)
            else:
                self._pending[log_ns] = bits
                if len(self._pending) > _PENDING:
                    self._count(self._pending.pop(next(iter(self._pending))))
        if name == "applied":
            self._take_interval(log_ns)
        if isinstance(message, Frame):
            step = message.index - self._last_index - 1 if self._last_index is not None else 0
            self.index_steps += max(step, 0)
            self.index_backwards += step < 0
            self._last_index = message.index
        elif isinstance(message, Timing):
            self.dropped = max(self.dropped, message.dropped_frames)
        elif isinstance(message, Clocks):
            self.clocks.see(message)

    def close(self) -> None:
        """Count what has not become complete."""
        for bits in self._pending.values():
            self._count(bits)
        self._pending.clear()

    @property
    def period_ns(self) -> int:
        """Median time from tick to tick, 0 when there are fewer than two."""
        half = (self._intervals.total() + 1) // 2
        for interval, count in sorted(self._intervals.items()):
            half -= count
            if half <= 0:
                return interval
        return 0

    def gaps(self, first_ns: int) -> tuple[list[Gap], int]:
        """The longest gaps in order of time, and the number of all."""
        limit = GAP_PERIODS * self.period_ns
        count = sum(count for interval, count in self._intervals.items() if interval > limit)
        longest = sorted((begin, length) for length, begin in self._longest if length > limit + _STEP_NS / 2)
        return [Gap(seconds(begin - first_ns), seconds(length)) for begin, length in longest], count

    def _take_interval(self, log_ns: int) -> None:
        last_ns, self._last_ns = self._last_ns, log_ns
        if last_ns is None or log_ns <= last_ns:
            return
        interval = round((log_ns - last_ns) / _STEP_NS) * _STEP_NS
        if interval in self._intervals or len(self._intervals) < _INTERVALS:
            self._intervals[interval] += 1
        entry = (log_ns - last_ns, last_ns)
        if len(self._longest) < _GAPS_KEPT:
            heapq.heappush(self._longest, entry)
        elif entry > self._longest[0]:
            heapq.heapreplace(self._longest, entry)

    def _count(self, bits: int) -> None:
        if bits == _FRAME:
            self.images_alone += 1
            return
        self.ticks += 1
        self.unfinished_ticks += bits == _FRAME | _APPLIED
        self.images_missing += bits == _APPLIED | _TRACK
        self.inputs_missing += not bits & _APPLIED or bits == _APPLIED


class _Clocks:
    """The tally of what was said of clocks during the run."""

    def __init__(self) -> None:
        self.last: Clocks | None = None
        self.wall_set: list[tuple[int, float]] = []  # stamp, and by how many s
        self.late_s = self.latest_s = 0.0
        self._seconds = 0

    def see(self, message: Clocks) -> None:
        """Take note of one message."""
        before, self.last = self.last, message
        set_s = message.wall_set_s - (before.wall_set_s if before is not None else 0.0)
        if message.wall_jumps > (before.wall_jumps if before is not None else 0) and len(self.wall_set) < _GAPS_KEPT:
            self.wall_set.append((message.stamp_ns, set_s))
        self._seconds += 1
        self.late_s += (message.late_s - self.late_s) / self._seconds
        self.latest_s = max(self.latest_s, message.latest_s)


def _judge_head(verdict: Verdict, found: Audit) -> Config | None:
    written = f"by flowrec {found.flowrec_version}"
    if found.flowrec_version != __version__:
        written += f" (this is {__version__}: flowrec replay --verify tells whether it still does the same)"
    verdict.fact("written", written)
    if found.header is None:
        verdict.bad("head", f"its head is not whole: {found.header_fault}")
        return None
    try:
        config = config_from_toml(found.header.config_toml, "its configuration")
    except FlowrecError as error:
        verdict.bad("head", str(error))
        return None
    try:
        chip_from_files(found.header.chip_png, found.header.chip_toml, "its chip")
    except FlowrecError as error:
        verdict.bad("head", str(error))
    return config


def _judge_end(verdict: Verdict, found: Audit) -> None:
    how = found.outcome.get("outcome", "")
    note = found.outcome.get("note") or found.outcome.get("reason", "")
    told = f" ({note})" if note and how != "cut" else ""  # of a cut one the findings tell
    verdict.figures |= {"outcome": how, "note": note}
    verdict.fact("outcome", (how or "not recorded") + told)
    if not found.finished:
        if is_growing(found.path):
            verdict.bad("end", "it is being recorded just now; stop that run with Ctrl-C, then check again")
        else:
            verdict.bad("end", f"it {_sentence(found.why_not)}; `flowrec recover {found.path}` saves what is whole")
    elif not how:
        verdict.odd("end", "how the run ended was not recorded")
    elif how == "failed":
        verdict.odd("end", f"the run failed: {note or 'for a reason that was not recorded'}")
    if "recovered_from" in found.outcome:
        text = f"it was recovered from {found.outcome['recovered_from']}"
        if how == "cut":
            verdict.odd("end", f"{text}; {note}")
        else:
            verdict.fact("recovered", f"from {found.outcome['recovered_from']}, without a loss")


def _sentence(why_not: str) -> str:
    return why_not if why_not.startswith(("was ", "has ")) else f"is damaged: {why_not}"


def _judge_content(verdict: Verdict, found: Audit) -> None:
    if found.lost:
        text = f"{found.lost} bytes are damaged, the first at {found.first_lost}"
        if found.finished:
            verdict.bad("content", f"{text}; `flowrec recover {found.path}` saves what is whole")
        else:
            verdict.odd("content", text)
    for text in found.contradictions:
        verdict.bad("index", f"{text}; `flowrec recover {found.path}` makes a new index")
    for text in found.disagreements:
        verdict.odd("index", text)
    bad = found.undecodable.total()
    if bad:
        verdict.bad("content", f"{bad} messages make no sense, the first is {found.first_undecodable}")
    for name, count in found.missing.items():
        if count:
            verdict.odd("content", f"{count} messages of {BY_FIELD[name].path} are missing on the way")
    count = found.counts.total()
    agrees = found.finished and not (found.contradictions or found.disagreements or found.lost)
    verdict.figures |= {"messages": count, "size_bytes": found.size_bytes}
    verdict.fact(
        "content",
        f"{count} messages on {len(found.counts)} topics in {found.size_bytes / 1e6:.1f} MB"
        + ("; index and statistics agree with what was read" if agrees else ""),
    )


def _judge_digest(verdict: Verdict, found: Audit) -> None:
    if found.edits is None:
        verdict.fact("digest", "none: recorded by an older flowrec" if found.finished else "none: not finished")
        return
    for text in found.edits:
        verdict.bad("digest", f"{text}: edited or damaged after the recording")
    if not found.edits:
        verdict.fact("digest", "head and messages are those that were recorded")


def _judge_times(verdict: Verdict, found: Audit, reading: _Reading, config: Config | None) -> None:
    rate_hz = NS_PER_S / reading.period_ns if reading.period_ns else math.nan
    rate = f", {rate_hz:.1f} Hz" if reading.period_ns else ""
    verdict.figures |= {"duration_s": found.duration_s, "ticks": reading.ticks, "rate_hz": finite(rate_hz)}
    verdict.fact("length", f"{found.duration_s:.2f} s, {reading.ticks} ticks{rate}")
    if not (found.backwards.total() or found.stamps_backwards.total() or reading.index_backwards):
        verdict.fact("time", "in order on every topic")
    for name, count in found.backwards.items():
        if count:
            verdict.odd("time", f"time goes backwards {count} times in {BY_FIELD[name].path}")
    for name, count in found.stamps_backwards.items():
        if count and not found.backwards[name]:
            verdict.odd("time", f"the source of {BY_FIELD[name].path} stamped {count} messages back in time")
    if reading.index_backwards:
        verdict.odd("time", f"the numbers of the images go backwards {reading.index_backwards} times")
    verdict.gaps, verdict.gap_count = reading.gaps(found.first_ns)
    if verdict.gap_count:
        longest = sorted(verdict.gaps, key=lambda gap: -gap.length_s)[:_GAPS_TOLD]
        told = ", ".join(f"{gap.length_s:.3f} s at {gap.at_s:.2f} s" for gap in longest)
        verdict.odd("gaps", f"{verdict.gap_count} times more than {GAP_PERIODS} periods without a frame: {told}"
                    + (", ..." if verdict.gap_count > len(longest) else ""))  # fmt: skip
    wanted_hz = config.camera.rate_hz if config is not None else None
    if wanted_hz and reading.period_ns and abs(rate_hz / wanted_hz - 1.0) > _RATE_TOLERANCE:
        verdict.odd("rate", f"{rate_hz:.1f} frames a second where {wanted_hz:g} were asked for")


def _judge_images(verdict: Verdict, found: Audit, reading: _Reading, config: Config | None) -> None:
    images = found.counts["frame"] - reading.repeated["frame"]
    elsewhere = not images and found.header is not None and bool(found.header.parent)
    if elsewhere:
        verdict.fact("images", "none: a replay, the recorded tracks stand in")
        return
    if not images and config is not None and is_left_out(BY_FIELD["frame"].path, config.recording.leave_out):
        verdict.fact("images", "none: recording.leave_out, the recorded tracks stand in")
        return
    dropped = max(reading.dropped, _whole(found.outcome, "dropped_frames"), _whole(found.outcome, "frames_dropped"))
    verdict.figures |= {"frames": images, "frames_dropped": dropped}
    verdict.fact("images", f"{images} for {reading.ticks} ticks; {dropped} dropped by the writer")
    if found.region is not None:
        windows = found.outcome.get(
            "frames_windows", "most of them hold what the tracker read, and are black elsewhere"
        )
        verdict.fact("windows", f"{windows}; exact for the recorded tracker and robot only")
    if dropped:
        verdict.odd("drops", f"{dropped} images were dropped because the disk was too slow (counted by the writer)")
    if reading.images_missing > dropped:
        verdict.odd("drops", f"{reading.images_missing - dropped} images are missing without having been counted")
    unseen = reading.index_steps - reading.images_missing
    if unseen > 0:
        verdict.odd("drops", f"{unseen} images of the camera never arrived, told by their numbers")


def _whole(outcome: Mapping[str, str], key: str) -> int:
    text = outcome.get(key, "")
    return int(text) if text.isdecimal() and len(text) < 20 else 0


def _judge_numbers(verdict: Verdict, reading: _Reading) -> None:
    for what, count in reading.not_finite.most_common(_GAPS_TOLD):
        verdict.odd("numbers", f"NaN or infinity in {what}, {count} times")
    if not reading.not_finite:
        verdict.fact("numbers", "finite wherever they must be")


def _judge_clocks(verdict: Verdict, found: Audit, clocks: _Clocks) -> None:
    """Stamps are of one monotonic clock; those of the wall and of the camera are noted beside it, and may do as they
    like.
    """
    if clocks.last is not None and clocks.last.rate:
        verdict.fact("camera", camera_told(clocks.last, clocks.late_s, clocks.latest_s))
        skew = skew_ppm(clocks.last)
        if clocks.last.unit or (clocks.last.known and abs(skew) > CRYSTAL_PPM):
            verdict.odd(
                "clocks",
                f"a count of the camera's clock is {clocks.last.rate:.6g} ns, which no crystal is off by; stamps are"
                " mended by the fit",
            )
    if clocks.last is not None:
        for what, count in faults_of(clocks.last):
            verdict.odd("clocks", f"{count} frames {what}")
    for stamp_ns, set_s in clocks.wall_set[:_GAPS_TOLD]:
        at_s = seconds(stamp_ns - found.first_ns)
        verdict.odd("clocks", f"the wall clock was set by {set_s:+.3f} s at {at_s:.2f} s; stamps are not affected")
    if len(clocks.wall_set) > _GAPS_TOLD:
        verdict.odd("clocks", f"and {len(clocks.wall_set) - _GAPS_TOLD} times more")
    said = dict(found.header.provenance) if found.header is not None else {}
    began = {name: _whole(said, name) for name in ("wall_ns", "monotonic_ns")}
    ended = {name: _whole(found.outcome, name) for name in ("wall_ns", "monotonic_ns")}
    moment = said.get("wall_time", "")[:19].replace("T", " ")
    if not all(began.values()):
        verdict.fact("clocks", "no reading of the wall clock beside the monotonic one")
        return
    verdict.fact("clocks", f"wall and monotonic read at {moment} UTC")
    if all(ended.values()):
        jump_s = seconds((ended["wall_ns"] - began["wall_ns"]) - (ended["monotonic_ns"] - began["monotonic_ns"]))
        verdict.facts["clocks"] += f" and at the end, {1e3 * jump_s:+.0f} ms apart by then"
        if abs(jump_s) > _CLOCK_JUMP_S and not clocks.wall_set:
            verdict.odd("clocks", f"the wall clock was set by {jump_s:+.1f} s during the run; stamps are not affected")


def _judge_replay(verdict: Verdict, found: Audit, reading: _Reading) -> None:
    if not reading.ticks and reading.repeated:
        verdict.odd("replay", "there is nothing in it but the tick that it repeats")
    elif not reading.ticks:
        verdict.bad("replay", "there is no tick in it, so nothing to replay")
    if reading.inputs_missing:
        verdict.odd(
            "replay", f"{reading.inputs_missing} of {reading.ticks} ticks lack inputs; a replay leaves them out"
        )
    if reading.images_alone:
        verdict.odd("replay", f"of {reading.images_alone} ticks there is only the image")
    if reading.unfinished_ticks:
        verdict.odd("replay", f"{reading.unfinished_ticks} ticks were not worked on to their end")
    if verdict.word == "bad":
        verdict.fact("replay", "no")
    elif reading.inputs_missing or reading.images_alone or found.missing.total():
        verdict.fact("replay", "yes, but not exact after what is missing")
    else:
        verdict.fact("replay", "yes: configuration, chip, and the inputs of every tick")
