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

import sys
from typing import Any

import lazy_loader

from flowrec.core.version import __version__ as __version__

_attribute, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    try:
        return _attribute(name)
    except AttributeError as error:  # with the module, Python adds the nearest name
        raise AttributeError(f"flowrec has no {name!r}", name=name, obj=sys.modules[__name__]) from error
