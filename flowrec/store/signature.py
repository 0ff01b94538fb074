"""Signatures of session files with the user's own SSH key, made and verified by OpenSSH, as git does it.

X.mcap.sig is what `ssh-keygen -Y sign -n flowrec -f KEY < X.mcap` writes: a signature of every byte, which can be
verified without flowrec. A digest says that a file agrees with itself; a signature says whose it is.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import NamedTuple

from flowrec.core import FlowrecError, OutputError, replace_content

_NAMESPACE = "flowrec"
_KEY = re.compile(r"with (\S+ key SHA256:\S+)")


class Signature(NamedTuple):
    """A signature that was verified."""

    key: str = ""  # kind and fingerprint of the key
    signer: str = ""  # as the list of signers names the key; '' without a list, or if the key is not in it
    fault: str = ""  # why the signature is not that of the file; '' if it is


def signature_file(session: Path) -> Path:
    """The path of the signature of a file."""
    return session.with_name(session.name + ".sig")


def refuse_unusable_key(key: Path) -> None:
    """Refuse a file that is no SSH key, before a run. FlowrecError : it is none, or OpenSSH is not installed."""
    told = _ssh_keygen("-l", "-f", str(key))
    if told.returncode:
        raise FlowrecError(f"{key}: is no SSH key ({_last_line(told.stderr)}); `ssh-keygen -t ed25519` makes one")


def sign_file(session: Path, key: Path, *, overwrite: bool) -> Path:
    """Sign a file; the path of the signature. A key with a passphrase asks for it, or is used by its agent.

    Raises FlowrecError: the key can not be used, or OpenSSH is not installed; OutputError if there is a signature
    already.
    """
    made = signature_file(session)
    if made.exists() and not overwrite:
        raise OutputError(f"{made}: exists already; --overwrite replaces it")
    told = _ssh_keygen("-Y", "sign", "-n", _NAMESPACE, "-f", str(key), content=session)
    if told.returncode:
        raise FlowrecError(f"{session}: is not signed, {key} can not be used ({_last_line(told.stderr)})")
    replace_content(made, told.stdout)
    return made


def verify_file(session: Path, signers: Path | None) -> Signature | None:
    """Verify the signature of a file; None: it has none.

    `signers`: the keys that are trusted, and whose they are, as of `ssh-keygen(1)`, ALLOWED SIGNERS. Raises
    FlowrecError: the list can not be read, or OpenSSH is not installed.
    """
    made = signature_file(session)
    if signers is not None and not signers.is_file():
        raise FlowrecError(f"{signers}: no such file; a line of it is `NAME KIND KEY`, as in NAME's .pub file")
    if not made.is_file():
        return None
    words = ("-n", _NAMESPACE, "-s", str(made))
    told = _ssh_keygen("-Y", "check-novalidate", *words, content=session)
    if told.returncode:
        return Signature(fault=_last_line(told.stderr or told.stdout))
    key = found[1] if (found := _KEY.search(told.stdout.decode(errors="replace"))) else "a key"
    if signers is None:
        return Signature(key)
    named = _ssh_keygen("-Y", "find-principals", "-s", str(made), "-f", str(signers))
    signer = named.stdout.decode(errors="replace").splitlines()[0] if not named.returncode and named.stdout else ""
    # The list may restrict a key to a time or to other purposes.
    if signer and _ssh_keygen("-Y", "verify", "-f", str(signers), "-I", signer, *words, content=session).returncode:
        signer = ""
    return Signature(key, signer)


def _ssh_keygen(*words: str, content: Path | None = None) -> subprocess.CompletedProcess[bytes]:
    program = shutil.which("ssh-keygen")
    if program is None:
        raise FlowrecError("ssh-keygen is not installed, which signs and verifies; it comes with OpenSSH")
    with Path(os.devnull if content is None else content).open("rb") as file:
        return subprocess.run([program, *words], stdin=file, capture_output=True, check=False)  # noqa: S603 - OpenSSH


def _last_line(printed: bytes) -> str:
    lines = printed.decode(errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "it says nothing")
