"""Layouts with which other viewers show a session file as it is."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rerun.chunk import RrdReader

from flowrec.core import OutputError
from flowrec.exports import write_layouts
from flowrec.store import SLOTS, Session
from flowrec.view.bare_plots import EVENTS, IMAGE, MAPS, ON_IMAGE, PLOTS, ROUTE, STATES
from tests.rewritten import parser_of

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


def fields_of(topic):
    return set(SLOTS[topic].schema.wire.DESCRIPTOR.fields_by_name)


def fields_in(path):
    """Fields of the schema in the file by topic, of topics that have messages; by readers of their own."""
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    found = {}
    for number, channel in summary.channels.items():
        schema = summary.schemas[channel.schema_id]
        if number in summary.statistics.channel_message_counts and schema.encoding == "protobuf":
            found[channel.topic] = set(parser_of(schema).DESCRIPTOR.fields_by_name)
    return found


def strings(data):
    """All strings in JSON data, keys included."""
    if isinstance(data, dict):
        yield from data
        data = list(data.values())
    if isinstance(data, list):
        for each in data:
            yield from strings(each)
    elif isinstance(data, str):
        yield data


def test_what_the_layouts_show_is_in_the_files():
    for plot in (*(plot for group in PLOTS.values() for plot in group), ROUTE):
        assert set(plot.lines) <= fields_of(plot.topic)
    assert all(field in fields_of(topic) for topic, (field, _) in STATES.items())
    assert {IMAGE, *MAPS, *ON_IMAGE, *EVENTS} <= SLOTS.keys()


def test_foxglove_gets_panels_topics_and_fields_that_exist_and_rerun_a_blueprint_of_the_same_name(session, tmp_path):
    made = write_layouts(session, tmp_path)
    foxglove, rerun = made.foxglove, made.rerun
    layout = json.loads(foxglove.read_text())
    panels = layout["configById"]
    shown = [layout["layout"], *(tab["layout"] for panel in panels.values() for tab in panel.get("tabs", ()))]
    assert {text for text in strings(shown) if "!" in text} == set(panels)
    named = [text for text in strings(panels) if text.startswith("/")]
    recorded = fields_in(session)
    for text in named:
        topic, field = re.fullmatch(r"([\w/]+)(?:\.(\w+)(?:\[:\])?)?", text).groups()
        assert field is None or field in recorded[topic]
        assert topic in recorded
    assert {"/view/camera", "/view/map", "/view/robot_mark", "/view/route_mark", "/view/flow_refined_grid"} <= set(
        named
    )
    (blueprint,) = RrdReader(rerun).blueprints()
    chunks = [each.to_record_batch().to_pydict() for each in RrdReader(rerun).stream(store=blueprint).to_chunks()]
    origins = {each["ViewBlueprint:space_origin"][0][0] for each in chunks if "ViewBlueprint:space_origin" in each}
    assert {"/verdict", IMAGE, *MAPS} <= origins <= SLOTS.keys() | {"/"}
    told = " ".join(made.advice)
    assert blueprint.application_id == "flowrec" and "--application-id flowrec" in told and str(rerun) in told
    assert layout["configById"]["Tab!maps"]["tabs"][1]["title"] == "Chip (mm)"
    topics = layout["configById"]["3D!chip"]["topics"]
    speed = np.hypot(*np.moveaxis(Session(session).fields["refined"].velocity_um_s, -1, 0))
    assert topics["/view/flow_refined_grid"]["maxValue"] == speed.max()
    assert topics["/view/flow_refined_grid"]["minValue"] == 0.0
    # Where points name no field of theirs, the program colours them by x.
    assert all(topics[name]["colorMode"] == "rgba-fields" and topics[name]["colorField"] == "red" for name in ON_IMAGE)
    chip = Session(session).chip
    target = layout["configById"]["3D!chip"]["cameraState"]["targetOffset"]
    assert np.allclose(target[:2], 5e-4 * (np.array(chip.size_um) - chip.um_per_px))
    assert not made.lacks and "older flowrec" in write_layouts(GOLDEN, tmp_path).lacks
    older = json.loads((tmp_path / "golden_foxglove.json").read_text())
    assert older["configById"]["3D!chip"]["foxglovePanelTitle"] == "Chip (m)"
    before = foxglove.read_bytes()
    rerun.unlink()
    with pytest.raises(OutputError, match="exists already"):
        write_layouts(session, tmp_path)
    assert foxglove.read_bytes() == before and not rerun.exists()
