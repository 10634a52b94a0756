"""Make the picture of the README: a measured sensor, and what it does to the night sky."""

from __future__ import annotations

from pathlib import Path

from lsst.fringe_sim.algorithms.sky_frame import simulate_sky_frame
from lsst.fringe_sim.files import write_whole
from lsst.fringe_sim.mock.thickness import e2v_321
from lsst.fringe_sim.model import FringeModel
from lsst.fringe_sim.style import figure, show_image, to_png

TARGET = Path(__file__).resolve().parents[1] / "doc" / "_static" / "readme.png"


def main() -> None:
    """Write ``doc/_static/readme.png``."""
    thickness = e2v_321()
    flat = FringeModel.from_setup("ts8_e2v").response(thickness[::8, ::8], [960.0])[0]
    sky = simulate_sky_frame(thickness, FringeModel.from_setup("lsst_e2v"))
    with figure(13.0, 3.9) as made:
        left, middle, right = made.subplots(1, 3)
        show_image(left, thickness, label="adhesive [µm]", title="E2V-CCD250-321")
        show_image(
            middle,
            100.0 * (flat / flat.mean() - 1.0),
            diverging=True,
            label="flat / mean - 1 [%]",
            title="960 nm flat, every 8th pixel",
        )
        show_image(
            right,
            100.0 * (sky.image / sky.mean_electrons - 1.0),
            diverging=True,
            label="sky / mean - 1 [%]",
            title="y-band sky, centre of the LSST field",
        )
        TARGET.parent.mkdir(parents=True, exist_ok=True)
        write_whole(TARGET, to_png(made))


if __name__ == "__main__":
    main()
