"""What products show of themselves in a notebook."""

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from product_makers import MAKERS
from recorded_numbers import Record, Words
from seen_pages import drawn

from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.products import FringeCube, SkyFrames

matplotlib.use("agg")


@pytest.mark.filterwarnings("ignore:Mean of empty slice", "ignore:All-NaN")
@pytest.mark.parametrize("kind", MAKERS)
def test_every_product_is_drawn_and_described(kind: str, recorded: Record) -> None:
    product = MAKERS[kind](metadata={"NOTE": "x"})
    shown = product._repr_html_()
    assert kind in shown
    assert "masked" in shown
    assert "data:image/png;base64," in shown
    axes = pyplot.figure().add_subplot()
    assert product.plot(axes) is axes
    assert axes.images
    axes.figure.canvas.draw()
    stated = [f"{name} {value}" for name, value in product.facts().items()]
    recorded({"stated": Words([*stated, repr(product)]), "drawn": drawn(axes.figure)})
    pyplot.close("all")


def test_a_cube_of_arrays_shows_fringes_in_percent() -> None:
    counts = 1e4 * (1.0 + 0.1 * np.sin(np.arange(24.0).reshape(1, 4, 6)) * np.ones((3, 1, 1)))
    cube = FringeCube.from_arrays(counts, [950.0, 960.0, 970.0])
    image = cube.plot().images[0]
    expected = 100.0 * (counts[1] / counts[1].mean() - 1.0)
    np.testing.assert_allclose(image.get_array(), expected, atol=1e-3)
    assert "950, 960, 970" in cube._repr_html_()
    pyplot.close("all")


def test_frames_set_ups_and_models_say_what_they_are() -> None:
    sky = 1e3 + np.arange(24.0).reshape(2, 3, 4)
    frames = SkyFrames.from_arrays(sky, np.full((3, 4), 15.0), hour=[20.0, 22.0])
    assert "20 to 22 h" in frames._repr_html_()
    assert "183.15 K" in Setup.from_name("ts8_e2v")._repr_html_()
    assert (
        "contrast_loss.factor = 0.13"
        in FringeModel.from_setup("ts8_e2v", {"contrast_loss.factor": 0.13})._repr_html_()
    )


def test_what_is_shown_is_no_markup() -> None:
    counts = np.full((1, 2, 2), 1e4)
    cube = FringeCube.from_arrays(counts, [950.0], detector="<b>x</b>")
    assert "<b>x</b>" not in cube._repr_html_()


def test_templates_are_drawn_in_parts_of_the_sky_or_in_the_unit_of_the_frames() -> None:
    """Frames without their sky say nothing of parts of it."""
    for per_sky, factor in ((True, 100.0), (False, 1.0)):
        product = MAKERS["FringeTemplates"](metadata={"PERSKY": per_sky})
        image = product.plot().images[0]
        good = product.mask == 0
        found = np.ma.filled(np.ma.asarray(image.get_array(), dtype=float), np.nan)[good]
        np.testing.assert_allclose(found, factor * product.patterns[0][good], rtol=1e-5)
        pyplot.close("all")
