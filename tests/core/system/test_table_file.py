"""Tables as people save them: separators, byte orders, Excel; and what is no number is named with its line."""

import re
import time
import zipfile
from datetime import UTC, datetime

import openpyxl
import pytest

from flowrec.core import UsageError, read_table

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


def test_a_column_is_found_in_other_spellings_and_one_of_the_very_name_goes_first(tmp_path):
    (tmp_path / "log.csv").write_bytes("Zeit für µ;Time [ms];Heading (°);f (Hz);F_Hz\n1;2,5;3;4;5\n".encode("cp1252"))
    table = read_table(tmp_path / "log.csv")
    assert [table.numbers(name)[0] for name in ("heading_deg", "F_Hz", "f (Hz)")] == [3.0, 5.0, 4.0]
    name, times_s = table.times_s()
    assert (name, times_s.tolist()) == ("time_ms", [0.0025])
    with pytest.raises(UsageError, match="f_hz"):
        table.numbers("f_hz")


DATED = [datetime(2026, 5, 3, 14, 0, 0, 500_000), datetime(2026, 5, 3, 14, 0, 1)]


@pytest.mark.parametrize("kind", ["iso", "with a zone", "time of day", "excel"])
def test_dates_are_times_and_a_number_is_never_taken_for_one(kind, tmp_path):
    written = {
        "iso": [each.isoformat() for each in DATED],
        "with a zone": [f"{each.isoformat(' ')}+02:00" for each in DATED],
        "time of day": [each.time().isoformat() for each in DATED],
        "excel": DATED,
    }[kind]
    if kind == "excel":
        book = openpyxl.Workbook()
        for cell in ["Time", *written]:
            book.active.append([cell, 1])
        book.save(tmp_path / "log.csv")
    else:
        (tmp_path / "log.csv").write_text("\n".join(["Time", *written]))
    _, times_s = read_table(tmp_path / "log.csv").times_s()
    first_s = 14 * 3600 + 0.5 if kind == "time of day" else DATED[0].replace(tzinfo=UTC).timestamp()
    first_s -= 7200.0 if kind == "with a zone" else 0.0
    assert times_s.tolist() == pytest.approx([first_s, first_s + 0.5], rel=0.0, abs=1e-6)
    (tmp_path / "log.csv").write_text("time\n140000\n140001\n")
    with pytest.raises(UsageError, match=r"'140000' .*time_s"):
        read_table(tmp_path / "log.csv").times_s()


@pytest.mark.skipif(not hasattr(time, "tzset"), reason="the zone of a process can not be set")
def test_dates_without_a_zone_are_those_of_utc_wherever_the_computer_is(tmp_path, monkeypatch):
    (tmp_path / "log.csv").write_text("time\n2026-05-03T14:00:00\n2026-05-03T14:00:01\n")
    with monkeypatch.context() as there:
        there.setenv("TZ", "XYZ-5:30")
        time.tzset()
        times_s = read_table(tmp_path / "log.csv").times_s()[1]
    time.tzset()
    assert times_s.tolist() == [datetime(2026, 5, 3, 14, 0, second, tzinfo=UTC).timestamp() for second in (0, 1)]


def test_a_first_sheet_without_a_table_is_named(tmp_path):
    book = openpyxl.Workbook()
    book.active.append(["notes"])
    for row in [HEADER, *ROWS]:
        book.create_sheet("log").append(row)
    book.save(tmp_path / "log.xlsx")
    with pytest.raises(UsageError, match="'Sheet'"):
        read_table(tmp_path / "log.xlsx")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("0,1\n1,1\n", "line 1: numbers where the names of the columns are expected"),
        ("t,f\n0,1\n1,nan\n2,nan\n", r"line 3: f is nan \(and 1 more rows\); leave these rows out"),
        ("t,f\n0,1\n\n1,\n", "line 4: f is empty"),
        ("t,f\n0,1\n12:03:05,1\n", r"line 3: t = '12:03:05' is no number"),
        ("t,f\n0,1\n1\n", "line 3: 1 values where the header has 2"),
        ("t,f\n0,1\n1,2,3\n", "line 3: 3 values where the header has 2"),
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


OVERLONG = {"cell.csv": "t,x\n0,1\n1," + "3" * 200_000 + "\n", "quote.csv": 't,x\n0,1\n1,"2\n' + "2,3\n" * 50_000}


@pytest.mark.parametrize("name", OVERLONG)
def test_a_cell_without_end_is_refused_with_its_line(name, tmp_path):
    (tmp_path / name).write_text(OVERLONG[name])
    with pytest.raises(UsageError, match=rf"{name}: line 3: "):
        read_table(tmp_path / name)


def test_a_sheet_that_names_a_row_beyond_the_last_is_refused(tmp_path):
    """Its reader makes an empty row for each that is left out."""
    excel(tmp_path / "book.xlsx")
    with (
        zipfile.ZipFile(tmp_path / "book.xlsx") as book,
        zipfile.ZipFile(tmp_path / "far.xlsx", "w", zipfile.ZIP_DEFLATED) as far,
    ):
        for part in book.namelist():
            text = re.sub(rb"<dimension[^>]*>", b"", book.read(part)) if "sheet1" in part else book.read(part)
            far.writestr(part, re.sub(rb'r="([A-Z]*)4"', rb'r="\g<1>2000000000"', text) if "sheet1" in part else text)
    with pytest.raises(UsageError, match=r"far\.xlsx: .*1048576"):
        read_table(tmp_path / "far.xlsx")
