"""The bench of the paper: what is stopped goes on, rows say what made them, pairs and intervals are what they say."""

import json
from pathlib import Path

import numpy as np
import pytest

from flowrec.bench import paper
from flowrec.bench.paper import Experiment, compare, measure, read_rows, row_key
from flowrec.bench.paper_figures import FIGURES, draw
from flowrec.bench.paper_rows import as_text, mean_of, read_parquet, select, share_of, write_parquet
from flowrec.core.errors import FlowError, UsageError

CELLS = {"method": ("a", "b"), "level": (1, 2)}
STORED = Path(__file__).parents[2] / "notebooks" / "paper_rows.parquet"


class Cases:
    """A quick experiment that counts its cases and can be stopped at one of them."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.seen: list[tuple[int, str, int]] = []
        self.stop_at = stop_at

    def __call__(self, seed: int, data: Path | None, method: str, level: int) -> dict[str, float]:
        if len(self.seen) == self.stop_at:
            raise KeyboardInterrupt
        self.seen.append((seed, method, level))
        return {"error": seed + 0.1 * level}

    def experiments(self, **more: object) -> dict[str, Experiment]:
        return {"toy": Experiment("Fig. 0", self, CELLS, **more)}  # type: ignore[arg-type]


def lines(folder: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


def test_a_stopped_run_goes_on_and_has_each_case_once(tmp_path):
    first, second = Cases(stop_at=6), Cases()
    with pytest.raises(KeyboardInterrupt):
        measure(tmp_path, seeds="0:3", experiments=first.experiments())
    assert len(lines(tmp_path)) == 6
    found = measure(tmp_path, seeds="0:3", experiments=second.experiments())
    assert not set(first.seen) & set(second.seen) and len(first.seen + second.seen) == 12
    keys = [row_key("toy", {name: row[name] for name in CELLS}, row["seed"]) for row in lines(tmp_path)]
    assert len(keys) == len(set(keys)) == 12
    assert found["cells"][0]["fewest"] == found["cells"][0]["most"] == 3


def test_a_stop_leaves_cells_of_equal_size(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        measure(tmp_path, seeds="0:9", experiments=Cases(stop_at=10).experiments())
    counts = [sum((row["method"], row["level"]) == cell for row in lines(tmp_path)) for cell in (("a", 1), ("b", 2))]
    assert max(counts) - min(counts) <= 1


def test_a_line_that_was_cut_short_is_made_again(tmp_path):
    measure(tmp_path, seeds="0:1", experiments=Cases().experiments())
    file = tmp_path / "rows.jsonl"
    file.write_bytes(file.read_bytes()[:-9])
    again = Cases()
    measure(tmp_path, seeds="0:1", experiments=again.experiments())
    assert again.seen == [(0, "b", 2)] and len(lines(tmp_path)) == 4


def test_a_row_states_what_made_it_and_how_long_it_took(tmp_path):
    measure(tmp_path, seeds="0:1", experiments=Cases().experiments())
    for row in lines(tmp_path):
        assert row["commit"] and row["processor"] and row["numerics"] and row["failed"] == ""
        assert len(str(row["date"]).split("-")) == 3 and row["seconds"] >= 0.0 and row["cpu_seconds"] >= 0.0
        assert {"experiment", "method", "level", "seed", "error"} <= row.keys()


def test_a_case_that_can_not_be_computed_is_a_row_with_its_reason(tmp_path):
    def fails(seed, data, method, level):
        raise FlowError("the channel is closed")

    experiments = {"toy": Experiment("Fig. 0", fails, CELLS)}
    found = measure(tmp_path, seeds="0:1", experiments=experiments)
    assert {row["failed"] for row in lines(tmp_path)} == {"the channel is closed"}
    assert found["cells"][0]["failed"] == 4 and select(lines(tmp_path), "toy") == []


def test_what_needs_absent_data_is_left_out_and_said(tmp_path, capsys):
    measure(tmp_path, seeds="0:1", experiments=Cases().experiments(needs="vessels"))
    assert "toy" in "".join(capsys.readouterr()) and not (tmp_path / "rows.jsonl").exists()


def test_another_file_is_refused(tmp_path):
    (tmp_path / "rows.jsonl").write_text('{"world": "kind"}\n')
    with pytest.raises(UsageError, match="line 1: is no row"):
        read_rows(tmp_path / "rows.jsonl", paper.EXPERIMENTS)


def test_the_table_has_the_rows_as_they_were_written(tmp_path):
    rows = [
        {"experiment": "toy", "seed": 0, "failed": "", "error": 1, "trace": [0.5, 0.25], "reached": True},
        {"experiment": "toy", "seed": 1, "failed": "", "error": 0.5, "note": "x"},
    ]
    write_parquet(rows, tmp_path / "rows.parquet")
    assert read_parquet(tmp_path / "rows.parquet") == rows


def navigations(seeds: list[int], navigation: str, factor: float) -> list[dict[str, object]]:
    cell = {"chip": "straight", "world": "kind", "sampler": "filter", "navigation": navigation}
    return [
        {
            "experiment": "missions",
            "seed": seed,
            "failed": "",
            **cell,
            "way": way,
            "time_s": factor * (1 + seed) * scale,
        }
        for way, scale in (("down", 1.0), ("up", 7.0))
        for seed in seeds
    ]


def test_pairs_have_the_seed_and_the_rest_of_the_cell_in_common():
    rows = navigations([4, 0, 2, 9], "astar_paper", 0.5) + navigations([9, 2, 5, 4, 0], "astar_length", 1.0)
    found = compare(rows, "navigation", "astar_paper", "astar_length", "time_s")
    assert found["count"] == 8 and found["mean"] == pytest.approx(0.5)
    assert found["interval_95"] == pytest.approx((0.5, 0.5)), "pairs of other seeds or ways would scatter"


def test_the_interval_of_a_mean_shrinks_with_the_number_of_cases():
    values = np.random.default_rng(1).normal(10.0, 1.0, 400)

    def width(count: int) -> float:
        low, high = mean_of([{"x": float(value)} for value in values[:count]], "x")["interval_95"]
        return float(high - low)

    assert width(400) / width(25) == pytest.approx(0.25, rel=0.35)
    half = [{"reached": number % 2 == 0} for number in range(100)]
    few, many = share_of(half[:10], "reached"), share_of(half, "reached")
    assert np.diff(many["interval_95"]) < 0.5 * np.diff(few["interval_95"])


def test_one_value_alone_has_no_interval_but_a_share_has():
    assert as_text(mean_of([{"x": 2.0}], "x"), "{:.1f}") == "2.0 (n 1)"
    assert as_text(share_of([{"x": True}], "x"), "{:.0%}") == "100% (21% to 100%; n 1)"
    assert as_text(mean_of([], "x")) == "none"


def test_a_value_that_a_row_lacks_does_not_count():
    assert mean_of([{"x": 2.0}, {"x": None}, {}], "x")["count"] == 1
    rows = navigations([0, 1], "astar_paper", 0.5) + navigations([0, 1], "astar_length", 1.0)
    rows[0]["time_s"] = None
    assert compare(rows, "navigation", "astar_paper", "astar_length", "time_s")["count"] == 3


def test_the_stored_rows_are_of_one_commit_without_local_changes_and_of_every_experiment():
    rows = read_parquet(STORED)
    (commit,) = {row["commit"] for row in rows}
    assert commit and "local changes" not in commit
    assert {row["experiment"] for row in rows} == set(paper.EXPERIMENTS)
    keys = [
        row_key(
            row["experiment"], {name: row[name] for name in paper.EXPERIMENTS[row["experiment"]].cells}, row["seed"]
        )
        for row in rows
    ]
    assert len(keys) == len(set(keys))
    # Each cell of an experiment has as many cases as the others, but for the last seed of a run that was stopped.
    for name, experiment in paper.EXPERIMENTS.items():
        found = paper.summary(name, experiment, rows)
        assert found["fewest"] > 0 and found["most"] - found["fewest"] <= 1, name


@pytest.mark.slow("draws every figure of the paper")
def test_each_figure_is_drawn_of_the_stored_rows():
    rows = read_parquet(STORED)
    for number, name in enumerate(FIGURES):
        assert draw(name, rows, (88.0, 180.0)[number % 2]).startswith(b"%PDF"), name
