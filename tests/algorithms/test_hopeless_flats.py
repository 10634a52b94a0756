"""Flats that tell nothing, or hardly anything, of the thickness."""

from dataclasses import replace

import numpy as np
import pytest
from foreign_sky import foreign_map
from recorded_numbers import Record

from lsst.fringe_sim.algorithms import fit_thickness
from lsst.fringe_sim.challenge.sealed_cases import expose
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube
from lsst.fringe_sim.products.mask import mask_bits


def flats(rows: int, columns: int) -> FringeCube:
    rng = np.random.default_rng(3)
    return expose(foreign_map(rng, (rows, columns), 14.0, 14.6), {}, rng)[0]


def without_good_pixels() -> FringeCube:
    cube = flats(12, 16)
    return replace(cube, mask=np.full(cube.shape, mask_bits("BAD"), np.int16))


def with_two_good_pixels() -> FringeCube:
    cube = without_good_pixels()
    mask = np.array(cube.mask)
    mask[:, 3, 4] = mask[:, 8, 13] = 0
    return replace(cube, mask=mask)


def of_noise() -> FringeCube:
    cube = flats(16, 20)
    noise = 1.0 + 0.3 * np.random.default_rng(4).standard_normal(cube.shape)
    level = float(np.mean(cube.image))
    return replace(
        cube, image=(level * noise).astype(np.float32), variance=0.0 * cube.variance + (0.3 * level) ** 2
    )


@pytest.mark.parametrize(
    "make",
    [of_noise, with_two_good_pixels, lambda: flats(24, 1), lambda: flats(3, 5)],
    ids=["noise", "two good pixels", "one column", "few pixels"],
)
def test_hopeless_flats_are_as_recorded(make, recorded: Record) -> None:
    found = fit_thickness(make(), FringeModel.from_setup("ts8_e2v"))
    assert not np.isfinite(found.value[(found.mask & mask_bits("NO_DATA")) != 0]).any()
    recorded(found)


def test_flats_without_a_good_pixel_are_refused() -> None:
    with pytest.raises(InputError, match="good pixels"):
        fit_thickness(without_good_pixels(), FringeModel.from_setup("ts8_e2v"))
