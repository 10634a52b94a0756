"""Products as data sets of xarray: the same numbers, with names and units."""

import shutil
import sys

import numpy as np
import pytest
from product_makers import MAKERS, cube, sky, thickness
from recorded_numbers import Record, Words

from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import FringeSimError, InputError, MissingPackageError, UnknownNameError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.products import MASK_PLANES, FringeCube, SensorSection
from lsst.fringe_sim.products.xarray_export import EXPORTED, read_exported, to_xarray, write_netcdf

xarray = pytest.importorskip("xarray")

SENSOR = Camera.from_name("lsstCam").detector("R11_S01")


def test_a_thickness_map() -> None:
    made = thickness((5, 6))
    found = to_xarray(made)
    assert dict(found.sizes) == {"y": 5, "x": 6}
    for name, values in (("thickness", made.value), ("sigma", made.sigma), ("chi2", made.chi2)):
        assert found[name].dims == ("y", "x")
        assert np.array_equal(found[name], values, equal_nan=True)
        assert np.shares_memory(found[name].values, values)
    assert found.thickness.attrs["units"] == found.sigma.attrs["units"] == "um"
    assert found.thickness.attrs["layer"] == made.layer
    assert found.attrs["detector"] == made.detector
    assert {key: found.attrs[key] for key in made.metadata} == dict(made.metadata)


def test_a_cube_is_selected_by_wavelength() -> None:
    made = cube((4, 6), 3)
    found = to_xarray(made)
    assert found.image.dims == ("wavelength", "y", "x")
    for number, wavelength in enumerate(made.wavelength_nm):
        plane = found.sel(wavelength=wavelength)
        assert np.array_equal(plane.image, made.image[number], equal_nan=True)
        assert float(plane.temperature) == made.exposures.temperature_k[number]
    assert found.wavelength.attrs["units"] == "nm"
    assert found.temperature.attrs["units"] == "K"


def test_every_variable_has_a_unit_and_a_name() -> None:
    for name in EXPORTED:
        found = to_xarray(MAKERS[name]())
        for key, variable in found.variables.items():
            assert variable.attrs["long_name"], key
            assert variable.attrs.get("units") or variable.dtype.kind in "OU", key


def test_the_mask_names_its_planes() -> None:
    made = thickness((5, 6))
    mask = to_xarray(made)["mask"]
    names = mask.attrs["flag_meanings"].split()
    assert dict(zip(names, mask.attrs["flag_masks"], strict=True)) == {
        name: 1 << bit for name, bit in MASK_PLANES.items()
    }
    assert mask.attrs["flag_masks"].dtype == mask.dtype


def test_coordinates_are_pixels_of_the_sensor(tmp_path) -> None:
    made = thickness((4, 6))
    assert to_xarray(made).x.values.tolist() == [0, 1, 2, 3, 4, 5]
    made.write_fits(tmp_path / "a.fits", section=SensorSection(SENSOR, (111, 100), (7, 10)))
    found = to_xarray(read_exported(tmp_path / "a.fits"))
    assert found.y.values.tolist() == [7, 8, 9, 10]
    assert found.x.values.tolist() == [110.5, 108.5, 106.5, 104.5, 102.5, 100.5]
    assert found.x.attrs["units"] == "pixel"


def test_a_night_is_joined_by_hour() -> None:
    frames = [to_xarray(sky((4, 5), hour=hour)) for hour in (20.0, 22.0, 25.0)]
    night = xarray.concat(frames, "hour", combine_attrs="drop_conflicts", coords="different", compat="equals")
    assert night.image.dims == ("hour", "y", "x")
    assert night.hour.values.tolist() == [20.0, 22.0, 25.0]


@pytest.mark.parametrize("name", sorted(EXPORTED))
def test_netcdf_gives_the_numbers_back(name: str, tmp_path) -> None:
    made = MAKERS[name](metadata={"FLAG": True, "NOTHING": None, "WORD": "a", "LSST BUTLER ID": "1-2"})
    first = to_xarray(made)
    write_netcdf(first, tmp_path / "a.nc")
    assert first.attrs["FLAG"] is True, "the data set itself stays as it was"
    with xarray.open_dataset(tmp_path / "a.nc") as again:
        for key in first.variables:
            assert np.array_equal(first[key], again[key], equal_nan=first[key].dtype.kind == "f"), key
            assert first[key].attrs.get("units") == again[key].attrs.get("units")
        assert again.attrs["FLAG"] == 1
        assert again.attrs["LSST BUTLER ID"] == "1-2"
        assert "NOTHING" not in again.attrs
    assert [path.name for path in tmp_path.iterdir()] == ["a.nc"]


def test_other_products_are_refused(tmp_path) -> None:
    flat = MAKERS["FringeFlat"]()
    with pytest.raises(InputError, match="FringeFlat"):
        to_xarray(flat)
    flat.write_fits(tmp_path / "flat.fits")
    with pytest.raises(UnknownNameError, match=r"flat\.fits.*FringeFlat"):
        read_exported(tmp_path / "flat.fits")
    with pytest.raises(InputError, match="existing"):
        read_exported(tmp_path / "none.fits")
    (tmp_path / "text.fits").write_text("no FITS")
    with pytest.raises(InputError, match=r"text\.fits"):
        read_exported(tmp_path / "text.fits")
    with pytest.raises(InputError, match="folder"):
        write_netcdf(to_xarray(thickness((2, 2))), tmp_path / "none" / "a.nc")


def test_without_xarray_the_error_says_what_to_install(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(MissingPackageError, match=r"lsst-fringe-sim\[xarray\]") as caught:
        to_xarray(thickness((2, 2)))
    assert isinstance(caught.value, FringeSimError)
    assert isinstance(caught.value, ImportError)


def test_the_command(tmp_path, capsys, monkeypatch) -> None:
    made = cube((4, 6), 3)
    made.write_fits(tmp_path / "cube.fits")
    sky((4, 5)).write_fits(tmp_path / "night.fits")
    files = [str(tmp_path / name) for name in ("cube.fits", "night.fits")]
    out = tmp_path / "nc"
    assert run(["export", *files, "--out", str(out), "--dry-run"]) == 0
    assert not out.exists()
    assert run(["export", *files, "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["cube.nc", "night.nc"]
    with xarray.open_dataset(out / "cube.nc") as found:
        expected = FringeCube.read_fits(files[0])
        assert np.array_equal(found.image, expected.image, equal_nan=True)
    capsys.readouterr()
    assert run(["export", files[0], files[0], "--out", str(out)]) == 1
    assert "different names" in capsys.readouterr().err
    (tmp_path / "CUBE.fits").symlink_to(files[0])
    assert run(["export", files[0], str(tmp_path / "CUBE.fits"), "--out", str(tmp_path / "other")]) == 1
    assert "different names" in capsys.readouterr().err
    shutil.copy(files[0], tmp_path / "cube[1].fits")
    bracket = ("export", str(tmp_path / "cube[1].fits"), "--out", str(tmp_path / "brackets"))
    assert [run(bracket), run(bracket)] == [0, 1]
    monkeypatch.setitem(sys.modules, "xarray", None)
    assert run(["export", files[0], "--out", str(tmp_path / "other")]) == 1
    assert "lsst-fringe-sim[xarray]" in capsys.readouterr().err


SECTION = {"DETSEC": "[101:106,7:10]", "NOTE": "x"}


@pytest.mark.parametrize(
    "made",
    [
        pytest.param(thickness((4, 6), metadata=SECTION), id="map"),
        pytest.param(thickness((4, 6), n_wavelengths=None), id="map without numbers"),
        pytest.param(cube((4, 6), metadata=SECTION), id="cube"),
        pytest.param(
            cube((4, 6), unit="relative", image=1.0 + 0.01 * cube((4, 6)).image / 2e4), id="relative"
        ),
        pytest.param(sky((4, 6)), id="sky"),
        pytest.param(sky((4, 6), unit="fraction", seed=None, mask=np.zeros((4, 6), int)), id="fraction"),
    ],
)
def test_a_data_set_is_as_recorded(made, recorded: Record) -> None:
    found = to_xarray(made)
    parts = {
        str(name): {
            "values": np.atleast_1d(one.values), "dims": Words(map(str, one.dims)),
            "attributes": Words(f"{key} {value}" for key, value in one.attrs.items()),
        }
        for name, one in {**found.data_vars, **found.coords}.items()
    }  # fmt: skip
    recorded({"parts": parts, "attributes": Words(f"{key} {value}" for key, value in found.attrs.items())})
