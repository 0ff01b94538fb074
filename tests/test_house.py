"""The house: rooms have one door each, arrows lead downwards, and reading a session loads no solver."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.sources import PACKAGE, tree_of

ROOT = Path(__file__).parents[1]
GOLDEN = ROOT / "sessions" / "golden.mcap"


def room_of(path: Path) -> str:
    """The room of a file; '' for flowrec/__init__.py and __main__.py."""
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


@cache
def arrows() -> list[tuple[Path, str, str, str]]:
    """File, room that it imports from, rest of the module's name ('' for the door), and the imported name."""
    return list(_arrows())


def _arrows() -> Iterator[tuple[Path, str, str, str]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("flowrec."):
                _, other, *inner = str(node.module).split(".")
                yield from ((path, other, ".".join(inner), each.name) for each in node.names)
            elif isinstance(node, ast.Import):
                for each in node.names:
                    _, *rest = each.name.split(".")
                    if each.name.startswith("flowrec."):
                        yield path, rest[0], ".".join(rest[1:]), ""


def door_of(room: str) -> set[str]:
    """The names in the door of a room."""
    stub = PACKAGE / room / "__init__.pyi"
    tree = ast.parse(stub.read_text(encoding="utf-8")) if stub.exists() else ast.Module([], [])
    return {each.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for each in node.names}


ROOMS = sorted({room_of(path) for path in PACKAGE.rglob("*.py")} - {""})


def test_a_room_is_imported_by_its_door_alone() -> None:
    # The face of the package takes its version without loading a door, and its stub names the definitions.
    beside = [
        f"{path.relative_to(PACKAGE)}: flowrec.{room}.{inner}"
        for path, room, inner, _ in arrows()
        if inner and room != room_of(path) and path != PACKAGE / "__init__.py"
    ]
    assert beside == []


def test_a_door_has_the_names_that_others_take_and_no_more() -> None:
    taken: dict[str, set[str]] = {room: set() for room in ROOMS}
    for path, room, inner, name in arrows():
        if not inner and room != room_of(path):
            taken[room].add(name)
    assert {room: taken[room] for room in ROOMS} == {room: door_of(room) for room in ROOMS}


def test_the_house_has_at_most_fourteen_rooms_on_nine_floors() -> None:
    below: dict[str, set[str]] = {room: set() for room in ROOMS}
    for path, room, _, _ in arrows():
        if room_of(path) and room != room_of(path):
            below[room_of(path)].add(room)

    def floor(room: str, above: tuple[str, ...] = ()) -> int:
        assert room not in above, f"a circle of rooms: {' > '.join([*above, room])}"
        return 1 + max((floor(each, (*above, room)) for each in below[room]), default=0)

    floors = {room: floor(room) for room in ROOMS}
    assert len(ROOMS) <= 14 and max(floors.values()) <= 9, floors
    assert not any(room in {"archive", "bench"} for path, room, _, _ in arrows() if room_of(path) != room)


def test_reading_a_session_loads_neither_solver_nor_compiler_nor_viewer() -> None:
    code = (
        f"import flowrec; s = flowrec.open({str(GOLDEN)!r}); s.outcome, s.at(3.0), s.table('track'), flowrec.info(s)\n"
        "import sys; print(*sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, cwd=ROOT)
    assert not set(found.stdout.split()) & {"torch", "numba", "scipy", "rerun", "filterpy", "pydantic"}
