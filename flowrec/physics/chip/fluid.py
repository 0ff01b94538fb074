"""The viscosity of a chip's fluid as a function of shear rate (generalised Newtonian fluids).

A law states the viscosity over the chip's viscosity_mpa_s, which so remains the scale of all viscosities and stresses:

    mu = viscosity_mpa_s f(gamma),   gamma = sqrt(2 D : D),   D = (grad v + grad v^T) / 2.

The stress f(gamma) gamma has to grow with the shear rate: otherwise the flow is not determined.

    [viscosity]              # of a chip's TOML; as settings chip.viscosity.law, ...
    law = "power_law"        # left out: newtonian
    exponent = 0.7

A user's function becomes a table when the chip is loaded. The chip of a session holds that table, so a replay needs
neither the function nor its version.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Annotated, Any, ClassVar, Protocol

import numpy as np

from flowrec.core import ChipError, Floats, Method, Methods, Range, faults

LEAST_EXPONENT = 0.05  # that an unknown exponent can reach
RATES_1_S = tuple(float(rate) for rate in np.logspace(-4, 6, 121).round(10))  # at which a user's function is read
STEEPEST = -0.95  # least d ln f / d ln gamma; at -1 the stress no longer grows
LARGEST = 1e6  # viscosity of a table over its smallest one

LAWS = Methods(
    "chip.viscosity.law",
    Method("newtonian", "flowrec.physics.chip.fluid:newtonian", "the same at all shear rates"),
    Method(
        "power_law",
        "flowrec.physics.chip.fluid:PowerLaw",
        "(shear rate / rate_1_s)^(exponent - 1)",
        ("exponent", "rate_1_s", "plateau_1_s"),
    ),
    Method(
        "carreau_yasuda",
        "flowrec.physics.chip.fluid:CarreauYasuda",
        "constant at low shear rates, a power law, constant again",
        ("exponent", "time_s", "infinite_share", "yasuda"),
    ),
    Method(
        "blood", "flowrec.physics.chip.fluid:blood", "Carreau-Yasuda for human blood; states viscosity and density, too"
    ),
    Method(
        "table",
        "flowrec.physics.chip.fluid:TabulatedLaw",
        "measured viscosities between which is interpolated",
        ("rates_1_s", "ratios"),
    ),
    Method(
        "function", "flowrec.physics.chip.fluid:from_function", "a Python function of the shear rate", ("function",)
    ),
)

# Y. I. Cho, K. R. Kensey, Effects of the non-Newtonian viscosity of blood on flows in a diseased arterial vessel, part
# 1: steady flows, Biorheology 28 (1991) 241-262: 56 mPa s at rest, 3.45 mPa s at infinite shear rate. They fit several
# laws to one collection of measurements. `blood` is their Carreau-Yasuda law (1.902 s, n = 0.22, a = 1.25); their
# Carreau law (3.313 s, n = 0.3568, a = 2) is within 10 % of it from 1 to 1000 /s.
BLOOD_MPA_S, BLOOD_INFINITE_MPA_S, BLOOD_KG_M3 = 56.0, 3.45, 1060.0


class ViscosityLaw(Protocol):
    """A law of viscosity: a frozen dataclass, so that equal laws are equal keys of a cache."""

    unknowns: ClassVar[tuple[str, ...]]  # names of the P parameters that can be unknowns

    @property
    def slit_factor(self) -> float:
        """Factor c: between plates at distance H, a fluid of mean speed V has the drag 12 mu(c 6 V / H) V / H^2."""

    def relative(self, rate2: Floats) -> tuple[Floats, Floats]:
        """Return f and df / d gamma^2 at squared shear rates (m,) in 1/s^2."""

    def by_unknowns(self, rate2: Floats) -> Floats:
        """Return the derivatives (P, m) of f with respect to the unknowns."""

    def with_offset(self, offset: Floats) -> ViscosityLaw:
        """Return the law with `offset` (P,) added to its unknowns."""


@dataclass(frozen=True, slots=True)
class PowerLaw:
    """f = (gamma / rate)^(n - 1); with a rate of 1 / s the chip's viscosity is the consistency K in mPa s^n.

    At rest this is infinite or zero, which no fluid is: gamma^2 stands for gamma^2 + plateau^2.
    """

    unknowns: ClassVar[tuple[str, ...]] = ("exponent",)

    exponent: float = 0.7
    rate_1_s: float = 1.0
    plateau_1_s: float = 0.01

    @property
    def slit_factor(self) -> float:
        return slit_factor(self.exponent)

    def relative(self, rate2: Floats) -> tuple[Floats, Floats]:
        power, shifted = 0.5 * (self.exponent - 1.0), rate2 + self.plateau_1_s**2
        f = (shifted / self.rate_1_s**2) ** power
        return f, power * f / shifted

    def by_unknowns(self, rate2: Floats) -> Floats:
        by_exponent = 0.5 * np.log((rate2 + self.plateau_1_s**2) / self.rate_1_s**2)
        return (self.relative(rate2)[0] * by_exponent)[None]

    def with_offset(self, offset: Floats) -> PowerLaw:
        return replace(self, exponent=max(self.exponent + float(offset[0]), LEAST_EXPONENT))


@dataclass(frozen=True, slots=True)
class CarreauYasuda:
    """f = s + (1 - s) (1 + (time gamma)^a)^((n - 1) / a): the chip's viscosity holds at rest.

    K. Yasuda, R. C. Armstrong, R. E. Cohen, Rheol. Acta 20 (1981) 163-178; a = 2 is Carreau's.
    """

    unknowns: ClassVar[tuple[str, ...]] = ("exponent", "ln time_s", "ln infinite_share")

    exponent: float = 0.5
    time_s: float = 1.0
    infinite_share: float = 0.0
    yasuda: float = 2.0

    @property
    def slit_factor(self) -> float:
        return slit_factor(self.exponent)

    def _parts(self, rate2: Floats) -> tuple[Floats, Floats, Floats]:
        """(time gamma)^2, not below a negligible value, that to the power of a / 2, and (1 + that)^((n - 1) / a)."""
        square = np.maximum(rate2 * self.time_s**2, 1e-24)
        scaled = square ** (0.5 * self.yasuda)
        return square, scaled, (1.0 + scaled) ** ((self.exponent - 1.0) / self.yasuda)

    def relative(self, rate2: Floats) -> tuple[Floats, Floats]:
        square, scaled, thinning = self._parts(rate2)
        rest = 1.0 - self.infinite_share
        slope = 0.5 * rest * (self.exponent - 1.0) * thinning * scaled / (1.0 + scaled)
        return self.infinite_share + rest * thinning, slope / square * self.time_s**2

    def by_unknowns(self, rate2: Floats) -> Floats:
        _, scaled, thinning = self._parts(rate2)
        rest = 1.0 - self.infinite_share
        return np.stack(
            [
                rest * thinning * np.log1p(scaled) / self.yasuda,
                rest * thinning * (self.exponent - 1.0) * scaled / (1.0 + scaled),
                self.infinite_share * (1.0 - thinning),
            ]
        )

    def with_offset(self, offset: Floats) -> CarreauYasuda:
        return replace(
            self,
            exponent=max(self.exponent + float(offset[0]), LEAST_EXPONENT),
            time_s=self.time_s * float(np.exp(offset[1])),
            infinite_share=self.infinite_share * float(np.exp(offset[2])),
        )


@dataclass(frozen=True, slots=True)
class TabulatedLaw:
    """f at some shear rates; ln f is a cubic of ln gamma between them that keeps monotone, and constant outside."""

    unknowns: ClassVar[tuple[str, ...]] = ()

    rates_1_s: tuple[float, ...] = ()  # ascending
    ratios: tuple[float, ...] = ()  # viscosity over the chip's viscosity_mpa_s

    @property
    def slit_factor(self) -> float:
        # A table has no exponent; 0.75 is exact for 0.5, and between 0.72 and 0.78 for 0.3 to 1.
        return slit_factor(0.5)

    def relative(self, rate2: Floats) -> tuple[Floats, Floats]:
        curve, slope, ends = _curves(self)
        place = 0.5 * np.log(np.maximum(rate2, 1e-300))
        inside = np.clip(place, *ends)
        f = np.exp(curve(inside))
        by_log = np.where(inside == place, slope(inside), 0.0)
        return f, 0.5 * f * by_log / np.maximum(rate2, 1e-300)

    def by_unknowns(self, rate2: Floats) -> Floats:
        return np.zeros((0, len(rate2)))

    def with_offset(self, offset: Floats) -> TabulatedLaw:
        return self


@lru_cache(maxsize=8)
def _curves(table: TabulatedLaw) -> tuple[Any, Any, tuple[float, float]]:
    """Return ln f as a function of ln gamma, its derivative, and the ends of the table."""
    from scipy.interpolate import PchipInterpolator

    places = np.log(table.rates_1_s)
    curve = PchipInterpolator(places, np.log(table.ratios))
    return curve, curve.derivative(), (float(places[0]), float(places[-1]))


def slit_factor(exponent: float) -> float:
    """Factor c of a power law, exact: its drag between plates is K ((2 n + 1) / n)^n V^n (2 / H)^(n + 1).

    So c^(n - 1) = ((2 n + 1) / (3 n))^n. Flow through a thin slit: R. B. Bird, R. C. Armstrong, O. Hassager,
    Dynamics of Polymeric Liquids 1 (1987), chapter 4.
    """
    if abs(exponent - 1.0) < 1e-6:
        return float(np.exp(-1.0 / 3.0))
    return float(((2.0 * exponent + 1.0) / (3.0 * exponent)) ** (exponent / (exponent - 1.0)))


def newtonian() -> None:
    """No law: the viscosity is constant."""


def blood() -> CarreauYasuda:
    """Human blood."""
    return CarreauYasuda(0.22, 1.902, BLOOD_INFINITE_MPA_S / BLOOD_MPA_S, 1.25)


def from_function(function: str) -> TabulatedLaw:
    """The table of a user's function "module:name" from shear rates (m,) in 1/s to viscosities (m,) over the chip's.

    Raises ChipError if there is no such function, it fails, or does not return a positive number per shear rate.
    """
    module, _, name = function.partition(":")
    what = f"chip.viscosity.function = {function!r}"
    try:
        called = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise ChipError(f'{what}: {error}; give "module:name" of a function that Python can import') from error
    try:
        values = np.asarray(called(np.array(RATES_1_S)), np.float64)
    except Exception as error:
        raise ChipError(
            f"{what} fails ({type(error).__name__}: {error}); it gets an array of shear rates in 1/s"
        ) from error
    if values.shape != (len(RATES_1_S),):
        raise ChipError(
            f"{what} returns shape {values.shape} for {len(RATES_1_S)} shear rates; return one value per rate"
        )
    return TabulatedLaw(RATES_1_S, tuple(values.tolist()))


@dataclass(frozen=True, slots=True)
class ViscositySettings:
    """Section [chip.viscosity], and [viscosity] of a chip's TOML. None: that of the chip, or the default of the law."""

    # how the viscosity depends on the shear rate. None: as the chip's file states
    law: Annotated[str, LAWS] | None = None
    # exponent n of the law; below 1: thinner at higher shear rates
    exponent: Annotated[float, Range(0.1, 3.0)] | None = None
    rate_1_s: Annotated[float, Range(1e-6, 1e6)] | None = None  # shear rate at which viscosity_mpa_s holds
    plateau_1_s: Annotated[float, Range(1e-9, 1e3)] | None = None  # shear rate below which the viscosity is constant
    time_s: Annotated[float, Range(1e-9, 1e6)] | None = None  # one over the shear rate at which thinning begins
    # viscosity at an infinite shear rate over that at rest
    infinite_share: Annotated[float, Range(0.0, 1e3)] | None = None
    # exponent a: how sharply thinning begins; 2: Carreau's law
    yasuda: Annotated[float, Range(0.1, 10.0)] | None = None
    rates_1_s: Annotated[tuple[float, ...], Range(1e-9, 1e9)] | None = None  # shear rates of the table, ascending
    # viscosities at these rates, over viscosity_mpa_s
    ratios: Annotated[tuple[float, ...], Range(1e-9, 1e9)] | None = None
    function: str | None = None  # Python function of the shear rate, as "module:name"


def law_of(settings: ViscositySettings, where: str) -> ViscosityLaw | None:
    """The law that the settings choose; None for a Newtonian fluid. `where` begins errors.

    Raises
    ------
    ChipError
        In one line, for settings that are not of the law, or of which no flow can be computed.
    """
    given = _given_values(settings)
    name = given.pop("law", "newtonian")
    row = LAWS[name]
    for key in given:
        if key not in row.options:
            known = f"it has {', '.join(row.options)}" if row.options else "it has none"
            able = " or ".join(other.name for other in LAWS.values() if key in other.options)
            raise ChipError(
                f"{where}: chip.viscosity.{key} is not for the law {name}, {known}; set chip.viscosity.law = {able}"
            )
    fault = next(faults(settings, "chip.viscosity."), None)
    if fault is not None:
        raise ChipError(f"{where}: {fault}")
    needed = {"table": ("rates_1_s", "ratios"), "function": ("function",)}.get(name, ())
    for key in needed:
        if key not in given:
            raise ChipError(f"{where}: the law {name} needs chip.viscosity.{key}")
    law: ViscosityLaw | None = row.load()(**given)
    if isinstance(law, TabulatedLaw):
        _check_table(law, where)
    return law


def with_settings(law: ViscosityLaw | None, settings: ViscositySettings, where: str) -> ViscosityLaw | None:
    """A chip's own law with the settings that are given instead; raises ChipError as `law_of` does."""
    given = _given_values(settings)
    if not given:
        return law
    own = law_settings(law) if settings.law is None else {}
    return law_of(ViscositySettings(**(own | given)), where)


def _given_values(settings: ViscositySettings) -> dict[str, Any]:
    return {field.name: value for field in fields(settings) if (value := getattr(settings, field.name)) is not None}


def law_settings(law: ViscosityLaw | None) -> dict[str, Any]:
    """The settings from which `law_of` makes exactly this law; {} for a Newtonian fluid."""
    if law is None:
        return {}
    name = next(name for name, row in LAWS.items() if row.load() is type(law))
    return {"law": name} | {field.name: getattr(law, field.name) for field in fields(law)}  # type: ignore[arg-type]


def law_text(law: ViscosityLaw | None) -> str:
    """The law in words, for a field and its people: "power_law exponent=0.5 ...", '' for a Newtonian fluid."""
    values = law_settings(law)
    name = values.pop("law", "")
    parts = [f"{len(value)} {key}" if isinstance(value, tuple) else f"{key}={value!r}" for key, value in values.items()]
    return " ".join([name, *parts])


def _check_table(table: TabulatedLaw, where: str) -> None:
    rates, ratios = np.array(table.rates_1_s), np.array(table.ratios)
    what = f"{where}: the viscosity"
    if len(rates) < 2 or len(rates) != len(ratios) or not (np.diff(rates) > 0.0).all():
        raise ChipError(
            f"{where}: chip.viscosity.rates_1_s and ratios have to be equally long, at least 2, with rates ascending"
        )
    wrong = np.flatnonzero(~(np.isfinite(ratios) & (ratios > 0.0)))
    if len(wrong):
        raise ChipError(
            f"{what} is {ratios[wrong[0]]:g} at {rates[wrong[0]]:g} /s; it has to be finite and more than zero"
        )
    if ratios.max() > LARGEST * ratios.min():
        raise ChipError(
            f"{what} varies by a factor of {ratios.max() / ratios.min():.0e}; at most {LARGEST:.0e} can be computed: "
            "let it level off"
        )
    slopes = np.diff(np.log(ratios)) / np.diff(np.log(rates))
    if slopes.min() < STEEPEST:
        at = rates[int(slopes.argmin())]
        raise ChipError(
            f"{what} falls as shear rate^{slopes.min():.2f} at {at:.3g} /s, so the stress does not grow there; the "
            f"power has to be above {STEEPEST}"
        )
