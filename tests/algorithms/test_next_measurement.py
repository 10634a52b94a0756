"""Measurements that could be taken, and what is said of their rank."""

import numpy as np
import pytest

from lsst.fringe_sim.algorithms.next_measurement import (
    FlatMeasurement,
    FlatSeries,
    PairForecast,
    RankedMeasurement,
    break_ambiguity,
    candidate_measurements,
)
from lsst.fringe_sim.errors import InputError, OutOfRangeError
from lsst.fringe_sim.model import FringeModel

FLATS = tuple(float(nm) for nm in range(880, 1000, 10))


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


def ranked(name: str, *separations: tuple[float, float]) -> RankedMeasurement:
    """A measurement with pairs of such separations before and after it."""
    pairs = [PairForecast("bandwidth", "roughness", 0.9, 0.5, now, then) for now, then in separations]
    return RankedMeasurement(FlatMeasurement(name, f"flats {name}", FlatSeries(FLATS)), tuple(pairs))


def test_a_measurement_is_as_good_as_its_hardest_pair() -> None:
    """Pairs come hardest first."""
    one = ranked("once more", (2.0, 4.0), (3.0, 9.0))
    assert (one.separation, one.gain, one.decides) == (4.0, 2.0, False)
    assert ranked("narrow", (0.0, 5.0)).gain == np.inf
    assert ranked("narrow", (0.0, 5.0)).decides
    assert one.text == (
        "flats once more: bandwidth against roughness: likeness 0.900 -> 0.500, separation 2 -> 4 sigma"
    )


def test_the_best_measurement_is_told() -> None:
    decisive, weak = ranked("narrow", (2.0, 50.0)), ranked("once more", (2.0, 2.8))
    assert break_ambiguity([decisive, weak]) == decisive.text
    assert break_ambiguity([weak]) == f"no measurement that was tried decides; the best are {weak.text}"
    assert break_ambiguity(()) == ""


def test_usual_candidates(model: FringeModel) -> None:
    found = {item.name: item.series for item in candidate_measurements(model)}
    assert set(found) == {"repeat", "temperature", "level", "narrow_bandpass", "f_number", "wide_range"}
    assert found["repeat"] == FlatSeries(FLATS)
    assert found["narrow_bandpass"].bandwidth_fwhm_nm == 0.5
    assert not set(found["wide_range"].wavelength_nm) & set(FLATS)
    narrow = FringeModel.from_setup("bnl_ts8_e2v")
    names = {item.name for item in candidate_measurements(narrow, (900.0, 950.0))}
    assert ("narrow_bandpass" in names) == (narrow.setup.bandwidth_fwhm_nm > 0.75)


def test_exposures_get_longer_with_more_light_and_a_narrower_line(model: FringeModel) -> None:
    seconds = tuple(np.linspace(10.0, 32.0, len(FLATS)))
    found = {item.name: item.series for item in candidate_measurements(model, FLATS, dark_time_s=seconds)}
    assert found["repeat"].dark_time_s == found["temperature"].dark_time_s == seconds
    assert found["level"].dark_time_s == pytest.approx([4.0 * time for time in seconds])
    assert found["narrow_bandpass"].dark_time_s == pytest.approx([4.0 * time for time in seconds])
    assert len(found["wide_range"].dark_time_s) == len(found["wide_range"].wavelength_nm)
    assert set(found["wide_range"].dark_time_s) == {10.0, 32.0}
    with pytest.raises(InputError, match="dark times"):
        FlatSeries(FLATS, dark_time_s=(10.0,))


def test_bad_flats_are_refused() -> None:
    with pytest.raises(InputError, match="wavelengths"):
        FlatSeries(())
    with pytest.raises(OutOfRangeError, match="level"):
        FlatSeries((900.0,), level_e=0.0)
