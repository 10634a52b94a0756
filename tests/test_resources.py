"""Shipped tables: provenance, units, refusal of what is not there."""

import importlib.resources

import pytest

from lsst.fringe_sim.errors import ResourceError, UnknownNameError
from lsst.fringe_sim.resources import list_resources, read_table, read_yaml

FOLDERS = ("media", "sky", "instrument", "laboratory")
TABLES = [(folder, name) for folder in FOLDERS for name in list_resources(folder, ".ecsv")]

NOT_SHIPPED = {"oh_lines_guo2022_fig8", "oh_lines_pfs_skylines", "ts8_lamp_xenon_digitised"}
"""Tables without a licence: comparison only."""


@pytest.mark.parametrize(("folder", "name"), TABLES)
def test_every_table_states_where_it_comes_from(folder, name) -> None:
    table = read_table(folder, name)
    assert len(table) > 0
    assert {"source", "doi", "licence"} <= set(table.meta)
    assert not table.meta["licence"].startswith(("no ", "none", "unknown"))


def test_tables_without_a_licence_are_not_shipped() -> None:
    shipped = {name.removesuffix(".ecsv") for _, name in TABLES}
    assert not shipped & NOT_SHIPPED


def test_tables_are_copies() -> None:
    first = read_table("media", "nk_Si_green2008.ecsv")
    first["n"][0] = -1.0
    assert read_table("media", "nk_Si_green2008.ecsv")["n"][0] > 0.0


def test_unknown_table_names_the_near_miss() -> None:
    with pytest.raises(UnknownNameError, match="nk_Si_green2008"):
        read_table("media", "nk_Si_green2009.ecsv")


@pytest.mark.parametrize("name", ["../media/media.yaml", "../../errors.py", "/etc/passwd"])
def test_names_cannot_leave_their_folder(name) -> None:
    with pytest.raises(UnknownNameError):
        read_yaml("setups", name)


def test_a_table_without_provenance_is_refused(tmp_path, monkeypatch) -> None:
    folder = tmp_path / "data" / "media"
    folder.mkdir(parents=True)
    text = (
        "# %ECSV 1.0\n# ---\n# datatype:\n# - {name: n, datatype: float64}\n# schema: astropy-2.0\nn\n1.0\n"
    )
    (folder / "bare.ecsv").write_text(text)
    monkeypatch.setattr(importlib.resources, "files", lambda package: tmp_path)
    with pytest.raises(ResourceError, match="source, doi, licence"):
        read_table("media", "bare.ecsv")
