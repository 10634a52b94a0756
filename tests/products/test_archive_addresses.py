"""Files laid out as ``lsst.images`` lays them out, made by hand: that package needs a later Python than this one."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from lsst.fringe_sim.errors import FrameFormatError
from lsst.fringe_sim.products.observed_files import observed_images, write_images

SHAPE = (12, 20)
IMAGE = np.arange(240, dtype=np.float32).reshape(SHAPE)
TREE: dict[str, Any] = {
    "detector": {"attributes": {"name": "R22_S11"}},
    "obs_info": {"physical_filter": "y_10", "datetime_begin": [2461042.0, 0.75]},
    "image": {"yx0": [10, 20]},
    "backgrounds": {"sky": 1, "subtracted": "standard"},
}


def exposure(path: Path) -> Path:
    """An image that is compressed, two images of the mask, the tree and the index, with addresses of no use."""
    stored = np.frombuffer(json.dumps(TREE, separators=(",", ":")).encode(), dtype=np.uint8)
    rows = [("", 1, "IMAGE"), ("IMAGE", 1, "BINTABLE"), ("MASK", 1, "IMAGE"), ("MASK", 2, "IMAGE")]
    names, versions, kinds = zip(*rows, ("JSON", 1, "BINTABLE"), strict=True)
    ones = np.ones(len(names), dtype=np.int64)
    index = [fits.Column("EXTNAME", "8A", array=names), fits.Column("EXTVER", "K", array=versions)]
    index += [fits.Column("XTENSION", "8A", array=kinds), fits.Column("ZIMAGE", "L", array=ones == 1)]
    index += [fits.Column(name, "K", array=7 * ones) for name in ("HDRADDR", "DATADDR", "DATSIZE")]
    planes = np.zeros(SHAPE, dtype=np.int32)
    hdus = [
        fits.PrimaryHDU(header=fits.Header({"DATAMODL": "visit_image"})),
        fits.CompImageHDU(IMAGE, name="IMAGE", tile_shape=SHAPE),
        fits.ImageHDU(planes, name="MASK", ver=1),
        fits.ImageHDU(planes, name="MASK", ver=2),
        fits.BinTableHDU.from_columns([fits.Column("JSON", "PB", array=[stored])], name="JSON"),
        fits.BinTableHDU.from_columns(index, name="INDEX"),
    ]
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize("added", [True, False])
def test_a_file_that_is_written_again_knows_its_parts(added: bool, tmp_path: Path) -> None:
    path, target = exposure(tmp_path / "visit.fits"), tmp_path / "new.fits"
    flags = {1: np.zeros(SHAPE, dtype=bool)}
    write_images(path, target, {1: IMAGE + 1.0}, {1: {"FRINGCOR": 2}}, flags, {"OTHER": 3}, added=added)
    content = target.read_bytes()
    with fits.open(target, checksum=True, disable_image_compression=True) as hdus:
        assert hdus[0].header["OTHER"] == 3
        np.testing.assert_array_equal(hdus["IMAGE"].data, IMAGE + 1.0)
        for keyword, name in (("INDX", "INDEX"), ("JSON", "JSON")):
            begin, size = (int(hdus[0].header[f"{keyword}{what}"]) for what in ("ADDR", "SIZE"))
            there = fits.BinTableHDU.fromstring(content[begin : begin + size])
            assert (there.header["EXTNAME"], there.filebytes()) == (name, size)
        rows = {(row["EXTNAME"], row["EXTVER"]): row for row in hdus["INDEX"].data}
        assert len(rows) == 5
        for (name, version), row in rows.items():
            hdu = hdus[name, version] if name else hdus[0]
            place = hdu.fileinfo()
            found = [int(row[key]) for key in ("HDRADDR", "DATADDR", "DATSIZE")]
            assert found == [place["hdrLoc"], place["datLoc"], place["datSpan"]]
            assert (row["XTENSION"], row["ZIMAGE"]) == (hdu.header.get("XTENSION", "IMAGE"), False)
        text = np.asarray(hdus["JSON"].data[0]["JSON"]).tobytes()
    kept = {"sky": 1} if added else TREE["backgrounds"]
    assert json.loads(text) == TREE | {"backgrounds": kept}
    assert len(text) == len(json.dumps(TREE, separators=(",", ":")))
    (image,) = observed_images(target)
    assert image.header()["DATE-OBS"] == "2026-01-02T06:00:00.000"


class Drawn(SimpleNamespace):
    """A background as the package has it: it covers a box and is drawn on a part of it."""

    def render(self, box: Any, dtype: Any) -> Any:
        rows, columns = (np.arange(part.start, part.stop, dtype=dtype) for part in box)
        return SimpleNamespace(array=100.0 * rows[:, None] + columns)


class Box:
    def __init__(self, *parts: slice) -> None:
        self.y, self.x = parts

    def __class_getitem__(cls, parts: Any) -> Box:
        return cls(*parts)

    def __iter__(self) -> Any:
        return iter((self.y, self.x))

    def contains(self, other: Box) -> bool:
        return all(a.start <= b.start and b.stop <= a.stop for a, b in zip(self, other, strict=True))

    factory: Any


Box.factory = Box


def stand_in(monkeypatch: pytest.MonkeyPatch, found: Any, *, whole: bool) -> None:
    """The two modules of ``lsst.images`` that draw a background, as far as they are asked."""

    class Reader:
        def __enter__(self) -> Reader:
            return self

        def __exit__(self, *_: object) -> None: ...

        def get_tree(self) -> Any:
            return SimpleNamespace(backgrounds=1) if whole else SimpleNamespace()

        def get_component(self, name: str) -> Any:
            return {"backgrounds": found}[name] if whole else None

        def read(self) -> Any:
            return None if whole else found

    archive = SimpleNamespace(open_archive=lambda path: Reader())
    monkeypatch.setitem(sys.modules, "lsst.images", SimpleNamespace(Box=Box))
    monkeypatch.setitem(sys.modules, "lsst.images.serialization", archive)


def sky(begin: tuple[int, int] = (10, 20), end: tuple[int, int] = (22, 40)) -> Drawn:
    return Drawn(bounds=SimpleNamespace(bbox=Box(*map(slice, begin, end))))


@pytest.mark.parametrize("kind", ["exposure", "map", "one"])
def test_a_background_is_drawn_where_the_image_is(kind: str, tmp_path: Path, monkeypatch) -> None:
    field = sky() if kind == "one" else SimpleNamespace(subtracted=SimpleNamespace(field=sky()))
    stand_in(monkeypatch, field, whole=kind == "exposure")
    path = exposure(tmp_path / "visit.fits")
    (image,) = observed_images(path)
    added = 100.0 * np.arange(10.0, 22.0)[:, None] + np.arange(20.0, 40.0)
    np.testing.assert_array_equal(image.read(path).image, IMAGE + added)
    fits.PrimaryHDU(IMAGE).writeto(tmp_path / "plain.fits")  # it has no place on the sensor
    (plain,) = observed_images(tmp_path / "plain.fits")
    np.testing.assert_array_equal(plain.read(path).image, IMAGE + added)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (SimpleNamespace(subtracted=None), "subtracted background is 'none'; allowed: one"),
        (sky((10, 21)), "background is .* and more, the image"),
        (sky((11, 20)), "background is .* and more, the image"),
        (sky((10, 20), (21, 40)), "background is .* and more, the image"),
        (sky((10, 20), (22, 39)), "background is .* and more, the image"),
    ],
)
def test_a_background_that_is_not_there_is_refused(
    found: Any, said: str, tmp_path: Path, monkeypatch
) -> None:
    stand_in(monkeypatch, found, whole=False)
    path = exposure(tmp_path / "visit.fits")
    with pytest.raises(FrameFormatError, match=said):
        observed_images(path)[0].read(path)
