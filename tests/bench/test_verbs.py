"""The command line of the benches: options are those of `measure`."""

import inspect
import json
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Annotated, get_origin

import pytest
import typer
from typer.testing import CliRunner

from flowrec.bench import harness
from flowrec.bench.bench_verb import BENCHES, bench
from flowrec.core.system.endings import Ended

PERF = sorted(path.stem for path in (Path(__file__).parents[1] / "perf").glob("*.py"))


def options_of(measure):
    parameters = inspect.signature(measure, eval_str=True).parameters.values()
    return {one.name.replace("_", "-") for one in parameters if get_origin(one.annotation) is Annotated}


@pytest.mark.parametrize("name", BENCHES)
def test_the_help_of_a_bench_has_its_summary_and_the_options_of_its_measure(name):
    done = CliRunner().invoke(bench, [name, "--help"], env={"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"})
    assert done.exit_code == 0, done.output
    shown = " ".join(done.output.split())
    assert BENCHES[name].split(":")[0] in shown and "--json" in shown and "--overwrite" in shown
    module = import_module(f"flowrec.bench.{name}")
    renamed = {"folder", "k", "tree-channels", "tree-iterations", "sets"}  # declared with names of their own
    assert all(f"--{option}" in shown for option in options_of(module.measure) - renamed)


def test_results_that_count_faults_end_with_status_1_after_they_are_written(tmp_path):
    out = tmp_path / "a.json"

    def measure(count: Annotated[int, typer.Option()] = 3, hidden: int = 7):
        return {"fault_count": count, "hidden": hidden}

    for count, status in ((0, 0), (2, 1)):
        with pytest.raises(SystemExit) as ended:
            harness.run(measure, print, ["--count", str(count), "--out", str(out), "--overwrite", "--json"], "a", "b")
        assert ended.value.code == status
        assert json.loads(out.read_text())["fault_count"] == count
    with pytest.raises(SystemExit) as ended:
        harness.run(measure, print, ["--hidden", "3"], "a", "b")
    assert ended.value.code == 2


@pytest.mark.parametrize("within", ["measure", "show"])
def test_a_bench_that_is_stopped_says_so_and_leaves_no_file(within, tmp_path, capsys):
    def stopped_in(place):
        if place == within:
            raise Ended(signal.SIGTERM)

    def measure(count: Annotated[int, typer.Option()] = 3):
        stopped_in("measure")
        return {}

    words = ["--out", str(tmp_path / "a.json"), *(["--json"] if within == "measure" else [])]
    with pytest.raises(SystemExit) as ended:
        harness.run(measure, lambda _: stopped_in("show"), words, "a", "b")
    said = capsys.readouterr()
    assert (
        ended.value.code == 143 and said.err.count("\n") == 1 and "SIGTERM" in said.err and not list(tmp_path.iterdir())
    )
    assert not said.out or json.loads(said.out)["exit_status"] == 143
    assert bool(said.out) == (within == "measure")


HELP_OF_EACH = """
import runpy, sys
for name in sys.argv[1:]:
    sys.argv = [name, "--help"]
    try:
        runpy.run_module(f"tests.perf.{name}", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        print("status", end.code or 0)
"""


@pytest.mark.slow("imports the libraries of six measurements in a process of its own")
def test_engineering_measurements_run_as_modules():
    names = ("clocks", "fuzz", "grid", "large", "stops", "store")
    words = [sys.executable, "-c", HELP_OF_EACH, *names]  # one process: most of its time are the libraries
    done = subprocess.run(words, check=False, capture_output=True, text=True)
    helps = done.stdout.split("status 0\n")
    assert done.returncode == 0 and len(helps) == len(names) + 1, done.stderr
    assert all("--json" in text for text in helps[:-1]) and set(names) <= set(PERF)
