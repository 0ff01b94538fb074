"""A mission on a rig, written to one session file: the engine of `flowrec record` and `flowrec import`."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flowrec.console import RunEnded, refuse_without_packages
from flowrec.core import (
    DOUBTS,
    MCAP,
    RRD,
    ClockMonitor,
    Coverage,
    Figures,
    FlowrecError,
    Image,
    Outcome,
    Output,
    SessionError,
    Tick,
    View,
    as_text,
    doubts_text,
    kernels_cached,
    realtime_priority,
    say,
    shell_word,
    warn,
)
from flowrec.measure import as_pictured
from flowrec.rigs import Connecting, MovieRig, Picturing, Rig, RunLog
from flowrec.run import (
    CommandSocket,
    DiskMonitor,
    Joining,
    LockstepWorker,
    Preloaded,
    ProcessWorker,
    RunControl,
    RunReport,
    Sink,
    StreamInputs,
    Streams,
    Watchdog,
    Worker,
    obey,
    run,
)
from flowrec.stages import MOVIE, RIGS, Config, RunStatistics, assemble, extra_rows, shortest_way
from flowrec.store import SessionWriter, session_writer
from flowrec.verbs.admission import admit, rehearse_aloud
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.preparation import (
    Prepared,
    checked_image,
    field_of_session,
    files_of,
    guard_timeout_s,
    place_of_session,
    prepare,
)
from flowrec.verbs.run_summary import GOOD_ENDS, Recorded, figures_of, files_text, judge_refinement, judges_of
from flowrec.verbs.watching import Watching

if TYPE_CHECKING:
    from flowrec.verbs.first_pass import Looked

# Parts of the 2 s that a run may take to end; the rest is for the coils (run/control.py) and for Python itself.
CLOSE_TIMEOUT_S = 0.5  # for images that are still queued
VIEW_TIMEOUT_S = 0.2  # for a viewer to show the last messages
_GIVE_UP_TIMEOUT_S = 1.0  # to close the file while the main thread hangs


def run_mission(
    config: Config,
    out: Path | None = None,
    view: View = "none",
    realtime: bool = False,
    overwrite: bool = False,
    control: Unattended | None = None,
    inputs: Sequence[Path] = (),
    console: bool = False,
    looked: Looked | None = None,
    log: RunLog | None = None,
) -> Recorded:
    """Run the mission of `config` and write it to `out`, in any thread.

    The field is off before this function returns or raises, whatever the exception; also for KeyboardInterrupt. Raises
    FlowrecError: any of its kinds; a stage, a rig or a worker may raise others.

    Parameters
    ----------
    view : spawn, serve, rrd or none.
    realtime : keep the rig to the wall clock, with a watchdog of its ticks (run/watchdog.py); devices of a lab know no
        other time.
    control : who attends the run; None: nobody, it takes no signals and no keys and shows no progress.
    inputs : files that were read besides those that `config` names; no output may be one of them.
    console : serve a page on this machine that shows the run and steers it.
    looked : what the movie has shown, of an import. An import can be repeated: one that ends by an exception leaves
        no file, and the file that it was to replace stays.
    log : values of this program, which are recorded beside the run.
    """
    if console:
        refuse_without_packages()
    inputs = (*inputs, *files_of(config))
    if out is not None:  # before anything else: to solve the flow takes a while
        Output(out, MCAP, inputs, overwrite).check()
    prepared = prepare(config, known=looked.prepared if looked is not None else None)
    resolved = prepared.config
    realtime = realtime or "realtime" in RIGS[resolved.rig].needs
    timeout_s = guard_timeout_s(resolved) if realtime and resolved.rig != MOVIE else None
    output = Output(place_of_session(resolved, out, overwrite), MCAP, inputs, overwrite)
    if view == "rrd":
        Output(output.path.with_suffix(RRD[0]), RRD, inputs, overwrite).check()
    mission = _Mission(prepared, output, looked, realtime, timeout_s, control or Unattended(), log)
    with ExitStack() as stack:
        # From the first byte of the file to the last, every way to end the run leaves a complete file.
        mission.connect(stack)
        mission.refuse_stopped()
        mission.open_file(stack)
        watching = stack.enter_context(mission.watching(view, console))
        mission.fly(watching.sinks)
        ended = mission.close_file()
        watching.close(ended, VIEW_TIMEOUT_S if mission.run_control.reason else None)
    recorded = mission.result()
    if view == "rrd":
        _export_rrd(recorded, mission.run_control, overwrite)
    return recorded


class _Mission:
    """One run: its rig, its worker and its file. The methods are called once each, in the order that they stand in."""

    _worker: Worker
    _writer: SessionWriter
    _disk: DiskMonitor
    _report: RunReport
    _facts: Figures

    def __init__(
        self,
        prepared: Prepared,
        output: Output,
        looked: Looked | None,
        realtime: bool,
        timeout_s: float | None,
        control: Unattended,
        log: RunLog | None,
    ) -> None:
        """Make the rig, which is not connected yet.

        Parameters
        ----------
        looked, realtime, log : as of `run_mission`.
        timeout_s : of the watchdog; None: it has no timer.
        """
        config, pipeline = prepared.config, prepared.pipeline
        self._prepared, self._config, self._chip, self._pipeline = prepared, config, prepared.chip, pipeline
        self._output, self._folder = output, output.path.resolve().parent
        self._looked, self._realtime, self._control = looked, realtime, control
        self._source = {**prepared.facts, **(looked.facts if looked is not None else {})}  # for the head of the file
        self.run_control = control.run_control
        self._fields = field_of_session(Path(config.start.field), self._chip) if config.start.field else {}
        self._rig: Rig = RIGS[config.rig].load().of(pipeline, config, config.duration_s, realtime)
        if isinstance(self._rig, Connecting):
            self._rig.tell = warn
        self._watchdog = Watchdog(self._rig, timeout_s, partial(self.run_control.stop, zero=True), warn)
        self._statistics, self._clocks, self._judges = RunStatistics(), ClockMonitor(), judges_of(pipeline)
        self._joining: list[Joining] = [Streams(extra_rows(config), warn)] if config.topics else []
        self._streams: StreamInputs | None = None
        if config.streams:
            self._streams = StreamInputs(config.streams, self._rig, self.run_control, warn, log, realtime=realtime)
            self._joining.append(self._streams)
        self._opened: list[SessionWriter] = []  # the writer, once there is one: the thread of the signals looks here
        self._low: list[str] = []  # why the disk monitor has ended the run
        self._priorities: dict[str, str] = {}
        self._covered: Coverage | None = None

    def connect(self, stack: ExitStack) -> None:
        """Take the signals, connect the rig and start the worker; refuse what then shows, before there is a file."""
        config, chip, rig = self._config, self._chip, self._rig
        stack.enter_context(
            self._control.end_on_signals(
                self._watchdog, lambda: _close_in_thread(self._opened, self.run_control.reason)
            )
        )
        if isinstance(rig, Connecting):
            stack.enter_context(rig.connected())
        if self._streams is not None:
            setting = "pump.inlets" if config.pump.inlets else "pump.channel"
            self._streams.connect(stack, dict.fromkeys(config.pump.channels, setting))
        if isinstance(rig, Picturing) and (config.mission.check_axes or config.camera.trace_walls):
            picture = rig.picture()
            verdict = checked_image(picture, config, chip, "camera")
            self._source |= {"source_axes": verdict.text} if verdict is not None else {}
            if config.camera.trace_walls:
                self._take_walls(picture)
                config, chip = self._config, self._chip
        tried = self._realtime and config.recording.admission_s > 0.0
        if tried:
            say("getting ready: methods, first flow, trial of the camera")
        if tried or not kernels_cached():
            rehearse_aloud(config, self._control)
        adopt_after_s, pipeline = config.worker.adopt_after_s, self._pipeline
        worker: Worker = ProcessWorker(pipeline) if self._realtime else LockstepWorker(pipeline, adopt_after_s)
        stack.callback(worker.close)
        if tried:
            scene = config, chip, pipeline
            self._source |= admit(rig, worker, scene, self._fields, self._folder, self.run_control)
        self._worker = Preloaded(worker, self._fields) if self._fields else worker

    def _take_walls(self, picture: Image) -> None:
        """Let the stages, but not the rig, have the registration and the walls of the camera's picture (h, w)."""
        config, chip, found = as_pictured(self._config, self._chip, picture)
        if config is not self._config or chip is not self._chip:
            self._config, self._chip, self._pipeline = config, chip, assemble(config, chip)
            self._judges = judges_of(self._pipeline)
        if found:
            self._source["source_walls"] = found
            say(f"camera: {found}")

    def refuse_stopped(self) -> None:
        """Raise FlowrecError, with the status of a stop, where the run was stopped before it had a file."""
        if self.run_control.reason:
            error = FlowrecError(f"{self.run_control.reason}, before the mission began; nothing was recorded")
            error.exit_status = self.run_control.with_stop(Coverage(0, 1, "ticks")).status
            raise error

    def open_file(self, stack: ExitStack) -> None:
        """Open the file, and watch the disk that it is on."""
        self._writer = writer = stack.enter_context(
            session_writer(
                self._output,
                self._config,
                self._chip,
                live=self._realtime,
                in_pieces=True,
                derived=self._prepared.derived,
                facts=self._source,
                keep_failed=self._looked is None,
            )
        )
        self._opened.append(writer)
        floor_gb = self._config.recording.disk_floor_gb
        # Without `self`: a circle of references would keep the whole run in memory after its end.
        low, run_control = self._low, self.run_control

        def disk_low(reason: str) -> None:
            low.append(reason)
            run_control.stop(reason)

        disk = DiskMonitor(self._folder, lambda: writer.bytes_written, floor_gb, disk_low)
        self._disk = stack.enter_context(disk.running())
        stack.enter_context(CommandSocket(self._output.path, run_control, warn))

    def watching(self, view: View, console: bool) -> Watching:
        """Displays of the run."""
        disk, writer, duration_s = self._disk, self._writer, self._config.duration_s
        return Watching(
            view,
            (self._config, self._chip, self._output.path),
            partial(obey, self.run_control) if console else None,
            lambda: {
                "disk": disk.text,
                "file_mb": writer.bytes_written / 1e6,
                "duration_s": duration_s,
                "outputs": list(self.run_control.outputs),
            },
        )

    def fly(self, displays: Sequence[Sink]) -> None:
        """Run the loop until the mission ends."""
        writer = self._writer
        # A run that is not in real time never waits: with real-time priority it would occupy a core.
        priority = realtime_priority() if self._realtime else nullcontext(enter_result=False)
        with self._control.show_run(writer, self._disk) as show, priority as first:
            writes_first = first and writer.prioritise()

            def on_tick(tick: Tick) -> None:
                show(tick)
                _report_remarks(writer)

            self._report = run(
                self._pipeline,
                self._rig,
                self._worker,
                [writer, self._statistics, *self._judges, *displays],
                control=self.run_control,
                on_tick=on_tick,
                queue_state=lambda: (writer.queue_bytes / 1e6, writer.dropped_frames),
                clocks=self._clocks,
                watchdog=self._watchdog,
                paced=self._realtime,
                joining=self._joining,
            )
        if self._realtime:
            granted = {"loop_priority": first, "writer_priority": writes_first}
            self._priorities = {name: "real time" if each else "ordinary" for name, each in granted.items()}

    def _figures(self) -> Figures:
        """Figures of the run, with the reasons to doubt it."""
        config, rig, walls, report = self._config, self._rig, self._prepared.walls, self._report
        facts = figures_of(self._chip, report, self._statistics.true_field)
        if not self.run_control.reason:  # a run that is stopped ends at once
            facts |= shortest_way(report.last, self._pipeline.planner, self._chip, self._pipeline.robot)
        # Without navigation, and for a control law that descends the time to go, there is no reference.
        if not (config.mission.observes or config.control.needs):
            facts["tracking_error_um"] = self._statistics.tracking_error_um
        facts |= self._statistics.others
        if (latency := self._statistics.latency) is not None:
            facts["latency"] = latency
        if self._control.note:
            facts["note_not_finished"] = self._control.note
        doubted = [walls.text] if walls is not None and walls.other_scale else []
        refinement_facts, refinement_doubts = judge_refinement(
            report.last.refined, config, known_doubts=bool(doubted), still=self._chip.is_still
        )
        facts |= refinement_facts
        doubted += refinement_doubts
        if isinstance(rig, MovieRig):
            if rig.noticed:
                facts["note_movie"] = "; ".join(rig.noticed)
            self._covered = self.run_control.with_stop(Coverage(rig.taken, rig.images, "images"))
            facts["covered"] = self._covered.amount
        doubted += [doubt for judge in self._judges for doubt in judge.doubts()]
        if self._looked is not None:
            doubted = [*self._looked.doubts, *doubted]
        if doubts := doubts_text(doubted):
            facts[DOUBTS] = doubts
        return facts

    def close_file(self) -> RunEnded:
        """Close the file with its outcome; soon, if the run was stopped."""
        writer, report = self._writer, self._report
        self._facts = self._figures()
        outcome = as_text(self._facts) | self._clocks.outcome() | self._priorities
        bad = "" if report.outcome in GOOD_ENDS else f"the run ended {report.outcome}: {report.note}".rstrip(": ")
        writer.close(outcome, CLOSE_TIMEOUT_S if self.run_control.reason else None, why=bad)
        _report_remarks(writer)
        files = files_text(self._output.path, tuple(writer.files))
        return RunEnded.of(self._facts, report.last.refined, files)

    def result(self) -> Recorded:
        """The result, after all is closed."""
        self._facts["frames_dropped"] = self._writer.dropped_frames  # the writer has added it to the file's outcome
        return Recorded(
            self._output.path,
            self._report,
            self._facts,
            tuple(self._writer.files),
            self._prepared.derived,
            self._low[0] if self._low else "",
            bool(self.run_control.reason),
            self._source,
            self._covered,
        )


def _export_rrd(recorded: Recorded, control: RunControl, overwrite: bool) -> None:
    """Write an .rrd of each session of a run and add it to the facts; after a stop, say how to make it."""
    if control.reason:
        say(f"the run was stopped: no .rrd was made; flowrec export {recorded.path} makes it")
        return
    from flowrec.exports import export

    for name in recorded.sessions:
        recorded.facts["rrd"] = str(export(name, overwrite=overwrite))


def _close_in_thread(opened: list[SessionWriter], reason: str) -> str:
    """Close the file while the main thread hangs; return a message about the file.

    Runs in the thread of the signals, and does not wait if the main thread hangs in the writer.
    """
    if not opened:
        return ""
    writer = opened[0]

    def close() -> None:
        with suppress(SessionError):  # what was written stays in the partial file
            writer.close(
                {"outcome": Outcome.FAILED, "note": f"{reason}; the main thread did not answer"}, CLOSE_TIMEOUT_S
            )

    thread = threading.Thread(target=close, name="give up", daemon=True)
    thread.start()
    thread.join(_GIVE_UP_TIMEOUT_S)
    if writer.partial_path.exists():
        return f"flowrec recover {shell_word(writer.partial_path)} makes a session of what was recorded"
    return f"the file is whole: {files_text(writer.path, tuple(writer.files))}"


def _report_remarks(writer: SessionWriter) -> None:
    while writer.remarks:
        say(writer.remarks.popleft())
