"""Fringes in images that GalSim draws from a configuration."""

from pathlib import Path
from typing import Any

import galsim
import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.mock import e2v_321

SHAPE = (40, 60)
SKY = 1000.0
DARK = {"profile": {"type": "Gaussian", "sigma": 2.0, "flux": 5e3}}


@pytest.fixture(scope="module")
def thickness(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "thickness.fits"
    layer = e2v_321((400, 400))[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    layer[0, :3] = np.nan
    fits.PrimaryHDU(layer).writeto(path)
    return path


def drawn(kind: str, size: tuple[int, int] = SHAPE, **image: Any) -> np.ndarray:
    config = {
        "modules": ["lsst.fringe_sim.algorithms.galsim_config"],
        "gal": DARK["profile"],
        "image": {
            "type": kind,
            "xsize": size[1],
            "ysize": size[0],
            "nobjects": 2,
            "random_seed": 7,
            "image_pos": {
                "type": "XY",
                "x": {"type": "Random", "min": 1, "max": size[1]},
                "y": {"type": "Random", "min": 1, "max": size[0]},
            },
            "sky_level_pixel": SKY,
            **image,
        },
    }
    return galsim.config.BuildImage(galsim.config.ImportModules(config) or config).array.astype(float)


def test_the_sky_has_fringes_and_the_objects_have_none(thickness: Path) -> None:
    fringes = {"detector": "R00_S00", "setup": "monocam", "thickness": str(thickness)}
    plain = drawn("Scattered")
    faint, bright = (
        drawn("FringedSky", fringes=fringes, sky_level_pixel=level)
        - drawn("Scattered", sky_level_pixel=level)
        for level in (SKY, 2.0 * SKY)
    )
    assert plain.max() > 1.1 * SKY  # objects are in it
    np.testing.assert_allclose(bright, 2.0 * faint, atol=1e-3)
    assert np.std(faint) > 1e-3 * SKY
    assert abs(faint.mean()) < 1e-3 * np.std(faint) + 1e-4
    np.testing.assert_array_equal(faint[0, :3], 0.0)  # the thickness is not known


@pytest.mark.slow
def test_bands_and_effects_change_the_fringes(thickness: Path) -> None:
    fringes: dict[str, Any] = {"detector": "R00_S00", "setup": "monocam", "thickness": str(thickness)}
    plain = np.std(drawn("FringedSky", fringes=fringes) - drawn("Scattered"))
    half = {**fringes, "effects": {"contrast_loss.factor": 0.5}}
    assert np.std(drawn("FringedSky", fringes=half) - drawn("Scattered")) == pytest.approx(
        0.5 * plain, rel=0.01
    )
    strong = {**fringes, "bands": {"8-4": 3.0}}
    assert np.std(drawn("FringedSky", fringes=strong) - drawn("Scattered")) != pytest.approx(plain, rel=0.01)


def test_what_does_not_belong_together_is_refused(thickness: Path) -> None:
    fringes = {"detector": "R00_S00", "setup": "monocam", "thickness": str(thickness)}
    with pytest.raises(InputError, match="shape of the image"):
        drawn("FringedSky", (40, 50), fringes=fringes)
    with pytest.raises(InputError, match="fringes"):
        drawn("FringedSky")
    with pytest.raises(InputError, match="no_such"):
        drawn("FringedSky", fringes={**fringes, "bands": {"no_such": 3.0}})
    with pytest.raises(InputError, match="detector"):
        drawn("FringedSky", fringes={**fringes, "detector": "R99_S99"})
    with pytest.raises(galsim.GalSimConfigError, match="thicknes"):
        drawn("FringedSky", fringes={"detector": "R00_S00", "thicknes": "x"})
