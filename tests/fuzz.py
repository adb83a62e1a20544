"""Definitions and recipes, mutated at random: each is refused in words of ours, or is one that works.

python tests/fuzz.py 10000      # so many mutations, from a new seed, which is printed; a second number is the seed
"""

from __future__ import annotations

import random
import re
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from cirl_marl import CirlError, MultiAgentVectorEnv, load_network
from cirl_marl.definitions.catalogue import folder
from cirl_marl.learners.recipe import load_recipe

SOURCES = [*sorted(folder("envs").glob("*.toml")), Path(__file__).parent.parent / "examples" / "metal_cycle.toml"]
RECIPES = sorted(folder("agents").glob("*.toml"))
NUMBERS = ("0", "-1", "1e308", "-1e308", "1e-320", "nan", "inf", "9" * 400, "1e999", "true", '"x"', "[]", "{}", "0.5")
WORDS = ("", "x", "\\u0000", "9**9**9 kg", "k" * 3000, "default", "technosphere", "os:system", "../../x", "1/day", "Ω")
SLOW = 1.0
"""Processor seconds that a mutation may take beside what its source takes."""


def numbers(text: str, draw: random.Random) -> str:
    """Replace a number."""
    return replaced(text, r"(?<![\w.\"-])-?\d+(\.\d+)?(e-?\d+)?(?![\w.\"])", draw.choice(NUMBERS), draw)


def words(text: str, draw: random.Random) -> str:
    """Replace a text."""
    return replaced(text, r'"[^"\n]*"', f'"{draw.choice(WORDS)}"', draw)


def keys(text: str, draw: random.Random) -> str:
    """Misspell a key."""
    return replaced(
        text, r"(?m)^[a-z_]+(?= =)", draw.choice(("x", "rate", "initial", "role", "control", "share")), draw
    )


def lines(text: str, draw: random.Random) -> str:
    """Leave out a line, write it twice, or put it elsewhere."""
    found = text.split("\n")
    i, j = (draw.randrange(len(found)) for _ in range(2))
    line = found[i]
    how = draw.randrange(3)
    found[i : i + 1] = [[], [line, line], []][how]
    if how == 2:
        found.insert(j, line)
    return "\n".join(found)


def characters(text: str, draw: random.Random) -> str:
    """Cut something out, or put a sign in."""
    i = draw.randrange(len(text))
    return text[:i] + draw.choice(("", "[", "}", '"', "=", "#", "\n", "\x00", "é")) + text[i + draw.randrange(4) :]


def replaced(text: str, pattern: str, by: str, draw: random.Random) -> str:
    """Put ``by`` in one place where the pattern fits."""
    places = [match.span() for match in re.finditer(pattern, text)]
    if not places:
        return text
    start, end = draw.choice(places)
    return text[:start] + by + text[end:]


MUTATIONS: list[Callable[[str, random.Random], str]] = [numbers, numbers, words, keys, lines, characters]


def network_works(path: Path, region: str) -> None:
    """Build the network and play three steps, in which nothing is infinite."""
    network = load_network(f"{path}:{region}" if region else path)
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    for _ in range(3):
        actions = {agent: np.full((1, *space.shape), -0.3) for agent, space in env.action_spaces.items()}
        seen, paid, *_ = env.step(actions)
        found: list[Any] = [*seen.values(), *paid.values(), env.physical.stock]
        if not all(np.isfinite(each).all() for each in found):
            raise AssertionError("what is seen or paid is not finite")


def fuzzed(count: int, seed: int, report: Callable[[str], None] = print) -> Counter[str]:
    """Try ``count`` mutations; return how many were refused and how many work.

    Raises:
        AssertionError: for one that raises anything but a ``CirlError``, hangs, or gives what is not finite; its file
            is kept, and named.
    """
    found: Counter[str] = Counter()
    texts = {path: path.read_text(encoding="utf-8") for path in (*SOURCES, *RECIPES)}
    with tempfile.TemporaryDirectory() as scratch:
        for data in folder("envs").glob("*.csv"):
            (Path(scratch) / data.name).symlink_to(data)
        for number in range(count):
            draw = random.Random(f"{seed} {number}")
            source = draw.choice(SOURCES if draw.random() < 0.7 else RECIPES)
            text = texts[source]
            for _ in range(draw.randint(1, 3)):
                text = draw.choice(MUTATIONS)(text, draw)
            path = Path(scratch) / f"{number}.toml"
            path.write_text(text, encoding="utf-8")
            began = time.process_time()
            try:
                if source in SOURCES:
                    network_works(path, "japan" if source.stem == "steel" else "")
                else:
                    load_recipe(path)
                found["works"] += 1
            except CirlError as error:
                found["refused"] += 1
                if str(path) not in str(error) and source in RECIPES:
                    found["without the file's name"] += 1
            except BaseException as error:
                kept = Path(tempfile.gettempdir()) / f"fuzzed-{seed}-{number}.toml"
                kept.write_text(text, encoding="utf-8")
                raise AssertionError(
                    f"{kept} (of {source.name}, seed {seed}): {type(error).__name__}: {error}"
                ) from error
            if (took := time.process_time() - began) > 10 * SLOW:
                found["slow"] += 1
                report(f"mutation {number} of {source.name}, seed {seed}, took {took:.1f} s")
            path.unlink()
    return found


if __name__ == "__main__":
    asked = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    chosen = int(sys.argv[2]) if len(sys.argv) > 2 else random.SystemRandom().randrange(10**6)
    sys.stdout.write(f"{asked} mutations, seed {chosen}: {dict(fuzzed(asked, chosen))}\n")
