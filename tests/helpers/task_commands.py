"""What the tests of the tasks share."""

from collections.abc import Callable
from dataclasses import dataclass

WAVELENGTHS_NM = tuple(float(nm) for nm in range(880, 1000, 10))


@dataclass(frozen=True)
class Outcome:
    """What a command said and how it ended."""

    code: int
    text: str


Command = Callable[..., Outcome]
