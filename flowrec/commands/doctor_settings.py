"""What the doctor looks at devices with where a setting of the run is wrong or missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flowrec.chip import ChipSettings, load_chip
from flowrec.config import Config, ResolvedConfig, config_from_tree
from flowrec.config_tree import apply_sets
from flowrec.errors import UsageError
from flowrec.resolve import resolve
from flowrec.rig_settings import LAB, SIMULATED
from flowrec.system.toml_file import read_toml

_OF_DEVICES = ("camera", "coils", "lab")  # sections


def of_devices(file: Path | None, sets: Sequence[str], wrong: UsageError) -> Config:
    """The settings of camera and coils that are right in themselves, where the whole configuration is refused.

    Raises
    ------
    UsageError : `wrong`, where the configuration is none of a lab; the file can not be read.
    """
    tree: dict[str, Any] = read_toml(file) if file is not None else {}
    apply_sets(tree, sets)
    kept: dict[str, Any] = {"rig": tree.get("rig")}
    if kept["rig"] != LAB:
        raise wrong
    for section in _OF_DEVICES:
        table = tree.get(section)
        for key, value in table.items() if isinstance(table, dict) else ():
            more = kept | {section: kept.get(section, {}) | {key: value}}
            try:
                config_from_tree(more, str(file))
            except UsageError:
                continue  # told already, or after it is mended
            kept = more
    return config_from_tree(kept, str(file))


def stand_in(asked: Config) -> ResolvedConfig:
    """The settings of camera, coils and lab that are given, with those of a made-up run for all the rest.

    Raises
    ------
    UsageError : these are wrong, too.
    """
    devices = {section: getattr(asked, section) for section in _OF_DEVICES}
    made_up = resolve(replace(Config(), rig=SIMULATED, recording=asked.recording, **devices), load_chip(ChipSettings()))
    return replace(made_up, rig=LAB)
