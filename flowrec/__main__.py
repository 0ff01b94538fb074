"""`python -m flowrec`, and the command `flowrec`: a signal ends it in one line, from before its imports."""

import os
import signal

_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


def main() -> None:
    """Entry point."""
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _end_at_once)
    from flowrec.core import one_line_at_the_end

    with one_line_at_the_end():
        from flowrec.verbs import main as command_line

        command_line()


def _end_at_once(number: int, _frame: object) -> None:
    """Before the imports of what else deals with signals."""
    os.write(2, f"flowrec: stopped ({signal.Signals(number).name})\n".encode())
    os._exit(128 + number)


if __name__ == "__main__":
    main()
