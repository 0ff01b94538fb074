"""Steps of a mission whose robot is not in sight. MissionStateMachine describes the limits that they take."""

from __future__ import annotations

from dataclasses import replace

from flowrec.core import Mission, Outcome, Phase, seconds
from flowrec.stages.control.mission_steps import MissionInputs, elapsed_s, finish

IN_VIEW = "is it in view (camera.um_per_px), and of the size in robot.radius_um?"


def end_if_lost(previous: Mission, now: MissionInputs, find_limit_s: float, lost_limit_frames: int) -> Mission | None:
    """The end of a run whose robot was not found, or not seen for too many frames.

    A camera that was absent and is back has as much time to find the robot as in the beginning.
    """
    absent_ns = now.applied.absent_until_ns if now.applied is not None else None
    if now.track.seen or (absent_ns is not None and seconds(now.now_ns - absent_ns) <= find_limit_s):
        return None
    if previous.phase == Phase.START:
        if now.refused:
            return finish(previous, now, Outcome.NOT_FOUND, now.not_found_note)
        seen_ns = now.track.seen_ns
        if seen_ns is not None and seconds(now.now_ns - seen_ns) <= find_limit_s:
            return None  # it was found, and this image does not show it
        if elapsed_s(previous, now) > find_limit_s:
            note = f"no robot seen in the image for {find_limit_s:g} s; {IN_VIEW}"
            return finish(previous, now, Outcome.NOT_FOUND, now.with_advice(note))
    elif now.track.lost_frames > lost_limit_frames:
        why = f"{previous.blind}, " if previous.blind else "robot not seen in "
        return finish(previous, now, Outcome.LOST, f"{why}{now.track.lost_frames} frames")
    return None


def without_sight(
    previous: Mission, now: MissionInputs, hold_after_s: float, zero_after_s: float, find_limit_s: float
) -> Mission:
    """Without sight of the robot: hold it, then switch the field off, then end; continue when it is seen again.

    If it was carried too far off its route meanwhile, a new one is planned as after any other disturbance. While
    the camera is absent the field is off; the rig says when that has lasted too long.
    """
    applied, now_ns, seen_ns = now.applied, now.now_ns, now.track.seen_ns
    if applied is None or seen_ns is None or applied.image_since_ns is None:  # never seen yet, or an older session
        return previous
    if now.track.seen:
        if previous.blind_since_ns is None:
            return previous
        return replace(previous, stamp_ns=now_ns, blind_since_ns=None, blind="", field_off=False)
    absent_ns = applied.absent_until_ns
    if applied.without_image:
        if previous.field_off:
            return previous
        since_ns = now_ns if previous.blind_since_ns is None else previous.blind_since_ns
        why = f"no image since {seconds(applied.image_since_ns):.1f} s: the camera is absent"
        return replace(previous, stamp_ns=now_ns, blind_since_ns=since_ns, blind=why, field_off=True)
    unseen_s = seconds(now_ns - (seen_ns if absent_ns is None else max(seen_ns, absent_ns)))
    why = f"robot not seen since {seconds(seen_ns):.1f} s"
    if applied.repeats_image:
        why = f"the camera repeats one image since {seconds(applied.image_since_ns):.1f} s"
    if unseen_s >= zero_after_s + find_limit_s:
        return finish(previous, now, Outcome.LOST, why)
    if unseen_s >= zero_after_s and not previous.field_off:
        since_ns = now_ns if previous.blind_since_ns is None else previous.blind_since_ns
        return replace(previous, stamp_ns=now_ns, blind_since_ns=since_ns, blind=why, field_off=True)
    if unseen_s >= hold_after_s and previous.blind_since_ns is None:
        return replace(previous, stamp_ns=now_ns, blind_since_ns=now_ns, blind=why)
    return previous
