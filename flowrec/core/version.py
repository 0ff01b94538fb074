"""Versions that every session states; that of the file format stands in store/session_metadata.py.

A session without a version of the numerics is of version 1, the first release.
"""

__version__ = "0.1.0"
# 5: error bars are at least as wide as what no cause explains; `gain` states no spread where nothing flows.
# 4: all walls may be off by the same distance.
# 3: the assimilation knows the robot, the depth, the pump and a structural error as unknowns.
# 2: velocities of a flow field are values at pixel centres; in version 1 they were means over pixels.
NUMERICS_VERSION = 7  # to be raised when a stage or a solver gives other numbers than before for the same inputs
