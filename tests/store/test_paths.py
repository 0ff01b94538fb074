"""Names of the files of a run."""

from pathlib import Path

import pytest

from flowrec.store.paths import part_path, partial_path, parts, run_files, run_path, snapshot_path


@pytest.mark.parametrize("make", [lambda p: p, lambda p: part_path(p, 7), lambda p: snapshot_path(p, 1234)])
def test_every_piece_of_a_run_names_its_run(make):
    run = Path("somewhere/a.part.of.it.mcap")
    assert run_path(make(run)) == run
    assert run_path(partial_path(make(run))) == run


def test_parts_are_in_order_of_their_number_and_nothing_else_is_among_them(tmp_path):
    run = tmp_path / "x.mcap"
    numbers = (2, 999, 1000, 1)
    others = (snapshot_path(run, 1), partial_path(part_path(run, 3)), part_path(tmp_path / "xy.mcap", 1))
    for path in (*(part_path(run, number) for number in numbers), *others):
        path.touch()
    assert parts(run) == [part_path(run, number) for number in sorted(numbers)]
    assert set(run_files(run)) == {part_path(run, number) for number in numbers} | set(others[:2])
