"""What is unfinished of a run, made whole: one file, or parts and snapshots."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from flowrec.errors import SessionError
from flowrec.store.metadata import Part
from flowrec.store.part_continuity import goes_on, unfinished_of
from flowrec.store.paths import PARTIAL_SUFFIX, part_number, part_path, parts
from flowrec.store.reader import SessionReader
from flowrec.store.recovery import NothingSavedError, Recovered, recover
from flowrec.store.writer import SessionWriter

_REMAINS_SUFFIX = ".remains"


def recover_run(path: Path, out: Path | None = None) -> list[Recovered]:
    """Recover a file as `recover` does or, where X.mcap is no file, whatever is unfinished of that run.

    Where there is no whole tick in the last part, one is made that holds nothing but the end of the part before, so
    that the run has an end; the remains are put aside as NAME.remains.

    Raises
    ------
    SessionError : as `recover`; `out` where there are several files; parts that are no run.
    """
    left = unfinished_of(path)
    if path.exists() or not (left or parts(path)):
        return [recover(path, out)]
    if out is not None and len(left) != 1:
        raise SessionError(f"{path}: is a run with {len(left)} unfinished files; recover it without --out, or name one")
    done = []
    for file in left:
        try:
            done.append(recover(file, out))
        except NothingSavedError:
            number = part_number(file)
            if number < 2 or number <= len(parts(path)):
                raise
            file.rename(file.with_name(file.name.removesuffix(PARTIAL_SUFFIX) + _REMAINS_SUFFIX))
    finished = parts(path)
    if finished:
        with SessionReader(finished[-1]) as last:
            if last.part is not None and goes_on(last.outcome):
                done.append(_end_of_run(path, last, last.part))
    if not done:
        with SessionReader(path) as whole:
            done = [Recovered(path, whole.counts.get("track", 0), whole.duration_s, changed=False)]
    return done


def _end_of_run(path: Path, last: SessionReader, part: Part) -> Recovered:
    """The part that `last` says to follow and of which nothing is left."""
    target = part_path(path, part.number + 1)
    header = replace(last.header, part=Part(part.run, part.number + 1, carried_ns=last.last_ns))
    lost = f"everything after {last.path.name}"
    with SessionWriter(target, header, block=True) as writer:
        writer.write(replace(last.tick_before(last.last_ns), stamp_ns=last.last_ns))
        writer.close({"outcome": "cut", "note": f"lost: {lost}", "recovered_from": last.path.name})
    return Recovered(target, 0, 0.0, lost=lost)
