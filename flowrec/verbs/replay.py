"""`flowrec replay`: run the pipeline again on a recorded session, the same or with other methods and settings."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from flowrec.core import REPLAYED
from flowrec.verbs.command import MethodsOf, MisuseError, Told, verb
from flowrec.verbs.options import AS_THE_COMMAND, ATTENDED, Asked, Overwrite, SessionFile, Sets

if TYPE_CHECKING:
    from flowrec.verbs.interactive import Unattended
    from flowrec.verbs.replay_change import Change
    from flowrec.verbs.replay_result import Replay

DEFAULT_REFINE = "pi_unet"


def _output_of(asked: Asked, done: "Replay") -> Told:
    session: Path = asked["session"]
    if asked["verify"]:
        return Told.of(done, session=session)
    covered = done.covered
    return Told(
        lambda: {"session": str(session), "out": str(done.file), **done.changes_as_json()},
        lambda: done.show_changes(session.name),
        covered.status if covered.stopped else 3 if done.doubts else 0,
    )


@verb("flowrec replay a.mcap --refine", "flowrec replay a.mcap --plan astar_time --refly -o b.mcap", result=_output_of)
def replay(
    session: SessionFile,
    change: "Change | None" = None,
    from_s: Annotated[float | None, typer.Option("--from", metavar="TIME", help="Resume at this second.")] = None,
    verify: Annotated[bool, typer.Option("--verify", help="Compare with the recording, message by message.")] = False,
    out: Annotated[Path | str | None, typer.Option("--out", "-o", help="Session file of the replay.")] = None,
    overwrite: Overwrite = False,
    frames: Annotated[bool, typer.Option("--frames", help="Copy the camera images into the replay's file.")] = False,
    control: Annotated["Unattended | None", ATTENDED] = None,
    *,
    refine: Annotated[
        str | None,
        typer.Option(metavar="[METHOD]", help=f"Refine the flow again; without a method: {DEFAULT_REFINE}."),
        MethodsOf(REPLAYED["refine"]),
    ] = None,
    plan: Annotated[
        str | None, typer.Option(metavar="METHOD", help="Plan with another planner."), MethodsOf(REPLAYED["plan"])
    ] = None,
    observer: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Estimate with another observer."),
        MethodsOf(REPLAYED["observer"]),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Control with another control law."),
        MethodsOf(REPLAYED["controller"]),
    ] = None,
    sets: Sets = None,
    refly: Annotated[
        bool,
        typer.Option(
            "--refly", help="Fly both plans in a simulator, in the true flow if it is known, else the replay's map."
        ),
    ] = False,
    jobs: Annotated[int, typer.Option(metavar="N", help="Processes of --verify; 0: one a core.")] = 1,
    view: Annotated[Literal["rrd", "none"], typer.Option(help="Write an .rrd of both, side by side.")] = "none",
    numbered: Annotated[bool, AS_THE_COMMAND] = False,
) -> "Replay":
    """Run the pipeline again on a recorded session, with the same or other methods, and compare.

    >>> done = flowrec.replay("a.mcap", refine="assimilate", sets={"robot.um_per_rev": 24})
    >>> print(done.before_after)
    >>> done.table("estimate").to_pandas()

    The recording is only read. Any thread may call it.

    Parameters
    ----------
    change : methods and settings as one object, instead of refine, plan, observer, controller and sets.
    control : who attends the replay; None: nobody, it takes no signals and shows no progress.
    numbered : without `out` the replay is SESSION_replay_NNN.mcap beside the session, with the first free number, and
        a verification writes none; False: it is a temporary file.

    Notes
    -----
    Long because its parameters are the options of the verb.

    Raises
    ------
    UsageError : a change that is not possible, or a time outside of the session.
    SessionError : the session can not be read or replayed, or `out` not be written.
    """
    if verify and refly:
        raise MisuseError("--verify only compares; it goes without --refly")
    from flowrec.verbs.replay_change import Change

    named = Change(refine, plan, observer, controller, sets or ())
    if change is not None and named != Change():
        raise MisuseError("change and the names of methods or settings: give one of them")
    change = change or named
    if jobs != 1 and not verify:
        raise MisuseError("--jobs goes with --verify: in a changed replay each tick depends on those before")
    if jobs != 1 and (change != Change() or out is not None):
        raise MisuseError("--verify --jobs only compares: it goes without --refine, --set, --out ...")
    from flowrec.verbs.replay_made import make_replay

    if jobs != 1:
        from flowrec.verbs.replay_segments import verify as verify_in_segments

        return verify_in_segments(session, jobs, from_s, control)
    return make_replay(
        session,
        change,
        from_s,
        None if out is None else Path(out),
        verify=verify,
        overwrite=overwrite,
        frames=frames,
        control=control,
        numbered=numbered,
        fly=refly,
        rrd=view == "rrd",
    )
