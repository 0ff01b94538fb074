import itertools
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import label

from flowrec.core import ChipError
from flowrec.physics import (
    Chip,
    ChipSettings,
    FlowSolver,
    Opening,
    check_point,
    chip_files,
    chip_from_files,
    clearance_um,
    distance_um,
    find_openings,
    guess_inlets,
    load_chip,
    median_width_um,
    opening_point_um,
    with_levels,
)
from flowrec.physics.chip.clearance import nearest_fluid

SESSIONS = Path(__file__).parents[3] / "sessions" / "chips"


def mask_of(rows=40, columns=60, *channels):
    mask = np.zeros((rows, columns), np.bool_)
    for channel in channels:
        mask[channel] = True
    return mask


def write_png(path, mask):
    cv2.imwrite(str(path), np.where(mask, 255, 0).astype(np.uint8))
    return str(path)


def same_chip(a: Chip, b: Chip) -> bool:
    others = (replace(chip, mask=None) for chip in (a, b))
    first, second = ({n: getattr(c, n) for n in Chip.__slots__} for c in others)
    return first == second and np.array_equal(a.mask, b.mask)


def test_a_chip_survives_its_two_files_exactly():
    chips = [load_chip(ChipSettings(name)) for name in ("bifurcation", "straight", "vessels")]
    odd = replace(
        chips[2].with_boundary([0.1 + 0.2, 1e-17, -3.3333333333333335, 7.0], 1.0 / 3.0, 1e3 / 7),
        name='ein "Chip" \\ with ü',
        depth_um=np.nextafter(100.0, 101.0),
        walls="pixel",
        um_per_px=19.999999999999996,
    )
    for chip in (*chips, odd):
        assert same_chip(chip_from_files(*chip_files(chip)), chip)


def test_walls_between_pixel_centres_survive_the_two_files_and_pockets_in_them_are_filled():
    chip = load_chip(ChipSettings("bifurcation"))
    level_px = np.clip(clearance_um(chip.mask, 1.0) + 0.3, -2.5, 2.5)
    level_px[2:4, 2:4] = 0.7  # fluid that no opening reaches
    grey = with_levels(chip, level_px)
    again = chip_from_files(*chip_files(grey))
    assert not grey.mask[2, 2]
    assert grey.walls == again.walls == "grey"
    assert np.array_equal(again.level_px, grey.level_px)
    assert np.array_equal(again.mask, grey.mask)
    assert np.abs(grey.level_px - level_px)[10:].max() <= 0.011  # steps of a grey level


@pytest.mark.parametrize(
    ("fluid", "inlet", "count"),
    [
        ((np.s_[4:8, :], np.s_[20:30, :], np.s_[8:20, 30:34]), ("left", 20, 29), 4),
        ((np.s_[:, 10:14], np.s_[30:, 10:40], np.s_[0:30, 10:14]), ("bottom", 10, 39), 2),  # none is on the left
    ],
)
def test_the_widest_opening_on_the_left_or_else_of_all_is_taken_for_the_inlet(fluid, inlet, count):
    openings = guess_inlets(find_openings(mask_of(40, 60, *fluid)))
    assert [(o.side, o.first, o.last) for o in openings if o.kind == "inlet"] == [inlet] and len(openings) == count


def test_grazed_pixels_are_no_openings_and_a_corner_is_only_one():
    mask = mask_of(40, 60, np.s_[10:20, :], np.s_[20:22, 0:2], np.s_[0:3, 5:7], np.s_[0:5, 50:60], np.s_[5:12, 50:54])
    found = [(o.side, o.first, o.last) for o in find_openings(mask)]
    # Column 59 rows 0-4 and row 0 columns 50-59 are one hole around the corner: the wider run stands for it.
    assert found == [("left", 10, 21), ("right", 10, 19), ("top", 50, 59)]


def test_a_photograph_is_no_mask_and_a_mask_with_blurred_edges_is_one(tmp_path):
    rng = np.random.default_rng(5)
    photograph = (140.0 + 30.0 * rng.standard_normal((60, 80))).clip(0, 255).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "photo.png"), photograph)
    with pytest.raises(ChipError, match=r"photo\.png: .*flowrec calibrate chip .*photo\.png"):
        load_chip(ChipSettings(path=str(tmp_path / "photo.png"), um_per_px=5.0))
    sharp = np.where(mask_of(60, 80, np.s_[20:40, :]), 255, 0).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "mask.png"), cv2.GaussianBlur(sharp, (0, 0), 1.5))
    chip = load_chip(ChipSettings(path=str(tmp_path / "mask.png"), um_per_px=5.0))
    assert np.array_equal(chip.mask, sharp > 0)


def test_settings_say_which_openings_are_inlets_and_how_fast(tmp_path):
    path = write_png(tmp_path / "cross.png", mask_of(40, 60, np.s_[15:25, :], np.s_[:, 25:33]))
    chip = load_chip(ChipSettings(path=path, um_per_px=10.0, inlets=("top:0", "left"), inlet_speed_um_s=300.0))
    assert {(o.side, o.kind, o.value) for o in chip.openings} == {
        ("left", "inlet", 300.0),
        ("top", "inlet", 300.0),
        ("right", "outlet", 0.0),
        ("bottom", "outlet", 0.0),
    }
    with pytest.raises(ChipError, match=r"'tap:0'.* left:0, right:0, top:0, bottom:0$"):
        load_chip(ChipSettings(path=path, um_per_px=10.0, inlets=("tap:0",)))


def test_the_inlet_speed_keeps_the_ratio_of_several_inlets(tmp_path):
    write_png(
        tmp_path / "two.png",
        mask_of(40, 60, np.s_[5:12, :30], np.s_[25:32, :30], np.s_[5:32, 30:36], np.s_[15:22, 36:]),
    )
    toml = "um_per_px = 10\n"
    for side, a, b, kind, value in (
        ("left", 5, 11, "inlet", "speed_um_s = 100"),
        ("left", 25, 31, "inlet", "speed_um_s = 50"),
        ("right", 15, 21, "outlet", "pressure_pa = 0.5"),
    ):
        toml += f'[[opening]]\nside = "{side}"\nfirst = {a}\nlast = {b}\nkind = "{kind}"\n{value}\n'
    (tmp_path / "two.toml").write_text(toml)
    chip = load_chip(ChipSettings(path=str(tmp_path / "two.toml"), inlet_speed_um_s=400.0))
    assert chip.boundary_values.tolist() == [400.0, 200.0, 0.5]


def test_dark_fluid_is_read_and_pockets_without_opening_are_filled(tmp_path):
    mask = mask_of(40, 60, np.s_[15:25, :], np.s_[2:8, 20:30])
    write_png(tmp_path / "dark.png", ~mask)
    (tmp_path / "dark.toml").write_text('um_per_px = 5.0\nfluid = "dark"\n')
    chip = load_chip(ChipSettings(path=str(tmp_path / "dark.png")))
    assert chip.mask[20, 30]
    assert not chip.mask[:15].any()
    assert chip.name == "dark"


@pytest.mark.parametrize(
    ("mask", "toml", "words"),
    [
        (mask_of(), "um_per_px = 5", "no fluid in the mask"),
        (~mask_of(), "um_per_px = 5", "the first and the last row of pixels black"),
        (mask_of(40, 60, np.s_[10:20, 10:20]), "um_per_px = 5", "no opening"),
        (mask_of(40, 60, np.s_[10:20, :30]), "um_per_px = 5", "no outlet"),
        (mask_of(4, 60, np.s_[1:3, :]), "um_per_px = 5", "at least 8 x 8"),
        (mask_of(40, 60, np.s_[10:20, :]), "", "no um_per_px"),
        (mask_of(40, 60, np.s_[10:20, :]), "um_per_px = 0", "um_per_px = 0; it must be more than zero"),
        (mask_of(40, 60, np.s_[10:20, :]), "um_per_px = -1", "more than zero"),
        (mask_of(40, 60, np.s_[10:20, :]), 'um_per_px = "5"', "must be a number"),
        (mask_of(40, 60, np.s_[10:20, :]), "um_per_px = nan", "must be a number"),
        (mask_of(40, 60, np.s_[10:20, :]), "um_per_pixel = 5", "did you mean um_per_px"),
        (mask_of(40, 60, np.s_[10:20, :]), 'um_per_px = 5\nwalls = "round"', "one of smooth, pixel"),
        (mask_of(40, 60, np.s_[10:20, :]), "um_per_px = ", "not valid TOML"),
        (
            mask_of(40, 60, np.s_[10:20, :]),
            'um_per_px = 5\n[[opening]]\nside = "left"\nfrist = 3',
            "did you mean first",
        ),
        (
            mask_of(40, 60, np.s_[10:20, :]),
            'um_per_px = 5\n[[opening]]\nside = "left"\nfirst = 8\nlast = 15\nkind = "outlet"',
            "lies on a wall; the fluid on that side is at 10-19",
        ),
        (
            mask_of(40, 60, np.s_[10:20, :]),
            'um_per_px = 5\n[[opening]]\nside = "left"\nfirst = 10\nlast = 19\nkind = "outlet"',
            "no inlet",
        ),
    ],
)
def test_a_chip_that_no_flow_can_be_computed_on_is_refused_in_one_line(tmp_path, mask, toml, words):
    path = write_png(tmp_path / "bad.png", mask)
    (tmp_path / "bad.toml").write_text(toml)
    with pytest.raises(ChipError) as caught:
        load_chip(ChipSettings(path=path))
    assert words in str(caught.value)
    assert "bad" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_are_missing_or_damaged_are_named(tmp_path):
    (tmp_path / "noise.png").write_bytes(b"not an image")
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "noise.npz").write_bytes(b"not an archive")
    np.savez(tmp_path / "short.npz", mask=np.ones((9, 9), bool))
    for name, words in (
        ("gone.png", "no such file"),
        ("gone.npz", "no such vessel case"),
        ("noise.png", "no PNG image"),
        ("empty.png", "no PNG image"),
        ("noise.npz", "not a readable"),
        ("short.npz", "no px, rho_assumed"),
        ("chip.jpeg", "convert"),
    ):
        with pytest.raises(ChipError, match=words):
            load_chip(ChipSettings(path=str(tmp_path / name), um_per_px=5.0))
    with pytest.raises(ChipError, match="'vessels'"):
        load_chip(ChipSettings("vesels"))


@pytest.mark.parametrize("width", [3, 4, 9, 10])
def test_clearance_in_a_straight_channel_is_exact_and_the_border_is_no_wall(width):
    mask = mask_of(30, 40, np.s_[10 : 10 + width, :])
    distance = clearance_um(mask, 5.0)
    rows = np.arange(10, 10 + width)
    expected = 5.0 * np.minimum(rows - 9.5, 9.5 + width - rows)
    assert np.allclose(distance[rows], expected[:, None])
    assert np.allclose(distance[[9, 8]], [[-2.5], [-7.5]])
    chip = Chip("c", mask, 5.0, guess_inlets(find_openings(mask)), 1.0, 1000.0)
    assert median_width_um(chip) == pytest.approx(5.0 * width)


def test_points_in_walls_are_refused_and_the_nearest_good_one_is_named():
    chip = load_chip(ChipSettings("straight"))
    check_point(chip, (1000.0, 640.0), "goal", 150.0)
    for place, what, told in (
        ((1000.0, 100.0), "goal", "goal 1000,100 um .* 1000,500"),  # in a wall; the nearest that would do
        ((1000.0, 450.0), "goal", "goal 1000,450 um"),  # too near to a wall
        ((-500.0, 640.0), "start", "start -500,640 um"),
    ):
        with pytest.raises(ChipError, match=told):
            check_point(chip, place, what, 70.0)
    assert nearest_fluid(chip, (0.0, 0.0), 1e6) is None


@pytest.mark.parametrize("seed", range(8))
def test_vessels_of_any_seed_are_one_piece_with_loops_and_several_openings(seed):
    chip = load_chip(ChipSettings("vessels", seed=seed))
    assert label(chip.mask)[1] == 1
    islands, _ = label(~chip.mask, np.ones((3, 3)))
    edge = set(np.concatenate((islands[0], islands[-1], islands[:, 0], islands[:, -1])))
    assert len(set(islands.ravel()) - edge) >= 2
    assert [o.kind for o in chip.openings].count("inlet") == 1
    assert len(chip.openings) == 4
    assert same_chip(chip, load_chip(ChipSettings("vessels", seed=seed)))


def test_vessels_differ_from_seed_to_seed():
    masks = [load_chip(ChipSettings("vessels", seed=seed)).mask for seed in range(5)]
    assert not any(np.array_equal(a, b) for a, b in itertools.combinations(masks, 2))


def test_a_robot_of_600_um_s_can_hold_its_place_everywhere_on_the_built_in_chips():
    for settings in (ChipSettings("bifurcation"), ChipSettings("vessels", seed=4), ChipSettings("straight")):
        field = FlowSolver(1).solve(load_chip(settings))
        fastest = float(np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1]).max())
        assert 250.0 < fastest < 500.0


def test_the_short_branch_of_the_bifurcation_is_much_faster_than_the_long_one():
    chip = load_chip(ChipSettings("bifurcation"))
    vx = FlowSolver(1).solve(chip).velocity_um_s[..., 0]
    middle = chip.mask.shape[1] // 2
    long, short = vx[:135, middle].max(), vx[135:, middle].max()
    assert 0.68 * 600 < short < 0.8 * 600
    assert short > 2.3 * long


def test_the_example_chip_loads_and_flows(monkeypatch):
    monkeypatch.chdir(SESSIONS.parents[1])
    chip = load_chip(ChipSettings(path="sessions/chips/y_junction.png"))
    assert [o.side for o in chip.openings] == ["left", "right", "bottom"]
    assert set(find_openings(chip.mask)) == {replace(o, kind="outlet", value=0.0) for o in chip.openings}
    flow = FlowSolver(1).solve(chip)
    assert np.isfinite(flow.velocity_um_s).all()


def test_a_vessel_case_is_read_without_its_truth(tmp_path, monkeypatch):
    home = os.environ.get("FLOWREC_REFERENCE_DATA")
    if not home:
        pytest.skip("FLOWREC_REFERENCE_DATA is not set")
    source = next(p for p in (Path(home) / "vessels" / "case_01.npz", Path(home) / "case_01.npz") if p.exists())
    with np.load(source) as case:
        known = {
            key: case[key] for key in case.files if not key.startswith(("v", "p_", "true", "guess", "route", "obs"))
        }
        blind = {
            key: value for key, value in known.items() if key not in ("p", "mu", "rho", "nu") and "true" not in key
        }
    np.savez(tmp_path / "case_01.npz", **blind)
    chip = load_chip(ChipSettings(path=str(source)))
    assert same_chip(chip, load_chip(ChipSettings(path=str(tmp_path / "case_01.npz"))))
    assert chip.um_per_px == pytest.approx(10.0)
    assert [(o.side, o.first, o.last, o.kind) for o in chip.openings] == [
        ("left", 67, 79, "inlet"),
        ("left", 116, 122, "inlet"),
        ("right", 112, 118, "outlet"),
        ("bottom", 40, 55, "inlet"),
    ]
    assert chip.openings[0].value == pytest.approx(729.8, abs=0.1)
    assert chip.walls == "pixel"


@pytest.mark.parametrize("name", ["bifurcation", "vessels", "straight"])
def test_named_places_lie_in_the_middle_of_the_channel_behind_their_opening(name):
    chip = load_chip(ChipSettings(name))
    for place in ("inlet", "outlet", "outlet:0"):
        check_point(chip, opening_point_um(chip, place, 250.0), place, 70.0)
    with pytest.raises(ChipError, match="'inlet:7'"):
        opening_point_um(chip, "inlet:7", 250.0)


def test_the_distance_to_an_opening_is_that_to_the_border_of_the_image():
    mask = np.ones((6, 9), bool)
    chip = Chip("border", mask, 20.0, (), 1.0, 1000.0)
    for side, row, column in (("left", 2, 0), ("right", 2, 8), ("top", 0, 4), ("bottom", 5, 4)):
        opening = Opening(side, 0, 3 if side in ("left", "right") else 7, "outlet", 0.0)
        # The centre of a border pixel is half a pixel, 10 um, from the border.
        assert distance_um(chip, opening, 20.0 * np.array([column, row])) == pytest.approx(10.0)
    left, right = (Opening(side, 0, 5, "outlet", 0.0) for side in ("left", "right"))
    across = [distance_um(chip, opening, (70.0, 40.0)) for opening in (left, right)]
    assert sum(across) == pytest.approx(9 * 20.0)
    # Beside an opening: to its nearest place.
    corner = replace(left, last=1)
    assert distance_um(chip, corner, (0.0, 100.0)) == pytest.approx(np.hypot(10.0, 80.0))


@pytest.mark.parametrize("um_per_px", [5.0, 20.0])
def test_the_point_of_an_opening_lies_so_many_um_along_the_channel_in_its_middle(um_per_px):
    mask = np.zeros((15, 200), bool)
    mask[4:11] = True
    openings = Opening("left", 4, 10, "inlet", 100.0), Opening("right", 4, 10, "outlet", 0.0)
    chip = Chip("straight", mask, um_per_px, openings, 1.0, 1000.0)
    for name, end_px, sign in (("inlet", 0.0, 1.0), ("outlet", 199.0, -1.0)):
        x_um, y_um = opening_point_um(chip, name, 300.0)
        assert (x_um, y_um) == pytest.approx((end_px * um_per_px + sign * 300.0, 7.0 * um_per_px))


def test_a_depth_of_nothing_takes_a_depth_away():
    assert load_chip(ChipSettings(depth_um=60.0)).depth_um == 60.0
    assert load_chip(ChipSettings(depth_um=0.0)).depth_um is None
