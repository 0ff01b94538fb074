"""`python -m flowrec`, and the command `flowrec`: a signal ends it in one line, from before its imports."""

from flowrec.system.endings import one_line_at_the_end


def main() -> None:
    """Entry point."""
    with one_line_at_the_end():
        from flowrec.cli import main as command_line

        command_line()


if __name__ == "__main__":
    main()
