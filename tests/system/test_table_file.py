"""Tables as people save them: separators, byte orders, Excel; and what is no number is named with its line."""

import openpyxl
import pytest

from flowrec.errors import UsageError
from flowrec.system.table_file import read_table

HEADER, ROWS = ["t", "Heading °"], [[0.5, -90.0], [1.25, 30.0]]


def excel(path):
    book = openpyxl.Workbook()
    for row in [["# made by a rig"], HEADER, *ROWS, [None, None]]:
        book.active.append(row)
    book.create_sheet("notes").append(["nothing"])
    book.save(path)


WRITTEN = {
    "comma.csv": lambda path: path.write_text("# rig 3\nt,Heading °\n0.5,-90\n\n1.25,30.0\n", "utf-8"),
    "german.csv": lambda path: path.write_text("t;Heading °\n0,5;-90\n1,25;30,0\n", "utf-8-sig"),
    "tabs.txt": lambda path: path.write_text("t\tHeading °\r\n0.5\t-90\r\n1.25\t30\r\n", "utf-16"),
    "book.xlsx": excel,
    "renamed.csv": excel,
}


@pytest.mark.parametrize("name", WRITTEN)
def test_the_same_table_is_read_however_it_was_saved(name, tmp_path):
    WRITTEN[name](tmp_path / name)
    table = read_table(tmp_path / name)
    assert table.header == tuple(HEADER)
    assert [table.numbers("T").tolist(), table.numbers("heading °").tolist()] == [[0.5, 1.25], [-90.0, 30.0]]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("t,f\n0,1\n1,nan\n2,nan\n", r"line 3: f is nan \(and 1 more rows\); leave these rows out"),
        ("t,f\n0,1\n\n1,\n", "line 4: f is empty"),
        ("t,f\n0,1\n12:03:05,1\n", r"line 3: t = '12:03:05' is no number"),
        ("t,f\n0,1\n1\n", "line 3: 1 values where the header has 2"),
        ("t,f,f\n0,1,2\n", "two columns are named f"),
        ("t,g\n0,1\n", "no column f; its columns are t, g"),
        ("", "is empty"),
    ],
)
def test_a_table_that_can_not_be_used_is_refused_in_one_line(text, why, tmp_path):
    (tmp_path / "log.csv").write_text(text)
    with pytest.raises(UsageError, match=why) as refused:
        [read_table(tmp_path / "log.csv").numbers(name) for name in "tf"]
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("data", [b"PK\x03\x04 no zip", b"\x89PNG\r\n\x1a\n\0\0", bytes(100)])
def test_a_file_that_is_no_table_is_refused(data, tmp_path):
    (tmp_path / "log.csv").write_bytes(data)
    with pytest.raises(UsageError, match=r"log\.csv"):
        read_table(tmp_path / "log.csv").numbers("time_s")
