"""From a picture to a chip that can be solved."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from flowrec.core import ChipError, FlowrecError, OutputError, UsageError
from flowrec.measure import outline
from flowrec.measure.calibrate_chip import calibrate_chip, chip_toml
from flowrec.physics import Calibration, ChipSettings, FlowSolver, load_chip, sample
from tests.conftest import invoke
from tests.physics.chip.looks import LOOKS, picture

CHIP = load_chip(ChipSettings("bifurcation"))
SIZE_PX, UM_PER_PX = (480, 384), 40.0 / 3.0


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("chip") / "picture.png"
    camera = Calibration.centre_on(UM_PER_PX, np.array(CHIP.size_um) / 2 - 10.0, SIZE_PX, 0.0, False)
    look = LOOKS["thick dark lines"]
    shown = picture(CHIP.mask, 20.0, camera, SIZE_PX, look, np.random.default_rng(1))
    cv2.imwrite(str(path), cv2.merge((shown, shown // 2, shown)))  # in colour
    return path


@pytest.mark.slow("solves the flow on two chips")
def test_the_flow_on_the_chip_of_a_picture_is_about_that_on_the_true_one(image, tmp_path):
    out = tmp_path / "mine.toml"
    words = ["calibrate", "chip", str(image), "--um-per-px", str(UM_PER_PX), "-o", str(out)]
    words += ["--inlet", "left:0", "--inlet-speed", "220"]
    done = invoke(*words)
    assert done.exit_code == 0, done.output
    assert {path.name for path in tmp_path.iterdir()} == {"mine.toml", "mine.png", "mine_overlay.png"}
    chip = load_chip(ChipSettings(path=str(out)))
    found, true = FlowSolver().solve(chip), FlowSolver().solve(CHIP)
    rows, columns = np.nonzero(CHIP.mask)
    at_um = np.stack((columns, rows), -1) * 20.0
    # Both chips have their middle where the picture has it.
    shift_um = (np.array(chip.size_um) - chip.um_per_px - np.array(CHIP.size_um) + 20.0) / 2
    off = sample(found, at_um + shift_um) - sample(true, at_um)
    assert np.sqrt(np.sum(off**2) / np.sum(sample(true, at_um) ** 2)) < 0.07
    assert isinstance(invoke(*words).exception, OutputError)  # nothing is overwritten


def test_what_a_picture_does_not_tell_is_asked_for_and_a_corrected_mask_loads(image, tmp_path):
    out = tmp_path / "mine.toml"
    calibrate_chip(image, out, walls="dark")
    asked = (
        ("# um_per_px =  ", f"um_per_px = {UM_PER_PX}", "no um_per_px"),
        ('kind = "?"', 'kind = "outlet"', r"kind = '\?'; it must be one of inlet, outlet"),
        ('kind = "?"', 'kind = "inlet"', r"kind = '\?'; it must be one of inlet, outlet"),
        ("# speed_um_s =   # FILL IN", "# none", None),
        ("# speed_um_s =   # FILL IN", "speed_um_s = 100.0  #", "needs speed_um_s"),
    )
    for line, filled, refusal in asked:
        if refusal is not None:
            with pytest.raises(ChipError, match=refusal):
                load_chip(ChipSettings(path=str(out)))
        out.write_text(out.read_text().replace(line, filled, 1))
    chip = load_chip(ChipSettings(path=str(out)))
    assert [(o.side, o.kind, o.value) for o in chip.openings] == [("left", "outlet", 0.0), ("right", "inlet", 100.0)]
    mask = cv2.imread(str(out.with_suffix(".png")), cv2.IMREAD_GRAYSCALE)
    island = cv2.circle(mask.copy(), (40, 202), 5, 0, -1)
    cv2.imwrite(str(out.with_suffix(".png")), island)
    assert np.array_equal(load_chip(ChipSettings(path=str(out))).mask, island >= 128)


@pytest.mark.slow("a picture of several megapixels")
def test_the_mask_of_a_large_picture_has_larger_pixels_and_says_so(image, tmp_path):
    large, out = tmp_path / "large.png", tmp_path / "mine.toml"
    cv2.imwrite(str(large), cv2.resize(cv2.imread(str(image)), None, fx=3.0, fy=3.0, interpolation=cv2.INTER_CUBIC))
    calibrate_chip(large, out, um_per_px=UM_PER_PX / 3.0, inlets=["left:0"], inlet_speed_um_s=220.0)
    chip = load_chip(ChipSettings(path=str(out)))
    assert chip.mask.shape[1] < 3 * SIZE_PX[0]
    assert chip.size_um == pytest.approx(UM_PER_PX * np.array(SIZE_PX), rel=1e-3)


@pytest.mark.slow("solves the flow on two chips")
def test_a_known_width_moves_the_walls(image):
    plain = calibrate_chip(image, None, UM_PER_PX, walls="dark")
    narrower = calibrate_chip(image, None, UM_PER_PX, walls="dark", wall_shift_um=-UM_PER_PX)
    assert [o.width_px - 2 for o in plain.openings] == [o.width_px for o in narrower.openings]
    lost = np.count_nonzero(plain.mask & ~narrower.mask)
    assert not (narrower.mask & ~plain.mask).any() and 0.05 < lost / np.count_nonzero(plain.mask) < 0.15
    with pytest.raises(UsageError, match="channels"):
        calibrate_chip(image, None, UM_PER_PX, walls="dark", wall_shift_um=-150.0)


def test_the_file_of_a_chip_states_how_large_its_pixels_are_and_the_speed_of_each_inlet(image):
    plain = calibrate_chip(image, None, UM_PER_PX, walls="dark")
    narrower = calibrate_chip(image, None, UM_PER_PX, walls="dark", wall_shift_um=-UM_PER_PX, seen=plain)
    assert [o.width_px - 2 for o in plain.openings] == [o.width_px for o in narrower.openings]
    inlets = tuple(
        replace(o, kind="inlet", value=value) for o, value in zip(plain.openings, (50.0, 100.0), strict=True)
    )
    done = plain._replace(pixel=2.0, openings=inlets, inlets_known=True, speed_um_s=75.0)
    lines = chip_toml(done, "mine").splitlines()
    assert f"um_per_px = {2.0 * UM_PER_PX:.7g}  # a pixel of the mask, 2 pixels of the picture" in lines
    assert [line for line in lines if line.startswith("speed_um_s")] == [
        "speed_um_s = 50.0  # mean",
        "speed_um_s = 100.0  # mean",
    ]


def test_a_refused_picture_leaves_no_file(image, tmp_path):
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((128, 128), 90, np.uint8))
    out = tmp_path / "mine.toml"
    for bad, error, why, words in (
        (blank, ChipError, "is blank", {}),
        (image, UsageError, "--seed-point", {"seed_points": ["12"]}),
        (image, UsageError, "--walls", {"walls": "thick"}),
        (tmp_path / "none.png", FlowrecError, "no such", {}),
        (image, ChipError, "no opening 'top:3'", {"inlets": ["top:3"], "walls": "dark"}),
    ):
        with pytest.raises(error, match=why):
            calibrate_chip(bad, out, 5.0, **words)
    assert [path.name for path in tmp_path.iterdir()] == ["blank.png"]


@pytest.mark.parametrize("count", [100, 32_767, 70_000])
def test_walls_of_any_length_are_read_from_the_picture(count):
    ramp = np.tile(np.arange(200, dtype=np.float32), (200, 1))
    x = np.linspace(0.0, 150.0, count)
    points = np.column_stack([x, np.full(count, 20.0)])
    assert np.allclose(outline._at(ramp, points), x + outline._PAD_PX, atol=0.02)


@pytest.mark.slow("a picture with walls of more than 32767 px in all, which OpenCV does not take at once")
def test_a_picture_of_stripes_is_a_chip_of_as_many_channels(tmp_path):
    y, x = np.mgrid[:800, :800]
    cv2.imwrite(str(tmp_path / "stripes.png"), ((x + y) % 64 * 4).astype(np.uint8))
    done = calibrate_chip(tmp_path / "stripes.png", None, 5.0)
    assert len(done.openings) == 24  # of 12 stripes that begin at the left or at the top, and end opposite


def test_a_mask_that_would_replace_the_picture_is_refused_with_a_name_that_does_not(image, tmp_path):
    mine = tmp_path / "mine.png"
    mine.write_bytes(image.read_bytes())
    with pytest.raises(OutputError, match=r"the mask of .*mine\.toml would be written to it; .* -o .*mine_chip\.toml$"):
        calibrate_chip(mine, tmp_path / "mine.toml", 5.0)


def test_the_table_of_a_chip_says_how_large_it_is_so_that_a_wrong_unit_is_seen(image, capsys):
    calibrate_chip(image, None, 0.005).show()
    width, height = (0.005 * side for side in reversed(cv2.imread(str(image)).shape[:2]))
    assert f"({width:.4g} um x {height:.4g} um in all)" in " ".join(capsys.readouterr().out.split())
