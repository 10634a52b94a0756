"""What a verdict says, in words, of a correction and of the accuracy of the model."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .verdict import Verdict

__all__ = ["accuracy_text", "chance_text", "learned_text"]

LEAST_CHANCE = 1e-300
"""Chances below this are not told: they are at the end of what a number can be."""

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
    return (
        f"{beyond} the accuracy of the model, {100.0 * told['assumed']:.2g} % of the fringes ({told['source']}): "
        f"chance {chance_text(told['chance'])} with it, {chance_text(verdict.global_probability)} of noise alone"
    )


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
