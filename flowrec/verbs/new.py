"""`flowrec new`: a package of a lab's own methods and devices, which works from the start."""

import importlib.util
import keyword
import re
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import typer

from flowrec.core import UsageError
from flowrec.verbs.command import verb

TEMPLATE = Path(__file__).parent / "template"
_PLUGIN = "lab_plugin"  # in the files of the template and in their names, instead of the one that is asked for


class Made(NamedTuple):
    """The folder of the new package."""

    folder: Path

    def lines(self) -> list[str]:
        """Next steps for a person, in lines."""
        return [f"{self.folder} made; next: pip install -e {self.folder} && flowrec methods"]


@verb("flowrec new plugin lab_planners", with_json=False)
def new(
    _what: Annotated[Literal["plugin"], typer.Argument(metavar="plugin", help="What to make.")],
    name: Annotated[str, typer.Argument(help="Name of the package and its module, such as lab_planners.")],
    folder: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="DIR", help="Folder to make; by default NAME here.")
    ] = None,
) -> Made:
    """Write a package that adds a planner, a camera, a topic, an export and a verb, for a lab to replace by its own."""
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name) or keyword.iskeyword(name) or name == "flowrec":
        raise UsageError(f"{name}: no name for a module; use lower-case letters, digits and _, as in lab_planners")
    if importlib.util.find_spec(name) is not None and name != _PLUGIN:
        raise UsageError(f"{name}: is the name of an installed package or of Python's own; choose another one")
    target = folder or Path(name)
    try:
        target.mkdir()
        for file in sorted(each for each in TEMPLATE.iterdir() if each.is_file()):
            text = file.read_text(encoding="utf-8")
            for there in (_PLUGIN, _PLUGIN.replace("_", "-")):
                text = text.replace(there, name if "_" in there else name.replace("_", "-"))
            (target / file.name.replace(_PLUGIN, name)).write_text(text, encoding="utf-8")
    except OSError as error:
        raise UsageError(f"{target}: {error.strerror or error}; choose another folder with --out") from error
    return Made(target)
