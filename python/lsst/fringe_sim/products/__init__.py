"""What travels between stages: frozen, validated on construction, and the same after a trip to disk.

Each product has ``write_fits(path, metadata=None)`` and ``read_fits(path)``. Files are written whole or not
at all, carry checksums, and two writes of one product agree to the byte.
"""

from ..resources import DAMAGE
from .combined_bias import CombinedBias
from .flat_exposures import FlatExposures
from .flat_fit import FlatFit
from .fringe_components import FringeComponents
from .fringe_cube import CUBE_UNITS, FringeCube
from .fringe_flat import FringeFlat
from .fringe_frame import FringeFrame
from .fringe_templates import FringeTemplates
from .mask import MASK_PLANES, describe_mask, mask_bits
from .observed_frame import ObservedFrame
from .plain_flats import read_plain_flats
from .sensor_section import SensorSection
from .sky_frame import (
    CORRECTED,
    NOISE,
    SKY_UNITS,
    SkyFringe,
    band_cards,
    bands_of_header,
    refuse_corrected,
    refuse_noiseless,
)
from .sky_frames import SkyFrames
from .thickness_map import ThicknessMap

__all__ = [
    "CORRECTED",
    "CUBE_UNITS",
    "DAMAGE",
    "MASK_PLANES",
    "NOISE",
    "SKY_UNITS",
    "CombinedBias",
    "FlatExposures",
    "FlatFit",
    "FringeComponents",
    "FringeCube",
    "FringeFlat",
    "FringeFrame",
    "FringeTemplates",
    "ObservedFrame",
    "SensorSection",
    "SkyFrames",
    "SkyFringe",
    "ThicknessMap",
    "band_cards",
    "bands_of_header",
    "describe_mask",
    "mask_bits",
    "read_plain_flats",
    "refuse_corrected",
    "refuse_noiseless",
]
