"""A lab's own package, made by `flowrec new`: installed beside flowrec, used, and missed."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import pyarrow.parquet
import pytest

from flowrec.stages import to_toml
from flowrec.store import Session
from tests.conftest import needs_quiet
from tests.rewritten import rewrite
from tests.short_missions import SMALL, set_words

ROOT = Path(__file__).parents[1]
STEPS = "plan.method=lab_kit_steps"
PRESSURE = 'topics=["lab_kit_pressure"]'
ONCE_MORE = pytest.mark.slow("a replay in a process that finds another state of the package")
MISSION = [*SMALL, "mission.phases=plan,navigate", STEPS, "plan.lab_kit_steps.neighbours=8", PRESSURE]
ONE_BY_ONE = """
import contextlib, io, json, sys
from flowrec.verbs.cli import main
told = []
for sys.argv in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as end:
            told.append((end.code or 0, out.getvalue(), err.getvalue()))
print(json.dumps(told))
"""


class Said(NamedTuple):
    status: int
    out: str
    err: str


def flowrec(site: Path | None, *lines: str | list[str]) -> list[Said]:
    """Commands one after the other: here without a package, or in a process that finds the packages in a folder."""
    words = json.dumps([["flowrec", *(line.split() if isinstance(line, str) else line)] for line in lines])
    if site is None:
        with (
            redirect_stdout(io.StringIO()) as out,
            mock.patch.object(sys, "argv", ["-c", words]),
            mock.patch.dict(os.environ, COLUMNS="200"),
        ):
            exec(ONE_BY_ONE, {})
        return [Said(*each) for each in json.loads(out.getvalue())]
    done = subprocess.run(
        [sys.executable, "-c", ONE_BY_ONE, words],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(site)]), "COLUMNS": "200"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [Said(*each) for each in json.loads(done.stdout)]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the package of the template is installed."""
    folder = tmp_path_factory.mktemp("kit")
    (made,) = flowrec(None, ["new", "plugin", "lab_kit", "--out", str(folder / "lab_kit")])
    assert made.status == 0, made.err
    assert not [path for path in (folder / "lab_kit").rglob("*") if "plugin" in path.name + path.read_text()]
    command = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    done = subprocess.run(
        [*command, "--no-compile", "--target", str(folder / "site"), str(folder / "lab_kit")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder / "site"


@pytest.fixture(scope="module")
def flown(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose route is by the package's planner, with the pressure of its pump."""
    path = tmp_path_factory.mktemp("flown") / "a.mcap"
    (done,) = flowrec(site, ["record", *set_words(MISSION), "--duration", "2", "--out", str(path)])
    assert done.status == 0, done.err
    return path


def changed(site: Path, folder: Path, *, version: str = "1.0", code: tuple[str, str] = ("", "")) -> Path:
    """A copy of the installed package, of another version or with other code."""
    copy = folder / "site"
    shutil.copytree(site, copy)
    text = (copy / "lab_kit.py").read_text()
    assert code[0] in text
    (copy / "lab_kit.py").write_text(text.replace(*code, 1))
    (info,) = copy.glob("*.dist-info")
    (info / "METADATA").write_text((info / "METADATA").read_text().replace("Version: 1.0", f"Version: {version}"))
    return copy


@pytest.mark.slow("three verbs in a process that finds the package")
def test_a_session_by_the_planner_of_a_package_is_verified_exported_and_read_by_its_verb(
    site: Path, flown: Path, tmp_path: Path
) -> None:
    verified, shown, exported, ran, listed = flowrec(
        site,
        f"replay {flown} --verify",
        f"info {flown} --json",
        f"export {flown} {tmp_path / 'path.jsonl'} --format lab_kit_path",
        f"lab-kit-routes {flown} --json",
        "methods plan --json",
    )
    assert verified.out.splitlines()[-1].endswith("every tick identical")
    assert verified.status == 0 and "/plan/route lab_kit_steps: identical" in verified.out
    stated = json.loads(shown.out)["facts"]["outside"]["plan.lab_kit_steps"]
    assert (stated["package"], stated["version"], len(stated["sha256"])) == ("lab_kit", "1.0", 64)
    assert exported.status == 0 and len((tmp_path / "path.jsonl").read_text().splitlines()) > 30
    (route,) = json.loads(ran.out)
    assert route["method"] == "lab_kit_steps"
    (row,) = [each for each in json.loads(listed.out) if each["package"] != "flowrec"]
    assert (row["setting"], row["name"], row["package"]) == ("plan.method", "lab_kit_steps", "lab_kit 1.0")
    with Session(flown) as session:
        assert session.setting("plan", "lab_kit_steps", "neighbours") == 8


@pytest.mark.slow("five verbs in processes that find the package")
def test_a_topic_of_a_package_is_recorded_and_read_compared_exported_and_replayed_without_it(
    flown: Path, tmp_path: Path
) -> None:
    replayed, tables, other = tmp_path / "replayed.mcap", tmp_path / "tables", tmp_path / "other.mcap"
    again, checked, same, exported = flowrec(
        None,
        f"replay {flown} --plan astar_time --out {replayed}",
        f"check {flown} --json",
        f"compare {flown} {replayed} --only /lab_kit/*,/coils/applied --json",
        f"export {flown} {tables} --format parquet",
    )
    assert [each.status for each in (again, checked, same, exported)] == [0, 0, 0, 0], again.err + same.err
    with Session(flown) as session:
        pressures = session.table("/lab_kit/pressure")
        assert session.topics["/lab_kit/pressure"] == len(pressures) > 0
        unit = pressures.schema.field("pressure_pa").metadata
    assert unit == {b"unit": b"Pa", b"meaning": b"above that of the room"}
    values = pressures["pressure_pa"].to_pylist()
    assert all(abs(value - 2e4) <= 500.0 for value in values)
    assert pyarrow.parquet.read_table(tables / "extra.lab_kit.pressure.parquet")["pressure_pa"].to_pylist() == values
    assert json.loads(same.out)["topics"]["/lab_kit/pressure"]["identical"] == len(values)

    def edit(channel: Any, _: Any, wire: Any) -> bool:
        if channel.topic != "/lab_kit/pressure":
            return False
        wire.pressure_pa = 0.0
        return True

    assert rewrite(flown, other, edit) == len(values)
    damaged, different = flowrec(None, f"check {other}", f"compare {flown} {other} --only /lab_kit/*")
    assert (damaged.status, different.status) == (1, 3)
    assert "/lab_kit/pressure, in its messages" in damaged.out and "pressure_pa" in different.out


@pytest.mark.slow("three verbs in a process that finds the package")
def test_settings_of_a_package_are_checked_like_ours_and_shown_by_a_dry_run(site: Path) -> None:
    unknown, beyond, dry, helped = flowrec(
        site,
        ["record", *set_words([STEPS, "plan.lab_kit_steps.neighbour=8"])],
        ["record", *set_words([STEPS, "plan.lab_kit_steps.neighbours=5"])],
        ["record", *set_words(MISSION), "--dry-run"],
        "--help",
    )
    assert unknown.status == beyond.status == 2
    assert "did you mean plan.lab_kit_steps.neighbours?" in unknown.err
    assert "plan.lab_kit_steps.neighbours = 5: must be one of 4, 8; the nearest is 4" in beyond.err
    assert "[plan.lab_kit_steps]\nneighbours = 8\n" in dry.out
    assert "lab-kit-routes" in helped.out and "Print the routes" in helped.out


@pytest.mark.slow("ten verbs in processes without the package")
def test_without_the_package_its_session_is_read_and_a_replay_says_what_to_install(flown: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.mcap"
    *refused, replanned, again, checked, shown, drawn, typo = flowrec(
        None,
        f"replay {flown} --verify",
        f"replay {flown} --verify --jobs 2",
        f"replay {flown} --refine gain --out {tmp_path / 'refined.mcap'}",
        f"replay {flown} --controller ff_fb --plan astar_time --refly --out {tmp_path / 'flown.mcap'}",
        f"replay {flown} --plan astar_time --out {other}",
        f"replay {other} --verify",
        f"check {flown}",
        f"info {flown} --json",
        f"export {flown} {tmp_path / 'drawn.rrd'}",
        f"replay {flown} --plan lab_kit",
    )
    assert len(refused) == 4
    for said in refused:
        assert said.status == 2
        assert re.search(r"plan\.method = lab_kit_steps .*: pip install lab_kit==1\.0\s*$", said.err)
    assert replanned.status == again.status == 0, "another planner needs no package"
    assert checked.status == 0 and "its stages need the packages lab_kit 1.0" in checked.out
    assert json.loads(shown.out)["facts"]["plan"] == "lab_kit_steps"
    assert drawn.status == 0
    assert typo.status == 2 and "must be one of time_field" in typo.err
    with Session(flown) as session:
        assert "neighbours = 8" in to_toml(session.config)
        assert next(iter(session.messages("route"))).method == "lab_kit_steps"


@pytest.mark.parametrize(
    ("version", "code", "status", "said"),
    [
        pytest.param("1.1", ("", ""), 0, "recorded with lab_kit 1.0, replayed with lab_kit 1.1", marks=ONCE_MORE),
        pytest.param(
            *("1.0", ("-> bool", "->  bool"), 0, "recorded with other code of lab_kit 1.0: sha256 "), marks=ONCE_MORE
        ),
        pytest.param(
            *("1.1", ("    neighbours:", "    nodes:"), 2),
            "are not those of lab_kit 1.1 (plan.lab_kit_steps: unknown key",
            marks=ONCE_MORE,
        ),
        pytest.param(
            *("1.0", ("import json", "import no_such_module"), 2),
            "No module named 'no_such_module'); mend or uninstall it",
            marks=ONCE_MORE,
        ),
    ],
)
def test_a_replay_by_another_state_of_the_package_says_so(
    site: Path, flown: Path, tmp_path: Path, version: str, code: tuple[str, str], status: int, said: str
) -> None:
    (done,) = flowrec(changed(site, tmp_path, version=version, code=code), f"replay {flown} --verify")
    assert done.status == status
    assert said in (done.err if status else done.out)


@pytest.mark.slow("three sweeps, each with processes of its own")
def test_a_sweep_does_a_replay_again_whose_package_has_other_code(site: Path, flown: Path, tmp_path: Path) -> None:
    sweep = f"sweep {flown} --grid plan=lab_kit_steps,astar_time --out {tmp_path / 'swept.parquet'} --workers 1"
    (first,), (second,) = flowrec(site, sweep), flowrec(site, sweep)
    (third,) = flowrec(changed(site, tmp_path, code=("-> bool", "->  bool")), sweep)
    assert [each.status for each in (first, second, third)] == [0, 0, 0], first.err + third.err
    assert "2 replays to do" in first.err and "to do" not in second.err
    assert "1 replays to do, 1 are done" in third.err


@pytest.mark.slow("three verbs in processes of their own")
def test_a_broken_package_stops_nothing_that_does_not_use_it(site: Path, flown: Path, tmp_path: Path) -> None:
    broken = changed(site, tmp_path, code=("import json", "raise RuntimeError('no licence')"))
    listed, helped, used, read, ours = flowrec(
        broken,
        "methods --json",
        "--help",
        f"lab-kit-routes {flown}",
        f"check {flown}",
        ["record", *set_words(["plan.method=astar_tim"])],
    )
    faults = {row["name"]: row["fault"] for row in json.loads(listed.out) if row["fault"]}
    assert faults.keys() == {*("lab_kit_steps", "lab_kit_disc", "lab_kit_pressure", "lab_kit_path", "lab-kit-routes")}
    assert all("lab_kit 1.0" in fault and "no licence" in fault for fault in faults.values())
    assert helped.status == 0 and "Can not be used: lab-kit-routes" in helped.out
    assert used.status == 2 and used.err.count("\n") == 1
    assert read.status == 0
    assert "the nearest is astar_time" in ours.err


@needs_quiet
def test_a_run_of_the_lab_records_the_camera_of_a_package(site: Path, tmp_path: Path) -> None:
    path = tmp_path / "seen.mcap"
    lab = [
        *("rig=lab", "lab.camera=lab_kit_disc", "lab.lab_kit_disc.background=150", "mission.phases=observe"),
        *("camera.width_px=96", "camera.height_px=64", "camera.rate_hz=20", "camera.um_per_px=20.0"),
        *("camera.centre_um=[1100.0,2560.0]", "robot.radius_um=160", "mission.check_axes=false"),
        # The process of the slow stages is up and has solved the flow before the run, however busy the machine is.
        *("recording.admission_s=0.2", "recording.accept_losses=true"),
        *("lab.camera_timeout_s=2", "safety.guard_timeout_s=20"),
    ]
    seen, wrong = flowrec(
        site,
        ["record", *set_words(lab), "--duration", "1.5", "--out", str(path)],
        ["record", *set_words([*lab, "lab.lab_kit_disc.background=0"])],
    )
    assert seen.status == 0, seen.err
    assert "lab.lab_kit_disc.background = 0: must be from 1 to 255" in wrong.err
    with Session(path) as session:
        assert int(session.frames[0].image.max()) in range(150, 160)
        assert json.loads(session.provenance["outside.lab.lab_kit_disc"])["package"] == "lab_kit"
    (replayed,) = flowrec(None, f"replay {path} --verify")
    assert replayed.status == 0, "what the camera did is recorded; a replay does not need it"
