"""flowrec: flight recorder and replay lab for magnetic micro-robots that swim in flow."""

__version__ = "0.1.0"
