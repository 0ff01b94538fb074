"""`flowrec push`: sessions copied into a bucket."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flowrec.core import Ended, StoppedError
from flowrec.verbs import Asked, Told, verb

if TYPE_CHECKING:
    from flowrec.archive.push import Pushed


def _output_of(_asked: Asked, done: "Pushed | StoppedError") -> Told:
    if isinstance(done, StoppedError):  # not after the parts that are being sent, which may take minutes
        return Told(exit_status=done.exit_status, remarks=lambda: [str(done)], ends_at_once=True)
    return Told(
        done.as_json,
        exit_status=done.exit_status,
        remarks=lambda: [f"not pushed: {text}" for text in done.failed.values()],
    )


@verb("flowrec push a.mcap s3://lab/runs", "flowrec push runs/*.mcap s3://lab/2026", result=_output_of)
def push(
    sessions: Annotated[
        list[Path],
        typer.Argument(metavar="SESSION...", help="Sessions (.mcap), or runs in parts; their notes go with them."),
    ],
    target: Annotated[str, typer.Argument(metavar="s3://BUCKET/FOLDER", help="Folder in a bucket of S3.")],
) -> "Pushed | StoppedError":
    """Copy sessions into a bucket of S3, checked before and compared after; an interrupted copy goes on.

    Credentials come from the environment (AWS_ACCESS_KEY_ID, ...), the address of another store than Amazon's, too
    (AWS_ENDPOINT_URL). No object is replaced by other content.
    """
    from flowrec.archive.push import push as run

    try:
        return run(sessions, target)
    except KeyboardInterrupt as error:
        return StoppedError(Ended.of(error), "what was sent stays in the bucket, and the same command goes on")
