"""``fringe-sim export``."""

from __future__ import annotations

from glob import escape
from pathlib import Path

import click

from ..errors import InputError
from ..files import same_file_key
from .command import argument, command, flag
from .output import OutputFolder, output_folder
from .progress import progress


@command()
def export(
    files: tuple[Path, ...] = argument("FILE...", click.Path(path_type=Path)),
    out: OutputFolder = output_folder("Folder for the NetCDF files."),
    dry_run: bool = flag("Read everything, write nothing."),
) -> None:
    """Write thickness maps, fringe cubes and sky frames as NetCDF, for xarray.

    Axes are named, coordinates and images have units, header keywords become attributes. Needs the extra:
    pip install 'lsst-fringe-sim[xarray]'.

    \b
    Examples:
      fringe-sim export fit/thickness.fits --out nc
      fringe-sim export sky/*.fits --out nc
      python -c 'import xarray; print(xarray.open_dataset("nc/thickness.nc"))'
    """
    from ..products.xarray_export import read_exported, to_xarray, write_netcdf

    targets = [out.path / f"{file.stem}.nc" for file in files]
    taken: dict[str, int] = {}
    for number, target in enumerate(targets):
        other = taken.setdefault(same_file_key(target.name), number)
        if other != number:
            raise InputError("files", f"{files[other]} and {files[number]}", "files of different names")
    out = out.holding(*(escape(target.name) for target in targets))
    out.refuse_used()
    if not dry_run:
        out.prepare()
    with progress("exporting", len(files)) as advance:
        for file, target in zip(files, targets, strict=True):
            dataset = to_xarray(read_exported(file))
            if not dry_run:
                write_netcdf(dataset, target)
            advance()
    for target in targets:
        click.echo(f"would write {target}" if dry_run else str(target))
