"""What a verdict says, in words, of a correction and of the accuracy of the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .verdict import Verdict

METRIC = "rms of data minus model, relative counts"

WITHIN_ACCURACY = (
    "model and data differ beyond noise, and by no more than the tables of the model may be wrong"
)

LEAST_CHANCE = 1e-300  # Chances below this are not told: they are at the end of what a number can be

LEARNED_WORDS = {
    "learned_response": "a wave form over the fringe phase",
    "learned_map": "a pattern over the sensor",
    "learned_light": "a pattern over the sensor in each exposure",
    "learned_amplifiers": "factors of the amplifiers",
}
"""What a correction is, by its effect."""


def chance_text(chance: float) -> str:
    """A chance to two digits; none is zero."""
    return f"{chance:.2g}" if chance > LEAST_CHANCE else f"below {LEAST_CHANCE:g}"


def accuracy_text(verdict: Verdict) -> str:
    """The disagreement beside the accuracy of the model; empty where it was not asked for."""
    told = verdict.accuracy
    if told.get("chance") is None:
        return ""
    beyond = "within" if verdict.within_accuracy else "beside"
    text = (
        f"{beyond} the accuracy of the model, {100.0 * told['assumed']:.2g} % of the fringes ({told['source']}): "
        f"chance {chance_text(told['chance'])} with it, {chance_text(verdict.global_probability)} of noise alone"
    )
    if "log_evidence" in told:
        text += (
            f"; the best effects bring log evidence {told['log_evidence_within']:.1f} with it, "
            f"{told['log_evidence']:.1f} with an exact model"
        )
    return text


def learned_text(verdict: Verdict) -> str:
    """What was learned; empty where nothing was."""
    if not verdict.has_learned:
        return ""
    told, alike = verdict.learned, ", ".join(verdict.unexplained.get("like", ()))
    first = f"like {alike}, and not quite: " if alike else ""
    return (
        f"{first}{LEARNED_WORDS[told['name']]} ({told['words']}; no physics) takes data that it has not seen from "
        f"{told['before_rms']:.6g} to {told['after_rms']:.6g}, noise floor {told['noise_floor']:.6g} "
        f"(chance of noise {told['chance']:.2g})"
    )


def said_of_left_out(why: Mapping[str, str]) -> list[str]:
    """Which effects were not looked for, those of one reason together."""
    by_reason: dict[str, list[str]] = {}
    for name, reason in why.items():
        by_reason.setdefault(reason, []).append(name)
    return [
        f"{', '.join(names)} {'were' if len(names) > 1 else 'was'} left out: {reason}"
        for reason, names in by_reason.items()
    ]
