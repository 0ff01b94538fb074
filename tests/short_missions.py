"""Settings of short missions: without what conftest loads, for processes that tests start."""

from collections.abc import Iterable

# A short survey, no check of the axes before it, and no doubt about the depth of the chip, which makes a refinement
# three times as long: most tests are about something else. The recorded sessions in `sessions/` have the latter.
SMALL = [
    "camera.width_px=320",
    "camera.height_px=256",
    "simulated.seed=1",
    "simulated.world=kind",
    "survey.method=downstream",
    "refine.assimilate.doubt_depth=false",
    "recording.admission_s=0",  # what the machine holds beside all other tests is of no interest
    "recording.own_process=false",  # which loads its own libraries, for longer than the mission takes
    "mission.check_axes=false",
    "mission.goal=outlet",
]

# In real time, and still under way however long a busy machine takes for what a test does meanwhile.
LONG = [*SMALL, "recording.own_process=true", "mission.hold_start_s=100", "safety.guard_timeout_s=20"]


def set_words(sets: Iterable[str]) -> list[str]:
    """Settings as words of a command."""
    return [word for each in sets for word in ("--set", each)]
