"""The specification of the file, notebook 07, lists every topic that flowrec writes."""

from __future__ import annotations

import json
from pathlib import Path

from flowrec.core import PUMP, SAMPLES, STREAMS, TOPICS
from flowrec.store.viewer_topics import VIEWER_TOPICS

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "07_format.ipynb"


def test_the_specification_names_every_topic() -> None:
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    texts = ["".join(cell["source"]) for cell in cells]
    texts += ["".join(output.get("text", ())) for cell in cells for output in cell.get("outputs", ())]
    text = "\n".join(texts)
    topics = [*(topic.path for topic in TOPICS), SAMPLES, STREAMS, PUMP, *(each.path for each in VIEWER_TOPICS)]
    assert [path for path in topics if f"{path}`" not in text and f"{path} " not in text] == []
