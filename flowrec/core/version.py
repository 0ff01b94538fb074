"""Versions that every session states; that of the file format stands in store/session_metadata.py.

A session without a version of the numerics is of version 1, the first release.
"""

__version__ = "0.1.0"
# 10: that the inflow is a power of two times the stated one, or reversed, is a hypothesis of the refinement.
# 9: a stretch of a tracer's way counts only if nearly all images show the tracer; ways may be of one stretch.
# 8: tracers count by the length of way that they went, whatever their number; 2000 stretches are of the whole run.
# 7: a refined flow states the um per revolution as a line over the drag of the side walls.
# 6: what a robot misses near its step-out frequency is a cause of its own.
# 5: error bars are at least as wide as what no cause explains; `gain` states no spread where nothing flows.
# 4: all walls may be off by the same distance.
# 3: the assimilation knows the robot, the depth, the pump and a structural error as unknowns.
# 2: velocities of a flow field are values at pixel centres; in version 1 they were means over pixels.
NUMERICS_VERSION = 10  # to be raised when a stage or a solver gives other numbers than before for the same inputs
