"""The words of the sources: one class a name, docstrings that state a result, short functions, keys that exist."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

from flowrec.stages import Config
from tests.sources import PACKAGE, tree_of

LONGEST = 60  # lines of a function without its docstring
QUESTION = re.compile(r"(Why|What|Of|The same|How|Whether|Where|When|Which|Who|Whose)\b")
# A participle alone tells neither what a function does nor what it returns. A property may have one.
PARTICIPLE = re.compile(
    r"(?!.*(need|feed|speed|seed|embed|exceed)$)([a-z]+ed|begun|bound|broken|built|chosen|done|drawn|driven|flown|found|given|gone"
    r"|grown|heard|held|hidden|kept|known|left|lost|made|met|said|seen|sent|shown|stuck|swept|taken|thrown|told|woken|worn|written)"
)
# Ends of names that state a unit, or what is counted.
UNIT = re.compile(
    r"(?i).*_((um|mm|m|in|px|ns|us|ms|s|days|minutes|hz|rad|deg|mt|pa|mpa_s|kg_m3|m_s|um_s|j_k|bytes|gb|mb|bits)"
    r"|(characters|files|frames|lines|pages|pixels|rows|threads|ticks))"
)
LONG = "Long because"  # begins the sentence that gives the reason

Function = ast.FunctionDef | ast.AsyncFunctionDef

# Exceptions, with the rename or the work that will end them. A list only shrinks: an entry that is not needed fails.
CAMERAS = ("camera", "genicam", "mmcore", "pylon")
PARTICIPLES = {
    **{f"rigs/lab/cameras/{name}.py: discarded": "cameras of other packages implement it" for name in CAMERAS},
    **{f"rigs/{name}.py: connected": "rigs of other packages implement it" for name in ("rig", "lab/rig")},
    **{f"rigs/{name}.py: tried": "rigs of other packages implement it" for name in ("rig", "lab/rig", "simulated/rig")},
    "stages/planning/problem.py: timed": "planners of other packages call it",
    "verbs/template/lab_plugin.py: discarded": "a camera of another package",
    "core/system/numba_setup.py: compiled": "a decorator",
}


@cache
def definitions() -> list[tuple[str, ast.Module | ast.ClassDef | Function]]:
    """Each module, class and function of the package, with its file."""
    return [
        (path.relative_to(PACKAGE).as_posix(), node)
        for path in sorted(PACKAGE.rglob("*.py"))
        for node in within(tree_of(path))
    ]


def within(node: ast.AST) -> Iterator[ast.Module | ast.ClassDef | Function]:
    """A module, class or function and those inside; expressions, most of a tree, hold none."""
    if isinstance(node, ast.Module | ast.ClassDef | Function):
        yield node
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
            yield from within(child)


def length_of(function: Function) -> int:
    """Lines of a function without its docstring."""
    first, lines = function.body[0], int(function.end_lineno or 0) - function.lineno + 1
    return lines if ast.get_docstring(function) is None else lines - (int(first.end_lineno or 0) - first.lineno + 1)


def is_property(function: Function) -> bool:
    return any("property" in ast.unparse(each) for each in function.decorator_list)


def test_no_two_classes_have_one_name() -> None:
    files: dict[str, list[str]] = {}
    for file, node in definitions():
        if isinstance(node, ast.ClassDef):
            files.setdefault(node.name, []).append(file)
    assert {name: where for name, where in files.items() if len(where) > 1} == {}


def test_no_docstring_begins_with_a_question_word() -> None:
    found = [f"{file}: {text}" for file, node in definitions() if QUESTION.match(text := ast.get_docstring(node) or "")]
    assert found == []


def test_a_long_function_gives_its_reason() -> None:
    found = {
        f"{file}: {node.name}"
        for file, node in definitions()
        if isinstance(node, Function) and length_of(node) > LONGEST and LONG not in (ast.get_docstring(node) or "")
    }
    assert found == set()


def test_no_function_is_named_by_a_bare_participle() -> None:
    found = [
        f"{file}: {node.name}"
        for file, node in definitions()
        if isinstance(node, Function) and PARTICIPLE.fullmatch(node.name.strip("_")) and not is_property(node)
    ]
    assert [each for each in found if not each.startswith(tuple(PARTICIPLES))] == []
    unused = [place for place in PARTICIPLES if not any(each.startswith(place) for each in found)]
    assert unused == [], "take it from the list"


def is_number(value: ast.expr) -> bool:
    """Whether an expression is a number, a tuple of numbers, or computed from numbers alone."""
    match value:
        case ast.Constant():
            return isinstance(value.value, int | float) and not isinstance(value.value, bool)
        case ast.UnaryOp():
            return is_number(value.operand)
        case ast.BinOp():
            return is_number(value.left) and is_number(value.right)
        case ast.Tuple():
            return bool(value.elts) and all(map(is_number, value.elts))
    return False


def unexplained_numbers(module: ast.Module, lines: list[str]) -> Iterator[str]:
    """Names of a module's numbers without a unit and without a comment, behind them or above their paragraph."""
    end, explained = 0, False  # of the assignment above
    for node in module.body:
        match node:
            case ast.Assign(targets=[target], value=value) | ast.AnnAssign(target=target, value=ast.expr() as value):
                names = [each.id for each in ast.walk(target) if isinstance(each, ast.Name)]
            case _:
                continue
        first, last = node.lineno, node.end_lineno or node.lineno
        explained = lines[first - 2][:1] == "#" or (explained and first == end + 1)
        end = last
        if is_number(value) and not explained and not any("#" in line for line in lines[first - 1 : last]):
            yield from (name for name in names if not UNIT.fullmatch(name))


def test_each_number_of_a_module_states_its_unit_or_its_reason() -> None:
    found = [
        f"{file}: {name}"
        for file, node in definitions()
        if isinstance(node, ast.Module)
        for name in unexplained_numbers(node, (PACKAGE / file).read_text(encoding="utf-8").split("\n"))
    ]
    assert found == [], "say in a comment where the number comes from"


def test_a_number_is_explained_by_its_name_or_the_comment_of_its_paragraph() -> None:
    def names(source: str) -> list[str]:
        return list(unexplained_numbers(ast.parse(source), source.split("\n")))

    assert names("# Limits.\nA = 1\nB = 2\n\nLEAST_UM = 3.0\nD = 4  # of five\nE = F\n") == []
    assert names("# Limits.\nA = 1\n\nB = -2.0\nC: int = 1 << 3\nD, E_S = 1, 2\n") == ["B", "C", "D"]


KEY = re.compile(r"(?<![\w/.*{])([a-z_]{2,}(?:\.[a-z_0-9]+)+)")


def keys(settings: object, prefix: str = "") -> set[str]:
    found = set()
    for field in fields(settings):  # type: ignore[arg-type]
        value, key = getattr(settings, field.name), prefix + field.name
        found |= {key, *(keys(value, f"{key}.") if is_dataclass(value) else ())}
    return found


def messages(source: Path) -> list[str]:
    """What is raised, warned of or said, as written in the source."""
    found = []
    for node in ast.walk(tree_of(source)):
        called = getattr(node.func, "id", getattr(node.func, "attr", "")) if isinstance(node, ast.Call) else ""
        told = node.exc if isinstance(node, ast.Raise) else node if called in ("warn", "say", "bad", "odd") else None
        if told is not None:
            found += [s.value for s in ast.walk(told) if isinstance(s, ast.Constant) and isinstance(s.value, str)]
    return found


def test_every_key_that_a_message_names_exists() -> None:
    known = keys(Config())
    named = {key: text for source in PACKAGE.rglob("*.py") for text in messages(source) for key in KEY.findall(text)}
    assert len(named) > 20
    settings = {key: text for key, text in named.items() if not (key.startswith("flowrec.") or key.endswith(".py"))}
    assert {key: text for key, text in settings.items() if key not in known} == {}


def test_every_key_that_the_readme_names_exists() -> None:
    known, text = keys(Config()), (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    sections = {field.name for field in fields(Config())}
    named = {key.rstrip("._") for key in KEY.findall(text) if key.split(".")[0] in sections}
    files = {key for key in named if key.endswith((".png", ".csv", ".toml", ".mcap"))}
    assert named - known - files == set()
