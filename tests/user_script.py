"""What a user writes: .ci/run checks it with mypy --strict against the installed package; it is never run."""

from pathlib import Path

import numpy as np

import flowrec


def main(path: Path) -> None:
    """Read, solve, refine, replay and export."""
    session = flowrec.open(path)
    print(session.outcome["outcome"], session.config.plan.method, session.duration_s)
    positions = np.array([message.position_um for message in session.messages("track")])
    print(positions.mean(axis=0), session.table("track").num_rows, len(session.frames))
    for tick in session.ticks(0.5, with_frames=False):
        if tick.field is not None:
            print(tick.stamp_ns, tick.field.method, tick.field.error_share)
            break
    replay = flowrec.replay(session, refine="assimilate", sets={"robot.um_per_rev": 24.0})
    print(replay.before_after, replay.result.outcome)
    assumed = flowrec.solve(session.chip.mask, um_per_px=session.chip.um_per_px)
    refined = flowrec.refine(session.chip, np.array([[800.0, 700.0, 120.0, 5.0]]))
    print(assumed.velocity_um_s.max(), refined.note)
    print(flowrec.export(session, file_format="csv"), flowrec.check(session).word)
