"""Ticks to Rerun: the only room that imports rerun."""
