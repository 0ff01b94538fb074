"""The chip: where fluid is, where it comes in and goes out, how far the walls are."""

from flowrec.chip.chip import Chip, Opening
from flowrec.chip.clearance import check_point, clearance_um, median_width_um, nearest_fluid
from flowrec.chip.io import chip_files, chip_from_files
from flowrec.chip.load import load_chip
from flowrec.chip.settings import ChipSettings

__all__ = [
    "Chip",
    "ChipSettings",
    "Opening",
    "check_point",
    "chip_files",
    "chip_from_files",
    "clearance_um",
    "load_chip",
    "median_width_um",
    "nearest_fluid",
]
