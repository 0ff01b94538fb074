"""The chip: where fluid is, where it enters and leaves, how far the walls are."""

from flowrec.chip.chip import Chip, ChipSettings, Opening
from flowrec.chip.clearance import check_point, clearance_um, median_width_um, nearest_fluid
from flowrec.chip.io import chip_files, chip_from_files, load_chip

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
