import sys

from .control import RunControl as RunControl
from .disk_monitor import DiskMonitor as DiskMonitor, refuse_below as refuse_below
from .loop import Joining as Joining, RunReport as RunReport, Sink as Sink, run as run
from .operator_commands import (
    COMMANDS as COMMANDS, GOAL as GOAL, HAND as HAND, HELP as HELP, LONGEST_NOTE as LONGEST_NOTE, NOTE as NOTE, OUTPUT as OUTPUT, SPEED as SPEED,
    obey as obey,
)
from .recorded import RecordedRig as RecordedRig
from .remote_control import CommandSocket as CommandSocket, RemoteControl as RemoteControl
from .replay_figures import (
    CommandDifference as CommandDifference, ReplayFiles as ReplayFiles, ReplayPair as ReplayPair,
    before_after as before_after,
)
from .stream_inputs import StreamInputs as StreamInputs, Streams as Streams
from .watchdog import Watchdog as Watchdog
from .worker_process import ProcessWorker as ProcessWorker
from .workers import (
    LockstepWorker as LockstepWorker, Preloaded as Preloaded, ReplayWorker as ReplayWorker, Worker as Worker,
    messages_read as messages_read,
    work as work,
)

if sys.platform != "win32":
    from .keyboard import keyboard_of as keyboard_of
    from .signals import Signals as Signals
