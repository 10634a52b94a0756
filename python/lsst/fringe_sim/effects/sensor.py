"""Effects on the charge that a sensor collects, and on how it is read."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.fft import dct, idct

from ..errors import InputError
from .base import FloatArray, Parameter, PlainNullEffect, SearchHints, Values
from .geometry import AMPLIFIERS, ImageGeometry

LEAST_RATIO = 1.05  # Longest over shortest exposure from which its length can tell a rate from a level
REFERENCE_E = 100_000.0  # Charge at which brighter-fatter effect and non-linearity are stated [electrons]
MOST_PASSED = 0.2  # Part of its departure that a pixel may pass on; what is first order here is not beyond


class MidlineStep(PlainNullEffect):
    """The upper half of the sensor is brighter or fainter than the lower."""

    name = "midline_step"
    title = "step at the middle row"
    acts_on = "image"
    reference = "Guo, Walter, Lage & Lupton 2022, Fig. 5 (-1.1 % at the midline of E2V-CCD250-321)"
    parameters = (Parameter("fraction", "", 0.0, (-0.2, 0.2), 0.01, "upper over lower half, minus 1"),)

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Scale the upper half, and both so that the mean stays."""
        fraction = values["fraction"]
        factor = np.where(geometry.upper_half, 1.0 + fraction, 1.0) / (1.0 + 0.5 * fraction)
        return image * factor


class DarkPedestal(PlainNullEffect):
    """Every exposure holds the same number of electrons that are not from the monochromator."""

    name = "dark_pedestal"
    title = "dark pedestal, the same in every exposure"
    acts_on = "image"
    laboratory_only = True
    reference = "EMVA standard 1288, release 4 (dark signal of a camera)"
    parameters = (
        Parameter("electrons", "electron", 0.0, (-5000.0, 100000.0), 200.0, "level in every exposure"),
    )

    def dark_charge(self, values: Values, geometry: ImageGeometry) -> FloatArray:
        """The pedestal, in every exposure."""
        return np.full((1, 1, 1), values["electrons"])


class DarkCurrent(PlainNullEffect):
    """Every exposure gathers electrons that are not from the monochromator in proportion to its length."""

    name = "dark_current"
    title = "dark current or light leak, per second"
    acts_on = "image"
    laboratory_only = True
    reference = "EMVA standard 1288, release 4 (dark current of a camera)"
    parameters = (Parameter("rate", "electron/s", 0.0, (-50.0, 2000.0), 2.0, "electrons per second"),)

    def dark_charge(self, values: Values, geometry: ImageGeometry) -> FloatArray:
        """The rate, times the length of each exposure."""
        return values["rate"] * geometry.require_dark_times(self.name)

    def check_search(self, geometry: ImageGeometry) -> None:
        """Refuse exposures of one length, in which it is `DarkPedestal`."""
        times = geometry.require_dark_times(self.name)
        if np.max(times) < LEAST_RATIO * np.min(times):
            raise InputError(
                "dark times [s]",
                sorted(set(times.ravel().tolist())),
                "different ones, else it is dark_pedestal",
            )


class ChargeDiffusion(PlainNullEffect):
    """The image is blurred by a Gaussian: fine fringes lose contrast, coarse ones do not."""

    name = "charge_diffusion"
    title = "charge diffusion"
    acts_on = "image"
    reference = "Lage 2019, doi 10.48550/arXiv.1911.09577 (a few um rms in 100 um of silicon)"
    parameters = (Parameter("sigma", "px", 0.0, (0.0, 5.0), 0.4, "rms radius along one axis"),)

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Blur along both axes; exact for the band-limited image that the samples define, mirrored at the edges."""
        for axis in (-2, -1):
            if image.shape[axis] > 1:
                image = _filtered(
                    image, geometry, axis, lambda frequency: np.exp(-0.5 * (values["sigma"] * frequency) ** 2)
                )
        return image

    def blur_px(self, values: Values) -> float:
        """The rms radius."""
        return values["sigma"]


class BrighterFatter(PlainNullEffect):
    """What arrives is spread by a variance in proportion to the charge that is there: bright fringes lose height.

    The face between two pixels moves towards the fuller one by their difference of charge and takes the mean of
    their light along. Summed over an exposure in which the charge q grows evenly, every pixel gains a quarter of the
    differences of q² to its four neighbours times the variance that one electron adds.
    """

    name = "brighter_fatter"
    title = "brighter-fatter effect"
    acts_on = "image"
    reference = "Antilogus et al. 2014, doi 10.1088/1748-0221/9/03/C03048"
    parameters = (
        Parameter("variance", "px2", 0.0, (0.0, 0.5), 0.1, "spread along one axis behind 100 000 electrons"),
    )

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Add the differences of the square, mirrored at the edges."""
        strength = 0.25 * values["variance"] * geometry.require_levels(self.name) / REFERENCE_E
        return image + strength * _differences(image**2, geometry)

    def charge_spread_px2(self, values: Values, level_e: float) -> float:
        """In proportion to the level."""
        return values["variance"] * level_e / REFERENCE_E

    def noise_correlation(self, values: Values, geometry: ImageGeometry) -> float:
        """What a pixel has too much pushes some of the next electrons into its neighbours.

        First order in the departure from an even level; of a cell, only the pixels at the edge exchange charge.
        """
        level = float(geometry.require_levels(self.name).mean())
        passed = min(self.charge_spread_px2(values, level) / max(geometry.cell_px), MOST_PASSED)
        return passed / (1.0 - 2.0 * passed)


def _differences(image: FloatArray, geometry: ImageGeometry) -> FloatArray:
    """Sum of the four neighbouring pixels minus four times the pixel, for the band-limited image of the samples."""
    result = np.zeros(image.shape)
    for axis in (-2, -1):
        if image.shape[axis] > 1:
            result -= _filtered(image, geometry, axis, lambda frequency: 2.0 - 2.0 * np.cos(frequency))
    return result


class NonLinearity(PlainNullEffect):
    """The signal falls behind the charge, in proportion to the charge."""

    name = "non_linearity"
    title = "non-linear response to charge"
    acts_on = "image"
    reference = "Astier et al. 2019, doi 10.1051/0004-6361/201935508; LSSTCam is linear to a few 1e-3"
    parameters = (Parameter("quadratic", "", 0.0, (-0.2, 0.2), 0.02, "relative loss at 100 000 electrons"),)

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Take the quadratic term off.

        The level of the flats is what was counted. More charge is behind it: the root of
        ``counted = charge - quadratic * charge**2``, up to where more charge would count less.
        """
        counted = geometry.require_levels(self.name) / REFERENCE_E
        charge = 2.0 * counted / (1.0 + np.sqrt(np.maximum(1.0 - 4.0 * values["quadratic"] * counted, 0.0)))
        return image * (1.0 - values["quadratic"] * charge * image)


class Crosstalk(PlainNullEffect):
    """Each amplifier adds a small part of the pixels that its neighbours in x read at the same time.

    The part is one of what the neighbours hold before any crosstalk; all amplifiers read in the same direction.
    """

    name = "crosstalk"
    title = "crosstalk between neighbouring amplifiers"
    acts_on = "image"
    reference = "O'Connor 2015, doi 10.1088/1748-0221/10/05/C05010 (crosstalk in multi-output CCDs)"
    parameters = (
        Parameter(
            "from_left", "", 0.0, (-0.05, 0.05), 1e-3, "part of the signal of the amplifier at lower x"
        ),
        Parameter(
            "from_right", "", 0.0, (-0.05, 0.05), 1e-3, "part of the signal of the amplifier at higher x"
        ),
    )

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Add the neighbours, shifted by the distance of the amplifiers; all are read in the same direction."""
        result = image
        for side, part in ((-1, values["from_left"]), (1, values["from_right"])):
            if part:
                result = result + part * _neighbour(image, geometry, side)
        return result


def _neighbour(image: FloatArray, geometry: ImageGeometry, side: int) -> FloatArray:
    """What the amplifier next in x holds at the same place; 0 where there is none."""
    edges, x = np.array(geometry.x_edges, dtype=float), geometry.x_px
    own = geometry.amplifier_column
    other = own + side
    there = (other >= 0) & (other <= len(edges) - 2)
    source = x + np.where(there, edges[np.clip(other, 0, len(edges) - 2)] - edges[own], 0.0)
    place = np.clip((source - x[0]) / geometry.cell_px[1], 0.0, max(x.size - 1, 0))
    first = np.minimum(place.astype(np.int64), max(x.size - 2, 0))
    share = place - first
    after = np.minimum(first + 1, x.size - 1)
    shifted: FloatArray = np.where(there, (1.0 - share) * image[..., first] + share * image[..., after], 0.0)
    return shifted


class AmplifierGain(PlainNullEffect):
    """Each amplifier has another gain (electrons per count) than the tables say, and one that is larger counts fewer.

    A factor common to all does not show in relative flats: the errors are known relative to one another, and the
    uncertainty of each is mostly that of their mean.
    """

    name = "amplifier_gain"
    title = "gain errors of the amplifiers"
    acts_on = "image"
    reference = "Guo, Walter, Lage & Lupton 2022, section 3.2; gains of LSSTCam scatter by a few per cent"
    parameters = tuple(
        Parameter(name, "", 0.0, (-0.5, 0.5), 0.01, f"true over stated gain of {name}, minus 1")
        for name in AMPLIFIERS
    )
    search = SearchHints(exchangeable=True)

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Divide by the gain of the amplifier that reads the sample; a gain common to all is one of the level."""
        counts = 1.0 / np.array([1.0 + values[name] for name in AMPLIFIERS])
        return image * (counts / counts.mean())[geometry.amplifier]


class AmplifierOffset(PlainNullEffect):
    """Each amplifier keeps a level of its own after the bias was taken off."""

    name = "amplifier_offset"
    title = "bias residuals of the amplifiers"
    acts_on = "image"
    reference = "Guo, Walter, Lage & Lupton 2022, section 3.2 (bias subtraction)"
    parameters = tuple(
        Parameter(name, "electron", 0.0, (-5000.0, 5000.0), 50.0, f"offset of {name}") for name in AMPLIFIERS
    )
    search = SearchHints(exchangeable=True)

    def change_image(self, image: FloatArray, values: Values, geometry: ImageGeometry) -> FloatArray:
        """Let the offset be its part of the level of the amplifier that reads the sample, and light the rest."""
        offset = np.array([values[name] for name in AMPLIFIERS])
        level = geometry.require_levels(self.name)
        return (1.0 - offset.mean() / level) * image + offset[geometry.amplifier] / level


def _filtered(
    image: FloatArray, geometry: ImageGeometry, axis: int, response: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Multiply the cosine series of an image along one axis by a function of its frequency.

    ``image`` ``(..., ny, nx)``: the image.
    ``geometry``: where its samples lie.
    ``axis``: -2 or -1.
    ``response``: factor at angular frequencies [rad/px].
    Returns ``(..., ny, nx)``.
    """
    size = image.shape[axis]
    factor = response(np.arange(size) * np.pi / size / geometry.cell_px[axis])
    shape = (size, 1) if axis == -2 else (size,)
    result: FloatArray = idct(dct(image, type=2, axis=axis) * factor.reshape(shape), type=2, axis=axis)
    return result
