"""Settings that a calibration proposes, as TOML and as values of --set; and the files that it writes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from itertools import groupby
from pathlib import Path
from typing import Any

from flowrec.core import PICTURE, TOML, Output


def check_outputs(
    out: Path | None, inputs: tuple[Path, ...], overwrite: bool, pictures: Sequence[str] = ()
) -> tuple[Output, ...]:
    """The TOML file, and pictures beside it whose names end so, checked before any work; () without a file.

    Raises OutputError, see `Output.check`.
    """
    if out is None:
        return ()
    names = [(out, TOML), *((out.with_name(out.stem + ending), PICTURE) for ending in pictures)]
    outputs = tuple(Output(path, kind, inputs, overwrite) for path, kind in names)
    for output in outputs:
        output.check()
    return outputs


def write_outputs(outputs: Iterable[Output], contents: Iterable[bytes]) -> None:
    """Write the files; the first one gets its name last: without it the others are nothing."""
    with ExitStack() as files:
        parts = [files.enter_context(output.new_file()) for output in outputs]
        for part, content in zip(parts, contents, strict=True):
            part.write_bytes(content)


def as_toml(comments: Iterable[str], settings: Mapping[str, Any]) -> str:
    """Settings, whose keys are in the order of their sections, below comments on their source."""
    lines = [f"# {comment}\n" for comment in comments]
    for section, keys in groupby(settings, key=lambda key: key.partition(".")[0]):
        lines.append(f"[{section}]\n")
        lines += [f"{key.partition('.')[2]} = {_value(settings[key])}\n" for key in keys]
    return "".join(lines)


def _value(value: Any) -> str:
    """A value in TOML; of a matrix each row has a line."""
    if isinstance(value, tuple) and isinstance(value[0], tuple):
        return "[\n" + "".join(f"    {json.dumps(row)},\n" for row in value) + "]"
    return json.dumps(value)


def as_sets(settings: Mapping[str, Any]) -> list[str]:
    """The settings as values of --set, to go with any configuration."""
    return [f"{key}={json.dumps(value)}" for key, value in settings.items()]
