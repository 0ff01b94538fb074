import numpy as np
import pytest
from scipy.ndimage import label

from flowrec.bench.vessel_truth import read_observations, read_true_velocity
from flowrec.bench.vessels import draw_mask, make_case, thin
from flowrec.core.errors import ChipError
from flowrec.physics.chip.io import read_vessel_case
from flowrec.physics.flow.solver import FlowSolver

EIGHT = np.ones((3, 3))


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    path = tmp_path_factory.mktemp("cases") / "case.npz"
    np.savez(path, **made_case(0, truth_k=4))
    return path


def test_a_skeleton_is_thin_and_as_connected_as_its_mask():
    for seed in (0, 3, 4, 5):
        mask = draw_mask(np.random.default_rng(seed))
        skeleton = thin(mask)
        assert (skeleton <= mask).all()
        assert label(skeleton, EIGHT)[1] == label(mask, EIGHT)[1]
        # Nowhere a square of four pixels, but for a few knots.
        squares = skeleton[1:, 1:] & skeleton[:-1, 1:] & skeleton[1:, :-1] & skeleton[:-1, :-1]
        assert skeleton.sum() > 0 and squares.sum() < 0.03 * skeleton.sum()


def test_a_made_up_case_is_read_like_any_other_and_its_truth_obeys_its_true_parameters(case):
    chip = read_vessel_case(case)
    truth = read_true_velocity(case)
    with np.load(case) as known:
        values = np.where(known["op_type"] == "inlet", known["op_u_true"] * 1e6, known["op_p_true"])
        real = chip.with_boundary(values, float(known["mu"]) * 1e3, float(known["rho"]))
    again = FlowSolver(4).solve(real).velocity_um_s
    assert np.abs(again - truth).max() < 1e-5 * np.abs(truth).max()
    assumed = FlowSolver(2).solve(chip).velocity_um_s
    assert np.abs(assumed - truth).max() > 0.02 * np.abs(truth).max()


def test_observations_of_a_case_lie_on_its_way_with_the_stated_noise(case):
    chip, truth = read_vessel_case(case), read_true_velocity(case)
    clean, noisy = (read_observations(case, noise, "20") for noise in ("00", "10"))
    column, row = (clean.position_um / chip.um_per_px).round().astype(int).T
    assert chip.mask[row, column].all()
    assert clean.flow_um_s == pytest.approx(truth[row, column])
    assert (clean.std_um_s == 0.0).all()
    pull = (noisy.flow_um_s - clean.flow_um_s) / noisy.std_um_s[:, None]
    assert 0.7 < np.sqrt((pull**2).mean()) < 1.3
    assert len(read_observations(case, "05", "05").std_um_s) < len(clean.std_um_s)


def test_a_case_needs_no_truth_to_be_read_and_says_what_it_lacks(case, tmp_path):
    with np.load(case) as known:
        blind = {key: known[key] for key in known.files if key not in ("vx", "vy", "p", "op_u_true", "op_p_true")}
    path = tmp_path / "blind.npz"
    np.savez(path, **blind)
    read_vessel_case(path)
    read_observations(path, "05", "10")
    with pytest.raises(ChipError, match="no vx, vy"):
        read_true_velocity(path)


def test_the_same_seed_makes_the_same_case():
    first, second = (made_case(12) for _ in range(2))
    for key, value in first.items():
        assert np.array_equal(value, second[key], equal_nan=np.asarray(value).dtype.kind == "f"), key


def made_case(seed, truth_k=1):
    while True:
        rng = np.random.default_rng(seed)
        made = make_case(draw_mask(rng), rng, truth_k)
        if made is not None:
            return made
        seed += 1
