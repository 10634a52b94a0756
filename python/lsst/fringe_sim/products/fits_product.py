"""What all products have in common: keywords and extensions are declared once, and all else follows."""

from __future__ import annotations

import math
import os
from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from ..errors import FrameFormatError
from ..notebook import InNotebook, axes_or_new
from . import _check as check
from . import _fits as io
from .sensor_section import SensorSection

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class _NEEDED:
    """Stands for no default: a header must have the keyword."""


@dataclass(frozen=True)
class Card:
    """A number or a name of a product, and the keyword of the primary header that holds it.

    Without ``default``, a header must have the keyword; with ``omit``, a header lacks it where the value is the
    default. Numbers lie between ``low`` and ``high``, and above ``low`` if it is ``open_low``.
    """

    field: str
    keyword: str
    what: str
    unit: str = ""
    kind: type = float
    low: float = -math.inf
    high: float = math.inf
    open_low: bool = False
    empty: bool = True
    default: Any = _NEEDED
    omit: bool = False

    def check(self, value: Any) -> Any:
        """The value as the product keeps it."""
        if value is None and self.default is None:
            return None
        if self.kind is str:
            return check.check_name(self.field, value, empty=self.empty)
        if self.kind is int:
            return check.check_whole_number(self.field, value, low=int(self.low), high=int(self.high))
        return check.check_number(
            self.field, value, low=self.low, high=self.high, open_low=self.open_low,
            allow_inf=self.default == math.inf, unit=self.unit,
        )  # fmt: skip

    def cards(self, value: Any) -> list[tuple[str, io.Scalar, str]]:
        """Keyword, value and comment; none if the value goes without saying."""
        if self.omit and value == self.default:
            return []
        return [(self.keyword, value, f"[{self.unit}] {self.what}" if self.unit else self.what)]

    def read(self, header: fits.Header, source: str) -> Any:
        """The value that a header states."""
        if self.default is _NEEDED:
            return io.read_keyword(header, self.keyword, source=source)
        return header.get(self.keyword, self.default)


DETECTOR = Card("detector", "DETNAME", "sensor", kind=str, default="")
FILTER = Card("physical_filter", "FILTER", "physical filter", kind=str, default="")


def _noted(keyword: str, what: str, unit: str = "", low: float = 0.0, high: float = math.inf) -> Card:
    return Card(keyword, keyword, what, unit, low=low, high=high)


NOTED = (
    _noted("LABTEMP", "temperature at which the thickness was measured", "K", 100.0, 400.0),
    _noted("SCALESIG", "uncertainty that all thicknesses share, fraction of them"),
    _noted("CONTRAST", "contrast of the flats over that of the model"),
    _noted("CONTRSIG", "its uncertainty"),
    _noted("ORDMARG", "margin of the order of the fringe", low=-math.inf),
    _noted("SLOPEORD", "orders of the fringes from one pixel to the next"),
    _noted("SLOPECON", "contrast that is left within a pixel", high=1.0),
    _noted("MISFIT", "misfit of the flats"),
    _noted("CELLMISF", "misfit of cells"),
    _noted("SMOOTHPX", "smoothing of the flats", "px"),
    _noted("RDNOISE", "read noise", "electron"),
    _noted("FRINGRMS", "rms of the fringes, fraction of the sky"),
    _noted("PHASERMS", "change of the fringes by an open phase, fraction of the sky"),
    _noted("PHASESIG", "that phase", "rad / 10 K"),
)
"""Numbers among the metadata that readers go by; a product need not have them, but not other than they can be."""


def check_noted(metadata: Mapping[str, Any]) -> None:
    """Refuse metadata with a value that a number of `NOTED` cannot have."""
    for card in NOTED:
        if metadata.get(card.keyword) is not None:
            card.check(metadata[card.keyword])


@dataclass(frozen=True)
class Extension:
    """One HDU, and the fields of a product that it holds; subclasses say how."""

    field: str
    name: str

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:
        """Fields as the product keeps them; ``known`` has those that are checked: the first image and the mask."""
        raise NotImplementedError

    def hdu(self, product: Any) -> Any:
        """What is written; `None` if there is nothing."""
        raise NotImplementedError

    def read(self, hdus: fits.HDUList, source: str, native: bool) -> dict[str, Any]:
        """Fields from a file; big arrays stay there unless ``native``."""
        raise NotImplementedError

    def table(self, hdus: fits.HDUList, source: str) -> Any:
        """Rows of a binary table."""
        if self.name not in hdus or not isinstance(hdus[self.name], fits.BinTableHDU):
            raise FrameFormatError(
                "extension", f"no {self.name}", f"a binary table named {self.name}", source=source
            )
        return hdus[self.name].data


@dataclass(frozen=True)
class Image(Extension):
    """Image of real numbers.

    ``unit`` is its BUNIT, in which ``{unit}`` stands for that of the product; `None` for no such keyword. Its last
    axes are those of the first image unless it is not ``on_sensor``. Pixels must be numbers where the mask is 0, or
    ``everywhere``, or need not be if ``gaps``.
    """

    unit: str | None = ""
    ndim: int = 2
    dtype: type[np.floating] = np.float32
    everywhere: bool = False
    gaps: bool = False
    nonnegative: bool = False
    optional: bool = False
    on_sensor: bool = True

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:  # noqa: D102
        values = getattr(product, self.field)
        if values is None and self.optional:
            return {self.field: None}
        array = self._as_array(product, values)
        if self.on_sensor and "mask" in known:
            shape = known["mask"].shape[-self.ndim :]
            check.check_shape(self.name, array, (*array.shape[: self.ndim - len(shape)], *shape))
        if not self.gaps and "mask" in known:
            mask = None if self.everywhere else known["mask"]
            check.check_good_pixels(self.name, array, mask, nonnegative=self.nonnegative)
        return {self.field: array}

    def _as_array(self, product: Any, values: Any) -> NDArray[Any]:
        unit = (self.unit or "").format(unit=getattr(product, "unit", ""))
        plain = "" if unit.startswith(("relative", "fraction")) else unit
        return check.as_float_array(self.name, values, self.ndim, self.dtype, plain)

    def hdu(self, product: Any) -> Any:  # noqa: D102
        data = getattr(product, self.field)
        if data is None:
            return None
        unit = None if self.unit is None else self.unit.format(unit=getattr(product, "unit", ""))
        return io.image_hdu(self.name, data, unit=unit, cards=product._extension_cards(self.name))

    def read(self, hdus: fits.HDUList, source: str, native: bool) -> dict[str, Any]:  # noqa: D102
        if self.optional and self.name not in hdus:
            return {self.field: None}
        data = io.read_image(hdus, self.name, source=source, native=native)
        stated = hdus[self.name].header.get("BUNIT")
        if self.unit and "{" not in self.unit:
            data = io.in_unit(self.name, data, stated, self.unit, source=source)
        elif self.unit is not None:
            unit = self.unit.format(unit=str(hdus[1].header.get("BUNIT", "")).strip())
            io.refuse_other_unit(self.name, stated, unit, source=source)
        return {self.field: data}


@dataclass(frozen=True)
class _Mask(Extension):
    """Image of bits, one for each of `MASK_PLANES`; 0 is good."""

    dtype: type[np.signedinteger] = np.int32

    def check(self, product: Any, known: Mapping[str, Any]) -> dict[str, Any]:
        (first,) = known.values()
        return {self.field: check.as_mask(self.name, getattr(product, self.field), first.shape, self.dtype)}

    def hdu(self, product: Any) -> Any:
        return io.mask_hdu(getattr(product, self.field), cards=product._extension_cards(self.name))

    def read(self, hdus: fits.HDUList, source: str, native: bool) -> dict[str, Any]:
        return {self.field: io.read_mask(hdus, source=source, native=native)}


MASK = _Mask("mask", "MASK")
NARROW_MASK = _Mask("mask", "MASK", np.int16)
"""Of a cube, in which the mask is as large as the image; all planes fit into it."""


class FitsProduct(InNotebook, ABC):
    """A product that a FITS file can hold: a frozen dataclass with ``metadata``, which says what is where."""

    CARDS: ClassVar[tuple[Card, ...]]  # its numbers and names, in the order of the header
    # The rest, in the order of the file. The first is an image whose shape the mask has.
    EXTENSIONS: ClassVar[tuple[Extension, ...]]
    RESERVED: ClassVar[tuple[str, ...]] = ()  # further keywords that metadata may not use

    def __post_init__(self) -> None:
        first = self.EXTENSIONS[0]
        mask = next(item for item in self.EXTENSIONS if isinstance(item, _Mask))
        values = first.check(self, {})
        values |= mask.check(self, values)
        object.__setattr__(self, first.field, values[first.field])  # converted once
        known = dict(values)
        for item in self.EXTENSIONS:
            if item is not mask:
                values |= item.check(self, known)
        for card in self.CARDS:
            values[card.field] = card.check(getattr(self, card.field))
        values["metadata"] = io.normalise_metadata(getattr(self, "metadata"), self._keywords())  # noqa: B009
        check_noted(values["metadata"])
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self._check()

    def _check(self) -> None:
        """What no single field can tell."""

    def __repr__(self) -> str:
        """What it is, how large, and its numbers and names; no arrays."""
        shape = " x ".join(map(str, getattr(self, self.EXTENSIONS[0].field).shape))
        told = (f", {card.field}={value!r}" for card, value in self._told())
        return f"{type(self).__name__}({shape}{''.join(told)})"

    def _told(self) -> list[tuple[Card, Any]]:
        """Numbers and names that are not the default."""
        values = [(card, getattr(self, card.field)) for card in self.CARDS]
        return [(card, value) for card, value in values if value not in ("", card.default)]

    def facts(self) -> dict[str, Any]:
        """Shape of its images, its numbers and names, and the share of the pixels that is masked."""
        shown: dict[str, Any] = {"shape": " × ".join(map(str, getattr(self, self.EXTENSIONS[0].field).shape))}
        for card, value in self._told():
            number = f"{value:.4g}" if isinstance(value, float) else value
            shown[card.what or card.field] = f"{number} {card.unit}" if card.unit else number
        mask: NDArray[Any] = getattr(self, "mask")  # noqa: B009
        return {**shown, "masked": f"{100.0 * np.mean(mask != 0):.3g} %"}

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw its image, of several the middle one, with masked pixels grey; on new axes by default."""
        from ..style import show_image

        image, label, diverging = self._picture()
        mask: NDArray[Any] = getattr(self, "mask")  # noqa: B009
        drawn = axes_or_new(axes)
        title = str(getattr(self, "detector", ""))
        mask = mask[len(mask) // 2] if mask.ndim > image.ndim else mask
        show_image(drawn, image, mask=mask, label=label, title=title, diverging=diverging)
        return drawn

    def _picture(self) -> tuple[NDArray[Any], str, bool]:
        """What is drawn, its label, and whether its zero is the middle of the colours."""
        first = self.EXTENSIONS[0]
        image = getattr(self, first.field)
        return image[len(image) // 2] if image.ndim > 2 else image, first.name.lower(), False

    @classmethod
    def _keywords(cls) -> tuple[str, ...]:
        return (*(card.keyword for card in cls.CARDS), *cls.RESERVED)

    def write_fits(
        self,
        path: str | os.PathLike[str],
        metadata: Mapping[str, Any] | None = None,
        *,
        section: SensorSection | None = None,
    ) -> None:
        """Write the product with checksums, repeatable to the byte.

        ``path``: file to write; an existing one is replaced when the new one is complete. ``metadata``: further
        header keywords, which win over those of the product. ``section``: pixels of the sensor that the images
        show; their world coordinates are written with them.
        """
        merged = io.merge_metadata(getattr(self, "metadata"), metadata, self._keywords())  # noqa: B009
        check_noted(merged)
        hdus = [io.primary_hdu(type(self).__name__, self._primary_cards(merged), merged)]
        hdus += [hdu for item in self.EXTENSIONS if (hdu := item.hdu(self)) is not None]
        io.write_hdus(path, hdus, section)

    def _primary_cards(self, metadata: Mapping[str, io.Scalar]) -> list[tuple[str, io.Scalar, str]]:
        """Cards of the primary header before the metadata."""
        return [card for item in self.CARDS for card in item.cards(getattr(self, item.field))]

    def _extension_cards(self, name: str) -> list[tuple[str, Any, str]]:
        """Further cards of an image."""
        return []

    @classmethod
    def read_fits(cls, path: str | os.PathLike[str]) -> Self:
        """Read a file that `write_fits` wrote."""
        with io.open_fits(path, cls.__name__) as hdus:
            return cls(**cls._values(hdus, str(path)))

    @classmethod
    def _values(cls, hdus: fits.HDUList, source: str, *, native: bool = True) -> dict[str, Any]:
        """Fields of the product in a file."""
        header = hdus[0].header
        values = {card.field: card.read(header, source) for card in cls.CARDS}
        for item in cls.EXTENSIONS:
            values |= item.read(hdus, source, native)
        return values | {"metadata": io.read_metadata(header, cls._keywords())}


class SensorProduct(FitsProduct):
    """A product whose first image covers a sensor."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the sensor."""
        rows, columns = getattr(self, self.EXTENSIONS[0].field).shape
        return rows, columns
