"""A map from a range of the thickness alone, by the command."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from foreign_sky import foreign_map

from lsst.fringe_sim.algorithms.sky_response import sky_response
from lsst.fringe_sim.cli.inputs import placed_model
from lsst.fringe_sim.cli.main import run
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.model import Setup
from lsst.fringe_sim.products import ThicknessMap

BEAM = "{kind: telescope, telescope: LSST}", "{kind: cone, f_number: 2.25, obscuration: 0.61}"
"""A slower beam, whose fringes are large enough for few pixels."""


def night(folder: Path, setup: str, layer: np.ndarray, rng: np.random.Generator, frames: int) -> str:
    """Frames of the model's own sky, each with noise of twice the fringes."""
    described = Setup.from_file(setup)
    model = placed_model(described, {}, described.sensor("R22_S11"))
    dark = sky_response(model, SkySpectrum.dark(airmass=described.airmass), thickness_range_um=(12.0, 15.0))
    light = dark.sky().frame(layer).astype(float)
    light /= light.mean()
    folder.mkdir()
    for number in range(frames):
        image = 1e4 * (light + 2.0 * light.std() * rng.standard_normal(layer.shape))
        header = fits.Header({"DETNAME": "R22_S11", "BUNIT": "electron"})
        fits.writeto(folder / f"{number:02d}.fits", image.astype(np.float32), header)
    return str(folder)


@pytest.mark.slow
@pytest.mark.rng("a map is searched for by the command")
def test_a_map_is_written_where_its_order_is_told(
    tmp_path: Path, rng: np.random.Generator, capsys: pytest.CaptureFixture[str]
) -> None:
    """Orders differ by less than the model is known to; a model without error tells them."""
    setup = tmp_path / "slower.yaml"
    content = (files("lsst.fringe_sim") / "data/setups/lsst_e2v.yaml").read_text(encoding="utf-8")
    setup.write_text(content.replace(*BEAM), encoding="utf-8")
    layer = foreign_map(rng, (64, 64), 13.1, 13.8)
    frames = night(tmp_path / "night", str(setup), layer, rng, 20)
    command = ["fit-sky", frames, "--setup", str(setup), "--thickness", "13um:13.9um", "--out"]
    assert run([*command, str(tmp_path / "told"), "--order-error", "0"]) == 0
    assert "direction are right with a probability of" in capsys.readouterr().out
    found = ThicknessMap.read_fits(tmp_path / "told" / "thickness.fits")
    known = np.isfinite(found.known_um())
    away = np.abs(found.value - layer)[known]
    assert known.mean() > 0.6
    assert np.mean(away < 0.03) > 0.95
    assert float(found.slip_probability[known].max()) < 0.5
    assert run([*command, str(tmp_path / "not_told")]) == 0
    assert "no map was found: the likeliest one has a probability of" in capsys.readouterr().out
    assert not (tmp_path / "not_told" / "thickness.fits").exists()
