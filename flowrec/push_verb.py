"""The verb push: arguments in, exit status out."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from flowrec.bench.verbs import AsJson


def push(
    sessions: Annotated[
        list[Path],
        typer.Argument(metavar="SESSION...", help="Sessions (.mcap), or runs in parts; their notes go with them."),
    ],
    target: Annotated[str, typer.Argument(metavar="s3://BUCKET/FOLDER", help="Folder in a bucket of S3.")],
    as_json: AsJson = False,
) -> None:
    """Copy sessions into a bucket of S3, checked before and compared after; an interrupted copy goes on.

    Credentials come from the environment (AWS_ACCESS_KEY_ID, ...), the address of another store than Amazon's, too
    (AWS_ENDPOINT_URL). No object is replaced by other content.
    """
    from flowrec.commands.push import push as run
    from flowrec.terminal import say

    try:
        done = run(sessions, target)
    except KeyboardInterrupt:
        say("interrupted; what was sent stays in the bucket, and the same command goes on")
        sys.stdout.flush()
        os._exit(130)  # not after the parts that are being sent, which may take minutes
    if as_json:
        typer.echo(json.dumps(done.as_json()))
    for text in done.failed.values():
        say(f"not pushed: {text}")
    raise typer.Exit(done.exit_status)
