"""`flowrec record`: run a mission on a rig and write every stage to one session file."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, Union

import typer

from flowrec.core import View
from flowrec.verbs.command import MisuseError, Told, verb
from flowrec.verbs.options import (
    AS_THE_COMMAND,
    ATTENDED,
    OF_A_CALL,
    AsConfig,
    Asked,
    Overwrite,
    SessionOut,
    Sets,
    readable_toml,
)

if TYPE_CHECKING:
    from flowrec.rigs import RunLog
    from flowrec.stages import Config
    from flowrec.verbs.doctor import Diagnosis
    from flowrec.verbs.interactive import Unattended
    from flowrec.verbs.run_summary import Recorded


class DryRun(NamedTuple):
    """A run that was prepared only.

    Attributes
    ----------
    config : resolved on its chip; for `short` as asked, of which only what differs from the defaults is printed.
    diagnosis : what the doctor finds, which looks when it is asked; None where the rig is not a lab's.
    """

    config: "Config"
    short: bool
    diagnosis: "Diagnosis | None"

    @property
    def exit_status(self) -> int:
        """1 if a device has failed."""
        return self.diagnosis.exit_status if self.diagnosis is not None else 0

    def show(self) -> None:
        """Print the configuration, then what the doctor finds, which a thousand lines would hide before them."""
        from flowrec.core import say
        from flowrec.stages import commented_toml

        typer.echo(commented_toml(self.config, self.short), nl=False)
        if self.diagnosis is not None:
            for line in self.diagnosis.lines():
                say(line)
            say("nothing was energised")


def _record_told(_asked: Asked, done: "Recorded | DryRun") -> Told:
    # Of a run that was stopped the file is complete and the coils are off: nothing delays its end.
    return Told.of(done)._replace(ends_at_once=not isinstance(done, DryRun) and done.stopped)


@verb(
    "flowrec record --goal 4400,1500",
    "flowrec record lab.toml -o run.mcap --split 2GB,10min",
    "flowrec record --console --realtime --set mission.wait_at_goal_s=600",
    result=_record_told,
)
def record(
    config: Annotated[
        AsConfig, typer.Argument(callback=readable_toml, help="Configuration (TOML); else flowrec.toml of this folder.")
    ] = None,
    out: SessionOut = None,
    view: Annotated[View, typer.Option(help="Watch live (spawn, serve) or write an .rrd at the end.")] = "none",
    realtime: Annotated[bool, typer.Option("--realtime", help="Run the simulated rig in real time.")] = False,
    overwrite: Overwrite = False,
    control: Annotated["Unattended | None", ATTENDED] = None,
    *,
    rig: Annotated[str | None, typer.Option(help="Rig to use: simulated, movie, lab.")] = None,
    goal: Annotated[
        str | tuple[float, float] | None, typer.Option(metavar="X,Y", help="Goal in um, or inlet, outlet, outlet:1.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the simulated rig.")] = None,
    sets: Sets = None,
    console: Annotated[
        bool,
        typer.Option(
            "--console",
            help="Serve a page on this machine: buttons, goal by a click, large stop; view --live --console adds it.",
        ),
    ] = False,
    duration_s: Annotated[
        float | None, typer.Option("--duration", metavar="S", help="Stop after this many seconds.")
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Energise nothing: check mission and devices, print the resolved configuration."
        ),
    ] = False,
    short: Annotated[
        bool, typer.Option("--short", help="With --dry-run: only the settings that differ from their defaults.")
    ] = False,
    split: Annotated[
        str | None,
        typer.Option(metavar="SIZE|TIME", help="Begin another file after this size or time, or both: 2GB,10min."),
    ] = None,
    snapshot: Annotated[
        str | None,
        typer.Option(metavar="TIME[,TIME]", help="Record only the time before and after marks and alarms: 30s,10s."),
    ] = None,
    accept_losses: Annotated[
        bool,
        typer.Option("--accept-losses", help="In real time: record also where images will be lost, or writing fails."),
    ] = False,
    sign: Annotated[
        Path | None, typer.Option(metavar="KEY", help="Sign the session with this SSH key when it is complete.")
    ] = None,
    movie_in_time: Annotated[bool, AS_THE_COMMAND] = False,
    log: Annotated["RunLog | None", OF_A_CALL] = None,
) -> "Union[Recorded, DryRun]":  # noqa: UP007 - as text
    """Run a mission (survey, refine, plan, navigate) and record every stage.

    Parameters
    ----------
    control : who attends the run; None: nobody, it takes no signals and no keys and shows no progress.
    movie_in_time : a movie is taken in real time; False: as fast as it can be read.
    log : values that this program gives while the run goes on, `log.log("pump/pressure", time.monotonic_ns(), 2.1e4)`:
        they are recorded as the stream `log`, unless a section [streams.NAME] of the kind `log` takes them.

    Notes
    -----
    The field is off before this function returns or raises, whatever the exception; also for KeyboardInterrupt. Any
    thread may call it.

    Long because its parameters are the options of the verb.

    Raises
    ------
    FlowrecError : any of its kinds; a stage, a rig or a worker may raise others.
    """
    from flowrec.core import settings_of

    given = settings_of(sets or ())
    flags: dict[str, str] = {}
    for flag, value, settings in (
        ("--rig", rig, lambda: {"rig": rig}),
        ("--goal", goal, lambda: {"mission.goal": _read("--goal 4400,1500", _goal, goal)}),
        ("--seed", seed, lambda: {"simulated.seed": seed}),
        ("--duration", duration_s, lambda: {"duration_s": duration_s}),
        ("--split", split, lambda: _read("--split 2GB,10min", _split, split)),
        ("--snapshot", snapshot, lambda: _read("--snapshot 30s,10s", _snapshot, snapshot)),
        ("--accept-losses", accept_losses or None, lambda: {"recording.accept_losses": True}),
    ):
        if value is not None:
            found = settings()
            given |= found
            flags |= dict.fromkeys(found, flag)
    chosen, inputs = config_of_call(config, given, flags)
    from flowrec.stages import LOG, MOVIE, with_sets

    if log is not None and LOG not in chosen.streams:
        chosen = with_sets(chosen, {f"streams.{LOG}.kind": LOG})

    path = None if out is None else Path(out)
    if short and not dry_run:
        raise MisuseError("prints a part of what --dry-run prints; give both", "--short")
    from flowrec.core import MCAP, Output

    if path is not None:  # before imports and before the flow is solved
        read = [*inputs, Path(chosen.start.field)] if chosen.start.field else inputs
        Output(path, MCAP, tuple(read), overwrite).check()
    if dry_run:
        from flowrec.verbs.diagnosis import diagnose
        from flowrec.verbs.doctor import Diagnosis
        from flowrec.verbs.preparation import prepare

        resolved = prepare(chosen).config
        findings = diagnose(chosen, inputs[0] if inputs else None, path.parent if path is not None else None)
        return DryRun(chosen if short else resolved, short, Diagnosis(findings) if chosen.rig == "lab" else None)
    from flowrec.store import refuse_unusable_key, sign_file
    from flowrec.verbs.mission_run import run_mission

    realtime = realtime or (movie_in_time and chosen.rig == MOVIE)
    if sign is not None:
        refuse_unusable_key(sign)
    recorded = run_mission(chosen, path, view, realtime, overwrite, control, inputs, console=console, log=log)
    if sign is not None:
        for file in recorded.sessions:
            sign_file(file, sign, overwrite=False)
    return recorded


def config_of_call(
    config: "Config | Path | str | None", sets: Mapping[str, Any], flags: Mapping[str, str]
) -> "tuple[Config, list[Path]]":
    """The configuration of a call with settings over it, and the file that was read."""
    file = Path(config) if isinstance(config, Path | str) else None
    from flowrec.stages import Config, load_config, with_sets

    if isinstance(config, Config):
        return (with_sets(config, sets, flags) if sets else config), []
    return load_config(file, sets, flags), [file] if file is not None else []


def _read(example: str, parse: Callable[[Any], Any], given: Any) -> Any:
    """Parse the value of an option; a text that has no meaning raises an error with an example."""
    try:
        return parse(given)
    except ValueError as error:
        raise MisuseError(f"{error}; as in {example}", example.partition(" ")[0]) from error


def _split(text: str) -> dict[str, float]:
    """`2GB`, `10min` or both, as settings."""
    from flowrec.core import amounts

    asked = amounts(text)
    if max(map(len, asked.values())) > 1:
        raise ValueError("one size, one time, or both")
    return {f"recording.split_{unit}": values[0] for unit, values in asked.items() if values}


def _snapshot(text: str) -> dict[str, float]:
    """`30s,10s` as settings: the time before and, if given, the time after."""
    from flowrec.core import amounts

    asked = amounts(text)
    if asked["mb"] or not 1 <= len(asked["s"]) <= 2:
        raise ValueError("the time before and, if 10 s is not it, the time after")
    keys = ("recording.snapshot_before_s", "recording.snapshot_after_s")
    return dict(zip(keys, asked["s"], strict=False))


def _goal(given: str | tuple[float, float]) -> Any:
    """`4400,1500` as a pair; a name stays a name, and a pair a pair."""
    if not isinstance(given, str):
        return given
    try:
        numbers = [float(part) for part in given.split(",")]
    except ValueError:
        return given
    if len(numbers) != 2:
        raise ValueError(f"{given!r}: a point is two numbers in um")
    return numbers
