"""How likely it is that a cause outside the catalogue stands where effects are named."""

from __future__ import annotations

import math

MIMICKED = 0.05
"""Part of the causes outside the catalogue that effects in it can mimic, however strong they are."""

HIDDEN_CHI2 = 25.0
"""χ² that a residual may hold and still look like noise to tests that share their power among many patterns."""

DECADES_OF_CHANCE, CHI2_PER_DECADE = 200.0, 14.0
"""Powers of ten by which a residual of signal to noise 30 is improbable; and what effects take off χ², of a cause
outside the catalogue, for each power of ten by which what they leave is improbable. It is 17 to 36 where they take
off 500 to 5000, for seven ghost images and stains of other seeds than the recorded ones."""


def outsider_probability(
    number: int, chance: float, prior: float, explained: float, spots: float = -math.inf
) -> float:
    """Probability of a cause outside the catalogue, from the chance of noise in what is left.

    An effect of the catalogue leaves noise: any chance is as likely as any other. A cause outside it either is
    mimicked, and leaves noise as well, or leaves a residual whose chance may lie anywhere down to that of a signal to
    noise of 30, or of a third of what is explained, each power of ten as likely as the other. What share of it
    effects cannot mimic may be anything, and is seen if it is not too weak: nearly nothing is known of the cause of a
    signal to noise of 5.

    The more effects a set has, the likelier is one cause outside the catalogue in their place; see
    `outsiders_for_one`.

    ``number``: effects of the set. ``chance``: that noise alone leaves as much as the set does. ``prior``:
    probability that a cause is outside the catalogue before the data are seen. ``explained``: χ² that the set takes
    off the unchanged model. ``spots``: log evidence of spots, which no effect is, in the place of an effect, over
    that of the effect.
    """
    hidden = HIDDEN_CHI2 / max(explained, 1e-300)
    mimicked = min(max(MIMICKED, hidden), 1.0)
    p = min(max(chance, 1e-100), 1.0)
    decades = max(DECADES_OF_CHANCE, explained / CHI2_PER_DECADE)
    density = mimicked + (1.0 - mimicked) / (p * math.log(10.0) * decades)
    # Spots stand in the place of one of the effects, with n! / (n - 1)! of the sum.
    instead = outsiders_for_one(number) * density + number * math.exp(min(spots, 100.0))
    odds = prior / (1.0 - prior) * instead
    return odds / (1.0 + odds)


def outsiders_for_one(number: int) -> int:
    """Factor on the prior odds of a cause outside the catalogue against a set of so many effects.

    The number of causes is Poisson distributed with mean 1, so that ``m`` causes have probability ``exp(-1) / m!``.
    That all of them are in the set, and these are ``n`` effects, has ``exp(-1) / n!``. In the place of ``n - k`` of
    the effects there may be one cause outside the catalogue, which explains what they explain: this is one of
    ``k + 1`` causes, any of which may be the one outside, with ``exp(-1) (k + 1) / (k + 1)! = exp(-1) / k!``. The
    sum of these over ``k < n`` over the probability of the set is ``n! Σ 1 / k!``: 1, 4 and 15 for one, two and three
    effects. The odds of one cause inside against outside, and how much of it effects mimic, are the same for every
    ``k`` and stand beside this factor.
    """
    return sum(math.perm(number, replaced) for replaced in range(1, number + 1))
