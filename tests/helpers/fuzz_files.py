"""FITS files that are spoiled on purpose: cards, bytes, lengths."""

import tempfile
from io import BytesIO
from pathlib import Path
from typing import Any

from astropy.io import fits
from hypothesis import strategies as st

CARD, BLOCK = 80, 2880

VALUES = st.one_of(
    st.integers(-(2**70), 2**70).map(str),
    st.floats().map(str),
    st.sampled_from(
        [
            "T",
            "F",
            "''",
            "'",
            "NaN",
            "1e400",
            "-1",
            "0",
            "999999999999",
            "'[1:1,1:1]'",
            "'[0:-5,3:99999]'",
            "",
            "(1,2)",
        ]
    ),
    st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=30).map(lambda text: f"'{text}'"),
)
"""Values as they stand in a card."""


def plain_header(made: Any, product: str | None = None) -> Any:
    """Bytes of HDUs; of a product those of the file, and those without its checksums and its name."""
    if product is None:
        stream = BytesIO()
        made.writeto(stream)
        return stream.getvalue()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "product.fits"
        made.write_fits(path)
        stream = BytesIO()
        with fits.open(path) as hdus:
            for hdu in hdus:
                for keyword in ("CHECKSUM", "DATASUM", "PRODUCT", "PRODVER", "NEXTEND"):
                    hdu.header.remove(keyword, ignore_missing=True)
            hdus.writeto(stream)
        return [path.read_bytes(), stream.getvalue()]


def alter_fits(data: st.DataObject, content: bytes) -> bytes:
    """Change cards, bytes, or the length of a file, a few times."""
    spoiled = bytearray(content)
    for _ in range(data.draw(st.integers(0, 3))):
        kind = data.draw(st.sampled_from(["card", "card", "card", "byte", "byte", "length", "block"]))
        if kind == "card":
            _alter_card(data, spoiled)
        elif kind == "byte" and spoiled:
            spoiled[data.draw(st.integers(0, len(spoiled) - 1))] ^= 1 << data.draw(st.integers(0, 7))
        elif kind == "length":
            del spoiled[data.draw(st.integers(0, len(spoiled))) :]
        elif kind == "block":
            start = BLOCK * data.draw(st.integers(0, max(len(spoiled) // BLOCK - 1, 0)))
            del spoiled[start : start + BLOCK]
    return bytes(spoiled)


def _alter_card(data: st.DataObject, content: bytearray) -> None:
    """Another value, or another keyword, in one card of one header."""
    cards = [
        start
        for start in range(0, len(content) - CARD + 1, CARD)
        if content[start + 8 : start + 10] == b"= " and content[start : start + 1].isalpha()
    ]
    if not cards:
        return
    start = data.draw(st.sampled_from(cards))
    keyword = content[start : start + 8]
    if not data.draw(st.integers(0, 4)):
        keyword = bytearray(
            data.draw(st.sampled_from([b"COMMENT ", b"END     ", b"NAXIS   ", b"XTENSION", b"BZERO   "]))
        )
    value = data.draw(VALUES).encode("ascii", "replace")
    content[start : start + CARD] = (bytes(keyword) + b"= " + value.rjust(20))[:CARD].ljust(CARD)
