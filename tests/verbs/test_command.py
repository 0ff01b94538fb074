"""A command follows from the function of its verb: options, help, JSON, what is printed, and the exit status."""

import inspect
import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer
from typer.main import get_command
from typer.testing import CliRunner

import flowrec
from flowrec.core import Ended, UsageError
from flowrec.verbs import Asked, MisuseError, Told, verb
from flowrec.verbs.cli import app
from flowrec.verbs.command import MethodsOf, add_verb
from flowrec.verbs.options import Supplied

TABLE = "flowrec.stages.planning.planner:PLANNERS"


class Counted:
    """A result with all that a result may have."""

    def __init__(self, count: int, status: int = 0) -> None:
        self.count, self.exit_status = count, status

    def as_json(self) -> dict[str, int]:
        return {"count": self.count}

    def lines(self) -> list[str]:
        return [f"counted {self.count}\x1b[2J"]


def told(_asked: Asked, found: Counted) -> Told:
    return Told.of(found)._replace(remarks=lambda: ["remarked"])


def run(function: Callable[..., Any], *words: str) -> Any:
    group = typer.Typer()
    add_verb(group, function, "count")
    return CliRunner().invoke(group, list(words))


def counting(
    limit: Annotated[int | str, typer.Option("--limit", "-n", min=1, help="How far.")] = 3,
    plan: Annotated[str | None, typer.Option(help="How."), MethodsOf(TABLE)] = None,
    given: Annotated[int, Supplied(lambda: 40)] = 0,
    hidden: int = 7,
) -> Counted:
    """Count up to a limit.

    Parameters
    ----------
    given : what the terminal makes.

    Raises
    ------
    UsageError : never.
    """
    if plan == "astar":
        raise MisuseError("a plan does not count", "--plan")
    if plan == "stop":
        raise Ended
    if plan == "stop early":
        raise Ended(result=Counted(1, 130))
    if plan == "refuse":
        raise UsageError("no")
    return Counted(int(limit) + given + hidden, 3 if limit == 5 else 0)


count = verb(
    "flowrec count -n 4", result=told, refused=lambda asked, error: {"limit": asked["limit"], "why": str(error)}
)(counting)


def test_a_verb_prints_lines_remarks_and_json_and_ends_with_the_status_of_its_result() -> None:
    done = run(count, "-n", "4")
    assert (done.exit_code, done.stdout) == (0, "counted 51\\x1b[2J\n")
    assert "remarked" in done.stderr
    done = run(count, "--json", "-n", "5")
    assert (done.exit_code, json.loads(done.stdout)) == (3, {"count": 52})


def test_a_verb_whose_options_are_text_is_refused_where_it_is_declared() -> None:
    def late(limit: "Annotated[int, typer.Option()]" = 3) -> None:
        """Count."""

    with pytest.raises(TypeError, match="limit"):
        verb()(late)


def test_a_call_from_python_is_given_nothing_by_the_terminal() -> None:
    assert count(2).count == count("2").count == 9


def test_options_keep_their_range_and_arguments_that_do_not_go_together_are_wrong_usage() -> None:
    assert run(count, "-n", "0").exit_code == 2
    done = run(count, "--plan", "astar")
    assert done.exit_code == 2
    assert "Invalid value for --plan: a plan does not count" in " ".join(done.stderr.replace("│", "").split())


def test_a_verb_that_was_stopped_tells_what_it_has_and_a_refusal_is_json_where_it_is_declared() -> None:
    done = run(count, "--plan", "stop early", "--json")
    assert (done.exit_code, json.loads(done.stdout)) == (130, {"count": 1})
    done = run(count, "--plan", "stop", "--json")
    assert done.exit_code and not done.stdout
    done = run(count, "--plan", "refuse", "--json")
    assert (done.exit_code, json.loads(done.stdout)) == (2, {"limit": 3, "why": "no"})
    assert isinstance(run(count, "--plan", "refuse").exception, UsageError)


def test_help_and_documentation_come_from_one_place() -> None:
    shown = " ".join(run(count, "--help").stdout.replace("│", "").split())
    assert "How far." in shown and "flowrec count -n 4" in shown and "astar_time: " in shown
    assert "given" not in shown and "Raises" not in shown and "hidden" not in shown
    assert count.__doc__ is not None
    text = inspect.cleandoc(count.__doc__)
    assert "limit : How far.\nplan : How.\ngiven : what the terminal makes.\n\nRaises" in text
    assert inspect.signature(count).parameters["plan"].annotation == str | None


def test_the_defaults_of_a_command_are_those_of_the_function() -> None:
    commands = get_command(app).commands  # type: ignore[attr-defined]
    functions = {name: getattr(flowrec, name) for name in ("record", "replay", "export", "report", "info")}
    for name, function in {**functions, "import": flowrec.import_movie}.items():
        parameters = inspect.signature(function).parameters
        for each in commands[name].params:
            if each.name not in ("as_json", "help"):
                wanted = parameters[each.name].default
                assert each.required == (wanted is inspect.Parameter.empty), each.name
                assert each.required or each.default == wanted, each.name


def test_a_run_from_python_takes_typed_options_over_a_file(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text("[recording]\noperator = 'a'\nsample = 'b'\n")
    sets = {"mission.phases": ("survey",), "recording.operator": "007", "recording.notes": 'a "quoted" true'}
    for config in (file, str(file), flowrec.load_config(file)):
        done = flowrec.record(config, goal=(4760, 1760), seed=4, split="2GB,10min", sets=sets, dry_run=True)
        made = done.config
        assert (made.recording.operator, made.recording.sample) == ("007", "b")
        assert made.recording.notes == 'a "quoted" true'
        assert (made.mission.goal, made.simulated.seed) == ((4760.0, 1760.0), 4)
        assert (made.recording.split_mb, made.recording.split_s) == (2000.0, 600.0)
    with pytest.raises(UsageError, match="as in --split 2GB,10min"):
        flowrec.record(file, split="3", dry_run=True)
    with pytest.raises(UsageError, match=r"--goal: .*mission\.goal"):
        flowrec.record(file, goal=(1.0, float("nan")), dry_run=True)
