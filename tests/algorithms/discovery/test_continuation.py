"""A field that is continued by the cells about those that are not known, against one by all cells."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.discovery.continuation import continued, filled

SHAPE = (36, 48)


@pytest.mark.rng("a field is continued by the cells about")
def test_only_the_cells_about_matter(rng: np.random.Generator) -> None:
    y, x = np.indices(SHAPE) / 20.0
    field = 15.0 + 0.5 * np.sin(2.0 * x + y) + 0.003 * rng.standard_normal(SHAPE)
    known = np.ones(SHAPE, dtype=bool)
    known[6:14, 10:20] = known[30:, :8] = known[20, 30] = False
    found = filled(np.where(known, field, np.nan), known)
    np.testing.assert_array_equal(found[known], field[known])
    np.testing.assert_allclose(found[~known], continued(field, known)[~known], atol=1e-7)
    assert np.abs(found - field)[~known].max() > 1e-3  # what is not known is not looked at
    assert filled(field, np.ones(SHAPE, dtype=bool)) is field
