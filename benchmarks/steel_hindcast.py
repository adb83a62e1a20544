"""What the reported flows of steel say of stocks and collection, and what they predict: tables of ``docs/data.md``.

python -m benchmarks.steel_hindcast
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from benchmarks.document import write_sections
from benchmarks.steel import DOCUMENT, TABLE, Country, calibrated, countries, populations
from cirl_marl.importing.flow_table import read_flows
from cirl_marl.network import Floats

CALIBRATED, TESTED = slice(0, 15), slice(15, 25)
LAST = slice(12, 15)
"""2012 to 2014, which set the collection of the hindcast."""
UNRELIABLE = 0.25
"""Error of hindcasts within 2000-2014 beyond which a country is called unreliable."""
ORIGINS = range(8, 15)
"""Years after 2000 from which hindcasts within 2000-2014 start."""


@dataclass(frozen=True, slots=True)
class Hindcast:
    """How well old scrap of 2015-2024 is predicted by what was known in 2014."""

    country: Country
    predicted: Annotated[Floats, "old scrap by calibrations that end in 2014, kt/a, shape (years,)"]
    earlier: Annotated[float, "Σ|predicted − reported|/Σ reported within 2000-2014, of calibrations that end earlier"]

    @property
    def errors(self) -> tuple[float, float, float]:
        """Σ|guess − reported|/Σ reported in 2015-2024: model, the value of 2014, the mean of 2012-2014."""
        reported = self.country.flows["old_scrap"]
        guesses = (self.predicted[TESTED], reported[CALIBRATED][-1], reported[LAST].mean())
        model, last, mean = (relative_error(guess, reported[TESTED]) for guess in guesses)
        return model, last, mean

    @property
    def unreliable(self) -> bool:
        """Whether 2000-2014 say that the model is not to be believed."""
        return self.earlier > UNRELIABLE or bool((self.country.flows["old_scrap"][CALIBRATED] == 0).any())


def relative_error(guess: Floats | float, reported: Floats) -> float:
    """Return Σ|guess − reported|/Σ reported, not a number where nothing is reported."""
    total = float(reported.sum())
    return float(np.abs(guess - reported).sum()) / total if total > 0 else float("nan")


def hindcast(country: Country) -> Hindcast:
    """Return what calibrations predict that know nothing of later years."""

    def predicted(end: int) -> Floats:
        known = calibrated(country, years=slice(0, end), recent=slice(end - 3, end))
        return known.mean(known.collection[..., None] * known.discards)

    reported = country.flows["old_scrap"]
    parts = [(predicted(end)[end:15], reported[end:15]) for end in ORIGINS]
    guesses, truth = (np.concatenate(each) for each in zip(*parts, strict=True))
    return Hindcast(country, predicted(15), relative_error(guesses, truth))


def known_lines(everyone: Sequence[Country]) -> Iterator[str]:
    """Yield the table of what is known of stocks and collection."""
    people = populations()
    yield "| country | in use, t a head | collected, % of discards | history, factor | lifetimes, factor |"
    yield "|-|-|-|-|-|"
    for country in everyone:
        found = calibrated(country)
        head = 1e3 / people[country.name][2025]
        cells = (
            f"{scale * float(found.mean(values)):{digits}} [{scale * low:{digits}}, {scale * high:{digits}}]"
            for values, scale, digits in ((found.stock, head, ".1f"), (found.collection, 100.0, ".0f"))
            for low, high in [found.range(values)]
        )
        level, stretch = found.mode
        yield f"| {country.name} | {' | '.join(cells)} | {level:.2f} | {stretch:.2f} |"


def hindcast_lines(found: Sequence[Hindcast]) -> Iterator[str]:
    """Yield the table of hindcasts."""
    yield "| country | error 2015–2024 | holding 2014 | holding 2012–2014 | within 2000–2014 | |"
    yield "|-|-|-|-|-|-|"
    for each in found:
        said = " | ".join("–" if not np.isfinite(error) else f"{error:.0%}" for error in (*each.errors, each.earlier))
        yield f"| {each.country.name} | {said} | {'unreliable' if each.unreliable else ''} |"
    good = [each for each in found if not each.unreliable]
    for what, chosen in (("median of all", found), (f"median of the {len(good)} others", good)):
        medians = np.nanmedian([each.errors for each in chosen], axis=0)
        yield f"| {what} | {' | '.join(f'{median:.1%}' for median in medians)} | | |"


def main() -> None:
    """Write both tables."""
    everyone = countries(read_flows(TABLE))
    found = [hindcast(each) for each in everyone]
    write_sections(DOCUMENT, {"known": "\n".join(known_lines(everyone)), "hindcast": "\n".join(hindcast_lines(found))})


if __name__ == "__main__":
    main()
