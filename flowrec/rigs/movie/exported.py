"""Facts on a run in an export of its session, so that `flowrec import` need not be given them.

It is in what flowrec writes into a movie (movies/notes.py), and in config.toml and chip.png of a folder of tables.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from flowrec.core import MovieError, marker_of, parse_toml, read_toml
from flowrec.movies import MovieFacts
from flowrec.rigs.movie.source import open_source
from flowrec.stages import Config, config_from_tree, is_of_session

# Settings that state facts about the run. What analyses it, such as the observer, is left to the import.
_OF_CAMERA = ("um_per_px", "angle_deg", "mirror", "centre_um", "exposure_s")
_SECTIONS = ("robot", "camera", "coils")
_SETTINGS, _CHIP = "config.toml", "chip.png"  # in a folder of tables


# Settings of the sections robot, camera and coils, and the chip, as in chip.path.
_Facts = tuple[dict[str, dict[str, Any]], str]


def session_of_log(log: Path) -> str:
    """`Session.key` of the session of whose tables a log is one; "" for any other log, and for one that was moved."""
    marker = marker_of(log.parent)
    return str(marker.get("session_key", "")) if marker is not None and is_of_session(log) else ""


def with_exported(asked: Config) -> tuple[Config, list[str]]:
    """The configuration with what the movie or its log tell of the session that they were exported from.

    Settings that are given stay: those that differ from their defaults, of the camera also those of a registration.
    Raises MovieError: the movie can not be read, or what flowrec wrote is damaged. Returns the configuration, and the
    settings that were taken, such as "robot.um_per_rev = 30".
    """
    with open_source(asked.movie) as movie:
        facts = movie.facts
    found = _of_movie(facts, asked.movie.path) or _of_folder(asked.movie.coils, facts)
    if found is None:
        return asked, []
    settings, chip = found
    told = config_from_tree(settings, f"{asked.movie.path}: the settings that flowrec wrote")
    default, changed, taken = Config(), asked, list[str]()
    for section in _SECTIONS:
        given, stated, usual = (getattr(config, section) for config in (asked, told, default))
        if section == "camera" and asked.camera.registration:
            continue
        new = {
            each.name: value
            for each in fields(given)
            if getattr(given, each.name) == getattr(usual, each.name)
            and (value := getattr(stated, each.name)) != getattr(usual, each.name)
        }
        changed = replace(changed, **{section: replace(given, **new)})
        taken += [f"{section}.{name} = {value}" for name, value in new.items()]
    if not asked.chip.path:
        changed = replace(changed, chip=replace(asked.chip, path=chip))
        taken.append("the chip")
    return changed, taken


def _of_movie(facts: MovieFacts, path: str) -> _Facts | None:
    notes = facts.notes
    if notes is None:
        return None
    try:
        settings = _run_facts(parse_toml(notes.settings))
    except (ValueError, RecursionError) as error:
        raise MovieError(f"{path}: the settings in it are damaged ({error}); export the session again") from error
    settings["camera"] = {**settings.get("camera", {}), "um_per_px": notes.um_per_px}
    return settings, path


def _of_folder(log: str, facts: MovieFacts) -> _Facts | None:
    """Facts from the folder of tables in which a log is."""
    folder = Path(log).parent
    settings, chip = folder / _SETTINGS, folder / _CHIP
    if not log or not session_of_log(Path(log)) or not settings.is_file() or not chip.is_file():
        return None
    tree = read_toml(settings)
    found = _run_facts(tree)
    camera = tree.get("camera", {})
    if (camera.get("width_px"), camera.get("height_px")) != (facts.width_px, facts.height_px):
        found.pop("camera", None)  # the movie was cut or scaled
    return found, str(chip)


def _run_facts(tree: dict[str, Any]) -> dict[str, Any]:
    """The settings of a run that state facts about it."""
    found = {section: tree[section] for section in _SECTIONS if section in tree}
    if isinstance(found.get("camera"), dict):
        found["camera"] = {key: value for key, value in found["camera"].items() if key in _OF_CAMERA}
    return found
