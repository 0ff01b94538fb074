"""Range of a setting, declared in its annotation: `kp_per_s: Annotated[float, Range(0.0, 1000.0)] = 3.0`.

NaN lies in no range; infinity only in a range that ends there.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from flowrec.core.errors import UsageError

Number = int | float
_ENDLESS = 2**62  # a limit beyond this is that of the type, and of no interest


@dataclass(frozen=True, slots=True)
class Range:
    """Numbers from `low` to `high`, both included."""

    low: Number
    high: Number

    def __contains__(self, value: Number) -> bool:
        return self.low <= value <= self.high

    def __str__(self) -> str:
        return f"from {short_number(self.low)}" + (f" to {short_number(self.high)}" if self.high < _ENDLESS else "")

    def nearest(self, value: Number) -> Number:
        """The nearest valid value; the lower end for NaN."""
        return self.high if value > self.high else self.low


@dataclass(frozen=True, slots=True)
class OneOf(Range):
    """Only these numbers, in ascending order."""

    values: tuple[Number, ...]

    def __init__(self, *values: Number) -> None:
        object.__setattr__(self, "low", values[0])
        object.__setattr__(self, "high", values[-1])
        object.__setattr__(self, "values", values)

    def __contains__(self, value: Number) -> bool:
        return value in self.values

    def __str__(self) -> str:
        return f"one of {', '.join(map(short_number, self.values))}"

    def nearest(self, value: Number) -> Number:
        clipped = min(max(value, self.low), self.high)
        return min(self.values, key=lambda valid: abs(valid - clipped))


Share = Annotated[float, Range(0.0, 1.0)]
PositiveShare = Annotated[float, Range(0.01, 1.0)]
Weight = Annotated[float, Range(0.0, 1e6)]
Seed = Annotated[int, Range(0, 2**63 - 1)]
Threads = Annotated[int, Range(1, 256)]


@dataclass(frozen=True, slots=True)
class Fault:
    """A setting outside of its range."""

    key: str
    value: Number
    valid: Range

    def __str__(self) -> str:
        nearest = (
            f"; the nearest is {short_number(self.valid.nearest(self.value))}" if not math.isnan(self.value) else ""
        )
        return f"{self.key} = {short_number(self.value)}: must be {self.valid}{nearest}"


def faults(settings: Any, prefix: str = "") -> Iterator[Fault]:
    """The numbers outside of their ranges in a settings dataclass and in those inside it."""
    section: type = type(settings)
    for key, hint in hints(section).items():
        value = getattr(settings, key)
        if is_dataclass(value):
            yield from faults(value, f"{prefix}{key}.")
            continue
        if named_section(hint) is not None:
            for name, inner in value.items():
                yield from faults(inner, f"{prefix}{key}.{name}.")
            continue
        valid = range_of(hint)
        if valid is not None:
            yield from (Fault(prefix + key, number, valid) for number in _numbers(value) if number not in valid)


def check_ranges(settings: Any, section: str) -> None:
    """Raise UsageError, in one line, if a number of a section of the configuration is outside of its range."""
    fault = next(faults(settings, f"{section}."), None)
    if fault is not None:
        raise UsageError(str(fault))


@functools.cache
def hints(section: type) -> dict[str, Any]:
    """The annotations of a dataclass's fields by name."""
    found = get_type_hints(section, include_extras=True)
    return {field.name: found[field.name] for field in fields(section)}


def named_section(hint: Any) -> Any:
    """The settings class of sections that a person names, such as [streams.NAME]: a `dict[str, X]`; None for others."""
    kind = get_args(hint)[1] if get_origin(hint) is dict else None
    return kind if is_dataclass(kind) else None


def range_of(hint: Any) -> Range | None:
    """The range in an annotation or in a type inside it (`... | None`, tuples)."""
    for part in get_args(hint):
        found = part if isinstance(part, Range) else range_of(part)
        if found is not None:
            return found
    return None


def short_number(number: Number) -> str:
    """A number in its shortest form: 3, 0.55, 1e+06."""
    return str(number) if isinstance(number, int) else f"{number:g}"


def _numbers(value: object) -> Iterator[Number]:
    if isinstance(value, tuple):
        for inner in value:
            yield from _numbers(inner)
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        yield value
