"""`python -m flowrec`."""

from flowrec.cli import main

main()
