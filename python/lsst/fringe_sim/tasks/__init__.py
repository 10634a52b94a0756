"""PipelineTasks, one per file: they fetch, call one algorithm, and store what it returns.

Each is imported on first use. Importing this package makes the storage classes known that their connections name.
"""

from __future__ import annotations

from ..lazy import on_first_use
from ..middleware import register_storage_classes

register_storage_classes()

_LAZY = {
    "EffectDiscoveryConfig": ".effect_discovery",
    "EffectDiscoveryTask": ".effect_discovery",
    "EpoxyFitConfig": ".epoxy_fit",
    "EpoxyFitTask": ".epoxy_fit",
    "FocalPlaneSummaryConfig": ".focal_plane_summary",
    "FocalPlaneSummaryTask": ".focal_plane_summary",
    "FringeBiasConfig": ".fringe_bias",
    "FringeBiasTask": ".fringe_bias",
    "FringeCorrectionConfig": ".fringe_correction",
    "FringeCorrectionTask": ".fringe_correction",
    "FringeForecastConfig": ".fringe_forecast",
    "FringeForecastTask": ".fringe_forecast",
    "FringeModelConfig": ".model_config",
    "FringePcaConfig": ".fringe_pca",
    "FringePcaTask": ".fringe_pca",
    "IsrFlatPrepConfig": ".isr_flat_prep",
    "IsrFlatPrepTask": ".isr_flat_prep",
    "MapTemplatesConfig": ".map_templates",
    "MapTemplatesTask": ".map_templates",
    "ObservedFringeConfig": ".observed_fringe",
    "ObservedFringeTask": ".observed_fringe",
    "RaftConfig": ".model_config",
    "SensorConfig": ".model_config",
    "SkyEffectDiscoveryConfig": ".effect_discovery",
    "SkyEffectDiscoveryTask": ".effect_discovery",
    "SkyFringeSimConfig": ".sky_fringe_sim",
    "SkyFringeSimTask": ".sky_fringe_sim",
    "UnusableDataError": ".quantum",
}

__all__ = sorted(_LAZY)  # pyright: ignore[reportUnsupportedDunderAll]
__getattr__ = on_first_use(__name__, _LAZY)
