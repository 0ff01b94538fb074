"""Where the twins of cameras that others wrote find the images of an emulated world."""

from __future__ import annotations

from pathlib import Path

import cv2

from flowrec.core import Image
from flowrec.stages import ResolvedConfig

_FILES = 3  # of the folder; the emulator reads one after the other, and keeps a file in memory where there is only one
_FEATURES = """# {{05D8C294-F295-4dfb-9D01-096BD04049F4}}
# GenApi persistence file (version 3.1.0)
Width\t{width}
Height\t{height}
PixelFormat\tMono8
TestImageSelector\tOff
ImageFilename\t{folder}
ImageFileMode\tOn
"""


class EmulatedView:
    """Where pylon's emulator finds the latest image.

    `sets`: settings of a recorder.
    """

    def __init__(self, folder: Path, config: ResolvedConfig) -> None:
        # The emulator reads every file of its folder, so that a file is written beside it first.
        self._images, self._drafts = folder / "images", folder / "drafts"
        for made in (self._images, self._drafts):
            made.mkdir()
        width, height = config.camera.width_px, config.camera.height_px
        features = folder / "camera.pfs"
        features.write_text(_FEATURES.format(width=width, height=height, folder=self._images), encoding="utf-8")
        self.sets = ("lab.camera=pylon", f'lab.device_config="{features}"')

    def __call__(self, image: Image) -> None:
        """Show an image from now on."""
        data = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        for number in range(_FILES):
            draft = self._drafts / f"{number}.png"
            draft.write_bytes(data)
            draft.replace(self._images / f"{number}.png")


class FileView:
    """Where gige_images.py finds the latest image: `file`."""

    sets = ("lab.camera=genicam",)

    def __init__(self, folder: Path) -> None:
        self.file = folder / "image.raw"
        self._draft = folder / "image.draft"

    def __call__(self, image: Image) -> None:
        """Show an image from now on."""
        self._draft.write_bytes(image.tobytes())
        self._draft.replace(self.file)
