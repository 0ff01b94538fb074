"""A movie of a dish without a channel, tracked only: what is said of it is about its images and the robot alone."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import flowrec
from flowrec.core import Tick
from flowrec.exports import scene_of
from flowrec.physics import Chip, Opening
from flowrec.stages import tells_flow
from flowrec.store import Session
from flowrec.verbs.info import Facts, facts_for_people
from flowrec.verbs.init import init
from flowrec.verbs.report import report
from flowrec.view import entities
from flowrec.view.blueprint import blueprint
from flowrec.view.logger import TickLogger

IMAGES, RATE_HZ, UM_PER_PX, RADIUS_PX = 20, 30.0, 2.0, 8


@pytest.fixture(scope="module")
def dish(tmp_path_factory: pytest.TempPathFactory) -> Session:
    """20 images of a dark disc that moves through a bright dish, imported without a chip."""
    folder = tmp_path_factory.mktemp("dish")
    images, rng = folder / "images", np.random.default_rng(0)
    images.mkdir()
    for number in range(IMAGES):
        image = np.clip(rng.normal(180.0, 3.0, (120, 160)), 0.0, 255.0).astype(np.uint8)
        cv2.circle(image, (40 + 3 * number, 60), RADIUS_PX, 40, -1, cv2.LINE_AA)
        cv2.imwrite(str(images / f"{number:03d}.png"), image)
    known = {"um_per_px": UM_PER_PX, "radius_um": UM_PER_PX * RADIUS_PX}
    init(images, no_chip=True, out=folder / "flowrec.toml", sets={"movie.rate_hz": RATE_HZ}, **known)
    out = folder / "dish.mcap"
    flowrec.import_movie(images, out, folder / "flowrec.toml", fps=RATE_HZ)
    return Session(out)


def mask_with(*, walls: bool) -> Any:
    mask = np.ones((20, 30), np.bool_)
    mask[[0, -1]] = False
    mask[10:12, 5:20] = not walls
    return mask


def test_a_chip_is_an_open_field_where_all_but_its_border_is_fluid_and_still_where_nothing_drives_it() -> None:
    def chip(inflow_um_s: float, *, walls: bool) -> Chip:
        openings = (Opening("left", 1, 18, "inlet", inflow_um_s), Opening("right", 1, 18, "outlet", 0.0))
        return Chip("dish", mask_with(walls=walls), 2.0, openings, 1.0, 998.0)

    assert chip(0.0, walls=False).is_open_field
    assert chip(0.0, walls=False).is_still
    assert not chip(5.0, walls=False).is_still
    assert not chip(0.0, walls=True).is_open_field
    assert not chip(0.0, walls=True).is_still


def test_info_says_that_there_is_no_channel(dish: Session) -> None:
    facts = flowrec.info(dish)
    assert isinstance(facts, Facts)
    rows = dict(facts_for_people(facts))
    assert rows["chip"] == "none (open field), 0.32 x 0.24 mm"
    assert "assumed flow" not in rows
    assert "flow observations" not in rows
    assert flowrec.info(Path("sessions/golden.mcap"))["chip_openings"] == 2


def test_the_view_shows_the_position_over_time_and_no_flow(dish: Session) -> None:
    import rerun as rr

    scene = scene_of(dish.config, dish.chip, dish.path)
    logger = TickLogger(rr.RecordingStream("test"), scene)
    for tick in dish.ticks():
        logger.log(tick)
    assert entities.POSITION in logger.present
    assert not logger.present & entities.SCALES.keys()
    layout = blueprint(scene, ("",), logger.present, 1.0, [{}])
    names = {str(view.name) for view in _views(layout.root_container)}
    assert {"Robot (orange)", "Position (µm)"} <= names
    assert not [name for name in names if "low" in name]


def _views(part: Any) -> Iterator[Any]:
    yield part
    for each in getattr(part, "contents", None) or ():
        if not isinstance(each, str):
            yield from _views(each)


def test_the_report_shows_the_track_and_no_flow(dish: Session, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    page = report(dish, out=tmp_path / "a.html").read_text()
    for words in ("<h3>At the openings", 'id="maps"', 'id="observer"', "<h2>The flow", ">error of the flow"):
        assert words not in page, words
    assert "<h3>Position and speed over time" in page
    assert "open field, goal none" in page


def test_a_flow_that_a_refinement_found_in_an_open_field_is_told_of(dish: Session) -> None:
    last = dish.last
    assert last.refined is not None
    assert not tells_flow(dish.chip, last)
    assert tells_flow(dish.chip, replace(last, refined=replace(last.refined, refused="")))
    assert not tells_flow(dish.chip, Tick())


def test_a_movie_that_does_not_state_when_it_was_taken_has_no_time_of_day_in_tables(dish: Session) -> None:
    pytest.importorskip("pyarrow")
    assert dish.provenance["wall_time"][:2] == "20", "that of the import"
    assert dish.table("track")["wall_time"].null_count == len(dish.table("track"))
    assert np.isnat(dish.frames.wall_times).all()


def test_an_exported_movie_states_when_its_images_were_taken(dish: Session) -> None:
    began = {"source_started": "2026-05-04T10:00:00+00:00", "source_first_image_s": "2.500000000"}
    known = replace(dish.header, provenance={**dish.header.provenance, **began})
    assert np.datetime64(known.taken_unix_ns, "ns") == np.datetime64("2026-05-04T10:00:02.5")
    recorded = Session(Path("sessions/golden_moderate.mcap")).header
    assert recorded.taken_unix_ns == recorded.start_unix_ns > 0


def test_what_is_said_of_a_movie_ends_with_its_last_image(dish: Session) -> None:
    film_s = (IMAGES - 1) / RATE_HZ
    assert dish.run.last_ns > (film_s + 0.4) * 1e9, "ticks without images, in which the refinement is adopted"
    assert dish.duration_s == pytest.approx(film_s)
    assert flowrec.info(dish)["duration_s"] == pytest.approx(film_s)
    assert dish.outcome["duration_s"] == pytest.approx(film_s)


def test_view_and_report_of_a_movie_do_not_lose_the_robot_after_the_last_image(dish: Session) -> None:
    import rerun as rr

    logger = TickLogger(rr.RecordingStream("test"), scene_of(dish.config, dish.chip, dish.path))
    for tick in dish.ticks():
        logger.log(tick)
    assert entities.PHASE in logger.present
    assert not logger.present & {entities.SIGHT, entities.MARKS}
    assert max(logger.states.phases.values()) <= dish.frames.stamps_ns[-1], "the outcome, too"
    pytest.importorskip("matplotlib")
    from flowrec.exports.report.history import History

    history = History.of(dish)
    assert not history.unseen.spans
    assert history.last_s == pytest.approx((IMAGES - 1) / RATE_HZ)
    assert history.last.refined is not None


def test_an_import_replays_identically(dish: Session) -> None:
    assert flowrec.replay(dish, verify=True).same


def test_a_dish_is_no_doubtful_flow(dish: Session) -> None:
    assert "not_refined" not in dish.outcome
    assert not dish.outcome.get("doubts")
