"""Changes of a replay, and the results that they make stale."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any

from flowrec.core import REPLAYED, WORKER_FIELDS, Phase, UsageError, WorkOrder, settings_of, stale_results, table_at
from flowrec.stages import CONTROLLERS, PLANNERS, ResolvedConfig, with_sets

# Sections that a replay can not change.
FIXED = ("chip", "camera", "rig", "simulated")
# Settings that every changed replay sets by itself: no person has changed them.
OF_EVERY_REPLAY = ("mission.replan_error_um",)


@dataclass(frozen=True, slots=True)
class Change:
    """Methods and settings that a replay changes; None leaves a method as recorded.

    Attributes
    ----------
    refine, plan, observer, controller : names of methods.
    sets : settings, values by key; or texts `key=value`, which become that.
    """

    refine: str | None = None
    plan: str | None = None
    observer: str | None = None
    controller: str | None = None
    sets: Mapping[str, Any] | Sequence[str] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "sets", settings_of(self.sets))

    def apply(self, config: ResolvedConfig) -> ResolvedConfig:
        """The recorded configuration with the changes.

        A changed replay does not plan again because of tracking errors: the recorded robot can not follow the
        replayed commands.
        """
        plan, controller = self.plan, self.controller
        # A control law may need a planner that provides the time to go: if one of them is given, the other follows.
        # An unknown name is reported below, with its option.
        if controller is not None and controller in CONTROLLERS and plan is None:
            plan = _able_planner(CONTROLLERS[controller].needs, config.plan.method)
        elif plan is not None and plan in PLANNERS and controller is None and not _provides(plan, config.control.needs):
            controller = next(row.name for row in CONTROLLERS.values() if not row.needs)
        named = {name: getattr(self, name) for name in REPLAYED} | {"plan": plan, "controller": controller}
        given = {table_at(REPLAYED[name]).setting: (f"--{name}", row) for name, row in named.items() if row is not None}
        if not given and not self.sets:
            return config
        methods = {key: row for key, (_, row) in given.items()}
        assert isinstance(self.sets, Mapping)  # since it was made
        changed = with_sets(config, {**methods, **self.sets}, {key: flag for key, (flag, _) in given.items()})
        mission = replace(changed.mission, replan_error_um=math.inf)
        if self.refine is not None and not {Phase.REFINE, Phase.OBSERVE} & set(mission.phases):
            phases = tuple(dict.fromkeys((*mission.phases, Phase.REFINE, Phase.PLAN)))
            mission = replace(mission, phases=phases)
        return replace(changed, mission=mission)

    def stale_results(self, recorded: ResolvedConfig, changed: ResolvedConfig) -> frozenset[str]:
        """Fields of Tick with results of the worker that must be computed again.

        Raises
        ------
        UsageError : a section of FIXED is changed.
        """
        sections = [
            each.name for each in fields(ResolvedConfig) if getattr(recorded, each.name) != getattr(changed, each.name)
        ]
        for section in sections:
            if section in FIXED:
                raise UsageError(
                    f"--set {section}...: a replay can not change the {section} of a recording; "
                    "record again, or use --refly"
                )
        return stale_results([*sections, *(["refine"] if self.refine is not None else [])])

    def same_orders(self, recorded: ResolvedConfig, changed: ResolvedConfig) -> frozenset[WorkOrder]:
        """Work orders whose computation reads no setting that has changed; a refinement asked for is not one."""
        orders = {order: settings for made_by in WORKER_FIELDS.values() for order, settings in made_by.orders.items()}
        same = {
            order
            for order, settings in orders.items()
            if all(attrgetter(setting)(recorded) == attrgetter(setting)(changed) for setting in settings)
        }
        return frozenset(same - ({WorkOrder.REFINE} if self.refine is not None else set()))


def _provides(planner: str, needs: tuple[str, ...]) -> bool:
    return not needs or (planner in PLANNERS and set(needs) <= set(PLANNERS[planner].provides))


def _able_planner(needs: tuple[str, ...], recorded: str) -> str | None:
    """The first planner that provides what a control law needs; None if the recorded one does."""
    if _provides(recorded, needs):
        return None
    return next((name for name in PLANNERS if _provides(name, needs)), None)
