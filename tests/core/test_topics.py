"""The declarations of Tick: what derives from them, and which mistakes in them are errors when flowrec is imported."""

from __future__ import annotations

from dataclasses import dataclass, fields, make_dataclass
from typing import Annotated, Any, TypeVar, get_type_hints

import numpy as np
import pytest
from typing_extensions import TypeAliasType

from flowrec.core import (
    BY_FIELD,
    WORKER_FIELDS,
    Message,
    Role,
    Source,
    Tick,
    Topic,
    Track,
    WorkOrder,
    message_fields,
    stale_results,
)
from flowrec.core.declarations import Shape, SlowStage, Vector
from flowrec.core.topics import topics_of
from flowrec.stages import Config


@dataclass(frozen=True, slots=True, eq=False)
class Unshaped(Message):
    """Its array has no shape."""

    stamp_ns: int
    points_um: Vector


Scalar = TypeVar("Scalar", bound=np.generic)
Alias = TypeAliasType("Alias", np.ndarray[tuple[Any, ...], np.dtype[Scalar]], type_params=(Scalar,))


def test_an_array_may_be_declared_by_an_alias_of_a_type_statement_as_numpy_does_since_2_5():
    image = Annotated[Alias[np.uint8 | np.uint16], "array", Shape(("h", "w")), "grey levels"]
    (field,) = message_fields(make_dataclass("Aliased", [("image", image)], bases=(Message,)))
    assert (field.kind, field.dtype, field.shape, field.meaning) == (
        "array",
        np.dtype(np.uint8),
        Shape(("h", "w")),
        "grey levels",
    )


def tick_with(**changed: Any) -> type:
    """Tick with some fields declared otherwise, or with one field more."""
    hints = get_type_hints(Tick, include_extras=True) | changed
    return make_dataclass("Changed", hints.items())


ORDERS = {WorkOrder.SOLVE: ()}


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"track": Track | None}, "Tick.track: declare it as Annotated"),
        ({"extra": Annotated[Track | None, "no topic"]}, "Tick.extra: declare it as Annotated"),
        ({"track": Annotated[Track, Topic("/robot/track", Source.STAGE)]}, "Tick.track: declare it as Annotated"),
        ({"track": Annotated[int | None, Topic("/robot/track", Source.STAGE)]}, "Tick.track: declare it as Annotated"),
        ({"extra": Annotated[Track | None, Topic("/robot/track", Source.STAGE)]}, "the same topic path"),
        ({"extra": Annotated[Track | None, Topic("/extra", Source.WORKER)]}, "Tick.extra: made_by=SlowStage"),
        (
            {"extra": Annotated[Track | None, Topic("/extra", Source.STAGE, made_by=SlowStage(ORDERS, (), ()))]},
            "Tick.extra: made_by=SlowStage",
        ),
        (
            {"extra": Annotated[Track | None, Topic("/extra", Source.WORKER, made_by=SlowStage(ORDERS, (), ()))]},
            "each work order needs one field",
        ),
        (
            {"extra": Annotated[Track | None, Topic("/extra", Source.WORKER, made_by=SlowStage({}, ("gone",), ()))]},
            r"fields that do not exist: \['gone'\]",
        ),
        ({"extra": Annotated[Track | None, Topic("/extra", Source.STAGE, 1e-6, {"gone": 1.0})]}, "do not exist"),
        ({"extra": Annotated[Unshaped | None, Topic("/extra", Source.STAGE)]}, "Unshaped.points_um: declare its shape"),
    ],
)
def test_a_mistake_in_the_declarations_of_tick_is_an_error_on_import(changed: dict[str, Any], complaint: str) -> None:
    with pytest.raises(TypeError, match=complaint):
        topics_of(tick_with(**changed))


def test_a_topic_without_a_source_can_not_be_declared() -> None:
    with pytest.raises(TypeError, match="source"):
        Topic("/robot/track")  # type: ignore[call-arg]


def test_the_declared_tick_passes_and_every_source_is_used() -> None:
    assert {topic.source for topic in topics_of(Tick)} == set(Source)
    assert {topic.role for topic in topics_of(Tick)} == set(Role)
    assert all(topic.type is not Message and topic.field == name for name, topic in BY_FIELD.items())


def test_a_changed_section_makes_stale_what_depends_on_it_and_all_that_is_made_from_that() -> None:
    everything = frozenset({"assumed", "refined", "route"})
    assert stale_results(["flow"]) == everything
    for section in ("tracker", "observer", "sampler", "refine", "mission"):
        assert stale_results([section]) == {"refined", "route"}
    for section in ("robot", "survey", "plan"):
        assert stale_results([section]) == {"route"}
    assert stale_results(["control", "recording"]) == frozenset()
    assert stale_results(["plan", "flow"]) == everything


def test_the_settings_of_slow_stages_are_sections_of_the_configuration() -> None:
    sections = {each.name for each in fields(Config)}
    for made_by in WORKER_FIELDS.values():
        read = {setting.partition(".")[0] for settings in made_by.orders.values() for setting in settings}
        assert {*made_by.settings, *read} <= sections
