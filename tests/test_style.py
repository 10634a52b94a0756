"""Pictures hold the numbers that they show: blocks, colours, places, pieces."""

import io
import warnings

import matplotlib
import numpy as np
import pytest
from PIL import Image

from lsst.fringe_sim.blocks import block_means, block_sums, in_blocks, means_of_known
from lsst.fringe_sim.style import (
    BAD_GREY,
    color_bar,
    draw_image,
    figure,
    finite_range,
    map_to_png,
    panels,
    pixels_to_png,
    show_image,
    to_pieces,
    to_png,
)


def picture(content: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


@pytest.mark.rng("blocks of an image")
@pytest.mark.parametrize("block", [1, 2, 3, 5])
def test_blocks_are_means_of_what_is_known(block: int, rng: np.random.Generator) -> None:
    values = rng.normal(5.0, 1.0, (11, 17))
    values[3:5] = np.nan
    values[:, 2] = np.inf if block > 1 else 1.0
    ny, nx = 11 // block * block, 17 // block * block
    cut = np.where(np.isfinite(values), values, np.nan)[:ny, :nx]
    if block == 1:
        np.testing.assert_array_equal(means_of_known(values, 1), values)
        return
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wanted = np.nanmean(cut.reshape(ny // block, block, nx // block, block), axis=(1, 3))
    np.testing.assert_allclose(means_of_known(values, block), wanted)


def test_range_of_colours() -> None:
    values = np.append(np.arange(1001.0), [np.nan, np.inf, -np.inf])
    assert finite_range(values) == pytest.approx((5.0, 995.0))
    assert finite_range(values, 10.0) == pytest.approx((100.0, 900.0))
    assert finite_range(values - 900.0, symmetric=True) == pytest.approx((-895.0, 895.0))
    assert finite_range(values - 100.0, symmetric=True) == pytest.approx((-895.0, 895.0))
    assert finite_range(np.array([np.nan])) == (-1.0, 1.0)
    assert finite_range(np.full(3, -50.0)) == pytest.approx((-50.5, -49.5))
    assert finite_range(np.zeros(3)) == (-1e-12, 1e-12)
    assert finite_range(np.zeros(3), symmetric=True) == (-1e-12, 1e-12)


@pytest.mark.parametrize("diverging", [False, True])
def test_colours_of_a_map(diverging: bool) -> None:
    """The first row is at the bottom; values beyond the limits have the colours of the limits."""
    values = np.array([[-3.0, 2.0, 4.0, 6.0, 9.0], [np.nan, 4.0, 3.0, 5.0, 2.0]])
    mask = np.zeros(values.shape, int)
    mask[1, 4] = 4
    shown = picture(map_to_png(values, (2.0, 6.0), mask=mask, diverging=diverging))[::-1]
    colors = matplotlib.colormaps["PuOr_r" if diverging else "cividis"]
    wanted = 255.0 * colors(np.clip((values - 2.0) / 4.0, 0.0, 1.0))[..., :3]
    wanted[1, 0] = wanted[1, 4] = 255.0 * BAD_GREY
    assert np.abs(shown - wanted).max() < 3.0
    assert tuple(shown[1, 0]) == (191, 191, 191)
    alone = picture(map_to_png(values, (2.0, 6.0), diverging=diverging))[::-1]
    assert tuple(alone[1, 0]) == (191, 191, 191)
    np.testing.assert_array_equal(alone[1, 4], alone[0, 1])


def test_pixels_of_a_picture() -> None:
    pixels = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    np.testing.assert_array_equal(picture(pixels_to_png(pixels)), pixels)
    palette = np.stack([np.arange(256), 255 - np.arange(256), np.full(256, 7)], axis=1).astype(np.uint8)
    numbers = np.arange(20, dtype=np.uint8).reshape(4, 5)
    np.testing.assert_array_equal(picture(pixels_to_png(numbers, palette)), palette[numbers])


def test_an_image_stands_in_pixels_of_the_sensor() -> None:
    values = np.arange(200.0).reshape(10, 20)
    with figure(4.0, 3.0) as made:
        axes = made.subplots()
        drawn = show_image(axes, values, label="thickness", title="a map", step_px=4.0, most_px=5)
        assert made.get_size_inches().tolist() == [4.0, 3.0]
        assert drawn.get_extent() == [-0.5, 79.5, -0.5, 39.5]
        np.testing.assert_allclose(drawn.get_array(), values.reshape(5, 2, 10, 2).mean(axis=(1, 3)))
        assert drawn.get_clim() == pytest.approx(finite_range(means_of_known(values, 2)))
        assert drawn.origin == "lower"
        assert drawn.get_interpolation() == "nearest"
        assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == (
            "a map",
            "column [px]",
            "row [px]",
        )
        assert len(axes.child_axes) == 1
        assert axes.child_axes[0].get_ylabel() == "thickness"
    with figure(4.0, 3.0, layout=None) as made:
        axes = made.subplots()
        mask = np.zeros(values.shape, int)
        mask[2, 3] = 2
        drawn = draw_image(axes, values, mask=mask, diverging=True, limits=(-1.0, 2.0))
        assert np.flatnonzero(
            drawn.get_array().mask if np.ma.isMaskedArray(drawn.get_array()) else 0
        ).tolist() == [43]
        assert drawn.get_clim() == (-1.0, 2.0)
        assert drawn.get_cmap().name == "PuOr_r"
        assert drawn.get_cmap().get_bad()[:3].tolist() == [BAD_GREY] * 3
        assert not axes.child_axes
        usual = show_image(made.add_subplot(), values - 100.0, label="", diverging=True)
        assert usual.get_clim() == pytest.approx((-99.005, 99.005), rel=1e-3)


def test_a_colour_bar_is_beside_what_it_belongs_to() -> None:
    with figure(4.0, 3.0, layout=None) as made:
        axes = made.add_axes((0.1, 0.1, 0.5, 0.8))
        bar = color_bar(axes, axes.imshow(np.eye(3), aspect="auto"), "level")
        made.canvas.draw()
        main, beside = axes.get_position(), bar.ax.get_axes_locator()(bar.ax, None)
        assert main.y0 == pytest.approx(beside.y0)
        assert main.height == pytest.approx(beside.height)
        assert 4.0 * beside.width == pytest.approx(0.1)
        assert 4.0 * (beside.x0 - main.x1) == pytest.approx(0.08)


def test_panels_have_parts_of_their_own() -> None:
    with figure(6.0, 5.0, layout=None) as made:
        axes = panels(made, 5, 3, (0.5, 0.25, 0.4, 0.3), last_row=1.5)
        assert len(axes) == 5
        assert len(made.subfigs) == 6
        for number, one in enumerate(axes):
            box = one.get_window_extent()
            row, column = divmod(number, 3)
            height, low = ((2.0, 3.0), (3.0, 0.0))[row]
            inches = np.array([box.x0, box.y0, box.x1, box.y1]) / made.dpi
            np.testing.assert_allclose(
                inches, [2.0 * column + 0.5, low + 0.4, 2.0 * column + 1.75, low + height - 0.3], atol=1e-9
            )
    with figure(6.0, 5.0) as made:
        assert len(panels(made, 2, 3)) == 2
        assert len(made.subfigs) == 2
    with figure(6.0, 5.0) as made:
        panels(made, 6, 3)
        assert len(made.subfigs) == 6


def test_pieces_of_a_figure_are_those_of_the_whole() -> None:
    with figure(4.0, 3.0, layout=None) as made:
        for number, axes in enumerate(panels(made, 3, 2, (0.3, 0.1, 0.3, 0.3))):
            axes.set_title(f"number {number}", y=1.0)
        whole, pieces = to_pieces(made)
        np.testing.assert_array_equal(picture(to_png(made)), whole)
    assert whole.shape == (330, 440, 3)
    assert [title for title, _ in pieces] == ["number 0", "number 1", "number 2"]
    np.testing.assert_array_equal(pieces[0][1], whole[:165, :220])
    np.testing.assert_array_equal(pieces[1][1], whole[:165, 220:])
    np.testing.assert_array_equal(pieces[2][1], whole[165:, :220])
    with figure(2.0, 1.0) as made:
        made.subplots()
        whole, pieces = to_pieces(made)
        assert [(title, part.shape) for title, part in pieces] == [("", whole.shape)]


@pytest.mark.parametrize("diverging", [False, True])
def test_limits_of_a_map_have_the_first_and_the_last_colour(diverging: bool) -> None:
    """Exactly: the colours of the bar end where the limits are."""
    shown = picture(map_to_png(np.array([[-1.0, 3.0]]), (-1.0, 3.0), diverging=diverging))[0]
    colors = matplotlib.colormaps["PuOr_r" if diverging else "cividis"]
    np.testing.assert_array_equal(shown, np.rint(255.0 * colors(np.array([0.0, 1.0]))[:, :3]))


def test_blocks_of_a_stack_are_those_of_its_images() -> None:
    stack = np.arange(2 * 3 * 5 * 7, dtype=float).reshape(2, 3, 5, 7)
    for images in (stack[0, 0], stack[0], stack):
        assert in_blocks(images, 2).shape == (*images.shape[:-2], 2, 2, 3, 2)
        # The mean of a block of steps of 1 along columns and 7 along rows lies 4 above its first pixel.
        np.testing.assert_allclose(block_means(images, 2), images[..., :4:2, :6:2] + 4.0)
        np.testing.assert_allclose(block_sums(images, 2), 4.0 * images[..., :4:2, :6:2] + 16.0)
