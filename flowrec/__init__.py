"""Experiment recorder and replay tool for magnetic micro-robots that swim in flow.

    import flowrec

    session = flowrec.open("a.mcap")          # only reads; nothing is loaded before it is used
    session.outcome, session.at(3.0), session.fields["refined"]
    flowrec.record(flowrec.load_config("my.toml"), "b.mcap")
    session.table("track").to_pandas()        # every topic as a table, units in the names of the columns
    flowrec.replay(session, refine="assimilate").before_after
    flowrec.refine("chip.png", "measured.csv").plot()

Every name is imported when it is first used: `import flowrec` takes milliseconds.
"""

from __future__ import annotations

import importlib

from flowrec.version import __version__ as __version__

TYPE_CHECKING = False  # as in typing, whose import takes longer than all the rest
if TYPE_CHECKING:  # the same names as in the table below, for type checkers and editors
    from typing import Any

    from flowrec.commands.check import check as check
    from flowrec.commands.compare import compare as compare
    from flowrec.commands.export import export as export
    from flowrec.commands.import_movie import import_movie as import_movie
    from flowrec.commands.info import info as info
    from flowrec.commands.record import record as record
    from flowrec.commands.replay import Change as Change
    from flowrec.commands.replay_api import Replay as Replay
    from flowrec.commands.replay_api import replay as replay
    from flowrec.commands.report import report as report
    from flowrec.config import Config as Config
    from flowrec.config import load_config as load_config
    from flowrec.errors import FlowrecError as FlowrecError
    from flowrec.refine.user_flow import refine as refine
    from flowrec.refine.user_flow import solve as solve
    from flowrec.replay_figures import before_after as before_after
    from flowrec.session import Session as Session
    from flowrec.session import open as open  # noqa: A004 - flowrec.open
    from flowrec.store.recovery import recover as recover

_MODULES = {
    "Change": "commands.replay",
    "Config": "config",
    "FlowrecError": "errors",
    "Replay": "commands.replay_api",
    "Session": "session",
    "before_after": "replay_figures",
    "check": "commands.check",
    "compare": "commands.compare",
    "export": "commands.export",
    "import_movie": "commands.import_movie",
    "info": "commands.info",
    "load_config": "config",
    "open": "session",
    "record": "commands.record",
    "recover": "store.recovery",
    "refine": "refine",  # a callable package: the name of a package can not be that of a function beside it
    "replay": "commands.replay_api",
    "solve": "refine.user_flow",
    "report": "commands.report",
}
__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'flowrec' has no attribute {name!r}")
    module = importlib.import_module(f"flowrec.{_MODULES[name]}")
    found = globals()[name] = module if _MODULES[name] == name else getattr(module, name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *_MODULES})
