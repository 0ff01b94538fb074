"""Files of a run: those that it reads, the path that it is written to, and what stood there before."""

from __future__ import annotations

import math
from datetime import datetime
from pathlib import Path

from flowrec.core import FlowField, SessionError, UsageError
from flowrec.physics import Chip
from flowrec.run import refuse_below
from flowrec.stages import Config
from flowrec.store import Session, files_behind, run_files, run_path, runs_in
from flowrec.verbs.auto_recovery import recover_leftovers


def files_of(config: Config) -> list[Path]:
    """The files that a configuration names, and those that are read with them."""
    files: list[Path] = []
    chip = Path(config.chip.path)
    if chip.name:
        files += [chip, chip.with_suffix(".png"), chip.with_suffix(".toml")]
    if config.start.field:
        files += files_behind(Path(config.start.field))
    movie = config.movie
    return [*files, *(Path(name) for name in (movie.path, movie.times, movie.coils) if name)]


def field_of_session(path: Path, chip: Chip) -> dict[str, FlowField]:
    """Assumed and refined flow at the end of an earlier session, on the same chip."""
    fields = {name: field for name, field in Session(path).fields.items() if name != "true"}
    if "assumed" not in fields:
        raise UsageError(f"start.field = {path}: that session holds no flow field; survey and refine first")
    shape = fields["assumed"].velocity_um_s.shape[:2]
    if shape != chip.mask.shape or not math.isclose(fields["assumed"].um_per_px, chip.um_per_px):
        raise UsageError(f"start.field = {path}: its field is for another chip ({shape[1]} x {shape[0]} pixels)")
    return fields


def place_of_session(config: Config, out: Path | None, overwrite: bool) -> Path:
    """The path of the session, after unfinished sessions in its folder are recovered and the free space is checked."""
    folder = out.parent if out is not None else Path()
    made: dict[Path, str] = {}
    if config.recording.recover_leftovers:
        excluded = frozenset(run_files(out.resolve())) if out is not None and overwrite else frozenset()
        made = recover_leftovers(folder, excluded)
    path = out if out is not None else default_path(config)
    same = next((file for file in made if run_path(file) == path), None)
    if same is not None and not overwrite:
        raise SessionError(
            f"{same}: was left by a run that did not finish and has just been recovered ({made[same]}); "
            "choose another name for this run with --out"
        )
    refuse_below(config.recording.disk_floor_gb, path.resolve().parent)
    return path


def default_path(config: Config, folder: Path | None = None) -> Path:
    """The path date_operator_sample_number.mcap with the first free number."""
    sample = config.recording.sample or Path(config.chip.path).stem or config.chip.name
    words = [datetime.now().astimezone().strftime("%Y-%m-%d"), config.recording.operator, sample]
    stem = "_".join(word.replace(" ", "-") for word in words if word)
    folder = folder or Path()
    names = runs_in(folder)
    for number in range(1, 10_000):
        path = folder / f"{stem}_{number:03d}.mcap"
        if path not in names:
            return path
    raise SessionError(f"{folder}: 9999 sessions named {stem} are here; name one with --out")
