"""`python -m flowrec`, and the command `flowrec`: a signal ends it in one line, from before its imports."""

import gc
import os
import signal
import sys

_NEW_OBJECTS = 10_000  # between two collections of garbage: with Python's 700 they are a tenth of every start
_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


def main() -> None:
    """Entry point."""
    gc.set_threshold(_NEW_OBJECTS)
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end_at_once)
    _open_closed_streams()
    from flowrec.core import one_line_at_the_end

    with one_line_at_the_end():
        from flowrec.verbs import main as command_line

        command_line()


def _open_closed_streams() -> None:
    """Let closed standard streams (`flowrec ... >&-`) lead nowhere: a session that is opened would take their place."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            if (found := os.open(os.devnull, os.O_RDWR)) != number:
                os.dup2(found, number)
                os.close(found)
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115 - for the process


def _end_at_once(number: int, _frame: object) -> None:
    """Before the imports of what else deals with signals."""
    os.write(2, f"flowrec: stopped ({signal.Signals(number).name})\n".encode())
    os._exit(128 + number)


if __name__ == "__main__":
    main()
