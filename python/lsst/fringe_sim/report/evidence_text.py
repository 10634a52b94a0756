"""What all public data say together, as text."""

from __future__ import annotations

from ..algorithms.public_evidence.joint import JointFit
from ..algorithms.public_evidence.verdict import Comparison


def evidence_text(found: Comparison) -> str:
    """Tables of sets and of kinds, and the verdict in sentences."""
    blocks = (_sets(found), _kinds(found), _wavelengths(found), _verdict(found))
    return "\n\n".join("\n".join(block) for block in blocks)


def _sets(found: Comparison) -> list[str]:
    lines = [f"{'effects':42}{'ln evidence':>12}{'P':>8}  parameters"]
    for fit, probability in zip(found.fits, found.probabilities, strict=True):
        values = ", ".join(f"{key} = {mean:.3g} ± {sigma:.1g}" for key, (mean, sigma) in fit.values.items())
        lines.append(f"{fit.name:42}{fit.log_evidence:12.1f}{probability:8.3f}  {values}")
    return lines


def _kinds(found: Comparison) -> list[str]:
    lines = [
        f"each kind of data foretold from all others by {found.best.name}; rms misfit (of logarithms but for the "
        "pixel, shape, phase and map)",
        f"{'kind':30}{'paper':>9}{'plane':>9}{'this':>9}{'factor':>8}{'Δ ln P':>9}",
    ]
    for row in found.rows:
        lines.append(
            f"{row.name:30}{row.paper:9.4f}{row.plane:9.4f}{row.foretold:9.4f}"
            f"{'fitted' if row.paper_fitted else f'{row.factor:.2f}':>8}"
            f"{row.log_probability:9.1f}"
        )
    return lines


def _wavelengths(found: Comparison) -> list[str]:
    base = found.wavelengths["paper, as published"]
    lines = [
        "each wavelength of the pixel foretold from the others and all other kinds; rms error, factor to the paper"
    ]
    lines += [f"{name:42}{error:9.5f}{base / error:8.2f}" for name, error in found.wavelengths.items()]
    return lines


def _verdict(found: Comparison) -> list[str]:
    members = found.members
    lines = [f"verdict: {_class(members)}"]
    for fit in members:
        along = found.goes_to_the_sky(fit)
        words = ", ".join(
            f"{name} {'goes to the sky' if goes else 'stays on the bench'}" for name, goes in along.items()
        )
        sky, plane = found.forecast[fit.name]
        lines.append(
            f"  {fit.name}: {words or 'nothing is missing'}; LSST sky in the field centre {sky:.3f} % rms "
            f"(plane layers {plane:.3f} %)"
        )
    shift, sigma = found.best.shift_um()
    lines.append(f"  the published map is to be shifted by {shift:.2f} ± {sigma:.2f} µm")
    if len(members) > 1:
        measurement, expected, apart = found.decisions[0]
        values = ", ".join(f"{name} {value:.3g}" for name, value in expected.items())
        unit = f" {measurement.unit}" if measurement.unit else ""
        lines.append(
            f"  what would decide: {measurement.name}, to {100.0 * measurement.accuracy:g} %: {values}{unit}; "
            f"any two at least {apart:.1f} σ apart"
        )
    return lines


def _class(members: tuple[JointFit, ...]) -> str:
    if len(members) == 1:
        return members[0].name
    return f"one class of {len(members)}: " + " | ".join(fit.name for fit in members)
