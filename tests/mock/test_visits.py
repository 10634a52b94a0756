"""Visits: the right fringes, the catalogue's photometry, charge that is conserved, and no truth in the files."""

from importlib.resources import files

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from lsst.fringe_sim.algorithms import simulate_sky_frame
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.camera import Camera
from lsst.fringe_sim.mock import random_field, visits
from lsst.fringe_sim.mock.visit_sources import Scene, VisitConditions, VisitImage
from lsst.fringe_sim.mock.visits import detected_sky, write_mock_visits
from lsst.fringe_sim.model import FringeModel, Setup
from lsst.fringe_sim.products.observed_files import observed_images

SHAPE = (64, 64)
LIGHT = {"pixel_scale_arcsec": 0.2, "bandpass": "lsst_y", "effective_area_m2": 32.4}


def _sensor():
    return Camera.from_name("lsstCam").detector("R22_S11")


@pytest.mark.slow
def test_the_fringes_are_those_of_the_model() -> None:
    """Another sum over lines and angles: level and fringes agree. So small a sensor has one beam."""
    thickness = np.linspace(15.0, 16.5, 256).reshape(16, 16)
    sky = detected_sky("lsst_e2v", _sensor().cut_down((16, 16)), thickness)
    light = sky.light.sum(axis=0, dtype=float) * 30.0
    model = FringeModel.from_setup(Setup.from_name("lsst_e2v"))
    frame = simulate_sky_frame(thickness, model)
    assert light.mean() == pytest.approx(frame.mean_electrons, rel=2e-3)
    ours, theirs = light / light.mean() - 1.0, frame.image / frame.image.mean() - 1.0
    assert np.abs(ours - theirs).max() < 0.005 * np.ptp(theirs)


@pytest.mark.rng("visits: flux of the sources")
def test_flux_of_the_sources_is_that_of_their_magnitudes(rng) -> None:
    """Without noise of the sky, all light that is drawn is in the catalogue; twice 2.5 magnitudes are a hundred."""
    quiet = VisitConditions(
        stars_per_arcmin2=40.0, galaxies_per_arcmin2=20.0, dither_arcsec=0.0, rotation_deg=0.0,
        cosmic_rays_per_s_cm2=0.0, moon=0.0, slope=0.0, amplifier_rms=0.0,
    )  # fmt: skip
    sensor = _sensor().cut_down((256, 256))
    scene = Scene.draw(LIGHT, quiet, sensor.shape, rng)
    image = VisitImage.expose(scene, np.zeros(sensor.shape, dtype=np.float32), sensor, 30.0, rng)
    far = (image.sources["magnitude"] > 17.0) & (np.abs(image.sources["x"] - 128) < 100)
    for source in image.sources[far & (np.abs(image.sources["y"] - 128) < 100)][:3]:
        assert source["electrons"] == pytest.approx(
            30.0 * scene.electrons_per_s_at_zero * 10.0 ** (-0.4 * source["magnitude"])
        )
    total = float(image.electrons.sum())
    assert total == pytest.approx(image.sources["electrons"].sum(), rel=0.1)


def test_charge_of_a_bright_star_runs_along_its_columns() -> None:
    from lsst.fringe_sim.mock.visit_sources import _bleed

    charge = np.zeros((200, 5), dtype=np.float32)
    charge[90:95, 2] = 1e6
    full = _bleed(charge, 1e5)
    assert charge.sum() == pytest.approx(5e6, rel=1e-5)
    assert charge.max() <= 1e5
    assert full[:, 2].sum() >= 50
    assert not full[:, [0, 1, 3, 4]].any()
    assert np.flatnonzero(full[:, 2]).mean() == pytest.approx(92, abs=1.5)


@pytest.mark.rng("visits: places on the sky")
def test_places_on_the_sky_are_those_of_the_header(rng) -> None:
    night = VisitConditions(stars_per_arcmin2=30.0)
    scene = Scene.draw(LIGHT, night, SHAPE, rng)
    first, second = scene.pointing(rng), scene.pointing(rng)
    x, y = first.pixels(scene.east, scene.north, SHAPE)
    sky = first.wcs(SHAPE).pixel_to_world_values(x, y)
    there = second.wcs(SHAPE).world_to_pixel_values(*sky)
    np.testing.assert_allclose(there, second.pixels(scene.east, scene.north, SHAPE), atol=0.02)


@pytest.mark.slow
@pytest.mark.rng("visits: visits are read")
def test_visits_are_read_and_tell_nothing(tmp_path, rng) -> None:
    thickness = random_field(SHAPE, rng, mean=16.0, span=1.0, scale=25.0)
    night = {"setup": "lsst_e2v", "detector": "R22_S11", "conditions": VisitConditions(2)}
    made = list(write_mock_visits(tmp_path, thickness_um=thickness, rng=rng, **night))
    for visit in made:
        (image,) = observed_images(visit.path)
        frame = image.read()
        assert frame.unit == "electron"
        assert frame.detector == "R22_S11"
        assert frame.variance is not None
        good = frame.mask == 0
        centre = np.median(frame.image[good])
        assert centre > visit.level_e * 0.9
        header = fits.getheader(visit.path, "IMAGE")
        assert WCS(header).has_celestial
        assert not [key for key in header if "THICK" in key or "SEED" in key or "EFFECT" in key]
    assert made[0].path.read_bytes() != made[1].path.read_bytes()


@pytest.mark.parametrize("effect", ["bandwidth.fwhm=3", "illumination.gradient_x=0.1", "void.thickness=100"])
def test_what_the_sky_does_not_see_is_refused(effect, tmp_path, capsys) -> None:
    size = ["--size", "64x64", "--seed", "1", "--visits", "1", "--dry-run"]
    assert run(["mock-visits", str(tmp_path / "night"), "--effect", effect, *size]) == 1
    assert "layers of the whole sensor" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "more", "said"),
    [
        ("pixel_scale_arcsec: 0.2", "pixel_scale_arcsec: 60.0", (), "width of a star"),
        ("air", "air", ("--stars", "1e5"), "fewer stars"),
        ("kind: telescope, telescope: LSST", "kind: collimated", (), "in a cone"),
    ],
)
def test_a_night_that_cannot_be_drawn_is_refused_before_work(old, new, more, said, tmp_path, capsys) -> None:
    own = files("lsst.fringe_sim").joinpath("data/setups/lsst_e2v.yaml").read_text()
    assert old in own
    (tmp_path / "own.yaml").write_text(own.replace(old, new))
    night = ["mock-visits", str(tmp_path / "night"), "--setup", str(tmp_path / "own.yaml"), "--seed", "1"]
    assert run([*night, *(more or ("--size", "64x64")), "--dry-run"]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / "night").exists()


def test_a_laboratory_has_no_sky() -> None:
    with pytest.raises(InputError, match="telescope"):
        detected_sky("ts8_e2v", _sensor(), np.full((2, 2), 15.0))


@pytest.mark.rng("maps that are no sensor")
@pytest.mark.parametrize("shape", [(64,), (64, 60), (2, 64, 64)])
def test_a_map_that_is_no_sensor_is_refused(shape, rng, tmp_path) -> None:
    with pytest.raises(InputError, match=r"rows.* and .*columns"):
        write_mock_visits(
            tmp_path, setup="lsst_e2v", detector="R22_S11", thickness_um=np.full(shape, 15.0), rng=rng
        )
    assert not any(tmp_path.iterdir())


@pytest.mark.slow
def test_the_command(tmp_path) -> None:
    arguments = ["mock-visits", str(tmp_path / "night"), "--size", "64x64", "--seed", "1", "--visits", "2"]
    assert run([*arguments, "--dry-run"]) == 0
    assert not (tmp_path / "night").exists()
    assert run([*arguments, "--truth", str(tmp_path / "truth")]) == 0
    night, truth = (
        sorted((tmp_path / "night").glob("visit_*.fits")),
        sorted((tmp_path / "truth").glob("*.fits")),
    )
    assert [path.name for path in night] == [path.name for path in truth]
    assert len(night) == 2
    assert run(arguments) == 1


@pytest.mark.slow
def test_a_night_with_another_table_of_silicon(tmp_path) -> None:
    """Templates with the right table leave what the noise of their scales does, those of another twice of it."""
    y, x = np.mgrid[:192, :192]
    fits.PrimaryHDU(16.0 + 0.9 * np.sin(x / 30) + 0.8 * np.cos(y / 25)).writeto(tmp_path / "map.fits")
    words = ["--thickness", str(tmp_path / "map.fits")]
    night = ["--size", "192x192", "--seed", "3", "--stars", "1", "--moon", "0.1", "--visits", "3"]
    other = [*night, "--silicon", "Si_franta2017", "--truth", str(tmp_path / "truth")]
    assert run(["mock-visits", str(tmp_path / "night"), *words, *other]) == 0
    own = files("lsst.fringe_sim").joinpath("data/setups/lsst_e2v.yaml").read_text()
    (tmp_path / "franta.yaml").write_text(f"{own}\nsilicon: Si_franta2017\n")
    left = []
    for setup in (str(tmp_path / "franta.yaml"), "lsst_e2v"):
        model, out = tmp_path / f"model_{len(left)}", tmp_path / f"corrected_{len(left)}"
        assert run(["sky", "--setup", setup, *words, "--templates", "--noiseless", "--out", str(model)]) == 0
        assert run(["correct", str(tmp_path / "night"), "--templates", str(model), "--out", str(out)]) == 0
        parts = []
        for visit in sorted((tmp_path / "night").glob("*.fits")):
            taken = fits.getdata(visit, "IMAGE") - fits.getdata(out / f"{visit.stem}_corrected.fits", "IMAGE")
            truth = fits.getdata(tmp_path / "truth" / visit.name)
            parts.append(np.std(truth - taken, dtype=float) / np.std(truth, dtype=float))
        left.append(np.sqrt(np.mean(np.square(parts))))
    assert left[0] < 0.3
    assert left[1] > 1.5 * left[0]


def test_a_table_that_is_no_silicon_is_refused_before_work(tmp_path, capsys) -> None:
    arguments = ["--size", "64x64", "--seed", "1", "--silicon", "nosuch", "--dry-run"]
    assert run(["mock-visits", str(tmp_path / "night"), *arguments]) == 1
    assert "nosuch" in capsys.readouterr().err


@pytest.mark.rng("visits: their hours")
def test_visits_begin_at_even_steps_of_the_night(rng, tmp_path, monkeypatch) -> None:
    """The first at one o'clock, the others a quarter of six hours later each."""
    dark = visits.DetectedSky(("continuum",), 0, np.full((1, *SHAPE), 50.0, dtype=np.float32))
    monkeypatch.setattr(visits, "detected_sky", lambda *_: dark)
    night = VisitConditions(4, hours=6.0)
    made = write_mock_visits(
        tmp_path, setup="lsst_e2v", detector=94, thickness_um=np.full(SHAPE, 15.0), rng=rng, conditions=night
    )
    begun = [fits.getheader(visit.path, "IMAGE")["DATE-OBS"] for visit in made]
    assert begun == [f"2026-01-15T{time}:00.000" for time in ("01:00", "02:30", "04:00", "05:30")]
