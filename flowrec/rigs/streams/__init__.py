"""Streams of other programs and devices: a row each, read by run/stream_reader.py."""
