"""A set-up whose camera, stack, media, bandpass and telescope are files of one's own, in any folder."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lsst.fringe_sim.errors import InputError
from lsst.fringe_sim.instrument.bandpass import Bandpass
from lsst.fringe_sim.instrument.setup import Setup
from lsst.fringe_sim.instrument.sky import SkySpectrum
from lsst.fringe_sim.instrument.telescope import Telescope
from lsst.fringe_sim.mock.optics import material_index
from lsst.fringe_sim.mock.raw_frames import setup_optics
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.model.provenance import model_cards
from lsst.fringe_sim.optics.media import get_medium, read_media

EXAMPLES = Path(__file__).resolve().parents[2] / "doc" / "tutorials" / "own_sensor"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The CCD290 of the tutorial, which a test may change."""
    return Path(shutil.copytree(EXAMPLES / "ccd290", tmp_path / "ccd290"))


def change(path: Path, old: str, new: str) -> None:
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_files_count_from_the_folder_of_the_setup(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    setup = Setup.from_name("ccd290/sky.yaml")
    sensor = setup.sensor()
    assert (sensor.shape, sensor.vendor, sensor.serial) == ((9232, 9216), "e2v", "CCD290-01")
    assert setup.amplifier_grid == (2, 8)
    assert setup.stack.names[-1] == "substrate"
    assert setup.filter_name == "z"
    assert {Path(file).name for file in setup.files} == {
        "sky.yaml", "camera.yaml", "stack.yaml", "media.yaml", "nk_N-BK7.ecsv",
        "z.yaml", "throughput_z.ecsv", "telescope.yaml",
    }  # fmt: skip
    # The cone of f/4.5, by hand.
    assert np.degrees(setup.beam().theta.max()) < np.degrees(np.arcsin(1 / 9.0)) < 6.4


def test_own_media_are_those_of_their_table(folder: Path) -> None:
    glass = read_media(folder / "media.yaml")["N-BK7"]
    # SCHOTT states 1.50669 at 1060 nm.
    assert glass.index(1060.0).real == pytest.approx(1.50669, abs=2e-5)
    assert glass.index(1060.0).imag == 0.0
    (mock,) = material_index("N-BK7", np.array([1060.0]), 173.0, str(folder / "media.yaml"))
    assert mock == pytest.approx(complex(glass.index(1060.0)))
    model = FringeModel.from_setup(str(folder / "flats.yaml"))
    assert model.system.stack.layers[-1].medium.index(950.0) == glass.index(950.0)


def test_own_silicon_takes_the_place_of_all_silicon(folder: Path) -> None:
    (folder / "media.yaml").write_text(
        "Si_mine: {constant: [3.6, 0.0], range_nm: [300, 1200], source: a test}\n", encoding="utf-8"
    )
    change(folder / "stack.yaml", "medium: N-BK7", "medium: SiO2")
    change(folder / "flats.yaml", "media: media.yaml", "media: media.yaml\nsilicon: Si_mine")
    setup = Setup.from_file(folder / "flats.yaml")
    assert setup.stack.layers[2].medium.index(950.0) == 3.6
    assert get_medium("Si").index(950.0) != 3.6


def test_model_and_mock_agree_on_a_sensor_of_ones_own(folder: Path) -> None:
    optics, camera = setup_optics(str(folder / "flats.yaml"))
    assert camera == str(folder / "camera.yaml")
    thickness = np.linspace(40.0, 40.13, 14)
    model = FringeModel.from_setup(str(folder / "flats.yaml"))
    for wavelength, own in zip((905.0, 985.0), model.response(thickness, [905.0, 985.0]), strict=True):
        np.testing.assert_allclose(own, optics.flat_field(thickness, wavelength), rtol=1e-4)


def test_the_header_of_a_product_states_every_file(folder: Path) -> None:
    cards = model_cards(Setup.from_file(folder / "flats.yaml"), {})
    tables = [str(value) for key, value in cards.items() if key.startswith("TABLE")]
    own = {text.partition(" ")[0] for text in tables if text.startswith("own/")}
    assert own == {
        f"own/{name}" for name in ("flats.yaml", "camera.yaml", "stack.yaml", "media.yaml", "nk_N-BK7.ecsv")
    }
    assert any(text.startswith("media/nk_HfO2") for text in tables)
    assert not any(text.startswith("stacks/") for text in tables)
    change(folder / "nk_N-BK7.ecsv", "absorption neglected", "without absorption")
    again = model_cards(Setup.from_file(folder / "flats.yaml"), {})
    changed = {str(cards[key]).partition(" ")[0] for key in cards if cards[key] != again[key]}
    assert changed == {"own/nk_N-BK7.ecsv"}


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("flats.yaml", "camera: camera.yaml", "camera: absent.yaml", "absent.yaml"),
        ("flats.yaml", "stack: stack.yaml", "stack: absent.yaml", "absent.yaml"),
        ("flats.yaml", "media: media.yaml", "media: absent.yaml", "absent.yaml"),
        ("flats.yaml", "media: media.yaml", "media: flats.yaml", "mapping"),
        ("flats.yaml", "detector: S00", "detector: S01", "S01"),
        ("flats.yaml", "varying: detection", "varying: adhesive", "adhesive"),
        ("stack.yaml", "medium: N-BK7", "medium: N-BK8", "N-BK8"),
        ("stack.yaml", "thickness_um: 40.0", "thickness_um: thin", "layers.2..thickness_um"),
        ("stack.yaml", "thickness_um: 40.0", "thickness_um: .inf", "infinite|finite"),
        ("stack.yaml", "doi: ", "dio: ", "doi"),
        ("stack.yaml", "layers: ", "layer: ", "layers"),
        ("media.yaml", "nk_N-BK7.ecsv", "nk_absent.ecsv", "nk_absent.ecsv"),
        ("media.yaml", "  table", "  tables", "table with wavelength"),
        ("nk_N-BK7.ecsv", "{doi: none}", "{dio: none}", "doi"),
        ("nk_N-BK7.ecsv", "wavelength n k", "wavelength n z", "nk_N-BK7.ecsv"),
        ("nk_N-BK7.ecsv", "1100.0 1.506167 0.0", "1100.0 0.0 1.506167", "ecsv: n is 0.0; allowed: positive"),
        ("nk_N-BK7.ecsv", "1.506167 0.0", "1.506167 -0.1", "ecsv: k is -0.1"),
        ("camera.yaml", "vendor: e2v", "vendor: ''", "vendor"),
        ("camera.yaml", "pixel_um: 10.0", "pixel_um: -10.0", "pixel_um"),
    ],
)
def test_what_is_wrong_is_said_with_the_file(folder: Path, file: str, old: str, new: str, words: str) -> None:
    change(folder / file, old, new)
    with pytest.raises(InputError, match=words) as caught:
        Setup.from_file(folder / "flats.yaml")
    assert ".yaml" in str(caught.value) or ".ecsv" in str(caught.value)


def test_a_vendor_may_be_any(folder: Path) -> None:
    change(folder / "camera.yaml", "vendor: e2v", "vendor: Gpixel")
    setup = Setup.from_file(folder / "flats.yaml")
    assert setup.sensor().vendor == "Gpixel"
    with pytest.raises(InputError, match="Gpixel"):
        setup.refuse_vendor_of("E2V-CCD250-321", "a file")
    setup.refuse_vendor_of("CCD290-01", "a file")


def test_throughputs_are_products_of_columns(folder: Path) -> None:
    band = Bandpass.from_file(folder / "z.yaml")
    np.testing.assert_allclose(band.transmission([880.0, 930.0, 990.0]), [0.0, 0.95 * 0.75, 0.0])
    assert band.name == "z"
    with pytest.raises(InputError, match="quantum efficiency"):
        band.quantum_efficiency(930.0)


def test_a_quantum_efficiency_is_a_table_beside_the_bandpass(folder: Path) -> None:
    shutil.copy(folder / "throughput_z.ecsv", folder / "qe.ecsv")
    change(folder / "qe.ecsv", "filter", "qe")
    stated = "detector: {table: qe.ecsv, columns: [qe]}"
    change(folder / "z.yaml", f"# {stated}", stated)
    assert Bandpass.from_file(folder / "z.yaml").quantum_efficiency(930.0) == pytest.approx(0.95)
    assert str(folder / "qe.ecsv") in Setup.from_file(folder / "sky.yaml").files


@pytest.mark.parametrize(
    ("file", "old", "new", "read"),
    [
        ("z.yaml", "column: atmosphere", "column: air", Bandpass.from_file),
        ("z.yaml", "factors: [filter, mirrors]", "factors: [filter, glass]", Bandpass.from_file),
        ("z.yaml", "throughput_z.ecsv", "absent.ecsv", Bandpass.from_file),
        ("telescope.yaml", "kind: cone", "kind: pipe", Telescope.from_file),
        ("telescope.yaml", "pixel_um: 10.0", "pixel_um: ten", Telescope.from_file),
        ("telescope.yaml", "licence: facts", "", Telescope.from_file),
    ],
)
def test_a_wrong_bandpass_or_telescope_is_named(
    folder: Path, file: str, old: str, new: str, read: Callable[[Path], object]
) -> None:
    change(folder / file, old, new)
    with pytest.raises(InputError):
        read(folder / file)


def test_a_sky_without_all_its_lines_is_refused(folder: Path) -> None:
    band = Bandpass.from_file(folder / "z.yaml")
    assert SkySpectrum.dark().components(band)
    blue = replace(band, wavelength_nm=band.wavelength_nm - 60.0)
    with pytest.raises(InputError, match="880 to 1110"):
        SkySpectrum.dark().components(blue)


def test_four_outputs() -> None:
    setup = Setup.from_file(EXAMPLES / "hamamatsu" / "flats.yaml")
    assert setup.amplifier_grid == (1, 4)
    assert setup.sensor().vendor == "Hamamatsu"
