"""Light on the sensor: OH lines, beams, photons in the silicon. Figures 8 to 11, Eqs. 4 and 5."""

from __future__ import annotations

import math

import batoid
import numpy as np

from ..algorithms.fringe_amplitudes import fringe_amplitudes
from ..algorithms.photon_migration import photon_migration
from ..algorithms.sky_frame import is_band
from ..instrument.bandpass import Bandpass
from ..instrument.sky import EmissionLines, SkySpectrum
from ..instrument.telescope import RayBundle, Telescope, batoid_optic
from ..model import FringeModel
from ..optics import Beam, Illumination
from ..resources import read_table
from .section import Context, Curve, Graph, PaperSection, columns, missing

PERCENT = 100.0
SECOND_RADIATION_CONSTANT = 1.4387769  # hc/k [cm K]

NAMED_BANDS = ("7-3", "8-4", "3-0", "9-5", "4-1", "5-2")
RED_BANDS = ("4-1", "5-2")
NEAR_NM = 0.05
"""Distance within which two lists mean one line: doublets are merged in one and split in the other."""

STRONG = 0.01
"""Strength from which lines are compared, relative to the strongest: the figure reads fainter ones badly."""

EDGE_DEG = 1.44
FIELDS = ((0.0, "LSST, centre"), (EDGE_DEG, f"LSST, {EDGE_DEG}° off axis"))
BINS = (10, 20, 50, 100)
BEAM_NODES = 192
PATH_RAYS = 7  # Rays on either side of the axis of which the path through the telescope is drawn
FAINTEST = 1e-6  # Weight below which lines are not drawn


def oh_lines(context: Context) -> PaperSection:
    """Section 4.1, Figure 8, Eq. 4."""
    bandpass = Bandpass.from_name("lsst_y")
    sky = SkySpectrum(EmissionLines.oh(), airmass=1.2)
    bands = [item for item in sky.components(bandpass) if is_band(item.name)]
    wavelength = np.concatenate([item.wavelength_nm for item in bands])
    photons = np.concatenate([item.photons for item in bands])
    light = Illumination.spectrum(wavelength, photons, Beam.collimated())
    named = sum(item.photons.sum() for item in bands if item.name in NAMED_BANDS)
    compared, drawn = _against_figure_8(context)
    curves = tuple(
        Curve(item.wavelength_nm, item.photons / photons.sum(), item.name, ".")
        for item in bands
        if item.name in NAMED_BANDS
    )
    return PaperSection(
        "OH lines: section 4.1, Fig. 8, Eq. 4",
        "Weights of the lines behind air, mirrors and filter, without the detector, whose efficiency the stack "
        "computes. The lines are those of PALACE, not those of the figure.",
        {
            "rotational_temperature": _rotational_temperature(),
            "vibrational_temperature": _vibrational_temperature(),
            "line_weights": float(light.weight.sum()),
            "six_bands": float(named / photons.sum()),
            **compared,
        },
        (Graph("LSST y band", "wavelength [nm]", "weight of a line [1]", curves, True, FAINTEST), *drawn),
        f"Normalised weight of every OH line above {FAINTEST:g}, by vibrational band.",
    )


def _against_figure_8(context: Context) -> tuple[dict[str, float], tuple[Graph, ...]]:
    """Every line of the figure against those of the same band of PALACE nearby."""
    theirs, ours = context.lines_of_figure_8(), read_table("sky", "oh_lines_palace_yband.ecsv")
    if theirs is None:
        return missing("lines_found", "lines_strength", "red_bands"), ()
    wavelength, intensity = columns(theirs, "wavelength", "intensity")
    own_wavelength, own = columns(ours, "wavelength", "photon_radiance")
    near = np.abs(wavelength[:, None] - own_wavelength) < NEAR_NM
    near &= np.asarray(theirs["band"], dtype=str)[:, None] == np.asarray(ours["band"], dtype=str)
    found = near.any(axis=1)
    # Several lines of the figure may share one of PALACE, and the doublets of PALACE one of the figure.
    strength = (near * own / np.maximum(near.sum(axis=0), 1)).sum(axis=1)
    ratio = np.log(intensity[found] / strength[found])
    strong = intensity[found] > STRONG * intensity.max()
    shares = [
        float(values[np.isin(np.asarray(table["band"], dtype=str), RED_BANDS)].sum() / values.sum())
        for table, values in ((theirs, intensity), (ours[near.any(axis=0)], own[near.any(axis=0)]))
    ]
    values = {
        "lines_found": PERCENT * float(intensity[found].sum() / intensity.sum()),
        "lines_strength": float(
            np.corrcoef(np.log(intensity[found][strong]), np.log(strength[found][strong]))[0, 1]
        ),
        "red_bands": shares[0] / shares[1],
    }
    curves = tuple(
        Curve(wavelength[found][own_band], np.exp(ratio[own_band] - np.median(ratio[strong])), band, ".")
        for band in NAMED_BANDS
        for own_band in [np.asarray(theirs["band"], dtype=str)[found] == band]
    )
    return values, (Graph("Figure 8 over PALACE", "wavelength [nm]", "ratio over its median", curves, True),)


def _rotational_temperature() -> float:
    """Mean over the named bands of the slope of ln(I / A g) against energy, lowest levels."""
    table = read_table("sky", "oh_lines_palace_yband.ecsv")
    found = []
    for name in NAMED_BANDS:
        rows = table[(table["band"] == name) & (table["N_up"] <= 4)]
        rate = np.asarray(rows["A"] * rows["g_up"], dtype=float)
        population = np.log(np.asarray(rows["photon_radiance"], dtype=float) / rate)
        slope = np.polyfit(np.asarray(rows["E_rot"], dtype=float), population, 1)[0]
        found.append(-SECOND_RADIATION_CONSTANT / slope)
    return float(np.mean(found))


def _vibrational_temperature() -> float:
    table = read_table("sky", "oh_levels_palace.ecsv")
    rows = table[(table["v_up"] >= 3) & (table["v_up"] <= 9)]
    energy, population = columns(rows, "E_v0", "ln_pop_N1")
    return float(-SECOND_RADIATION_CONSTANT / np.polyfit(energy, population, 1)[0])


def angles(context: Context) -> PaperSection:
    """Figures 9 and 10, Eq. 5."""
    centre, edge = (Telescope.from_name("lsst").trace(field) for field in (0.0, EDGE_DEG))
    hsc = Telescope.from_name("hsc").trace(0.0)
    degrees = {name: np.degrees(rays.theta) for name, rays in (("c", centre), ("e", edge), ("h", hsc))}
    curves = []
    for key, label in (("c", "LSST, centre"), ("e", f"LSST, {EDGE_DEG}° off axis"), ("h", "HSC, centre")):
        density, limits = np.histogram(degrees[key], bins=80, range=(0.0, 32.0), density=True)
        curves.append(Curve(0.5 * (limits[1:] + limits[:-1]), density, label))
    convergence = []
    for rays, (_, label) in zip((centre, edge), FIELDS, strict=True):
        converged = _rms(context, rays.beam(BEAM_NODES))
        ratio = [_rms(context, _histogram_beam(rays, bins)) / converged for bins in BINS]
        convergence.append(Curve(np.array(BINS, dtype=float), np.array(ratio), label, "o"))
    return PaperSection(
        "Beams: Figs. 9 and 10, Eq. 5",
        "Angles of incidence traced through the telescopes, and what too few of them do to the sum of Eq. 5.",
        {
            "beam_centre_low": float(degrees["c"].min()),
            "beam_centre_high": float(degrees["c"].max()),
            "beam_edge_low": float(degrees["e"].min()),
            "beam_edge_high": float(degrees["e"].max()),
            "beam_hsc_high": float(degrees["h"].max()),
            "angle_bins": float(convergence[0].y[BINS.index(50)]),
        },
        (
            _paths(),
            Graph("angles of incidence", "angle of incidence [deg]", "density [1/deg]", tuple(curves)),
            Graph(
                "sum over bins of angle",
                "bins",
                "rms fringe / converged",
                tuple(convergence),
                logarithmic=True,
            ),
        ),
        "Light path through the LSST, angles of incidence, and the fringe that too few of them leave.",
    )


def _paths() -> Graph:
    """Figure 9."""
    curves = tuple(_light_path(field, label) for field, label in FIELDS)
    return Graph("light path", "from the axis [m]", "along the axis [m]", curves)


def _light_path(field_deg: float, label: str) -> Curve:
    """Rays in a plane through the axis of the LSST, from before its mirrors to the sensor, one after the other."""
    optic = batoid_optic("LSST_y.yaml")
    radius = 0.5 * optic.pupilSize * np.linspace(optic.pupilObscuration, 1.0, PATH_RAYS + 2)[1:-1]
    start = np.concatenate([-radius, radius])
    rays = batoid.RayVector.fromStop(
        start,
        np.zeros(start.size),
        optic=optic,
        wavelength=960e-9,
        theta_x=math.radians(field_deg),
        theta_y=0.0,
    )
    ground = batoid.CoordSys()
    met = [rays.copy(), *(step["out"].copy() for step in optic.traceFull(rays).values())]
    places = np.stack([each.toCoordSys(ground).r for each in met], axis=1)
    arrived = ~(met[-1].vignetted | met[-1].failed)
    # A gap after each ray parts it from the next.
    drawn = np.pad(places[arrived], ((0, 0), (0, 1), (0, 0)), constant_values=math.nan).reshape(-1, 3)
    return Curve(drawn[:, 0], drawn[:, 2], label)


def _histogram_beam(rays: RayBundle, bins: int) -> Beam:
    """Beam of a few bins of angle, each at its left edge."""
    count, limits = np.histogram(rays.theta, bins=bins)
    return Beam(limits[:-1], count / count.sum())


def _rms(context: Context, beam: Beam) -> float:
    """Rms fringe of the OH lines in a beam, in the centre of the LSST field."""
    model = FringeModel.from_setup(context.setup("lsst_e2v"))
    components = SkySpectrum(EmissionLines.oh(), airmass=1.2).components(Bandpass.from_name("lsst_y"))
    wavelength = np.concatenate([item.wavelength_nm for item in components])
    photons = np.concatenate([item.photons for item in components])
    # A thousand lines of any strength: those below 1e-4 of the strongest carry nothing.
    strong = photons > 1e-4 * photons.max()
    light = Illumination.spectrum(wavelength[strong], photons[strong], beam)
    layer = np.asarray(context.thickness_um)
    table = model.table_of(light, (float(layer.min()) - 1e-3, float(layer.max()) + 1e-3), tolerance=1e-5)
    return fringe_amplitudes(table.lookup(layer)[0]).rms


def photon_walk(context: Context) -> PaperSection:
    """Section 4.2, Figure 11."""
    setup = context.setup("lsst_e2v")
    light = SkySpectrum(EmissionLines.oh()).components(Bandpass.from_name("lsst_y"))
    widths = np.linspace(0.5, 20.0, 40)
    values, curves = {}, []
    for field_deg, label in ((0.0, "field centre"), (EDGE_DEG, f"{EDGE_DEG}° off axis")):
        rays = Telescope.from_name("lsst").trace(field_deg)
        walk = photon_migration(rays, light, setup.stack, setup.temperature_k)
        share = np.array([walk.fraction_inside(float(width)) for width in widths])
        curves.append(Curve(widths, PERCENT * share, label))
        if field_deg > 0.0:
            values["walk_edge"] = PERCENT * walk.fraction_inside(10.0)
            values["walk_pixel"] = PERCENT * walk.fraction_inside(5.0)
    return PaperSection(
        "Photons in the silicon: section 4.2, Fig. 11",
        "How far photons walk sideways before they are absorbed.",
        values,
        (Graph("inside a square", "half width [µm]", "photons [%]", tuple(curves)),),
        "A pixel has a half width of 5 µm.",
    )
