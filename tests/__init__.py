"""The tests, and the measurements in `tests/perf`."""

import os
import sys

# Processes that the tests start compile no source that an earlier one has compiled, also where the user wants no
# bytecode: those of a run are some hundred, and the sources of flowrec take a third of a second of each.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# The workers share the cores, and idle threads of BLAS and OpenMP spin: one thread, also in the processes that tests
# start; set before anything imports NumPy. tests/stages/refine/test_blas_threads.py gives itself two.
os.environ.setdefault("OMP_NUM_THREADS", "1")
