from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from astropy import units as u
from astropy.table import Table
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from product_makers import MAKERS, cube, flat, masks, pixels, sky, templates, thickness

from lsst.fringe_sim.errors import FrameFormatError, InputError, OutOfRangeError, UnknownNameError
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.products import (
    MASK_PLANES,
    FlatExposures,
    FringeCube,
    SkyFrames,
    describe_mask,
    mask_bits,
)
from lsst.fringe_sim.products.flat_fit import FlatFit
from lsst.fringe_sim.products.fringe_templates import input_cards, made_of
from lsst.fringe_sim.products.mask import ALL_BITS, planes_from_header, remap_mask
from lsst.fringe_sim.products.observed_frame import observed_from_simulation
from lsst.fringe_sim.products.thickness_map import thickness_span_um

GOOD = np.zeros((3, 4), dtype=int)


def nan_at(shape: tuple[int, ...], at: tuple[int, ...], value: float = np.nan) -> np.ndarray:
    values = np.abs(pixels(shape, 3)) + 1
    values[at] = value
    return values


BAD: list[tuple[str, dict[str, Any], type[InputError], str]] = [
    (
        "FringeFlat",
        {"image": nan_at((3, 4), (1, 2)), "mask": GOOD},
        FrameFormatError,
        "1 pixels .* not finite",
    ),
    ("FringeFlat", {"variance": nan_at((3, 4), (1, 2), -1), "mask": GOOD}, FrameFormatError, "VARIANCE"),
    ("FringeFlat", {"variance": np.zeros((4, 3))}, FrameFormatError, r"VARIANCE is 'shape \(4, 3\)'"),
    ("FringeFlat", {"mask": np.zeros((3, 4), float)}, FrameFormatError, "MASK is 'dtype float64'"),
    ("FringeFlat", {"mask": np.full((3, 4), 1 << 29)}, FrameFormatError, "bits 0x20000000"),
    ("FringeFlat", {"image": np.zeros((2, 3, 4))}, FrameFormatError, "2 axes"),
    ("FringeFlat", {"image": np.zeros((0, 4))}, FrameFormatError, "none of them empty"),
    ("FringeFlat", {"image": np.zeros((3, 4), complex)}, FrameFormatError, "real numbers"),
    ("FringeFlat", {"image": [[1, 2], [3]]}, FrameFormatError, "ragged"),
    ("FringeFlat", {"wavelength_nm": 0.0}, OutOfRangeError, "wavelength_nm is 0.0"),
    ("FringeFlat", {"wavelength_nm": "960"}, InputError, "wavelength_nm is '960'; allowed: a number"),
    ("FringeFlat", {"wavelength_nm": True}, InputError, "a number"),
    ("FringeFlat", {"bandwidth_fwhm_nm": -1.0}, OutOfRangeError, "bandwidth_fwhm_nm"),
    ("FringeFlat", {"temperature_k": float("nan")}, OutOfRangeError, "temperature_k"),
    ("FringeFlat", {"level_e": float("inf")}, OutOfRangeError, "level_e"),
    ("FringeFlat", {"detector": " R11"}, InputError, "detector"),
    ("FringeFlat", {"detector": "é"}, InputError, "ASCII"),
    ("FringeFlat", {"detector": "x" * 61}, InputError, "60"),
    ("FringeCube", {"unit": "adu"}, UnknownNameError, "BUNIT is 'adu'; allowed: electron, relative"),
    ("FringeCube", {"layer": ""}, InputError, "LAYER"),
    ("FringeCube", {"thickness": None}, FrameFormatError, "THICKNESS is 'missing'"),
    ("FringeCube", {"thickness": np.zeros((4, 4))}, FrameFormatError, "THICKNESS"),
    ("FringeCube", {"thickness_sigma": np.full((3, 4), -1.0)}, OutOfRangeError, "THICKNESS_SIGMA"),
    (
        "FringeCube",
        {"image": nan_at((2, 3, 4), (1, 0, 0)), "mask": np.zeros((2, 3, 4), int)},
        FrameFormatError,
        "IMAGE is '1 pixels",
    ),
    ("FringeCube", {"exposures": [960.0]}, InputError, "FlatExposures"),
    ("FringeCube", {"exposures": FlatExposures([960.0], 2.0, 183.0)}, FrameFormatError, "1 rows"),
    ("ThicknessMap", {"value": np.zeros((3, 4)), "mask": GOOD}, OutOfRangeError, "a positive thickness"),
    ("ThicknessMap", {"sigma": nan_at((3, 4), (0, 0)), "mask": GOOD}, FrameFormatError, "SIGMA"),
    ("ThicknessMap", {"chi2": nan_at((3, 4), (0, 0), -2), "mask": GOOD}, FrameFormatError, "CHI2"),
    ("ThicknessMap", {"slip_probability": np.full((3, 4), 1.1), "mask": GOOD}, OutOfRangeError, "0 to 1"),
    ("ThicknessMap", {"n_wavelengths": np.full((3, 4), -1)}, OutOfRangeError, "N_WAVELENGTHS"),
    ("ThicknessMap", {"n_wavelengths": np.full((3, 4), 1.5)}, FrameFormatError, "integers"),
    ("ThicknessMap", {"layer": ""}, InputError, "layer"),
    ("FringeFrame", {"image": nan_at((3, 4), (0, 0)), "mask": GOOD + 1}, FrameFormatError, "IMAGE"),
    ("FringeFrame", {"variance": nan_at((3, 4), (0, 0)), "mask": GOOD + 1}, FrameFormatError, "VARIANCE"),
    ("FringeFrame", {"image": np.full((3, 4), 0.01), "mask": GOOD}, OutOfRangeError, "mean of IMAGE"),
    ("FringeFrame", {"creation_datetime": "yesterday"}, InputError, "YYYY"),
    ("FringeFrame", {"physical_filter": ""}, InputError, "physical_filter"),
    ("FringeFrame", {"xy0": (1.5, 2)}, InputError, "xy0"),
    ("FringeFrame", {"metadata": {"OBSTYPE": "flat"}}, InputError, "OBSTYPE"),
    ("FringeComponents", {"components": np.zeros((2, 4, 4))}, FrameFormatError, "COMPONENTS"),
    ("FringeComponents", {"mean": nan_at((3, 4), (0, 0))}, FrameFormatError, "MEAN"),
    ("FringeComponents", {"scores": np.zeros((5, 3))}, FrameFormatError, "SCORES"),
    ("FringeComponents", {"explained_variance": np.array([1.0, 2.0])}, OutOfRangeError, "largest first"),
    ("FringeComponents", {"explained_variance_ratio": np.array([0.9, 0.2])}, OutOfRangeError, "at most 1"),
    ("FringeComponents", {"explained_variance": np.ones(3)}, FrameFormatError, "3 values"),
    ("SkyFringe", {"unit": "adu"}, UnknownNameError, "unit"),
    ("SkyFringe", {"airmass": 0.9}, OutOfRangeError, "airmass"),
    ("SkyFringe", {"hour": 37.0}, OutOfRangeError, "hour"),
    ("SkyFringe", {"seed": -1}, OutOfRangeError, "seed"),
    ("SkyFringe", {"seed": 1.5}, InputError, "seed"),
    ("SkyFringe", {"quadrature_error": -1e-9}, OutOfRangeError, "quadrature_error"),
    ("CombinedBias", {"image": nan_at((3, 4), (0, 0))}, FrameFormatError, "IMAGE"),
    ("CombinedBias", {"noise_adu": {"C00": -1.0}}, OutOfRangeError, "noise of C00"),
    ("CombinedBias", {"noise_adu": {}}, InputError, "noise_adu"),
    ("CombinedBias", {"noise_adu": [1.0]}, InputError, "noise_adu"),
    ("CombinedBias", {"n_frames": 0}, OutOfRangeError, "n_frames"),
    ("SkyFringe", {"mean_electrons": 0.0}, OutOfRangeError, "mean_electrons"),
]


@pytest.mark.parametrize(("kind", "changes", "error", "message"), BAD)
def test_one_typed_error(kind: str, changes: dict[str, Any], error: type[InputError], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        MAKERS[kind](**changes)
    assert type(caught.value) is error


METADATA_REFUSED: list[dict[Any, Any]] = [
    {"NAXIS1": 3},
    {"CHECKSUM": "x"},
    {"EXTNAME": "x"},
    {"MP_BAD": 3},
    {"PRODUCT": "x"},
    {"": 1},
    {5: 1},
    {"WHAT?": 1},
    {"K" * 51: 1},
    {"A": float("nan")},
    {"A": float("inf")},
    {"A": "µm"},
    {"A": "two\nlines"},
    {"A": [1, 2]},
    {"A": 1 + 2j},
    {"A": 10**400},
]


@pytest.mark.parametrize("kind", sorted(MAKERS))
@pytest.mark.parametrize("metadata", METADATA_REFUSED)
def test_metadata_that_a_header_cannot_hold(kind: str, metadata: dict[Any, Any]) -> None:
    with pytest.raises(InputError, match="metadata"):
        MAKERS[kind](metadata=metadata)


@given(st.sampled_from(sorted(MAKERS)), st.text(max_size=12), st.text(max_size=90))
def test_any_text_is_kept_or_refused(kind: str, key: str, value: str) -> None:
    try:
        product = MAKERS[kind](metadata={key: value})
    except InputError:
        return
    assert dict(product.metadata) == {key.strip().upper(): value.rstrip(" ")}


@given(
    st.sampled_from(["wavelength_nm", "bandwidth_fwhm_nm", "temperature_k", "level_e", "f_number"]),
    st.one_of(st.floats(), st.text(max_size=3), st.none(), st.booleans(), st.complex_numbers()),
)
def test_a_scalar_is_kept_or_refused(name: str, value: Any) -> None:
    real = isinstance(value, float) and value >= 0
    try:
        product = flat(**{name: value})
    except InputError as error:
        field = error.field
        refused = not real or value == 0 or not np.isfinite(value)
        kept = False
    else:
        field, refused, kept = name, False, getattr(product, name) == value
    assert field == name
    assert refused or (real and kept)


@pytest.mark.parametrize(
    ("columns", "field"),
    [
        ({"wavelength_nm": [960.0, -1.0]}, "wavelength"),
        ({"wavelength_nm": []}, "wavelength"),
        ({"bandwidth_fwhm_nm": np.nan}, "bandwidth_fwhm"),
        ({"temperature_k": [183.0] * 3}, "temperature"),
        ({"temperature_k": np.inf}, "temperature"),
        ({"f_number": [np.inf, np.nan]}, "f_number"),
        ({"f_number": 0.0}, "f_number"),
        ({"level_e": -5.0}, "level"),
        ({"dark_time_s": [10.0, -5.0]}, "dark_time"),
    ],
)
def test_exposures_name_the_column(columns: dict[str, Any], field: str) -> None:
    good = {"wavelength_nm": [960.0, 970.0], "bandwidth_fwhm_nm": 2.0, "temperature_k": 183.0}
    with pytest.raises(InputError) as caught:
        FlatExposures(**(good | columns))
    assert caught.value.field == field


def test_amplitudes_are_not_taken_for_relative_counts() -> None:
    with pytest.raises(OutOfRangeError, match="counts over their mean"):
        cube(unit="relative", image=pixels((2, 3, 4), 1))


def test_flats_are_sorted_by_wavelength_and_shifted_to_relative_counts() -> None:
    flats = [flat(number=k, wavelength_nm=w, level_e=w) for k, w in enumerate([990.0, 880.0, 930.0])]
    stacked = FringeCube.from_flats(flats)
    np.testing.assert_array_equal(stacked.wavelength_nm, [880, 930, 990])
    np.testing.assert_array_equal(stacked.exposures.level_e, [880, 930, 990])
    assert stacked.unit == "relative"
    assert stacked.detector == "R11_S01"
    good = stacked.mask[2] == 0
    np.testing.assert_array_equal(stacked.image[2][good], (flats[0].image + np.float32(1))[good])
    np.testing.assert_array_equal(stacked.variance[2][good], flats[0].variance[good])
    assert np.isfinite(stacked.image).all()


def test_one_mask_is_kept_while_all_flats_share_it() -> None:
    """A fifth of the memory of a cube; other masks, and another order of the wavelengths, change nothing else."""
    shared, other = masks((3, 4), 1), masks((3, 4), 2)
    assert not np.array_equal(shared, other)
    wavelengths = [990.0, 880.0, 930.0]
    same = FringeCube.from_flats(
        [flat(number=k, wavelength_nm=w, mask=shared) for k, w in enumerate(wavelengths)]
    )
    assert same.mask.strides[0] == 0
    np.testing.assert_array_equal(same.mask, np.stack([shared] * 3))
    for place in range(3):
        chosen = [other if k == place else shared for k in range(3)]
        mixed = FringeCube.from_flats(
            [
                flat(number=k, wavelength_nm=w, mask=m)
                for k, (w, m) in enumerate(zip(wavelengths, chosen, strict=True))
            ]
        )
        np.testing.assert_array_equal(mixed.mask, np.stack([chosen[1], chosen[2], chosen[0]]))


def test_flats_may_come_one_by_one_and_pass_on_what_they_share() -> None:
    flats = [
        flat(number=k, wavelength_nm=w, metadata={"SMOOTHPX": 3.0, "EXPID": k, f"ONLY{k}": 1})
        for k, w in enumerate([880.0, 890.0])
    ]
    streamed = FringeCube.from_flats(iter(flats), {"NOTE": "x"}, number=2)
    assert dict(streamed.metadata) == {"SMOOTHPX": 3.0, "NOTE": "x"}
    np.testing.assert_array_equal(streamed.image, FringeCube.from_flats(flats).image)
    for number, message in ((None, "without length"), (1, "more than 1"), (3, "3, as announced")):
        with pytest.raises(InputError, match=message):
            FringeCube.from_flats(iter(flats), number=number)


def test_one_flat_without_noise_makes_a_cube_without() -> None:
    marks: list[dict[str, Any]] = [{}, {"NOISE": True}, {"NOISE": False}]
    flats = [flat(number=k, wavelength_nm=880.0 + k, metadata=mark) for k, mark in enumerate(marks)]
    assert FringeCube.from_flats(flats).metadata["NOISE"] is False
    assert "NOISE" not in FringeCube.from_flats(flats[:2]).metadata


def test_flats_that_do_not_belong_together() -> None:
    with pytest.raises(InputError, match="at least one flat"):
        FringeCube.from_flats([])
    with pytest.raises(FrameFormatError, match="flat at 970 nm is 'shape"):
        FringeCube.from_flats([flat(), flat((4, 4), wavelength_nm=970.0)])
    with pytest.raises(FrameFormatError, match="sensor R11_S02"):
        FringeCube.from_flats([flat(), flat(detector="R11_S02", wavelength_nm=970.0)])


def test_take_keeps_planes_and_exposures_together() -> None:
    whole = cube()
    part = whole.take([1])
    np.testing.assert_array_equal(part.image[0], whole.image[1])
    np.testing.assert_array_equal(part.wavelength_nm, whole.wavelength_nm[[1]])
    assert part.shape == (1, 3, 4)


def test_sky_fraction_is_the_same_from_either_unit() -> None:
    electrons = sky(mask=GOOD, image=2717.1 * (1 + pixels((3, 4), 1)))
    fraction = sky(mask=GOOD, image=pixels((3, 4), 1), unit="fraction")
    np.testing.assert_allclose(electrons.fraction(), fraction.fraction(), rtol=0, atol=3e-7)


@pytest.mark.parametrize(
    ("changes", "field", "expected"),
    [
        ({"wavelength_nm": 0.96 * u.um}, "wavelength_nm", 960.0),
        ({"dark_time_s": 0.5 * u.min}, "dark_time_s", 30.0),
        ({"level_e": 2e4 * u.electron}, "level_e", 2e4),
        ({"f_number": u.Quantity(2.5)}, "f_number", 2.5),
    ],
)
def test_quantities_are_converted(changes: dict[str, Any], field: str, expected: float) -> None:
    assert getattr(flat(**changes), field) == pytest.approx(expected)


@pytest.mark.parametrize(
    "make",
    [
        lambda: flat(wavelength_nm=183.0 * u.K),
        lambda: flat(f_number=2.5 * u.nm),
        lambda: flat(image=pixels((3, 4), 1) * u.electron, mask=GOOD),
        lambda: flat(mask=GOOD * u.nm),
        lambda: cube(thickness=np.full((3, 4), 14.0) * u.s),
        lambda: cube(image=np.ones((2, 3, 4)) * u.um),
        lambda: FlatExposures([960.0] * u.K, 2.0, 183.0),
        lambda: FlatExposures([960.0 * u.nm, 970.0 * u.K], 2.0, 183.0),
    ],
)
def test_quantities_of_another_kind_are_refused(make: Any) -> None:
    with pytest.raises(InputError):
        make()


def test_a_list_of_quantities_is_converted_one_by_one() -> None:
    exposures = FlatExposures([960.0 * u.nm, 0.97 * u.um], 2.0, 183.0)
    np.testing.assert_allclose(exposures.wavelength_nm, [960.0, 970.0])


def test_a_cube_from_arrays() -> None:
    images = np.full((2, 3, 4), 2e4)
    images[1, 0, :2] = np.nan
    rows = Table({"w": [0.96, 0.97] * u.um})
    made = FringeCube.from_arrays(images, rows["w"], mask=np.eye(3, 4, dtype=int), detector="R11_S01")
    np.testing.assert_allclose(made.wavelength_nm, [960.0, 970.0])
    assert list(made.mask[1, 0, :3]) == [mask_bits("BAD"), mask_bits("NO_DATA"), 0]
    np.testing.assert_array_equal(made.variance[0], images[0])
    assert repr(made) == "FringeCube(2 x 3 x 4, detector='R11_S01', 960 to 970 nm, electron)"
    with pytest.raises(InputError, match="do not tell their noise"):
        FringeCube.from_arrays(np.ones((2, 3, 4)), [960.0, 970.0], unit="relative")
    with pytest.raises(InputError, match="bandwidth_fwhm"):
        FringeCube.from_arrays(images, [960.0, 970.0], bandwidth_fwhm_nm=-1.0)


def test_sky_frames_from_arrays() -> None:
    images, layer = np.full((2, 3, 4), 2e3), np.full((3, 4), 14_000.0) * u.nm
    images[0, 0, 0] = np.nan
    made = SkyFrames.from_arrays(images, layer, hour=[24.0, 25.0], detector="R22_S11")
    np.testing.assert_allclose(made.thickness_um, 14.0)
    assert [frame.hour for frame in made.frames] == [24.0, 25.0]
    assert made.frames[0].mask[0, 0] == mask_bits("NO_DATA")
    assert made.frames[1].mean_electrons == pytest.approx(2e3)
    assert repr(made) == "SkyFrames(2 x 3 x 4, detector='R22_S11', layer='adhesive')"
    with pytest.raises(FrameFormatError, match="thickness map"):
        SkyFrames.from_arrays(np.ones((2, 4, 4)), layer)
    with pytest.raises(InputError, match="one sensor"):
        SkyFrames([sky(), sky(detector="R11_S01")], made.thickness)


AFW_PLANES = {
    "BAD": 0,
    "SAT": 1,
    "INTRP": 2,
    "CR": 3,
    "EDGE": 4,
    "DETECTED": 5,
    "DETECTED_NEGATIVE": 6,
    "SUSPECT": 7,
    "NO_DATA": 8,
}


def test_the_planes_of_afw_keep_their_bits() -> None:
    assert {name: MASK_PLANES[name] for name in AFW_PLANES} == AFW_PLANES
    assert len(set(MASK_PLANES.values())) == len(MASK_PLANES)
    assert min(set(MASK_PLANES.values()) - set(AFW_PLANES.values())) > max(AFW_PLANES.values())


def test_every_plane_fits_into_the_narrow_mask_of_a_cube() -> None:
    assert np.iinfo(np.int16).max >= ALL_BITS


def test_bits_add_up_and_repeat_harmlessly() -> None:
    assert mask_bits() == 0
    assert mask_bits("SAT", "EDGE", "SAT") == 2 + 16


def test_unknown_plane_offers_the_near_one() -> None:
    with pytest.raises(UnknownNameError, match="did you mean NO_DATA"):
        mask_bits("NODATA")


@given(st.permutations(list(MASK_PLANES)), st.data())
def test_remap_follows_names_not_bits(order: list[str], data: st.DataObject) -> None:
    bits = data.draw(st.lists(st.integers(0, 30), min_size=len(order), max_size=len(order), unique=True))
    planes = dict(zip(order, bits, strict=True))
    chosen = data.draw(st.lists(st.sampled_from(order), min_size=6, max_size=6))
    stored = np.array([1 << planes[name] for name in chosen], dtype=np.int32).reshape(2, 3)
    expected = np.array([mask_bits(name) for name in chosen], dtype=np.int32).reshape(2, 3)
    np.testing.assert_array_equal(remap_mask(stored, planes), expected)


@given(arrays(np.int32, (3, 4), elements=st.integers(0, ALL_BITS)))
def test_describe_counts_each_plane(mask: np.ndarray) -> None:
    for name, count in describe_mask(mask).items():
        assert count == sum(bool(value & mask_bits(name)) for value in mask.flat) > 0


def test_a_bit_without_a_name_is_refused() -> None:
    with pytest.raises(FrameFormatError, match="0x4"):
        remap_mask(np.array([[4]]), {"BAD": 0, "SAT": 1})


@pytest.mark.parametrize(
    ("header", "error"),
    [
        ({"MP_COSMIC": 3}, UnknownNameError),
        ({"MP_BAD": 31}, FrameFormatError),
        ({"MP_BAD": True}, FrameFormatError),
        ({"MP_BAD": "0"}, FrameFormatError),
        ({"MP_BAD": 1, "MP_SAT": 1}, FrameFormatError),
    ],
)
def test_headers_that_name_planes_badly(header: dict[str, object], error: type[Exception]) -> None:
    with pytest.raises(error):
        planes_from_header(header)


def arrays_in(value: Any) -> Iterator[np.ndarray]:
    """Arrays in the fields of a product, and in what it is made of."""
    if isinstance(value, np.ndarray):
        yield value
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            yield from arrays_in(getattr(value, field.name))


@pytest.mark.parametrize("kind", sorted(MAKERS))
def test_arrays_of_a_product_cannot_be_written(kind: str) -> None:
    """Nor is anything taken from those that it was made of."""
    ones = np.ones(2)
    flats = FlatFit(np.array([900.0, 960.0]), *(ones,) * 5)
    product = MAKERS[kind](**({"flats": flats} if kind == "ThicknessMap" else {}))
    found = list(arrays_in(product))
    assert len(found) >= 2
    assert not any(each.flags.writeable for each in found)
    assert ones.flags.writeable


def test_what_stands_for_what_frames_of_the_sky_do_not_say() -> None:
    """Half a minute at the airmass of the paper, without noise and without an error of the sum."""
    made = SkyFrames.from_arrays(100.0 * np.ones((2, 3, 4)), 14.0 * np.ones((3, 4)), hour=22.0)
    assert [frame.hour for frame in made.frames] == [22.0, 22.0]
    for frame in made.frames:
        assert (frame.exposure_s, frame.airmass, frame.seed, frame.quadrature_error) == (30.0, 1.2, None, 0.0)
        assert not frame.mask.any()


@pytest.mark.parametrize("unit", ["electron", "fraction"])
def test_a_simulated_frame_is_observed_in_electrons(unit: str) -> None:
    image = 2700.0 * (1.0 + 0.01 * pixels((3, 4), 2)) if unit == "electron" else 0.01 * pixels((3, 4), 2)
    frame = sky(unit=unit, image=image, mask=GOOD, mean_electrons=2500.0, metadata={"QONE": 3})
    seen = observed_from_simulation(frame)
    expected = image if unit == "electron" else 2500.0 * (1.0 + image)
    np.testing.assert_allclose(seen.image, expected, rtol=1e-6)
    assert (seen.unit, seen.detector, seen.physical_filter) == ("electron", "R22_S11", "y_10")
    assert seen.metadata["QONE"] == 3
    assert seen.variance is None


def test_one_flat_twice_is_refused() -> None:
    """Two of one wavelength have noise of their own; equal ones of several wavelengths are somebody's model."""
    exposures = FlatExposures(np.array([960.0, 960.0]), np.array(2.0), np.array(183.0))
    image = 20_000.0 * (1.0 + pixels((2, 3, 4), 4))
    assert cube(image=image, exposures=exposures).shape == (2, 3, 4)
    same = np.stack([image[0], image[0]])
    with pytest.raises(InputError, match="equal pixels in 0 and 1"):
        cube(image=same, exposures=exposures)
    assert cube(image=same).shape == (2, 3, 4)


def test_templates_are_frames_of_mean_zero_where_they_are_good() -> None:
    """What a mask only doubts keeps its value, and has no part in the mean."""
    mask = np.zeros((3, 4), np.int32)
    mask[0], mask[1, 0] = mask_bits("NO_DATA"), mask_bits("SAT")
    made = templates(mask=mask, physical_filter="", coverage=np.ones((3, 4), np.float32))
    for number, (frame, pattern) in enumerate(zip(made.frames(), made.patterns, strict=True)):
        level = pattern[mask == 0].mean(dtype=float)
        np.testing.assert_allclose(frame.image[1:], pattern[1:] - level, atol=1e-7)
        np.testing.assert_array_equal(frame.image[0], 0.0)
        assert (frame.metadata["TEMPLATE"], frame.physical_filter) == (number, "unknown")
    nothing = templates(mask=np.full((3, 4), mask_bits("NO_DATA")))
    assert not any(frame.image.any() for frame in nothing.frames())


def test_a_template_knows_its_frames() -> None:
    digests = [f"{number:032x}" for number in range(3)] + ["f" * 32]
    cards = {**input_cards(digests[1:]), "OTHER": digests[0][:16]}
    assert [made_of(cards, digest) for digest in ("e" * 32, "f" * 15 + "0" * 17, "f" * 16 + "0" * 16)] == [
        False, False, True
    ]  # fmt: skip
    assert not made_of({"OTHER": "f" * 16}, "f" * 32)
    assert cards["INPUT2"] == "f" * 16


def test_the_span_of_a_map_is_that_of_what_is_known() -> None:
    value = np.array([[np.nan, 13.5], [14.25, 14.0]])
    assert thickness_span_um(value, 0.25) == (13.25, 14.5)
    assert thickness_span_um(value, 20.0) == (0.0, 34.25)
    assert thickness_span_um(value) == pytest.approx((13.499, 14.251), abs=1e-9)
    with pytest.raises(InputError, match="no known thickness"):
        thickness_span_um(np.full((2, 2), np.nan))


def test_a_map_is_of_a_layer_and_of_a_vendor() -> None:
    of_e2v = Setup.from_name("ts8_e2v")
    fitted = thickness(layer="adhesive", detector="R22_S11")
    assert fitted.of_setup(of_e2v) is fitted
    assert thickness(layer="detection").of_setup(of_e2v, layer="detection").layer == "detection"
    with pytest.raises(
        InputError, match=r"here.*layer of the thickness map is 'detection'; allowed: adhesive"
    ):
        thickness(layer="detection").of_setup(of_e2v, "here")
    with pytest.raises(InputError, match="R22_S11"):
        thickness(layer="detection", detector="R22_S11").of_setup(of_e2v)
    assert fitted.contrast_sigma is None


@pytest.mark.parametrize(
    ("levels", "refused"),
    [((0.51, 1.0), False), ((1.99, 0.1), False), ((0.5, 1.0), True), ((2.0, 1.0), True), ((0.0, 1.0), True)],
)
def test_relative_counts_are_those_over_their_mean(levels: tuple[float, float], refused: bool) -> None:
    """The first flat with good pixels tells, by the median of these."""
    image = np.full((3, 3, 4), 1.0)
    image[0], image[1], image[2] = -5.0, levels[0], levels[1]
    mask = np.zeros((3, 3, 4), np.int16)
    mask[0], mask[1, :2] = 1, 1
    image[1, :2] = 7.0
    exposures = FlatExposures(np.array([950.0, 960.0, 970.0]), np.array(2.0), np.array(183.0))
    fields = {"unit": "relative", "mask": mask, "variance": np.ones(image.shape), "exposures": exposures}
    if refused:
        with pytest.raises(OutOfRangeError, match="counts over their mean"):
            cube(image=image, **fields)
    else:
        assert cube(image=image, **fields).unit == "relative"
    nothing = {**fields, "mask": np.ones(image.shape, np.int16)}
    assert cube(image=image, **nothing).unit == "relative"
