"""Build hook: which commit a wheel or an sdist was made of, as flowrec/_build.json inside of it."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CommitHook(BuildHookInterface):  # type: ignore[type-arg]
    """Adds the file where the sources are a checkout of git; an editable installation asks git itself."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        facts = built_from(Path(self.root))
        if facts is None or version == "editable":
            return
        self._folder = tempfile.TemporaryDirectory()
        file = Path(self._folder.name, "_build.json")
        file.write_text(json.dumps(facts), encoding="utf-8")
        build_data["force_include"][str(file)] = "flowrec/_build.json"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        if hasattr(self, "_folder"):
            self._folder.cleanup()


def built_from(root: Path) -> dict[str, Any] | None:
    """The commit, and whether the package differs from it; None where this is no checkout of its own."""

    def git(*words: str) -> str | None:
        try:
            done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=False)  # noqa: S603, S607
        except OSError:
            return None
        return done.stdout.strip() if done.returncode == 0 else None

    commit = git("rev-parse", "HEAD")
    if commit is None or git("ls-files", "--error-unmatch", "flowrec/__init__.py") is None:
        return None
    return {"git_commit": commit, "git_changed": bool(git("status", "--porcelain", "--", "flowrec"))}
