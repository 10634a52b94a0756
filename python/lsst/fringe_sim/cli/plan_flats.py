"""``fringe-sim plan-flats``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ..files import json_text, table_text, write_whole
from .command import command, flag, option
from .output import refuse_used_file
from .parameters import LABORATORY, THICKNESS_RANGE, WAVELENGTHS, ChosenEffects, Quantity, model_effects

if TYPE_CHECKING:  # imported by the functions, so that --help is quick
    from astropy.table import QTable
    from numpy.typing import NDArray

    from ..algorithms.flat_plan import FlatForecast, PlannedFlat, RankedFlat
    from ..instrument.setup import Setup

TABLE_ROWS = 10
RANKED_ROWS = 5


@command("plan-flats")
def plan_flats(
    setup: Setup = LABORATORY.option("ts8_e2v", "Laboratory set-up: name or file."),
    thickness: tuple[float, float] | None = option(
        "Thicknesses of the layer, µm; those of the set-up.", kind=THICKNESS_RANGE
    ),
    search: tuple[float, float] | None = option(
        "Thicknesses the fit will search, µm; as 'fit' does.", kind=THICKNESS_RANGE
    ),
    wavelengths: tuple[float, ...] | None = option(
        "Flats, nm: 880:990:10 or a list; those of the set-up.", kind=WAVELENGTHS
    ),
    bandwidth: float | None = option("Width of their line, FWHM; that of the set-up.", kind=Quantity("nm")),
    electrons: float = option("Level of each flat.", 20_000.0, Quantity("electron")),
    read_noise: float = option("Read noise per pixel.", 7.0, Quantity("electron")),
    region: int = option(
        "Pixels whose evidence on the order is added (8 x 8: a cell of the global fit).",
        64,
        click.IntRange(1),
    ),
    slip_limit: float = option(
        "Largest slip probability of a region.", 1e-5, click.FloatRange(0.0, 1.0, min_open=True)
    ),
    sigma: float | None = option(
        "Largest uncertainty of a pixel in the recommended list.", kind=Quantity("nm")
    ),
    candidates: tuple[float, ...] | None = option(
        "Further flats, nm; every 5 nm across the list.", kind=WAVELENGTHS
    ),
    widths: tuple[float, ...] = option(
        "Width of their line; may be repeated; the width of the list and half of it.",
        kind=Quantity("nm"),
        names="--candidate-bandwidth",
        multiple=True,
    ),
    effects: ChosenEffects = model_effects(),
    as_json: bool = flag("Machine-readable.", "--json"),
    ecsv: Path | None = option("File for the forecast at every thickness.", kind=click.Path(path_type=Path)),
    overwrite: bool = flag("Replace the file of --ecsv."),
    dry_run: bool = flag("Check everything, say what would be done, write nothing."),
) -> None:
    """Say what a list of flats will tell about the layer, which flat to add, and which few would do.

    Rivals are the thicknesses that a fit could mistake for the truth. The order is decided by all pixels of a
    region together. Real e2v sensors show about 15 % of the computed contrast: see the second example.

    \b
    Examples:
      fringe-sim plan-flats --thickness 7um:15um --wavelengths 880:990:10
      fringe-sim plan-flats --thickness 7:15 --effect contrast_loss.factor=0.15 --electrons 50000 --region 1024
    """
    import numpy as np

    from ..algorithms.flat_plan import (
        PlannedFlat,
        forecast_flats,
        nyquist_thickness_um,
        rank_flats,
        recommend_flats,
    )
    from ..model import FringeModel

    if ecsv is not None:
        refuse_used_file("--ecsv", ecsv, overwrite)
    model = FringeModel.from_setup(setup, effects.settings)
    nominal = wavelengths or setup.wavelengths_nm
    width = setup.bandwidth_fwhm_nm if bandwidth is None else bandwidth
    flats = [PlannedFlat(value, electrons, bandwidth) for value in nominal]
    pool = [
        PlannedFlat(value, electrons, wide)
        for value in candidates or tuple(np.arange(min(nominal), max(nominal) + 2.5, 5.0).tolist())
        for wide in widths or (width, 0.5 * width)
    ]
    if dry_run:
        click.echo(f"would forecast {len(flats)} flats and compare {len(pool)} further ones")
        return
    limits: dict[str, Any] = {"search_um": search, "read_noise_e": read_noise, "region_px": region}
    range_um = thickness or setup.thickness_range_um
    now = forecast_flats(model, flats, range_um, **limits)
    ranked = rank_flats(model, flats, pool, range_um, slip_limit=slip_limit, **limits)
    goal = math.inf if sigma is None else 1e-3 * sigma
    short = recommend_flats(model, pool, range_um, slip_limit=slip_limit, sigma_um=goal, **limits)
    if ecsv is not None:
        write_whole(ecsv, table_text(forecast_table(now)))
    if as_json:
        found = _as_mapping(now, ranked, short, slip_limit)
        found["nyquist_um"] = nyquist_thickness_um(model, nominal).tolist()
        click.echo(json_text(found))
    else:
        _print(now, ranked, short, slip_limit, width)
        _print_nyquist(nyquist_thickness_um(model, nominal), range_um)
        if ecsv is not None:
            click.echo(str(ecsv))


def forecast_table(forecast: FlatForecast) -> QTable:
    """Forecast at every thickness, with units."""
    from astropy import units
    from astropy.table import QTable

    table = QTable()
    table["thickness"] = forecast.thickness_um * units.um
    table["sigma"] = 1e3 * forecast.sigma_um * units.nm
    table["rival"] = forecast.rival_um * units.um
    table["separation"] = forecast.separation
    table["pixel_slip"] = forecast.pixel_slip
    table["region_slip"] = forecast.region_slip
    table["separation"].info.description = "expected excess of the rival's chi-square, single pixel"
    table["region_slip"].info.description = f"probability of a wrong order, {forecast.region_px} pixels"
    table.meta["wavelength_nm"] = [float(flat.wavelength_nm) for flat in forecast.flats]
    table.meta["electrons"] = [float(flat.electrons) for flat in forecast.flats]
    return table


def _print(
    now: FlatForecast, ranked: tuple[RankedFlat, ...], short: FlatForecast, slip_limit: float, width_nm: float
) -> None:
    import numpy as np

    click.echo(f"{len(now.flats)} flats: {_listed(now, width_nm)}")
    head = ("thickness µm", "σ nm", "rival µm", "orders off", "Δχ² pixel", "slip pixel", "slip region")
    click.echo("  ".join(f"{name:>13}" for name in head))
    for part in np.array_split(np.arange(len(now.thickness_um)), TABLE_ROWS):
        worst = part[np.argmin(now.separation[part])]
        off = (now.rival_um[worst] - now.thickness_um[worst]) / now.order_um
        cells = (
            f"{now.thickness_um[part[0]]:.2f}–{now.thickness_um[part[-1]]:.2f}",
            f"{1e3 * np.sqrt(np.mean(now.sigma_um[part] ** 2)):.2f}",
            f"{now.rival_um[worst]:.3f}",
            f"{off:+.2f}",
            f"{now.separation[worst]:.2f}",
            f"{now.pixel_slip[part].mean():.1e}",
            f"{now.region_slip[part].max():.1e}",
        )
        click.echo("  ".join(f"{text:>13}" for text in cells))
    click.echo(
        "Each line: σ and slip of a pixel are means; rival and slip of a region the worst of the line."
    )
    verdict = "no order is ambiguous" if now.safe(slip_limit) else "orders are AMBIGUOUS"
    click.echo(f"{verdict}: regions of {now.region_px} pixels slip with up to {now.region_slip.max():.1e}")
    click.echo("next flat, the most useful first:")
    for item in ranked[:RANKED_ROWS]:
        click.echo(
            f"  {_named(item.flat, width_nm):<22} Δχ² {item.separation:.2f}, slip of a pixel {item.pixel_slip:.1e} "
            f"(mean), of a region {item.region_slip:.1e} (worst), σ {1e3 * item.sigma_um:.2f} nm"
        )
    if short.safe(slip_limit):
        sigma = 1e3 * np.sqrt(np.mean(short.sigma_um**2))
        click.echo(f"{len(short.flats)} flats would do (σ {sigma:.2f} nm): {_listed(short, width_nm)}")
    else:
        click.echo(
            f"the candidates do not reach the goal; the best {len(short.flats)} of them: "
            f"{_listed(short, width_nm)}, slip of a region {short.region_slip.max():.1e}"
        )


def _print_nyquist(limit_um: NDArray[Any], range_um: tuple[float, float]) -> None:
    """Up to which thickness neighbouring flats sample the fringe, if there are two of them."""
    if limit_um.size == 0:
        return
    low, high = limit_um.min(), limit_um.max()
    where = f"{low:.1f} µm" if high - low < 0.05 else f"{low:.1f} to {high:.1f} µm"
    if range_um[1] > low:
        click.echo(
            f"steps are below the Nyquist rate for layers thicker than {where}, by wavelength: there only the chirp "
            "over all flats tells a thickness from its mirror image"
        )
    else:
        click.echo(f"steps are above the Nyquist rate up to {where}")


def _named(flat: PlannedFlat, width_nm: float) -> str:
    width = width_nm if flat.bandwidth_fwhm_nm is None else flat.bandwidth_fwhm_nm
    return f"{flat.wavelength_nm:g} nm ({width:g} nm wide)"


def _listed(forecast: FlatForecast, width_nm: float) -> str:
    """Wavelengths by width of their line."""
    groups: dict[float, list[str]] = {}
    for flat in forecast.flats:
        width = width_nm if flat.bandwidth_fwhm_nm is None else flat.bandwidth_fwhm_nm
        groups.setdefault(width, []).append(f"{flat.wavelength_nm:g}")
    return "; ".join(f"{', '.join(values)} nm ({width:g} nm wide)" for width, values in groups.items())


def _as_mapping(
    now: FlatForecast, ranked: tuple[RankedFlat, ...], short: FlatForecast, slip_limit: float
) -> dict[str, Any]:
    return {
        "forecast": _summary(now, slip_limit),
        "next": [
            {
                **_flat(item.flat),
                "separation": item.separation,
                "pixel_slip_mean": item.pixel_slip,
                "region_slip_worst": item.region_slip,
                "sigma_nm": 1e3 * item.sigma_um,
            }
            for item in ranked
        ],
        "recommended": _summary(short, slip_limit),
    }


def _summary(forecast: FlatForecast, slip_limit: float) -> dict[str, Any]:
    worst = forecast.worst
    return {
        "flats": [_flat(flat) for flat in forecast.flats],
        "safe": forecast.safe(slip_limit),
        "order_um": forecast.order_um,
        "sigma_nm": _number(1e3 * math.sqrt(float((forecast.sigma_um**2).mean()))),
        "worst": {
            "thickness_um": float(forecast.thickness_um[worst]),
            "rival_um": _number(float(forecast.rival_um[worst])),
            "separation": _number(float(forecast.separation[worst])),
        },
        "pixel_slip_mean": float(forecast.pixel_slip.mean()),
        "region_slip_worst": float(forecast.region_slip.max()),
        "region_px": forecast.region_px,
    }


def _flat(flat: PlannedFlat) -> dict[str, float | None]:
    return {
        "wavelength_nm": float(flat.wavelength_nm),
        "bandwidth_fwhm_nm": flat.bandwidth_fwhm_nm,
        "electrons": flat.electrons,
    }


def _number(value: float) -> float | None:
    """JSON knows no infinity."""
    return value if math.isfinite(value) else None
