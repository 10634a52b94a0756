"""Fields in a stack of films for one angle and polarisation, and the light that a film absorbs."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..array_types import ComplexArray, FloatArray
from ..compiled import kernel

if TYPE_CHECKING:
    from .optics import Film, FlatFieldOptics


class Light(NamedTuple):
    """All that one angle and polarisation need apart from the thickness; Q wavelengths.

    Fields ``(E, H)`` stand at the lower face of the varying film as ``bottom`` and are carried by the film's own
    matrix to its upper face. ``incident`` carries them on from there to the ambient medium. ``top_above`` and
    ``top_below`` give the fields at the upper face of the detection film, from those above and below the varying
    film; ``low_above`` and ``low_below`` at its lower face.
    """

    weight: FloatArray  # (Q,) includes 1 / incident power
    phase: ComplexArray  # (Q,) phase thickness per µm of the varying film
    admittance: ComplexArray  # (Q,) of the varying film
    ambient: FloatArray  # (Q,) admittance of the ambient medium
    bottom: ComplexArray  # (Q, 2)
    incident: ComplexArray  # (Q, 2, 2)
    top_above: ComplexArray  # (Q, 2, 2)
    top_below: ComplexArray  # (Q, 2)
    low_above: ComplexArray  # (Q, 2, 2)
    low_below: ComplexArray  # (Q, 2)
    extra_um: float  # departure of the varying film from its mean thickness


@functools.lru_cache(maxsize=8)
def _indices(films: tuple[Film, ...], wavelengths: bytes, temperature_k: float) -> ComplexArray:
    """Index of every film at every wavelength; the same for all angles."""
    wavelength_nm = np.frombuffer(wavelengths)
    return np.stack([film.index(wavelength_nm, temperature_k) for film in films])


def light_in(
    optics: FlatFieldOptics,
    wavelength_nm: FloatArray,
    weight: FloatArray,
    theta: float,
    s_wave: bool,
    height_um: float,
    support_um: float = 0.0,
) -> Light:
    """Fields for one angle and polarisation; ``support_um`` is added to the support."""
    thickness = [film.thickness_um for film in optics.films]
    if support_um:
        thickness[optics.position("support")] += support_um
    wave_number = 2.0 * np.pi / (1e-3 * wavelength_nm)  # rad/µm
    index = _indices(optics.films, wavelength_nm.tobytes(), optics.temperature_k)
    along = index[0].real * math.sin(theta)
    normal = np.sqrt(index * index - along * along)  # n cos(theta); the principal root decays downwards
    admittance = normal if s_wave else index * index / normal
    last = len(optics.films) - 1
    v, d = optics.position(optics.varying), optics.position(optics.detection)

    smooth = np.broadcast_to(np.eye(2, dtype=complex), (len(wavelength_nm), 2, 2))
    rough = optics.position(optics.rough_face) if optics.roughness_nm > 0.0 else -1

    def into(film: int) -> ComplexArray:
        """Matrix from the upper face of a film, inside it, to the lower face of the film above it."""
        if film != rough:
            return smooth  # tangential fields are continuous
        height = 1e-3 * optics.roughness_nm * wave_number
        return _rough_face(admittance[[film - 1, film]], normal[[film - 1, film]] * height)

    def through(first: int, stop: int) -> ComplexArray:
        """Matrix from the upper face of film ``stop`` to the upper face of film ``first``, scaled."""
        product = smooth
        for j in range(first, stop):
            film = _film_matrix(admittance[j], wave_number * normal[j] * thickness[j])
            product = product @ film @ into(j + 1)
        return product

    def decay(first: int, stop: int) -> ComplexArray:
        """The factor that the scaled matrices of the films first … stop - 1 leave out."""
        exponent = np.zeros(len(wavelength_nm), dtype=complex)
        for j in range(first, stop):
            exponent += 1j * wave_number * normal[j] * thickness[j]
        return np.exp(exponent)

    substrate = np.stack([np.ones(len(wavelength_nm)), admittance[last]], axis=1)
    none_matrix = np.zeros((len(wavelength_nm), 2, 2), dtype=complex)
    none_vector = np.zeros((len(wavelength_nm), 2), dtype=complex)

    def face(film: int) -> tuple[ComplexArray, ComplexArray]:
        """Fields at the upper face of a film, from those at the upper and at the lower face of the varying one."""
        if film <= v:
            scale = decay(1, film)[:, np.newaxis, np.newaxis]
            return scale * through(film, v), none_vector
        below = np.einsum("qij,qj->qi", through(film, last), substrate)
        return none_matrix, below * (decay(1, v) * decay(v + 1, film))[:, np.newaxis]

    top_above, top_below = face(d)
    low_above, low_below = face(d + 1)
    low_above, low_below = into(d + 1) @ low_above, np.einsum("qij,qj->qi", into(d + 1), low_below)
    return Light(
        weight=weight,
        phase=wave_number * normal[v],
        admittance=admittance[v],
        ambient=admittance[0].real.copy(),
        bottom=np.einsum("qij,qj->qi", into(v + 1) @ through(v + 1, last), substrate),
        incident=np.ascontiguousarray(into(1) @ through(1, v)),
        top_above=np.ascontiguousarray(top_above),
        top_below=np.ascontiguousarray(top_below),
        low_above=np.ascontiguousarray(low_above),
        low_below=np.ascontiguousarray(low_below),
        extra_um=height_um,
    )


def _film_matrix(admittance: ComplexArray, phase: ComplexArray) -> ComplexArray:
    """Characteristic matrix times ``exp(i phase)``, which keeps opaque films finite; shape ``(Q, 2, 2)``."""
    round_trip = np.exp(2j * phase)
    matrix = np.empty((*phase.shape, 2, 2), dtype=complex)
    matrix[..., 0, 0] = matrix[..., 1, 1] = 0.5 * (1.0 + round_trip)
    matrix[..., 0, 1] = 0.5 * (1.0 - round_trip) / admittance
    matrix[..., 1, 0] = 0.5 * (1.0 - round_trip) * admittance
    return matrix


def _rough_face(admittance: ComplexArray, phase: ComplexArray) -> ComplexArray:
    """Matrix of a face whose height is normally distributed, for the mean (specular) field.

    Raised by h, a face changes the phase of the wave that it reflects upwards by 2 q1 h, downwards by -2 q2 h, and of
    what it lets through by (q1 - q2) h, with q the normal wave number on either side. The mean of exp(i a h) is
    exp(-a² σ² / 2).

    ``admittance`` (2, Q). ``phase`` (2, Q): normal wave number above and below times the rms height.
    """
    above, below = admittance
    reflected = (above - below) / (above + below)
    from_above = reflected * np.exp(-2.0 * phase[0] ** 2)
    from_below = -reflected * np.exp(-2.0 * phase[1] ** 2)
    passed = np.exp(-0.5 * (phase[0] - phase[1]) ** 2) / (above + below)
    down, up = 2.0 * above * passed, 2.0 * below * passed
    # Waves (down, up) above the face from those below it.
    waves = np.empty((admittance.shape[1], 2, 2), dtype=complex)
    waves[:, 0, 0] = 1.0 / down
    waves[:, 0, 1] = -from_below / down
    waves[:, 1, 0] = from_above / down
    waves[:, 1, 1] = up - from_above * from_below / down
    to_fields, to_waves = np.empty_like(waves), np.empty_like(waves)
    to_fields[:, 0, :] = 1.0
    to_fields[:, 1, 0], to_fields[:, 1, 1] = above, -above
    to_waves[:, :, 0] = 0.5
    to_waves[:, 0, 1], to_waves[:, 1, 1] = 0.5 / below, -0.5 / below
    return to_fields @ waves @ to_waves


def add_mode(total: FloatArray, light: Light, thickness_um: FloatArray) -> None:
    """Add the weighted absorbed fraction of one angle and polarisation to ``total``."""
    _add_absorption(total, thickness_um + light.extra_um, light, 0, light.weight.size)


PHASES = 32
"""Phases of a fringe that determine its harmonics; those beyond the sixteenth are fainter than a millionth."""


def add_periodic_mode(total: FloatArray, light: Light, thickness_um: FloatArray) -> None:
    """`add_mode` for a varying layer that absorbs nothing, so that all fringes are alike: by their harmonics."""
    number = np.arange(PHASES // 2)
    to_harmonics = np.exp(-2j * np.pi * number[:, np.newaxis] * np.arange(PHASES) / PHASES) / PHASES
    to_harmonics[1:] *= 2.0
    _add_harmonics(total, thickness_um + light.extra_um, to_harmonics, light)


@kernel
def _add_absorption(
    total: FloatArray, thickness: FloatArray, light: Light, first: int, last: int
) -> None:  # pragma: no cover - compiled
    """Add what is absorbed of the wavelengths from the first to before the last."""
    for q in range(first, last):
        y, e_bottom, h_bottom = light.admittance[q], light.bottom[q, 0], light.bottom[q, 1]
        c, t, low = light.incident[q], light.top_above[q], light.low_above[q]
        t_below, low_below, ambient = light.top_below[q], light.low_below[q], light.ambient[q]
        for i in range(thickness.size):
            once = np.exp(1j * light.phase[q] * thickness[i])
            even, odd = 0.5 * (1.0 + once * once), 0.5 * (1.0 - once * once)
            e = even * e_bottom + odd * h_bottom / y
            h = odd * y * e_bottom + even * h_bottom
            e_top = t[0, 0] * e + t[0, 1] * h + once * t_below[0]
            h_top = t[1, 0] * e + t[1, 1] * h + once * t_below[1]
            e_low = low[0, 0] * e + low[0, 1] * h + once * low_below[0]
            h_low = low[1, 0] * e + low[1, 1] * h + once * low_below[1]
            flux = (
                e_top.real * h_top.real
                + e_top.imag * h_top.imag
                - e_low.real * h_low.real
                - e_low.imag * h_low.imag
            )
            e_front = c[0, 0] * e + c[0, 1] * h
            h_front = c[1, 0] * e + c[1, 1] * h
            forward = 0.5 * (e_front + h_front / ambient)
            total[i] += light.weight[q] * flux / (ambient * (forward.real**2 + forward.imag**2))


@kernel
def _add_harmonics(
    total: FloatArray, thickness: FloatArray, to_harmonics: ComplexArray, light: Light
) -> None:  # pragma: no cover - compiled
    samples = np.empty(to_harmonics.shape[1])
    places = np.arange(samples.size) / samples.size
    harmonic = np.empty(to_harmonics.shape[0], np.complex128)
    for q in range(light.weight.size):
        samples[:] = 0.0
        _add_absorption(samples, np.pi / light.phase[q].real * places, light, q, q + 1)
        for h in range(harmonic.size):
            harmonic[h] = 0.0
            for i in range(samples.size):
                harmonic[h] += to_harmonics[h, i] * samples[i]
        for i in range(thickness.size):
            turn = np.exp(2j * light.phase[q].real * thickness[i])
            wave = 0.0j
            for h in range(harmonic.size - 1, 0, -1):
                wave = (wave + harmonic[h]) * turn
            total[i] += harmonic[0].real + wave.real
