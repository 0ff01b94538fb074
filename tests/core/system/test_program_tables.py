"""Logs of MATLAB and of the Lab Streaming Layer are the tables that a CSV would hold; what is none is one line."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from flowrec.core import UsageError, read_table
from flowrec.stages import Coils, load_config, read_coil_log
from tests.extras import why

TIME, HERTZ, DEGREES, MT = (
    np.arange(6) * 0.5,
    np.array([0.0, 5.0, 5.0, 8.0, 8.0, 0.0]),
    np.array([0.0, 0.0, 90.0, 90.0, -45.0, 0.0]),
    np.array([0.0, 4.0, 4.0, 4.0, 4.0, 0.0]),
)
LOG = {"time_s": TIME, "frequency_hz": HERTZ, "heading_deg": DEGREES, "amplitude_mt": MT}
OTHERS = {"rate": 30.0, "name": "rig 3", "image": np.zeros((6, 300)), "note": np.array(["a", "b"], object)}


def hdf5(path: Path, variables: dict[str, Any], group: str = "") -> Path:
    """As MATLAB writes version 7.3: HDF5 behind a text of 512 bytes, matrices transposed, text as numbers."""
    h5py = pytest.importorskip("h5py", reason=why("h5py"))
    with h5py.File(path, "w", userblock_size=512) as file:
        into = file.create_group(group) if group else file
        for name, value in variables.items():
            if isinstance(value, str):
                made = into.create_dataset(name, data=np.array([[ord(letter)] for letter in value], np.uint16))
                made.attrs["MATLAB_class"] = np.bytes_("char")
            else:
                made = into.create_dataset(name, data=np.atleast_2d(np.asarray(value, np.float64)).T)
                made.attrs["MATLAB_class"] = np.bytes_("double")
        file.create_group("#refs#").create_dataset("a", data=np.zeros((9, 1)))
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, Created on: Mon Jan 01 12:00:00 2026 HDF5 schema 1.00 .")
    return path


def chunk(tag: int, content: bytes) -> bytes:
    return b"\x04" + struct.pack("<I", len(content) + 2) + struct.pack("<H", tag) + content


def xdf(path: Path, *streams: tuple[str, list[str], np.ndarray, np.ndarray]) -> Path:
    """By the specification of XDF 1.0: name, labels, times and samples of each stream, all in double precision."""
    made = [b"XDF:", chunk(1, b"<?xml version='1.0'?><info><version>1.0</version></info>")]
    for number, (name, labels, times, samples) in enumerate(streams, 1):
        channels = "".join(f"<channel><label>{label}</label></channel>" for label in labels)
        info = (
            f"<?xml version='1.0'?><info><name>{name}</name><type>log</type><channel_count>{samples.shape[1]}"
            "</channel_count><nominal_srate>0</nominal_srate><channel_format>double64</channel_format>"
            f"<desc><channels>{channels}</channels></desc></info>"
        )
        made.append(chunk(2, struct.pack("<I", number) + info.encode()))
        body = b"".join(
            b"\x08" + struct.pack("<d", at) + row.astype("<f8").tobytes()
            for at, row in zip(times, samples, strict=True)
        )
        made.append(chunk(3, struct.pack("<I", number) + b"\x04" + struct.pack("<I", len(times)) + body))
        foot = f"<?xml version='1.0'?><info><sample_count>{len(times)}</sample_count></info>"
        made.append(chunk(6, struct.pack("<I", number) + foot.encode()))
    path.write_bytes(b"".join(made))
    return path


def vectors(path: Path) -> Path:
    savemat(path, LOG | OTHERS)
    return path


def struct_of_columns(path: Path) -> Path:
    savemat(path, {"log": {name: column[:, None] for name, column in LOG.items()}, **OTHERS}, do_compression=True)
    return path


def stream(path: Path) -> Path:
    pytest.importorskip("pyxdf", reason=why("pyxdf"))
    return xdf(path, ("coils", list(LOG)[1:], TIME + 100.0, np.column_stack([HERTZ, DEGREES, MT])))


WRITTEN = {
    "vectors.mat": vectors,
    "struct.mat": struct_of_columns,
    "new.mat": lambda path: hdf5(path, LOG | {"rate": 30.0, "name": "rig 3"}),
    "new_struct.mat": lambda path: hdf5(path, LOG, "log"),
    "run.xdf": stream,
}


@pytest.mark.parametrize("name", WRITTEN)
def test_a_log_of_another_program_drives_as_that_of_a_csv_does(name: str, tmp_path: Path) -> None:
    log = read_coil_log(WRITTEN[name](tmp_path / name), load_config().movie.columns, Coils())
    lasts_s = np.diff(log.times_ns) * 1e-9
    assert lasts_s == pytest.approx(np.full(5, 0.5), abs=1e-6)
    assert log.frequency_hz == pytest.approx(HERTZ, abs=1e-9)
    assert np.degrees(log.heading_rad) == pytest.approx(DEGREES, abs=1e-9)
    assert log.amplitude_mt == pytest.approx(MT, abs=1e-9)


def test_a_matrix_with_as_many_rows_gives_a_column_each(tmp_path: Path) -> None:
    savemat(tmp_path / "b.mat", {"t": TIME, "B": np.outer(TIME, [1.0, 2.0, 3.0])})
    table = read_table(tmp_path / "b.mat")
    assert table.header == ("t", "B_1", "B_2", "B_3")
    assert table.numbers("B_3") == pytest.approx(3.0 * TIME)


def test_streams_of_other_rates_are_held_on_the_times_of_all_and_channels_of_one_name_say_whose_they_are(
    tmp_path: Path,
) -> None:
    pytest.importorskip("pyxdf", reason=why("pyxdf"))
    slow, fast = np.array([10.0, 11.0]), np.array([10.25, 10.5, 10.75, 11.25])
    table = read_table(
        xdf(
            tmp_path / "two.xdf",
            ("pump", ["value", "pressure"], slow, np.array([[1.0, 7.0], [2.0, 8.0]])),
            ("light", ["value"], fast, np.arange(4.0)[:, None]),
        )
    )
    assert table.header == ("time_s", "pump value", "pressure", "light value")
    times_s = table.numbers("time_s")
    assert times_s - times_s[0] == pytest.approx([0.0, 0.25, 0.5, 0.75, 1.0], abs=1e-6)
    assert table.numbers("pump value").tolist() == [1.0, 1.0, 1.0, 2.0, 2.0]
    assert table.numbers("light value").tolist() == [0.0, 1.0, 2.0, 2.0, 3.0]


def broken(made: Path, keep: float) -> Path:
    data = made.read_bytes()
    made.write_bytes(data[: int(keep * len(data))])
    return made


def saved(path: Path, **variables: Any) -> Path:
    savemat(path, variables)
    return path


def unlike(path: Path, text: bytes) -> Path:
    path.write_bytes(text)
    return path


WRONG = {
    "cut.mat": (lambda path: broken(vectors(path), 0.6), "can not be read"),
    "head.mat": (lambda path: unlike(path, b"MATLAB 5.0 MAT-file, and nothing else"), "can not be read"),
    "noise.mat": (lambda path: unlike(path, b"MATLAB 5.0 MAT" + bytes(range(256)) * 40), "can not be read"),
    "text.mat": (lambda path: saved(path, name="rig", other="two"), "holds no table"),
    "scalars.mat": (lambda path: saved(path, a=1.0, b=2.0), "holds no table"),
    "one.mat": (lambda path: saved(path, time_s=TIME), "holds no table"),
    "uneven.mat": (lambda path: saved(path, time_s=TIME, frequency_hz=HERTZ[1:]), "holds no table"),
    "complex.mat": (lambda path: saved(path, time_s=TIME, frequency_hz=HERTZ * 1j), "holds no table"),
    "nan.mat": (lambda path: saved(path, **LOG | {"frequency_hz": HERTZ * np.nan}), "line 2: frequency_hz is nan"),
    "back.mat": (lambda path: saved(path, **LOG | {"time_s": TIME[::-1]}), "time_s goes back"),
    "names.mat": (lambda path: saved(path, a=TIME, b=HERTZ), "no column"),
    "cut73.mat": (lambda path: broken(hdf5(path, LOG), 0.5), "can not be read"),
    "head73.mat": (lambda path: unlike(path, b"MATLAB 7.3 MAT-file, and nothing else"), "can not be read"),
    "words73.mat": (lambda path: hdf5(path, {"name": "rig"}), "holds no table"),
    "cut.xdf": (lambda path: broken(stream(path), 0.05), "can not be read|streams, none of them"),
    "head.xdf": (lambda path: unlike(path, b"XDF:"), "streams, none of them|can not be read"),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_no_log_is_one_line_that_names_the_file(name: str, tmp_path: Path) -> None:
    make, told = WRONG[name]
    if "73" in name:
        pytest.importorskip("h5py", reason=why("h5py"))
    if name.endswith("xdf"):
        pytest.importorskip("pyxdf", reason=why("pyxdf"))
    with pytest.raises(Exception, match=told) as caught:
        read_coil_log(make(tmp_path / name), load_config().movie.columns, Coils())
    assert str(caught.value).startswith(str(tmp_path / name)) and "\n" not in str(caught.value)
    assert caught.type.__module__.startswith("flowrec.")


def test_a_missing_package_is_named_with_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _name: None)
    with pytest.raises(UsageError, match=r"pip install 'flowrec\[movies\]'"):
        read_table(unlike(tmp_path / "run.xdf", b"XDF:"))
