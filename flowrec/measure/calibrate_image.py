"""`flowrec calibrate image`: how the chip lies in the image, from one picture; and how fresh such a registration is."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from flowrec.core import ChipError, Image, UsageError, __version__, say, table
from flowrec.measure.images import SourcePicture, png_of, read_picture
from flowrec.measure.picture_registration import fit_nearby, moved_px, other_scale, overlay, register
from flowrec.measure.proposal import as_toml, check_outputs, write_outputs
from flowrec.measure.wall_fit import WallFit
from flowrec.physics import Calibration, Chip, chip_key, compute_cached, load_chip
from flowrec.stages import CameraSettings, Config

_ABOUT = 1.12  # camera.um_per_px, where it is given, is right up to this factor
_UNKNOWN = 2.0  # the same of the scale at which the chip fills the image
_STALE_DAYS = 30.0  # after which a registration is said to be old
_POOR_PX = 1.0  # residual
_ADVICE = "flowrec calibrate image PICTURE -o registration.toml measures it"
_MOVED_PX = 1.0  # of the walls; a hundred times the error of a fit to good pictures, ten times that to poor ones


class ImageRegistration(NamedTuple):
    """Poses that explain a picture equally well, and the one that was chosen, if any."""

    picture: SourcePicture
    chip: Chip
    poses: tuple[WallFit, ...]
    chosen: WallFit | None
    registered_on: str
    out: Path | None  # that the settings of the chosen one were written to

    @property
    def exit_status(self) -> int:
        """1 if none was chosen."""
        return int(self.chosen is None)

    def as_json(self) -> dict[str, Any]:
        poses = []
        for fit in self.poses:
            x, y, angle, scale = fit.std.tolist()
            quality = {
                "walls_found": round(fit.found, 4),
                "walls_seen": round(fit.seen, 4),
                "explained": round(fit.explained, 4),
                "standard_error_um": [x, y],
                "standard_error_deg": angle,
                "standard_error_scale": scale,
            }
            poses.append(settings_of(self, fit) | quality)
        chosen = next((n for n, fit in enumerate(self.poses) if fit is self.chosen), None)
        return {"chip": self.chip.name, "poses": poses, "chosen": chosen, "covered": self.picture.covered.as_json()}

    def show(self) -> None:
        """Print the poses as a table.

        Raises ChipError, in one line, if several are equally good and none was chosen.
        """
        rows = []
        for number, fit in enumerate(self.poses, 1):
            settings, (x, y, angle, scale) = settings_of(self, fit), fit.std.tolist()
            rows.append(
                (
                    str(number),
                    f"{settings['um_per_px']:.5g} ± {100 * scale:.1g} %",
                    f"{settings['angle_deg']:.3f} ± {angle:.1g}",
                    "yes" if settings["mirror"] else "no",
                    f"{settings['centre_um'][0]:.1f}, {settings['centre_um'][1]:.1f} ± {max(x, y):.1g}",
                    f"{fit.residual_um:.2g}",
                    f"{100 * fit.found:.0f} %",
                )
            )
        columns = ("", "um per px", "angle (deg)", "mirror", "image centre (um)", "residual (um)", "walls found")
        table(f"{self.chip.name} in {self.picture.source}", columns, rows)
        if self.chosen is None:
            raise ChipError(
                f"{self.picture.source}: the chip {self.chip.name} looks the same in {len(self.poses)} ways; choose "
                "one of the table with --pick N, or say whether the image is mirrored with --mirror or --no-mirror"
            )
        if self.out is not None:
            say(f"{self.out} written, and {self.out.with_suffix('.png').name}, which shows the outline: look at it")
            say(f"In a configuration: camera.registration = {json.dumps(str(self.out))}")


def calibrate_image(
    path: Path,
    config: Config,
    out: Path | None = None,
    mirror: bool | None = None,
    pick: int | None = None,
    overwrite: bool = False,
    inputs: Sequence[Path] = (),
) -> ImageRegistration:
    """Register the chip of a configuration in a picture; write the settings to `out`, and the overlay beside it.

    Raises FlowrecError: one line: the picture can not be read, does not show the chip, or the outputs may not be
    written.

    Parameters
    ----------
    path : an image file, a movie or a session, of which the median is taken.
    config : its chip, and camera.um_per_px within 12 %, if it is known.
    mirror : whether the image is mirrored; None: both are tried.
    pick : which of several equally good poses is meant, from 1.
    inputs : files that were read besides; the outputs may be none of them.
    """
    outputs = check_outputs(out, (path, *inputs), overwrite, (".png",))
    picture = read_picture(path, config.movie.channel)
    chip = load_chip(config.chip)
    height, width = picture.image.shape
    about_um, factor = config.camera.um_per_px, _ABOUT
    if about_um is None:
        about_um, factor = max(chip.size_um[0] / width, chip.size_um[1] / height), _UNKNOWN
    mirrors = (False, True) if mirror is None else (mirror,)
    try:
        poses = register(picture.image, chip, (about_um / factor, about_um * factor), mirrors)
    except ChipError as error:
        raise ChipError(f"{path}: {error}") from error
    if pick is not None and not 1 <= pick <= len(poses):
        are = "is one pose" if len(poses) == 1 else f"are {len(poses)} poses"
        raise UsageError(f"--pick {pick}: there {are}; choose from 1 to {len(poses)}")
    chosen = poses[pick - 1] if pick is not None else poses[0] if len(poses) == 1 else None
    done = ImageRegistration(picture, chip, poses, chosen, datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"), out)
    if outputs and chosen is not None:
        drawing = png_of(overlay(picture.image, chip, chosen.calibration))
        write_outputs(outputs, (fragment(done, chosen).encode(), drawing))
    return done


def settings_of(done: ImageRegistration, fit: WallFit) -> dict[str, Any]:
    """The settings of section [camera] that a pose means."""
    height, width = done.picture.image.shape
    calibration = fit.calibration
    centre = calibration.to_um(((width - 1) / 2, (height - 1) / 2))
    angle = (calibration.angle_deg + 180.0) % 360.0 - 180.0
    return {
        "width_px": width,
        "height_px": height,
        "um_per_px": float(f"{calibration.um_per_px:.7g}"),
        "angle_deg": round(angle, 4) + 0.0,
        "mirror": calibration.mirror,
        "centre_um": [round(float(v), 3) for v in centre],
        "registered_on": done.registered_on,
        "registered_from": f"{done.picture.source}, sha256 {done.picture.sha256[:12]}",
        "residual_um": round(fit.residual_um, 3),
    }


def fragment(done: ImageRegistration, fit: WallFit) -> str:
    """The settings as TOML, with a comment on their quality."""
    x, y, angle, scale = fit.std.tolist()
    source = done.picture
    comments = (
        f"By flowrec {__version__} calibrate image from {source.source} (sha256 {source.sha256}),",
        f"chip {done.chip.name}: {100 * fit.found:.0f} % of the walls in the picture agree, {100 * fit.seen:.0f} % of "
        "the chip's walls are in it.",
        f"Standard errors: {max(x, y):.2g} um, {angle:.2g} degrees, {100 * scale:.2g} %.",
    )
    return as_toml(comments, {f"camera.{key}": value for key, value in settings_of(done, fit).items()})


def registration_state(camera: CameraSettings, now: datetime | None = None) -> tuple[bool, str]:
    """Age and quality of the registration of a camera: True if both are good, and one line on it, for people."""
    if not camera.registered_on:
        return False, f"the registration of camera and chip was never measured; {_ADVICE}"
    try:
        made = datetime.fromisoformat(camera.registered_on)
    except ValueError:
        return False, f"camera.registered_on = {camera.registered_on!r} is no date; {_ADVICE}"
    made = made if made.tzinfo is not None else made.replace(tzinfo=UTC)
    days = ((now or datetime.now(UTC)) - made).total_seconds() / 86_400.0
    residual_um = camera.residual_um
    residual = "" if residual_um is None else f", residual {residual_um:.2g} um"
    text = f"registered {max(days, 0.0):.0f} days ago from {camera.registered_from or 'an unnamed picture'}{residual}"
    if days > _STALE_DAYS:
        return False, f"{text}; {_ADVICE} again"
    if residual_um is not None and camera.um_per_px is not None and residual_um > _POOR_PX * camera.um_per_px:
        return False, f"{text}, more than a pixel; does the mask fit the chip? {_ADVICE} again"
    return True, text


class WallsState(NamedTuple):
    """Comparison of the walls in an image with a registration: True where they agree, and one line on it.

    `other_scale` : they contradict its scale.
    """

    good: bool
    text: str
    other_scale: bool = False


def walls_state(image: Image, chip: Chip, assumed: Calibration) -> WallsState | None:
    """Compare the walls in an image (h, w) with a registration; None: the image does not show enough of them."""
    # An import asks two or three times of the same picture, which takes a second.
    key = ("walls", image.tobytes(), image.shape, image.dtype.str, chip_key(chip), assumed)
    fit: WallFit | None = compute_cached(key, lambda: fit_nearby(image, chip, assumed))
    if fit is None:
        return None
    um_per_px, stated = other_scale(fit, assumed), assumed.um_per_px
    if um_per_px is not None:
        error = um_per_px * float(fit.std[3])
        share, way = 100.0 * abs(stated / um_per_px - 1.0), "large" if stated > um_per_px else "small"
        text = (
            f"camera.um_per_px = {stated:.4g} is {share:.1f} % too {way} for the walls in the image, which fit the "
            f"chip at {um_per_px:.5g} ± {error:.1g}: set camera.um_per_px = {um_per_px:.5g}, if the mask has the right "
            "size"
        )
        return WallsState(False, text, other_scale=True)
    moved = moved_px(fit, chip, assumed)
    if moved is None:
        return None
    text = f"the walls in the image are {moved:.2g} px from where the registration puts them"
    good = moved <= _MOVED_PX
    return WallsState(good, text if good else f"{text}; {_ADVICE}")
