"""The session clock, and the other clocks of a run relative to it."""
