"""Topics that other packages add to a run: `topics = ["lab_pressure"]` names rows of the group flowrec.topics.

A row is the frozen dataclass of its settings, section [NAME] of the configuration. Its class attribute `topic` declares
the topic: path, source, tolerances, message type. Of Source.STAGE it has the method `step(last, tick)`, which returns
the message of this tick, the previous one if nothing is due, or None; it is as memoryless as our stages. Of Source.RIG
it may have `stream()`, which yields messages while the run goes on (run/stream_inputs.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

from flowrec.core import FIXED, Message, Methods, Source, Tick, Topic, TopicTable, UsageError
from flowrec.stages.robot_topics import robot_topics
from flowrec.stages.stream_settings import PUMP_TOPIC, STREAM_TOPICS


class ExtraStage(Protocol):
    """Stage that computes the messages of an extra topic of Source.STAGE."""

    def step(self, last: Tick, tick: Tick) -> Message | None:
        """The message of this tick, given the tick before and this one with the results of all stages of flowrec."""


class ExtraRow(NamedTuple):
    """An extra topic that a configuration names, and the row with its settings."""

    topic: Topic
    settings: Any


class TopicRows(Methods):
    """The rows of the group; each declares a topic."""

    def lack_of(self, found: Any) -> str:
        topic = getattr(found, "topic", None)
        if not isinstance(found, type) or not isinstance(topic, Topic):
            return "but no class with the attribute topic, a flowrec.core.Topic"
        try:
            TopicTable([topic])
        except UsageError as error:
            return f"whose topic can not be used: {error}"
        if topic.source is Source.STAGE and not callable(getattr(found, "step", None)):
            return "whose topic is of Source.STAGE, which needs the method step(last, tick)"
        return ""


TOPIC_ROWS = TopicRows("topics", group="flowrec.topics", verb="step")


def extra_rows(config: Any) -> Iterator[ExtraRow]:
    """The extra topics that a configuration names; without those of a recording whose package is not installed."""
    for name in config.topics:
        settings = getattr(config, name, None)
        if not isinstance(settings, dict):
            yield ExtraRow(type(TOPIC_ROWS[name].section(config)).topic, settings)


def topics_of(config: Any) -> TopicTable:
    """The topics of a run; UsageError if two of one path are named."""
    pump = [PUMP_TOPIC] if config.pump.channels else []
    ours = [*(STREAM_TOPICS if config.streams else ()), *pump, *robot_topics(config)]
    if not config.topics and not ours:
        return FIXED
    return TopicTable([*ours, *(row.topic for row in extra_rows(config))])
