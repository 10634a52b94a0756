"""Writing one product while the next is being made."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any, Self

from .fits_product import FitsProduct
from .sensor_section import SensorSection

__all__ = ["BackgroundWriter"]


class BackgroundWriter:
    """Writes products in the order in which they come, one at a time, in a thread of its own.

    Used in a ``with`` statement. A file is whole or absent, as with `FitsProduct.write_fits`. The error of one that
    cannot be written is raised where the next is handed over, which then is not written, or at the end. When the
    block ends, no write is under way, also if it ends by an error.

    At most one product is held besides the one that the caller makes.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="write-fits")
        self._pending: Future[None] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self._wait()
        except Exception as failed:
            if error is None:
                raise
            error.add_note(f"besides, a file could not be written: {failed}")
        finally:
            self._thread.shutdown()

    def write(
        self,
        product: FitsProduct,
        path: str | os.PathLike[str],
        metadata: Mapping[str, Any] | None = None,
        *,
        section: SensorSection | None = None,
    ) -> None:
        """Hand over a product when the one before is written; parameters as of `FitsProduct.write_fits`.

        Raises
        ------
        InputError
            The product before could not be written, as of `FitsProduct.write_fits`.
        OSError
            The same, for a reason that lies with the disk.
        """
        self._wait()
        self._pending = self._thread.submit(product.write_fits, path, metadata, section=section)

    def _wait(self) -> None:
        """Wait for the write under way; its error is raised once."""
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()
