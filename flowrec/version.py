"""Versions that every session states; that of the file format stands in store/session_metadata.py.

A session without a version of the numerics is of version 1, the first release.
"""

__version__ = "0.1.0"
NUMERICS_VERSION = 1  # to be raised when a stage or a solver gives other numbers than before for the same inputs
