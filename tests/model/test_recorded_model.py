"""Everything that the model of a sensor says of itself, against other ways to compute it, and as recorded."""

import dataclasses
import hashlib
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_numbers import Record

from lsst.fringe_sim.effects import ImageGeometry
from lsst.fringe_sim.errors import ConvergenceError, FrameFormatError, InputError, OutOfRangeError
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.model import FringeModel, ResponseTable, response_table, tabulate
from lsst.fringe_sim.model.effects_override import (
    effects_override,
    ended,
    is_as_written,
    read_effects_override,
    refuse_other_effects,
    written_effects,
)
from lsst.fringe_sim.model.provenance import (
    effect_cards,
    effects_of_header,
    input_cards,
    inputs_of_header,
    model_cards,
    software_cards,
    table_cards,
    tables_of,
)
from lsst.fringe_sim.model.spectrum import StackSpectrum
from lsst.fringe_sim.resources import revision

WAVE = np.array([900.0, 960.0])


@pytest.fixture(scope="module")
def model() -> FringeModel:
    return FringeModel.from_setup("ts8_e2v")


@pytest.fixture(scope="module")
def island() -> FringeModel:
    settings = {"void.thickness": 150.0, "void.centre_x": 6.0, "void.centre_y": 4.0, "void.radius": 3.0,
                "contrast_loss.factor": 0.7, "epoxy_index.offset": 0.01}  # fmt: skip
    return FringeModel.from_setup("ts8_e2v", settings)


def test_flats_with_a_local_effect(island: FringeModel, recorded: Record) -> None:
    """In cells that it covers there is the response of its own stack, in others that of all the rest."""
    thickness = 15.0 + 0.01 * np.arange(120.0).reshape(10, 12)
    geometry = ImageGeometry.of_pixels(thickness.shape, WAVE)
    ((item, inside),) = island.islands
    whole = island.with_islands(lambda each: each.response(thickness, WAVE), geometry)
    part = item.coverage(island.base_system, geometry)
    outside = island.response(thickness, WAVE)
    within = inside.response(thickness, WAVE)
    np.testing.assert_allclose(whole, (1.0 - part) * outside + part * within, rtol=1e-13)
    assert np.abs(within - outside).max() > 0.01
    assert inside.effects == island.effects[:1] + island.effects[2:]
    image = island.flat_image(thickness, geometry)
    np.testing.assert_allclose(image, whole / whole.mean(axis=(1, 2), keepdims=True), rtol=1e-12)
    away = island.with_effects({**island.effect_settings, "void.centre_x": 500.0})
    np.testing.assert_array_equal(
        away.with_islands(lambda each: each.response(thickness, WAVE), geometry), outside
    )
    with pytest.raises(InputError, match="shape of the thickness map"):
        island.flat_image(thickness.T, geometry)
    recorded({"image": image, "inside": within, "settings": inside.effect_settings})


def test_numbers_of_a_model(model: FringeModel, island: FringeModel, recorded: Record) -> None:
    thickness = np.linspace(14.0, 15.0, 7)
    np.testing.assert_allclose(
        model.fringe_order_um(WAVE),
        5e-4
        * WAVE
        / model.system.stack.layers[model.system.stack.position("adhesive")].medium.index(WAVE, 183.15).real,
    )
    coarse, fine = (model.respond(model.system.flat_fields(WAVE, step), thickness) for step in (0.1, 0.05))
    assert model.quadrature_error(WAVE, thickness) <= np.abs(coarse - fine).max() + 1e-12
    light = island.system.flat_fields(WAVE)
    grid = island.respond_on_grid(light, 14.0, 0.01, 101, WAVE)
    np.testing.assert_allclose(grid[:, ::10], island.response(np.linspace(14.0, 15.0, 11), WAVE), atol=1e-12)
    np.testing.assert_allclose(island.response_on_grid(WAVE, 14.0, 0.01, 101), grid, atol=1e-15)
    table = island.table((14.0, 15.0), WAVE, tolerance=1e-5)
    assert (
        np.abs(table.lookup(thickness) - island.response(thickness, WAVE)).max() < table.interpolation_error
    )
    unnamed = island.table_of(light, (14.0, 15.0), tolerance=1e-5)
    np.testing.assert_allclose(unnamed.wavelength_nm, WAVE, atol=1e-3)
    recorded(
        {
            "order": model.fringe_order_um([880.0, 990.0]),
            "quadrature": model.quadrature_error(WAVE, thickness),
            "response": island.respond(light, thickness),
            "table": table,
            "total": FringeModel.from_setup("ts8_e2v", observable="total").response(thickness, WAVE),
            "field": FringeModel.from_setup("lsst_e2v", field_x_deg=1.2, field_y_deg=-0.4).response(
                thickness, WAVE
            ),
        }
    )


def test_thickness_may_leave_the_range_tenfold(model: FringeModel) -> None:
    low, high = model.setup.thickness_range_um
    for good in (0.1 * low, 10.0 * high):
        assert model.checked_thickness_um(good) == good
    for wrong in (0.0999 * low, 10.01 * high):
        with pytest.raises(OutOfRangeError):
            model.checked_thickness_um(wrong)


def test_what_a_map_says_of_its_temperature() -> None:
    sky, stand = FringeModel.from_setup("monocam"), FringeModel.from_setup("ts8_e2v")
    warm = sky.at_laboratory_temperature({"LABTEMP": 190.0})
    assert warm.setup.laboratory_temperature_k == warm.base_system.laboratory_temperature_k == 190.0
    assert sky.at_laboratory_temperature({}) is sky
    assert stand.at_laboratory_temperature({"LABTEMP": 190.0}) is stand
    for value, error in (("warm", InputError), (3.0, OutOfRangeError)):
        with pytest.raises(error, match="LABTEMP"):
            sky.at_laboratory_temperature({"LABTEMP": value})


def test_words_of_a_model(model: FringeModel, island: FringeModel) -> None:
    assert repr(model) == "FringeModel('ts8_e2v')"
    assert model.facts()["effects"] == "none"
    assert island.facts()["effects"].startswith("epoxy_index.offset = 0.01, void.thickness = 150, ")
    assert {"effects"} == island.facts().keys() - island.setup.facts().keys()


def test_light_that_is_split(model: FringeModel, recorded: Record) -> None:
    """Facts are means over the wavelengths; a line that nobody would see is not drawn."""
    cone = FringeModel.from_setup("lsst_e2v", {"roughness.sigma": 20.0}).spectrum(
        np.linspace(900.0, 1000.0, 6), 16.0
    )
    facts = cone.facts()
    assert facts["wavelengths"] == "900 to 1000 nm"
    assert facts["adhesive"] == "16 µm"
    assert facts["detection, mean"] == f"{cone.absorbed['detection'].mean():.3g}"
    assert repr(cone).startswith(
        "StackSpectrum(wavelengths: 900 to 1000 nm, adhesive: 16 µm, reflected, mean: "
    )
    middle = sum(model.setup.thickness_range_um) / 2.0
    assert model.spectrum([950.0]).thickness_um == middle
    made = StackSpectrum(
        WAVE,
        np.array([0.1, 0.3]),
        np.array([0.0, 9e-4]),
        {"a": np.array([0.0, 1.1e-3]), "b": np.full(2, 0.6)},
        "b",
        "a",
        3.0,
    )
    from lsst.fringe_sim.style import figure

    with figure(3.0, 3.0) as drawn:
        axes = made.plot(drawn.subplots())
        assert [line.get_label() for line in axes.get_lines()] == ["reflected", "a", "b (detected)"]
        assert axes.get_ylim() == (0.0, 1.0)
        assert (axes.get_xlabel(), axes.get_title()) == ("wavelength [nm]", "a 3 µm")
    recorded({"cone": cone, "facts": {key: float(text) for key, text in facts.items() if "mean" in key}})


# Tables


def kinked(start: float, step: float, count: int) -> np.ndarray:
    place = start + step * np.arange(count)
    return np.stack([np.sin(7.0 * place), np.cos(5.0 * place) + 0.1 * place**2])


@pytest.mark.parametrize("tolerance", [1e-3, 1e-6, 1e-9])
def test_any_response_as_a_table(tolerance: float, recorded: Record) -> None:
    for bound in (None, 7.0**4):
        table = tabulate(kinked, (2.0, 3.0), [900.0, 950.0], fourth_derivative=bound, tolerance=tolerance)
        place = np.linspace(2.0, 3.0, 997)
        error = np.abs(table.lookup(place) - kinked(2.0, 1.0 / 996.0, 997)).max()
        assert error <= table.interpolation_error <= tolerance
        assert table.stop_um == pytest.approx(3.0)
        np.testing.assert_allclose(table.thickness_um[[0, -1]], [2.0, 3.0])
        recorded_of = {"step": table.step_um, "error": table.interpolation_error, "values": table.values}
        if bound is None:
            first = recorded_of
    recorded([first, recorded_of])


def test_a_fast_wave_as_a_table(recorded: Record) -> None:
    """The first grid on which its fourth derivative is looked for does not resolve it."""

    def wave(start: float, step: float, count: int) -> np.ndarray:
        return np.sin(4000.0 * (start + step * np.arange(count)))[np.newaxis]

    table = tabulate(wave, (2.0, 3.0), [900.0], tolerance=1e-3)
    place = np.linspace(2.0, 3.0, 9973)
    error = np.abs(table.lookup(place)[0] - np.sin(4000.0 * place)).max()
    assert error <= table.interpolation_error <= 1e-3
    recorded({"step": table.step_um, "error": table.interpolation_error})


@pytest.mark.parametrize(("first", "factor"), [(1e3, 0.3), (10.0, 0.9 * 10.0**-0.25), (1.1, 0.8)])
def test_a_grid_is_refined_as_its_error_asks(first: float, factor: float) -> None:
    """By the fourth root of what the error is too large, from 0.3 to 0.8 at a time."""

    def at_odds(start: float, step: float, count: int) -> np.ndarray:
        """Zero at the nodes; between them as wrong as asked for on the first grid, and right on finer ones."""
        wrong = np.zeros(count)
        if not asked:
            wrong[1::3] = first * 1e-6 / 1.125
        asked.append(step)
        return wrong[np.newaxis]

    asked: list[float] = []
    table = tabulate(at_odds, (0.0, 1000.0), [900.0], fourth_derivative=1e-12, tolerance=1e-6)
    usual = (192.0 * 1e-6 / 1e-12) ** 0.25
    own = 1000.0 / math.ceil(1000.0 / usual)
    error = first + own**4 * 1e-6 / 1944.0
    expected = own * max(0.3, min(0.8, 0.9 * error**-0.25))
    assert expected == pytest.approx(factor * own, rel=0.02)
    assert table.step_um == 1000.0 / math.ceil(1000.0 / expected)


@pytest.mark.parametrize(("size", "good"), [(8e-15, True), (1.2e-14, False)])
def test_rounding_is_no_error_of_a_table(size: float, good: bool) -> None:
    """Nobody gets less than 1e-14, and nobody is refused for asking for less."""

    def rough(start: float, step: float, count: int) -> np.ndarray:
        return np.where(np.arange(count) % 3 == 0, 0.0, size)[np.newaxis]

    if good:
        assert (
            tabulate(rough, (0.0, 1.0), [900.0], fourth_derivative=0.0, tolerance=1e-20).values.shape[1] == 9
        )
    else:
        with pytest.raises(ConvergenceError):
            tabulate(rough, (0.0, 1.0), [900.0], fourth_derivative=0.0, tolerance=1e-20)


def test_a_cubic_is_its_own_table() -> None:
    """Splines through four points or more give it back, in single and in double precision, in any order of pixels."""
    table = ResponseTable(
        1.0, 0.5, ((1.0 + 0.5 * np.arange(9.0)) ** 3)[np.newaxis] / 125.0, np.array([900.0]), 0.0
    )
    place = np.linspace(1.0, 5.0, 1200).reshape(3, 400)
    np.testing.assert_allclose(table.lookup(place)[0], place**3 / 125.0, rtol=1e-13)
    out = np.empty((400, 3), np.float32).T
    for given in (place, place.astype(np.float32), place[:, ::-1]):
        np.testing.assert_allclose(table.frame(given), given**3 / 125.0, atol=2e-7)
        assert table.frame(given, out=out) is out
        np.testing.assert_allclose(out, given**3 / 125.0, atol=2e-7)
    whole = np.array([[1, 5], [2, 3]])
    np.testing.assert_allclose(table.frame(whole), whole**3 / 125.0, atol=2e-7)


def test_edges_of_a_table() -> None:
    table = ResponseTable(1.0, 0.5, np.arange(18.0).reshape(2, 9), np.array([900.0, 910.0]), 0.0)
    for place in (1.0 - 4e-10, 5.0 + 4e-10):
        assert np.isfinite(table.frame(np.full((2, 3), place), 1)).all()
        assert np.isfinite(table.lookup(place)).all()
    for place in (1.0 - 7.5e-10, 5.0 + 7.5e-10, 1.0 - 1e-6, 5.0 + 1e-6):
        for row in (0, 1):
            with pytest.raises(OutOfRangeError, match=r"1 to 5 \(range of the table\)"):
                table.frame(np.array([[2.0, 3.0], [np.nan, place]]), row)
        with pytest.raises(OutOfRangeError, match=f"{place:.7g}"[:8]):
            table.lookup([2.0, place])
    np.testing.assert_allclose(table.frame(np.array([[1.0, 5.0]]), 1), [[9.0, 17.0]], rtol=1e-6)
    assert np.isnan(table.lookup([np.nan, 2.0])).tolist() == [[True, False]] * 2
    for wrong in (-1, 2):
        with pytest.raises(OutOfRangeError, match="0 to 1"):
            table.frame(np.full((1, 1), 2.0), wrong)
    for changes in (
        {"values": np.zeros((2, 3))}, {"values": np.zeros(8)}, {"wavelength_nm": np.zeros(3)}, {"step_um": 0.0},
        {"step_um": -1.0}, {"step_um": np.inf}, {"start_um": np.nan},
    ):  # fmt: skip
        with pytest.raises(InputError, match="table"):
            dataclasses.replace(table, **changes)
    assert ResponseTable(0.0, 1.0, np.zeros((1, 4)), np.zeros(1), 0.0).stop_um == 3.0


def test_large_frames_are_shared_among_threads() -> None:
    """Each row is filled once, whatever the shares."""
    from lsst.fringe_sim.compiled import limit_threads

    table = ResponseTable(1.0, 0.5, ((1.0 + 0.5 * np.arange(9.0)) ** 2)[np.newaxis], np.array([900.0]), 0.0)
    place = np.linspace(1.0, 5.0, 90_000).reshape(300, 300)
    limit_threads(3)
    try:
        np.testing.assert_allclose(table.frame(place), place**2, rtol=1e-6)
        np.testing.assert_allclose(table.lookup(place)[0], place**2, rtol=1e-12)
    finally:
        limit_threads(None)


def test_labels_of_a_table(model: FringeModel) -> None:
    light = model.system.flat_fields(WAVE)
    own = response_table(model.system, light, (14.0, 14.2), wavelength_nm=901.0 * np.ones(2), tolerance=1e-4)
    mean = response_table(model.system, light, (14.0, 14.2), tolerance=1e-4)
    assert own.wavelength_nm.tolist() == [901.0, 901.0]
    np.testing.assert_allclose(mean.wavelength_nm, light.mean_wavelength_nm)


# What is written of it


def test_overrides_are_text_that_tells_of_itself() -> None:
    settings = {"bandwidth.fwhm": 2.5, "ar_coating.scale": 1.0}
    digest = hashlib.sha256(b"ar_coating.scale=1.0\nbandwidth.fwhm=2.5").hexdigest()[:16]
    assert written_effects(settings) == f"ar_coating.scale bandwidth.fwhm {digest}"
    lines = effects_override(settings, "my\nstand", "named", detector="R22_S11").splitlines()
    assert lines[:-1] == [
        f"config.written_effects = 'ar_coating.scale bandwidth.fwhm {digest}'",
        "# Effects found in data of set-up 'my\\nstand'; verdict: named.",
        "# Sensor R22_S11.",
        "# Use with -C label:effects.py on any task that reads effects.",
        "config.effects['bandwidth.fwhm'] = 2.5",
        "config.effects['ar_coating.scale'] = 1.0",
    ]
    above = hashlib.sha256(("\n".join(lines[:-1]) + "\n").encode()).hexdigest()
    assert lines[-1] == f"# End; SHA-256 of the lines above: {above}"
    known = effects_override({"bandwidth.fwhm": 3.0}, "a", "named", known=settings).splitlines()
    assert known[2:-1] == [
        "# Use with -C label:effects.py on any task that reads effects.",
        "# Known before the search:",
        "config.effects['bandwidth.fwhm'] = 2.5",
        "config.effects['ar_coating.scale'] = 1.0",
        "# Found by it:",
        "config.effects['bandwidth.fwhm'] = 3.0",
    ]
    text = "\n".join(known) + "\n"
    assert is_as_written(text)
    assert not is_as_written(text.replace("3.0", "3.5"))
    assert not is_as_written("config.effects['bandwidth.fwhm'] = 3.0\n")
    assert is_as_written(ended("anything\n"))
    assert read_effects_override(text) == {"bandwidth.fwhm": 3.0, "ar_coating.scale": 1.0}
    with pytest.raises(InputError, match="not what a search has written"):
        read_effects_override(text.replace("3.0", "3.5"))
    with pytest.raises(InputError, match="fwhm once"):
        read_effects_override("\n".join(known[2:-1]))
    with pytest.raises(InputError, match=r'statement is "config\.written_effects'):
        read_effects_override("# mine\nconfig.written_effects = 'x'\nconfig.effects['tilt.angle'] = 1.0\n")
    with pytest.raises(InputError, match="without any effect"):
        read_effects_override("# nothing\n\n")


def test_effects_beside_those_that_were_written() -> None:
    settings = {"bandwidth.fwhm": 2.5, "ar_coating.scale": 1.0}
    written = written_effects(settings)
    refuse_other_effects(written, settings)
    refuse_other_effects(written, {**settings, "tilt.angle": 1.0})
    refuse_other_effects("", {})
    for other in ({**settings, "bandwidth.fwhm": 2.6}, {"bandwidth.fwhm": 2.5}, {}):
        with pytest.raises(InputError, match="cut short or changed"):
            refuse_other_effects(written, other)


def test_an_effect_of_another_catalogue_is_named() -> None:
    for catalogue, said in (
        ("/a/own.py", "--effects-from /a/own.py"),
        ("entry point x = y", "entry point x = y"),
    ):
        text = f"# Needs effects of {catalogue} for haze, mist\nconfig.effects['haze.size'] = 0.5\n"
        with pytest.raises(InputError, match=f"effect is 'haze'; allowed: known with {re.escape(said)}"):
            read_effects_override(text)
    assert read_effects_override("config.effects['haze.size'] = 0.5\n") == {"haze.size": 0.5}
    known = "# Needs effects of /a/own.py for tilt\nconfig.effects['tilt.angle'] = 0.5\n"
    assert read_effects_override(known) == {"tilt.angle": 0.5}


def test_cards_go_in_and_out(tmp_path) -> None:
    effects = {"tilt.angle": 1.0, "bandwidth.fwhm": 2.5}
    cards = effect_cards(effects)
    assert cards == {"EFFECT0": "bandwidth.fwhm", "EFFVAL0": 2.5, "EFFECT1": "tilt.angle", "EFFVAL1": 1.0}
    assert effects_of_header(cards) == effects
    for value in ("wide", None, np.inf, np.nan, True):
        with pytest.raises(FrameFormatError, match=r"EFFVAL1.*a finite number, the value of tilt.angle"):
            effects_of_header({**cards, "EFFVAL1": value})
    (tmp_path / "a é.fits").write_bytes(b"first")
    (tmp_path / "b.fits").write_bytes(b"second")
    paths = [tmp_path / "a é.fits", tmp_path / "b.fits", tmp_path / "a é.fits"]
    contents = [hashlib.sha256(text).hexdigest()[:12] for text in (b"first", b"second")]
    made = input_cards(paths)
    assert made == {"INPUT0": f"a \\xe9.fits {contents[0]}", "INPUT1": f"b.fits {contents[1]}"}
    assert inputs_of_header(made) == [("a \\xe9.fits", contents[0]), ("b.fits", contents[1])]
    own = table_cards([("media", "media.yaml")], [str(paths[1])])
    assert own == {
        "TABLE0": f"media/media.yaml {revision('media', 'media.yaml')}",
        "TABLE1": f"own/b.fits {contents[1]}",
    }
    assert software_cards()["ORIGIN"] == "lsst.fringe_sim"
    assert {"VERSION NUMPY", "VERSION PYTHON", "FSIMVER"} <= software_cards().keys()


@pytest.mark.parametrize("name", ["ts8_e2v", "ts8_itl", "lsst_e2v", "hsc", "monocam"])
def test_tables_of_a_set_up(name: str) -> None:
    """Its description, its stack, what its layers and its light are of; each once."""
    setup = Setup.from_name(name)
    tables = tables_of(setup)
    assert tables[:3] == (
        ("setups", f"{name}.yaml"),
        ("stacks", f"{setup.stack.name}.yaml"),
        ("media", "media.yaml"),
    )
    folders = [folder for folder, _ in tables]
    sky = setup.kind == "sky"
    assert folders.count("bandpasses") == int(sky)
    assert folders.count("telescopes") == int(name in ("lsst_e2v", "hsc"))
    assert (folders.count("sky") >= 6) is sky
    assert len(set(tables)) == len(tables)
    assert ("media", "nk_Si_green2008.ecsv") in tables
    cards: dict[str, Any] = model_cards(name, {"tilt.angle": 1.0} if not sky else {})
    assert cards["SETUP"] == name
    assert ("EFFECT0" in cards) is not sky
    assert [value for key, value in cards.items() if key.startswith("TABLE")] == [
        f"{folder}/{file} {revision(folder, file)}" for folder, file in tables
    ]


def test_a_telescope_of_ones_own_is_no_shipped_table() -> None:
    own = Path(__file__).resolve().parents[2] / "doc" / "tutorials" / "own_sensor" / "ccd290" / "sky.yaml"
    setup = Setup.from_name(str(own))
    assert {folder for folder, _ in tables_of(setup)} == {"media", "sky"}
    cards = table_cards(tables_of(setup), setup.files)
    stated = {value.split()[0] for value in cards.values() if value.startswith("own/")}
    assert {"own/telescope.yaml", "own/stack.yaml", "own/sky.yaml"} <= stated
