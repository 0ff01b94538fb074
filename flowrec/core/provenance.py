"""Provenance of a session: versions, commit and local changes, packages, host, time.

Recorded first in every file, so that a result can be traced to the code that made it.
"""

from __future__ import annotations

import getpass
import json
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from flowrec.core.clocks.clock_monitor import read_clocks
from flowrec.core.version import NUMERICS_VERSION, __version__

PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "opencv-python-headless",
    "filterpy",
    "torch",
    "safetensors",
    "mcap",
    "foxglove-sdk",
    "protobuf",
    "rerun-sdk",
    "pydantic",
)
PACKAGE = Path(__file__).resolve().parents[1]
_DIFF_LIMIT = 200_000  # characters; a larger change is cut and says so


def provenance(anonymous: bool = False) -> dict[str, str]:
    """Facts about code, machine and time as text, for the header of a session; `anonymous` omits machine and user."""
    facts = {"flowrec": __version__, "numerics_version": str(NUMERICS_VERSION), "python": platform.python_version()}
    if not anonymous:
        facts |= {"platform": platform.platform(), "host": platform.node(), "user": user_name()}
    monotonic_ns, wall_ns = read_clocks()
    facts |= {"wall_time": datetime.now(UTC).isoformat(), "wall_ns": str(wall_ns), "monotonic_ns": str(monotonic_ns)}
    for package in PACKAGES:
        try:
            facts[f"package.{package}"] = version(package)
        except PackageNotFoundError:
            facts[f"package.{package}"] = "not installed"
    return facts | _code(anonymous)


def _code(anonymous: bool) -> dict[str, str]:
    """The commit and the local changes: from git in a checkout, else from the build of the wheel."""
    commit = _git("rev-parse", "HEAD")
    # Only a checkout of flowrec itself counts, not a repository that contains the virtual environment.
    if not (commit and _git("ls-files", "--error-unmatch", "__init__.py")):
        # What hatch_build.py wrote into the wheel, if it was built from a checkout.
        try:
            built = json.loads((PACKAGE / "_build.json").read_text(encoding="utf-8"))
        except FileNotFoundError:
            return {}
        return {key: str(value) for key, value in built.items()}
    facts = {"git_commit": commit, "git_changed": str(bool(_git("status", "--porcelain", "--", ".")))}
    diff = "" if anonymous else _git("diff", "HEAD", "--", ".")
    if diff:
        cut = f"\n... cut at {_DIFF_LIMIT} characters" if len(diff) > _DIFF_LIMIT else ""
        facts["git_diff"] = diff[:_DIFF_LIMIT] + cut
    return facts


def user_name() -> str:
    """Name of the user on this machine, "unknown" where it has none."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # a container may run under a number without a name
        return "unknown"


def _git(*words: str) -> str:
    """Output of git in the folder of the package, '' if there is no git or no repository."""
    try:
        done = subprocess.run(  # noqa: S603
            ["git", "-C", str(PACKAGE), *words],  # noqa: S607
            capture_output=True,
            text=True,
            timeout=10,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
