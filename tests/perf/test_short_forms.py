"""Measurements that no other test runs, in their shortest form."""

import pytest

from flowrec.bench.flow import make_up
from flowrec.core import UsageError
from tests.perf import grid, large


@pytest.mark.slow("fits constants on a grid twice as fine")
def test_the_constants_of_the_grid_error_are_fitted_to_cases_with_a_finer_truth(tmp_path, capsys):
    make_up(tmp_path, 2)
    results = grid.measure(tmp_path)
    grid.show(results)
    assert all(row["left"] <= row["error"] for row in results["rows"]) and 0.0 < results["left_share"] < 1.0
    assert "made_up_01" in capsys.readouterr().out
    with pytest.raises(UsageError, match="has no coarser grid"):
        grid.measure(tmp_path, 1)


@pytest.mark.slow("writes and reads 0.2 GB of images")
def test_poses_of_a_sparse_session_are_read_without_its_pixels(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(large, "LOADS", large.LOADS[:1])
    results = large.measure(0.2, tmp_path)
    large.show(results)
    (row,) = results["rows"]
    assert row["gigabytes"] > 0.19 and row["on_disk_mb"] < 20.0
    assert row["second_read_mb"] < 0.1 * 1e3 * row["gigabytes"] and row["second_count"] > 50
    assert not list(tmp_path.iterdir()) and "640 x 512" in capsys.readouterr().out
