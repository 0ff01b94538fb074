"""`flowrec sign`, and what `flowrec check` says of a signature; judged by OpenSSH's own `ssh-keygen`."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from flowrec.core import FlowrecError, OutputError
from flowrec.store.session_file import Split
from flowrec.verbs.check import check
from flowrec.verbs.record import record
from flowrec.verbs.sign import sign
from tests.short_missions import SMALL
from tests.store.made_up import ticks_of, write_session

pytestmark = pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="OpenSSH is not installed")


def key_of(folder: Path, name: str) -> Path:
    key = folder / name
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", name, "-f", key], check=True)
    return key


def signers_of(*keys: Path) -> Path:
    listed = keys[0].with_name("signers")
    listed.write_text("".join(f"{key.name}@lab {key.with_suffix('.pub').read_text()}" for key in keys))
    return listed


@pytest.fixture
def keys(tmp_path: Path) -> tuple[Path, Path]:
    folder = tmp_path / "keys"
    folder.mkdir()
    return key_of(folder, "ada"), key_of(folder, "eve")


@pytest.mark.parametrize("options", [{}, {"files": Split(seconds=0.4)}])
def test_a_signed_session_is_intact_and_its_signer_is_named(
    tmp_path: Path, keys: tuple[Path, Path], options: dict[str, Split]
) -> None:
    path, (ada, eve) = write_session(tmp_path / "a.mcap", ticks_of(60), **options), keys
    before = check(path, signers=signers_of(ada, eve))
    assert before.integrity == "consistent, unsigned"
    made = sign(path, ada)
    signed = check(path, signers=signers_of(ada, eve))
    assert signed.integrity == "intact, signed by ada@lab" and signed.exit_status == before.exit_status
    assert "intact, signed by ada@lab" in signed.judgement
    for one in made:  # by OpenSSH alone
        words = ["ssh-keygen", "-Y", "verify", "-n", "flowrec", "-I", "ada@lab", "-f", signers_of(ada), "-s", one]
        with one.with_suffix("").open("rb") as content:
            subprocess.run([*map(str, words)], stdin=content, check=True)


def test_what_was_edited_or_signed_by_others_is_not_intact(tmp_path: Path, keys: tuple[Path, Path]) -> None:
    path, (ada, eve) = write_session(tmp_path / "a.mcap", ticks_of(60)), keys
    sign(path, eve)
    stranger = check(path, signers=signers_of(ada))
    assert stranger.integrity == "consistent, unsigned" and "does not name" in stranger.findings[-1].text
    assert "--signers FILE tells whose it is" in check(path).facts["signature"]
    (made,) = sign(path, ada, overwrite=True)
    signature = made.read_bytes()
    # A file whose digest agrees: only the signature tells that it is another one.
    write_session(path, ticks_of(59), overwrite=True)
    assert not made.exists() and check(path).integrity == "consistent, unsigned"
    made.write_bytes(signature)
    forged = check(path, signers=signers_of(ada))
    assert forged.exit_status == 1 and forged.integrity == "damaged or edited since it was signed"


@pytest.mark.parametrize("limit", ['namespaces="git"', 'valid-before="20200101"'])
def test_a_key_signs_only_what_its_list_allows(tmp_path: Path, keys: tuple[Path, Path], limit: str) -> None:
    path, (ada, _) = write_session(tmp_path / "a.mcap", ticks_of(60)), keys
    sign(path, ada)
    listed = signers_of(ada)
    listed.write_text(listed.read_text().replace("ada@lab ", f"ada@lab {limit} "))
    assert check(path, signers=listed).integrity == "consistent, unsigned"


def test_a_signature_is_not_replaced_and_a_wrong_key_or_list_is_refused(
    tmp_path: Path, keys: tuple[Path, Path]
) -> None:
    path, (ada, eve) = write_session(tmp_path / "a.mcap", ticks_of(60)), keys
    sign(path, ada)
    with pytest.raises(OutputError, match="exists already"):
        sign(path, eve)
    sign(path, eve, overwrite=True)
    assert check(path, signers=signers_of(ada, eve)).integrity == "intact, signed by eve@lab"
    for wrong, named in (
        (lambda: sign(path, tmp_path / "nowhere", overwrite=True), "nowhere"),
        (lambda: check(path, signers=tmp_path / "nowhere"), "nowhere"),
        (lambda: record(out=tmp_path / "b.mcap", sign=path), path.name),
    ):
        with pytest.raises(FlowrecError, match=named):
            wrong()
    assert not (tmp_path / "b.mcap").exists()


def test_a_run_is_signed_when_it_is_complete(tmp_path: Path, keys: tuple[Path, Path]) -> None:
    record(out=tmp_path / "r.mcap", duration_s=0.5, sets=SMALL, sign=keys[0])
    assert check(tmp_path / "r.mcap", signers=signers_of(*keys)).integrity == "intact, signed by ada@lab"
