"""How much memory a process has needed."""

from __future__ import annotations

import re
from pathlib import Path


def peak_mb() -> float:
    """Largest memory of this process so far, in MB, of Linux; NaN elsewhere.

    getrusage's would include that of the parent before the exec.
    """
    status = Path("/proc/self/status")
    found = re.search(r"VmHWM:\s+(\d+)", status.read_text(encoding="ascii")) if status.exists() else None
    return float(found[1]) / 1024.0 if found else float("nan")
