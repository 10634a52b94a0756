"""The template task without a repository."""

from typing import Any

import numpy as np
import pytest
from product_makers import components

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.products import SkyFringe, mask_bits
from lsst.fringe_sim.tasks import FringePcaConfig, FringePcaTask
from lsst.fringe_sim.tasks.fringe_pca import FringePcaConnections, _above

ROWS, COLUMNS = 20, 30
CREATED = "2026-11-21T03:43:40"
Y, X = np.mgrid[:ROWS, :COLUMNS]
MAIN = 2e-3 * np.sin(X / 3.0)  # Pattern of the lines
SIDE = 3e-4 * np.cos(Y / 2.0)  # Pattern of a band that varies on its own
FAINT = 1e-7 * np.sin((X + Y) / 2.0)


def frames(number: int = 6, **changes: Any) -> list[SkyFringe]:
    rng = np.random.default_rng(3)
    mask = np.zeros((ROWS, COLUMNS), int)
    mask[2, 3] = mask_bits("NO_DATA")
    made = []
    for k in range(number):
        level = 2000.0 + 300 * k
        strength = rng.uniform(0.5, 1.5, 3)
        pattern = strength[0] * MAIN + strength[1] * SIDE + strength[2] * FAINT
        pattern -= pattern[mask == 0].mean()
        values: dict[str, Any] = {
            "image": level * (1 + pattern),
            "mask": mask,
            "unit": "electron",
            "mean_electrons": level,
            "exposure_s": 30.0,
            "airmass": 1.2,
            "hour": 20.0 + k,
            "seed": None,
            "quadrature_error": 1e-6,
            "metadata": {"SETUP": "lsst_e2v", "BAND 8-4": float(k), "LSST BUTLER ID": "same"},
            "detector": "R22_S11",
            "physical_filter": "y_10",
        }
        made.append(SkyFringe(**(values | changes)))
    return made


def run(given: list[SkyFringe], **config: Any) -> Any:
    made = FringePcaConfig(**config)
    made.validate()
    return FringePcaTask(config=made).run(given, CREATED)


def test_the_template_is_the_pattern_of_the_night() -> None:
    result = run(frames())
    good = result.fringe.mask == 0
    assert good.sum() == ROWS * COLUMNS - 1
    assert np.corrcoef(result.fringe.image[good], MAIN[good])[0, 1] > 0.95
    assert abs(result.fringe.image[good].mean(dtype=float)) < 1e-9
    assert (result.fringe.image[~good] == 0).all()
    assert result.fringe.creation_datetime == CREATED
    assert (result.fringe.detector, result.fringe.physical_filter) == ("R22_S11", "y_10")


def test_only_components_that_matter_are_kept() -> None:
    kept = run(frames()).components
    assert kept.n_components == 2
    assert run(frames(), least_rms=0.0).components.n_components > 2
    assert run(frames(), n_components=1).components.n_components == 1
    assert run(frames(), least_rms=1.0).components.n_components == 1


def test_the_template_does_not_depend_on_how_many_are_kept() -> None:
    first, second = run(frames()).fringe, run(frames(), n_components=1).fringe
    assert first.image.tobytes() == second.image.tobytes()


def test_what_the_frames_share_is_said_and_what_they_do_not_is_not() -> None:
    result = run(frames())
    for product in (result.fringe, result.components):
        assert product.metadata["SETUP"] == "lsst_e2v"
        assert "BAND 8-4" not in product.metadata
        assert "LSST BUTLER ID" not in product.metadata
    assert result.components.metadata["NFRAMES"] == 6


def test_one_frame_is_refused() -> None:
    with pytest.raises(InputError, match="two or more"):
        run(frames(1))


def test_an_exposure_that_is_there_twice_is_refused() -> None:
    """Noise is never the same twice, so that frames of equal pixels with noise are one exposure."""
    noisy = frames(seed=1)
    with pytest.raises(InputError, match="sky frames is 'equal pixels in 1 and 6'"):
        run([*noisy, noisy[1]])


def test_equal_hours_of_two_nights_count_twice_where_there_is_no_noise() -> None:
    """The template is the mean of all frames over their levels, the copy among them."""
    given = [*frames(), frames()[1]]
    fringe = run(given).fringe
    good = given[0].mask == 0
    relative = np.array([frame.image[good] / frame.image[good].mean(dtype=float) - 1.0 for frame in given])
    assert np.corrcoef(fringe.image[good], relative.mean(axis=0))[0, 1] > 1.0 - 1e-6
    assert run(given).components.metadata["NFRAMES"] == 7


@pytest.mark.parametrize("seed", [None, 1])
def test_frames_that_are_all_alike_are_refused(seed: int | None) -> None:
    """Even without noise: nothing varies, so that nothing tells the fringes."""
    with pytest.raises(InputError, match=r"equal pixels|no differences"):
        run([frames(1, seed=seed)[0]] * 3)


def test_the_template_can_be_registered_as_afw_wants_it() -> None:
    own = FringePcaConnections(config=FringePcaConfig())
    afw = FringePcaConnections(config=FringePcaConfig(fringeStorageClass="ExposureF"))
    assert (own.fringe.storageClass, afw.fringe.storageClass) == ("FringeFrame", "ExposureF")
    assert own.fringe.isCalibration
    assert afw.fringe.isCalibration


@pytest.mark.parametrize(("least_rms", "kept"), [(0.0, 2), (0.005, 2), (0.0051, 1), (0.01, 1), (0.5, 1)])
def test_components_that_add_little_are_left_out(least_rms: float, kept: int) -> None:
    """By what each adds to a good pixel of a typical frame; the first stays in any case."""
    mask = np.zeros((3, 4), np.int32)
    mask[0, :2] = mask_bits("NO_DATA")
    made = components(mask=mask, explained_variance=10 * np.array([0.01, 0.00500001]) ** 2)
    found = _above(made, least_rms)
    np.testing.assert_array_equal(found.components, made.components[:kept])
    np.testing.assert_array_equal(found.scores, made.scores[:, :kept])
    assert found.explained_variance.tolist() == made.explained_variance[:kept].tolist()
    assert found.explained_variance_ratio.tolist() == made.explained_variance_ratio[:kept].tolist()
